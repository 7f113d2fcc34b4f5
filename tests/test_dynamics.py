"""The regression of the dynamics, and the expected features that it gives."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import kreps
from kreps.algorithms.streaming import PredictedSuccessors, StateFeatures
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, as_float
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.kernels.regression import FeatureRegression, KernelEmbedding
from kreps.models.dynamics import (
    DeltaStateTargets,
    Dynamics,
    expected_features_of_samples,
    fit_dynamics,
    linear_least_squares,
    state_changes,
)
from kreps.models.terminations import Terminations, fit_terminations
from kreps.models.transition import state_actions, state_kernel

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]))


def pushes(
    rollouts: int = 10, steps: int = 20, noise: float = 0.0, ended: bool = False, seed: int = 0
) -> Transitions:
    """A mass with friction on a line, pushed at random: linear, but for its noise."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(rollouts):
        states = [rng.normal(size=2)]
        actions = rng.normal(0.0, 2.0, size=(steps, 1))
        for force in TASK.clip(actions)[:, 0]:
            velocity = 0.9 * states[-1][1] + 0.3 * force + noise * rng.normal()
            states.append(np.array([states[-1][0] + 0.3 * velocity, velocity]))
        rewards = np.zeros(steps)
        found.append(Rollout(np.array(states), actions, rewards, ended and number % 2 == 0))
    return Transitions.from_rollouts(found)


def basis_of(data: Transitions, task: TaskSpec = TASK) -> tuple[Kernel, RKHSBasis, FloatArray]:
    kernel = state_kernel(data, task, np.random.default_rng(0))
    return kernel, *RKHSBasis.fit(kernel, data.points, tolerance=1e-8, max_rank=200)


def test_changes_of_angles_are_wrapped() -> None:
    task = TaskSpec(2, np.array([-1.0]), np.array([1.0]), periodic=(0,))
    observations = np.array([[3.0, 3.0], [-3.0, -3.0], [3.0, 3.0]])
    data = Transitions.from_rollouts([Rollout(observations, np.zeros((2, 1)), np.zeros(2))])
    short = 2.0 * np.pi - 6.0
    np.testing.assert_allclose(state_changes(data, task), [[short, -6.0], [-short, 6.0]])


def test_coordinates_that_share_a_lengthscale_share_a_scale() -> None:
    task = TaskSpec(4, np.array([-1.0]), np.array([1.0]), groups=((0, 1),))
    observations = np.zeros((3, 4))
    observations[:, 0] = 0.0, 3.0, 0.0
    observations[:, 1] = 0.0, 4.0, 0.0
    observations[:, 2] = 0.0, 0.5, 1.0  # and the last one is constant
    data = Transitions.from_rollouts(
        [Rollout(observations, np.zeros((2, 1)), np.zeros(2), terminated=True)]
    )
    delta_targets = DeltaStateTargets.fit(data, task)
    np.testing.assert_allclose(delta_targets.scale, [12.5**0.5, 12.5**0.5, 0.5, 1.0])
    targets = delta_targets.targets(data, task)
    np.testing.assert_allclose(delta_targets.changes(targets), state_changes(data, task))
    assert not len(delta_targets.linear_mean.used)  # two samples are too few for a linear mean


def test_the_linear_mean_of_pictures_needs_no_square_of_their_pixels() -> None:
    pixels = 8000  # whose square takes 512 MB
    task = TaskSpec(pixels, np.array([-1.0]), np.array([1.0]), groups=(tuple(range(pixels)),))
    rng = np.random.default_rng(0)
    data = Transitions.from_rollouts(
        [Rollout(rng.normal(size=(21, pixels)), rng.normal(size=(20, 1)), rng.normal(size=20))]
    )
    tracemalloc.start()
    targets = DeltaStateTargets.fit(data, task).targets(data, task)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert targets.shape == (20, pixels)
    assert peak < 50e6


def test_linear_dynamics_are_predicted_by_the_linear_mean() -> None:
    data = pushes(20)
    delta_targets = DeltaStateTargets.fit(data, TASK)
    assert np.abs(delta_targets.targets(data, TASK)).max() < 0.02  # 400 samples, and a ridge of one
    # which extrapolates
    inputs = np.array([[50.0, 40.0, 1.0]])
    np.testing.assert_allclose(
        delta_targets.changes(delta_targets.linear_mean(inputs)),
        [[0.3 * 36.6, -4.0 + 0.6]],
        rtol=0.01,
    )


def test_actions_that_hardly_vary_have_no_slope() -> None:
    """Without a ridge the slope would be determined by one action of 500."""
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=500), np.ones(500)
    actions[17] = 0.967
    changes = -0.2 * states + 0.2 * actions + 0.1 * rng.normal(size=500)
    task = TaskSpec(1, np.array([-1.0]), np.array([1.0]))
    mean = linear_least_squares(np.column_stack([states, actions]), changes[:, None], task)
    assert mean.used.tolist() == [0, 1]
    assert mean.slopes[0, 0] == pytest.approx(-0.2, abs=0.02)
    assert abs(mean.slopes[1, 0]) < 0.02


def test_angles_have_no_slopes() -> None:
    task = TaskSpec(2, np.array([-2.0]), np.array([2.0]), periodic=(0,))
    mean = DeltaStateTargets.fit(pushes(20, ended=True), task).linear_mean
    assert mean.used.tolist() == [1, 2]
    assert mean.slopes.all()


def test_a_constant_coordinate_has_no_slope() -> None:
    rng = np.random.default_rng(0)
    inputs = np.column_stack([rng.normal(size=50), np.full(50, 0.1) * 3.0, np.zeros(50)])
    mean = linear_least_squares(inputs, 2.0 * inputs[:, :1] + 1.0, TASK)
    assert mean.used.tolist() == [0]
    np.testing.assert_allclose(mean.slopes, [[2.0]], atol=1e-5)
    np.testing.assert_allclose(mean.constants, [1.0], atol=1e-5)


@pytest.mark.parametrize(("samples", "linear"), [(29, False), (30, True)])
def test_the_linear_mean_needs_ten_samples_for_each_of_its_coefficients(
    samples: int, linear: bool
) -> None:
    # a constant and two slopes: the third input never changes, the angle has no slope
    task = TaskSpec(3, np.array([-1.0]), np.array([1.0]), periodic=(1,))
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(samples, 4))
    inputs[:, 2] = 0.3
    mean = linear_least_squares(inputs, inputs[:, :1], task)
    assert mean.used.tolist() == ([0, 3] if linear else [])
    np.testing.assert_allclose(mean.slopes[:1], [[1.0]] if linear else np.empty((0, 1)), atol=1e-5)
    assert mean(inputs).any() == linear


@pytest.mark.parametrize(("steps", "linear"), [(19, False), (20, True)])
def test_the_targets_have_a_linear_mean_from_forty_samples_on_a_line(
    steps: int, linear: bool
) -> None:
    # a constant, and the slopes of position, velocity and force
    assert bool(len(DeltaStateTargets.fit(pushes(2, steps), TASK).linear_mean.used)) == linear


def test_without_noise_successors_of_other_actions_are_predicted() -> None:
    data = pushes()
    kernel, basis, features = basis_of(data)
    dynamics, _, _ = fit_dynamics(data, kernel, TASK, None, np.random.default_rng(1))
    assert np.abs(dynamics.residuals).max() < 1e-2
    actions = np.random.default_rng(2).uniform(-2.0, 2.0, size=len(data))
    velocity = 0.9 * data.states[:, 1] + 0.3 * actions
    successors = np.stack([data.states[:, 0] + 0.3 * velocity, velocity], axis=1)
    inputs = np.column_stack([data.states, actions / 2.0])
    rows = np.arange(len(data))
    found = dynamics.expected_features(basis, features[0], rows, inputs)
    np.testing.assert_allclose(found, basis.features(successors), atol=5e-3)
    assert np.abs(found - features[data.successor]).max() > 0.1  # other actions, other successors


def exact_dynamics(data: Transitions, kernel: Kernel) -> tuple[Dynamics, KernelEmbedding]:
    """The dynamics with all samples as pivots, and their embedding."""
    _, x, _ = fit_dynamics(data, kernel, TASK, None, np.random.default_rng(1))
    factors = (*kernel.factors, SquaredExponential((2,)))
    whole = Kernel(factors, np.exp(x[:-1]))
    model = KernelEmbedding.fit(whole, state_actions(data, TASK), float(np.exp(x[-1])))
    delta_targets = DeltaStateTargets.fit(data, TASK)
    targets = delta_targets.targets(data, TASK)
    residuals = model.leave_one_out(targets).errors
    return Dynamics(delta_targets, model.predictor(targets), residuals), model


def test_few_pivots_predict_as_all_samples_do() -> None:
    data = pushes(noise=0.3)
    kernel, _, _ = basis_of(data)
    dynamics, _, jitter = fit_dynamics(data, kernel, TASK, None, np.random.default_rng(1))
    exact, _ = exact_dynamics(data, kernel)
    assert jitter == 0.0
    inputs = state_actions(data, TASK)
    np.testing.assert_allclose(dynamics.predict(inputs)[0], exact.predict(inputs)[0], atol=1e-3)
    np.testing.assert_allclose(dynamics.residuals, exact.residuals, atol=1e-3)


def test_expected_features_of_taken_actions_average_the_observation_and_its_mirror_image() -> None:
    data = pushes(noise=0.3)
    kernel, basis, features = basis_of(data)
    dynamics, model = exact_dynamics(data, kernel)
    own, after = features[data.state], features[data.successor]
    start = features[data.start].mean(axis=0)
    expected, errors = expected_features_of_samples(data, basis, own, after, start, dynamics, TASK)
    # the predictions of refits without one sample each
    targets = dynamics.delta_targets.targets(data, TASK)
    for i in range(0, len(data), 17):
        rest = np.arange(len(data)) != i
        refit = type(model).fit(model.kernel, model.inputs[rest], model.regulariser)
        predicted = refit.strengths(model.inputs[i : i + 1])[:, 0] @ targets[rest]
        predicted += dynamics.delta_targets.linear_mean(model.inputs[i : i + 1])[0]
        predict = data.states[i] + dynamics.delta_targets.changes(predicted[None])
        mirrored = 2.0 * predict - data.points[data.successor[i]]
        np.testing.assert_allclose(
            expected[i], 0.5 * (after[i] + basis.features(mirrored)[0]), atol=1e-6
        )
        np.testing.assert_allclose(
            errors.errors[i], after[i] - basis.features(predict)[0], atol=1e-6
        )
        np.testing.assert_array_equal(errors.targets[i], after[i] - own[i])


def test_the_expectation_includes_the_variance_of_the_noise() -> None:
    """Where features are nearly quadratic, their expectation is right on average."""
    noise = 0.2
    data = pushes(60, 20, noise=noise)
    kernel, _, _ = basis_of(data)
    wide = kernel.with_lengthscales(np.array([1e3, 5.0]))
    basis = RKHSBasis(velocity_alone(wide), np.zeros((1, 2)), np.eye(1), 0.0)
    dynamics, _, _ = fit_dynamics(data, kernel, TASK, None, np.random.default_rng(1))
    inputs, rows = state_actions(data, TASK), np.arange(len(data))
    found = dynamics.expected_features(basis, np.zeros(1), rows, inputs)[:, 0]
    velocity = 0.9 * data.states[:, 1] + 0.3 * TASK.clip(data.actions)[:, 0]
    # E exp(-v^2 / (2 l^2)) of a normal v
    variance = 25.0 + noise**2
    wanted = 5.0 / variance**0.5 * np.exp(-0.5 * velocity**2 / variance)
    without_noise = np.exp(-0.5 * velocity**2 / 25.0)
    assert abs(np.mean(found - wanted)) < 0.2 * abs(np.mean(without_noise - wanted))


def velocity_alone(kernel: Kernel) -> Kernel:
    """The velocity alone."""
    return Kernel((SquaredExponential((1,)),), kernel.lengthscales[1:])


def test_a_termination_leads_to_the_restart() -> None:
    data = pushes(ended=True)
    kernel, basis, features = basis_of(data)
    start = features[data.start].mean(axis=0)
    dynamics, _, _ = fit_dynamics(data, kernel, TASK, None, np.random.default_rng(1))

    def always(successors: FloatArray) -> FloatArray:
        return np.full((len(successors), 1), 1.7)  # a probability above one

    certain = replace(dynamics, terminations=Terminations(always, np.zeros(len(data)), 0.0))
    found = certain.expected_features(basis, start, np.arange(9), state_actions(data, TASK)[:9])
    np.testing.assert_allclose(found, np.tile(start, (9, 1)), atol=1e-12)


def test_random_terminations_are_expected_of_every_step() -> None:
    """Leave-one-out, a terminated step is as likely to terminate as any, which is an error."""
    rng = np.random.default_rng(0)
    rollouts = []
    for _ in range(400):
        observations = rng.normal(size=(2, 2))
        observations[1] = 0.9 * observations[0]
        ended = bool(rng.uniform() < 0.3)
        rollouts.append(Rollout(observations, rng.normal(size=(1, 1)), np.zeros(1), ended))
    data = Transitions.from_rollouts(rollouts)
    kernel, basis, features = basis_of(data)
    start = np.full(features.shape[1], 9.0)
    dynamics, _, _ = fit_dynamics(data, kernel, TASK, None, np.random.default_rng(1))
    own, observed = features[data.state], features[data.successor]
    expected, errors = expected_features_of_samples(
        data, basis, own, observed, start, dynamics, TASK
    )
    share = np.mean((expected - observed) / (start - observed), axis=1)
    assert share[data.terminated].mean() == pytest.approx(0.3, abs=0.06)
    assert share[~data.terminated].mean() == pytest.approx(0.3, abs=0.06)
    after = np.where(data.terminated[:, None], start, observed)
    np.testing.assert_allclose(errors.targets, after - own)
    # of a probability p: p (1 - p) times the squared distance
    wanted = 0.21 * np.mean(np.sum((start - observed) ** 2, axis=1))
    assert errors.mean_square == pytest.approx(wanted, rel=0.15)


def test_terminations_beyond_a_line_are_predicted() -> None:
    """The task terminates where the position exceeds 0.5."""
    rng = np.random.default_rng(0)
    rollouts = []
    for _ in range(150):
        observations = rng.uniform(-1.0, 1.0, size=(2, 2))
        action = rng.uniform(-2.0, 2.0, size=(1, 1))
        observations[1] = observations[0] + [0.5 * action[0, 0], 0.0]
        rollouts.append(Rollout(observations, action, np.zeros(1), observations[1, 0] > 0.5))
    data = Transitions.from_rollouts(rollouts)
    kernel, basis, _ = basis_of(data)
    dynamics, _, _ = fit_dynamics(data, kernel, TASK, None, np.random.default_rng(1))
    far, near = (dynamics.predict(np.array([[0.0, 0.0, a]]))[1][0] for a in (0.9, -0.9))
    assert far > 0.7 > 0.3 > near
    start = np.full(basis.lower.shape[0], 9.0)
    inputs = np.array([[0.0, 0.0, 0.9], [0.0, 0.0, -0.9]])
    found = dynamics.expected_features(basis, start, np.zeros(2, dtype=np.intp), inputs)
    assert found[0].mean() > 6.0 > 3.0 > found[1].mean()


def test_many_inputs_are_predicted_in_batches() -> None:
    data = pushes(noise=0.1)
    kernel, basis, features = basis_of(data)
    dynamics, _, _ = fit_dynamics(data, kernel, TASK, None, np.random.default_rng(1))
    rows = np.random.default_rng(3).integers(len(data), size=2048 + 7)
    inputs = state_actions(data, TASK)[rows]
    found = dynamics.expected_features(basis, features[0], rows, inputs)
    last = dynamics.expected_features(basis, features[0], rows[-7:], inputs[-7:])
    np.testing.assert_allclose(found[-7:], last, atol=1e-12)


@pytest.mark.parametrize("ended", [False, True])
def test_expected_features_of_chunks_average_the_observation_and_its_mirror_image(
    ended: bool,
) -> None:
    data = pushes(noise=0.3, ended=ended)
    kernel, basis, features = basis_of(data)
    dynamics, model = exact_dynamics(data, kernel)
    start = features[data.start].mean(axis=0)
    regression = FeatureRegression(dynamics.regression, 0.0)
    state_features = StateFeatures(basis, start, as_float)
    terminations = fit_terminations(data, kernel, np.random.default_rng(3))
    assert (terminations is not None) == ended
    own, expected = PredictedSuccessors(
        state_features, dynamics.delta_targets, regression, TASK, terminations
    )(data)
    np.testing.assert_allclose(own, features[data.state], atol=1e-8)
    predicted = model.expected_features(dynamics.delta_targets.targets(data, TASK))
    predicted += dynamics.delta_targets.linear_mean(state_actions(data, TASK))
    predict = data.states + dynamics.delta_targets.changes(predicted)
    mirrored = basis.features(2.0 * predict - data.points[data.successor])
    spread = 0.5 * (features[data.successor] + mirrored)
    if terminations is not None:  # from the observed successor
        ends = terminations.probabilities(data.points[data.successor])[:, None]
        assert ends.max() > 0.01
        spread = spread + ends * (start - spread)
    np.testing.assert_allclose(expected, spread, atol=1e-6)


def test_rounding_errors_are_not_scaled_up() -> None:
    still = 1.0 + 3e-16 * np.random.default_rng(0).integers(-1, 2, size=(4, 1))
    observations = np.column_stack([np.arange(4.0), still])
    data = Transitions.from_rollouts([Rollout(observations, np.zeros((3, 1)), np.zeros(3))])
    np.testing.assert_allclose(DeltaStateTargets.fit(data, TASK).scale, [1.0, 1.0])


def test_the_default_model_is_the_dynamics() -> None:
    assert kreps.KREPS(TASK).settings.model == "dynamics"


def test_the_model_of_a_state_that_is_held_knows_the_others() -> None:
    """Nine of ten samples are at rest: their median distance says nothing about those that move."""
    rng = np.random.default_rng(0)

    def steps(count: int, spread: FloatArray) -> Transitions:
        """Steps of a stiff spring, one for each rollout."""
        found = []
        for scale in np.broadcast_to(spread, count):
            (position, speed), force = scale * rng.normal(size=2), rng.uniform(-2.0, 2.0)
            speed_after = speed - 0.5 * np.sin(2.0 * position) + 0.1 * force
            after = np.array([position + 0.1 * speed_after, speed_after])
            states = np.stack([[position, speed], after])
            found.append(Rollout(states, np.full((1, 1), force), np.zeros(1)))
        return Transitions.from_rollouts(found)

    held = steps(500, np.where(np.arange(500) % 10 == 0, 1.0, 1e-3))
    moving = steps(100, np.ones(1))
    median = Kernel(TASK.state_factors, np.array([2e-3, 2e-3]))
    dynamics, _, _ = fit_dynamics(held, median, TASK, None, np.random.default_rng(1))
    successors, _ = dynamics.predict(state_actions(moving, TASK))
    error = np.mean((successors - moving.points[moving.successor]) ** 2, axis=0)
    assert np.all(error < 0.02 * np.var(moving.points[moving.successor] - moving.states, axis=0))
