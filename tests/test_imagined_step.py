"""The second step: what is drawn, what the model says of it, and what the policy makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.algorithms import generated as imagined_step
from kreps.algorithms import low_rank, reps
from kreps.algorithms.dual import MIN_ETA, DualProblem, effective_sample_size, standardise
from kreps.algorithms.generated import GeneratedSamples, generate
from kreps.algorithms.reps import (
    MIN_RELATIVE_WEIGHT,
    MIN_RIDGE,
    PolicyTargets,
    UpdateInfo,
    fit_policy,
    share_clipped,
    stationarity_ridge,
    value_basis,
)
from kreps.algorithms.state import Stopwatch
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels import regression as embedding
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.basis import Basis, RKHSBasis
from kreps.kernels.hyperparameters import Prior, minimise
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.kernels.regression import FeatureRegression, KernelEmbedding, LeaveOneOut, RegressionSums
from kreps.models import transition as transition_model
from kreps.models.dynamics import DeltaStateTargets
from kreps.models.transition import (
    feature_differences,
    fit_embedding,
    restart_features,
    state_actions,
    state_kernel,
)
from kreps.models.world_model import WorldModel
from kreps.policies import cost_sensitive_gp as policies
from kreps.policies.base import StochasticPolicy
from kreps.policies.sparse_gp import PolicySums, SparseGP
from kreps.settings import Settings, settings_of

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]))


def pushes(
    rollouts: int = 8, steps: int = 15, seed: int = 0, terminated: bool = False
) -> list[Rollout]:
    """A mass with friction on a line, pushed at random, often beyond the limits."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(rollouts):
        states = [np.array([rng.normal(), 0.0])]
        actions = rng.normal(0.0, 2.0, size=(steps, 1))
        for force in TASK.clip(actions)[:, 0]:
            velocity = 0.9 * states[-1][1] + 0.3 * force + 0.05 * rng.normal()
            states.append(np.array([states[-1][0] + 0.3 * velocity, velocity]))
        observations = np.array(states)
        rewards = -(observations[:-1, 0] ** 2) - 0.1 * observations[:-1, 1] ** 2
        rewards -= 0.01 * TASK.clip(actions)[:, 0] ** 2
        found.append(Rollout(observations, actions, rewards, terminated and number % 2 == 0))
    return found


def updated(
    given: list[Rollout] | Dataset, seed: int = 0, **settings: Any
) -> tuple[kreps.KREPS, UpdateInfo]:
    learner = kreps.KREPS(TASK, seed=seed, **settings)
    info = learner.update(given)
    assert isinstance(info, UpdateInfo)
    return learner, info


# ---- what the model says of them --------------------------------------------------------------


@dataclass
class Given:
    """A policy whose actions are given, whatever the states; it keeps what it was asked."""

    actions: FloatArray
    states: FloatArray | None = None

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        assert noise.shape == self.actions.shape
        self.states = states
        return self.actions


@dataclass(frozen=True)
class Case:
    """Everything that the first step has before it solves its dual."""

    data: Transitions
    settings: Settings
    basis: Basis
    features: FloatArray
    rewards: FloatArray
    expectation: reps.Expectation
    reward: Callable[[FloatArray], FloatArray]

    @classmethod
    def of(cls, **changes: Any) -> Case:
        rng = np.random.default_rng(5)
        settings = settings_of("default", **changes)
        data = Transitions.from_rollouts(pushes(terminated=True))
        kernel = state_kernel(data, TASK, rng)
        basis, features = value_basis(data, kernel, settings)
        expectation = reps.expected_successors(
            data, basis, features, kernel, TASK, settings, None, rng, Stopwatch()
        )
        rewards, _ = standardise(data.rewards)
        targets = (rewards - rewards.mean())[:, None]
        regression, _ = fit_embedding(data, targets, kernel, TASK, None, rng)
        reward = regression.predictor(targets)
        return cls(data, settings, basis, features, rewards, expectation, reward)

    def world(self, reward: Callable[[FloatArray], FloatArray] | None = None) -> WorldModel:
        assert self.expectation.for_actions is not None
        return WorldModel(
            states=self.data.states,
            features=self.features[self.data.state],
            phi=self.basis.features,
            restart=restart_features(
                self.features[self.data.start].mean(axis=0),
                self.features[self.data.state].mean(axis=0),
                self.settings,
            ),
            rewards=self.rewards,
            expected_features_at=self.expectation.for_actions,
            reward=self.reward if reward is None else reward,
            model_env=None,
            bonus=None,
        )

    def from_generated(
        self, policy: StochasticPolicy, weights: FloatArray | None = None, **changes: Any
    ) -> GeneratedSamples:
        """With uniform weights, if none are given, and a ridge of 0.3."""
        n = len(self.data)
        return generate(
            self.world(changes.pop("reward", None)),
            np.full(n, 1.0 / n) if weights is None else weights,
            policy,
            TASK,
            replace(self.settings, **changes),
            0.3,
            np.random.default_rng(6),
        )


@pytest.mark.parametrize("model", ["change", "embedding"])
def test_of_the_observed_actions_the_model_says_what_the_first_step_was_told(model: Any) -> None:
    case = Case.of(model=model)
    data = case.data
    found = case.from_generated(Given(data.actions), from_generated=1)
    np.testing.assert_array_equal(found.states[found.of], data.states)
    np.testing.assert_array_equal(found.actions, data.actions)
    p = case.settings.restart_probability
    world = case.world()
    wanted = feature_differences(world.features, case.expectation.expected, world.restart, p)
    assert np.abs(wanted).max() > 0.1
    np.testing.assert_allclose(found.problem.differences, wanted, atol=1e-8)
    said = case.rewards.mean() + world.reward(state_actions(data, TASK))[:, 0]
    said = np.clip(said, case.rewards.min(), case.rewards.max())
    np.testing.assert_allclose(found.problem.rewards, said - said.max(), atol=1e-8)
    assert np.corrcoef(said, case.rewards)[0, 1] > 0.9


def test_the_bounds_are_those_of_the_settings() -> None:
    case = Case.of(kl_bound=0.4, eta_floor=0.07)
    n = len(case.data)
    policy = Given(np.zeros((3 * n, 1)))
    problem = case.from_generated(policy, from_generated=3).problem
    assert (problem.kl_bound, problem.eta_floor) == (0.4, 0.07)
    assert problem.ridge == pytest.approx(0.3 / (3 * n), rel=1e-12)
    assert case.from_generated(policy, from_generated=3, eta_floor=0.0).problem.eta_floor == MIN_ETA


def test_actions_are_drawn_in_the_states_of_the_weights() -> None:
    case = Case.of(from_generated=2)
    n = len(case.data)
    weights = np.zeros(n)
    weights[[3, 11]] = 0.25, 0.75
    policy = Given(np.zeros((2 * n, 1)))
    found = case.from_generated(policy, weights)
    np.testing.assert_array_equal(found.states, case.data.states[[3, 11]])
    np.testing.assert_array_equal(np.bincount(found.of), [n // 2, 3 * n // 2])
    np.testing.assert_array_equal(policy.states, found.states[found.of])


def test_the_model_is_asked_about_the_applied_actions_and_the_commanded_ones_are_kept() -> None:
    case = Case.of(from_generated=1)
    n = len(case.data)
    commanded = np.linspace(-5.0, 5.0, n)[:, None]
    asked: list[FloatArray] = []

    def reward(inputs: FloatArray) -> FloatArray:
        asked.append(inputs)
        return np.zeros((len(inputs), 1))

    found = case.from_generated(Given(commanded), reward=reward)
    np.testing.assert_array_equal(found.actions, commanded)
    (inputs,) = asked
    np.testing.assert_array_equal(inputs[:, :2], case.data.states)
    np.testing.assert_allclose(inputs[:, 2], np.clip(commanded[:, 0], -2.0, 2.0) / 2.0)


def test_no_reward_beyond_the_observed_ones_is_believed() -> None:
    case = Case.of(from_generated=1)
    n = len(case.data)
    overshooting = np.linspace(-100.0, 100.0, n)
    found = case.from_generated(
        Given(np.zeros((n, 1))), reward=lambda inputs: overshooting[:, None]
    )
    rewards = found.problem.rewards
    assert rewards.max() == 0.0
    assert rewards.min() == pytest.approx(-np.ptp(case.rewards))
    wanted = np.clip(case.rewards.mean() + overshooting, case.rewards.min(), case.rewards.max())
    np.testing.assert_allclose(rewards, wanted - wanted.max(), atol=1e-12)


@pytest.mark.parametrize("spread", [0.5, 3.0, 50.0])
def test_predicted_rewards_stay_within_the_observed_range(spread: float) -> None:
    case = Case.of(from_generated=5)
    actions = spread * np.random.default_rng(7).normal(size=(5 * len(case.data), 1))
    rewards = case.from_generated(Given(actions)).problem.rewards
    assert rewards.max() == 0.0
    assert rewards.min() >= -np.ptp(case.rewards) - 1e-12


def test_no_more_is_imagined_than_fits_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imagined_step, "MAX_GENERATED", 37)
    case = Case.of(from_generated=4)
    found = case.from_generated(Given(np.zeros((37, 1))))
    assert len(found.of) == len(found.actions) == len(found.problem.rewards) == 37
    assert found.problem.differences.shape == (37, case.features.shape[1])
    assert found.problem.ridge == pytest.approx(0.3 / 37)
    _, info = updated(pushes(), imagined_rollouts=0.0)
    assert (info.samples, len(info.dual.weights)) == (120, 37)
    _, info = updated(pushes())  # half of them in each place
    assert len(info.dual.weights) == 18


# ---- the ridge that the model asks for --------------------------------------------------------


def errors_of_refits(model: KernelEmbedding, targets: FloatArray) -> FloatArray:
    """Each target less what a model of all other samples says of it."""
    errors = []
    for i in range(len(targets)):
        rest = np.arange(len(targets)) != i
        refit = KernelEmbedding.fit(model.kernel, model.inputs[rest], model.regulariser)
        errors.append(targets[i] - refit.strengths(model.inputs[i : i + 1])[:, 0] @ targets[rest])
    return np.array(errors)


@pytest.mark.parametrize("model", ["dynamics", "change"])
def test_the_ridge_is_the_error_of_refits_without_each_sample(model: Any) -> None:
    rollouts = pushes(6, 12)
    _, info = updated(rollouts, model=model)
    data = Transitions.from_rollouts(rollouts)
    settings = settings_of()
    # the same factors, with the lengthscales that the update reports
    kernel = state_kernel(data, TASK, np.random.default_rng(0))
    kernel = kernel.with_lengthscales(info.state_lengthscales)
    basis, features = value_basis(data, kernel, settings)
    targets = features[data.successor] - features[data.state]
    assert info.embedding_parameters is not None
    *lengthscales, regulariser = info.embedding_parameters
    factors = (*kernel.factors, SquaredExponential((2,)))
    embedding = KernelEmbedding.fit(
        Kernel(factors, np.array(lengthscales)), state_actions(data, TASK), regulariser
    )
    if model == "change":
        errors = errors_of_refits(embedding, targets)
    else:
        delta_targets = DeltaStateTargets.fit(data, TASK)
        loo_residuals = errors_of_refits(embedding, delta_targets.targets(data, TASK))
        predicted = basis.features(
            data.points[data.successor] - delta_targets.changes(loo_residuals)
        )
        errors = features[data.successor] - predicted
    assert info.ridge == pytest.approx(np.mean(np.sum(errors**2, axis=1)), rel=1e-6)
    assert info.ridge > 5.0 * MIN_RIDGE
    share = np.sqrt(np.sum(errors**2) / np.sum(targets**2))
    assert info.model_error == pytest.approx(share, rel=1e-6)


def test_a_ridge_that_is_given_is_taken() -> None:
    for ridge in (0.01, 3.0):
        _, info = updated(pushes(4), ridge=ridge)
        assert info.ridge == ridge
    rng = np.random.default_rng(8)
    errors = LeaveOneOut(rng.normal(size=(9, 3)), rng.normal(size=(9, 3)))
    assert stationarity_ridge(settings_of(), errors) == pytest.approx(errors.mean_square)
    assert stationarity_ridge(settings_of("observed"), None) == 0.1


def test_a_model_without_error_leaves_some_ridge() -> None:
    errors = LeaveOneOut(np.ones((4, 2)), np.zeros((4, 2)))
    assert stationarity_ridge(settings_of(), errors) == MIN_RIDGE
    still = [replace(r, observations=np.full_like(r.observations, 0.3)) for r in pushes(3)]
    learner, info = updated(still)
    assert info.ridge == MIN_RIDGE
    assert info.model_error == 0.0  # nothing was to be predicted
    assert np.isfinite(learner.policy.predict([0.3, 0.3], deterministic=True)[0]).all()


def test_without_a_model_there_is_neither_error_nor_second_step() -> None:
    for approximation in ("exact", "pivoted"):
        _, info = updated(pushes(4), recipe="observed", model="sample", approximation=approximation)
        assert np.isnan(info.model_error)
        assert info.ridge == 0.1
        assert len(info.dual.weights) == info.samples
        assert "imagined step" not in info.seconds


# ---- what the policy is fitted to -------------------------------------------------------------


def test_targets_are_the_weighted_means_of_the_actions_of_each_state() -> None:
    data = Transitions.from_rollouts(pushes(3, 8))
    task = TaskSpec(2, np.array([-2.0, 0.0]), np.array([2.0, 10.0]))
    rng = np.random.default_rng(9)
    rows = np.sort(rng.choice(len(data), 60))
    actions = rng.normal([0.0, 5.0], [2.0, 3.0], size=(60, 2))
    p = np.exp(rng.normal(size=60))
    p[rows == rows[30]] = 1e-9  # one state of no weight at all, and a sample here and there
    p[::7] = 1e-9
    p /= p.sum()
    nothing = DualProblem(np.zeros(60), np.zeros((60, 1)), 1.0, 1.0, 1.0)
    from_generated = GeneratedSamples(data.states, rows, actions, nothing)
    found = PolicyTargets.from_generated(from_generated, p, task)

    scaled = (actions - [0.0, 5.0]) / [2.0, 5.0]
    w = p * effective_sample_size(p)
    kept = 60 * p >= MIN_RELATIVE_WEIGHT
    states = [i for i in np.unique(rows) if kept[rows == i].any()]
    assert rows[30] not in states and 10 < len(states) < len(np.unique(rows))
    np.testing.assert_array_equal(found.states, data.states[states])
    for to_device, i in enumerate(states):
        mine = kept & (rows == i)
        mean = np.average(scaled[mine], axis=0, weights=w[mine])
        spread = np.average((scaled[mine] - mean) ** 2, axis=0, weights=w[mine])
        assert found.weights[to_device] == pytest.approx(w[mine].sum())
        np.testing.assert_allclose(found.targets[to_device], mean, atol=1e-12)
        assert found.target_variance[to_device] == pytest.approx(spread.sum(), abs=1e-12)
    assert found.evidence == pytest.approx(w[kept].sum())


def test_of_one_action_in_each_state_nothing_is_lost() -> None:
    data = Transitions.from_rollouts(pushes(3, 8))
    p = np.random.default_rng(10).uniform(0.01, 2.0, len(data))
    p /= p.sum()
    n = len(data)
    nothing = DualProblem(np.zeros(n), np.zeros((n, 1)), 1.0, 1.0, 1.0)
    wanted = PolicyTargets.of(data, p, TASK)
    found = PolicyTargets.from_generated(
        GeneratedSamples(data.states, np.arange(n), data.actions, nothing), p, TASK
    )
    for name, value in vars(wanted).items():
        np.testing.assert_allclose(getattr(found, name), value, atol=1e-14)


def test_the_spread_of_what_is_imagined_in_a_state_stays_in_the_policy() -> None:
    """Equal actions on average, but some agree and some do not: the noise tells them apart."""
    rng = np.random.default_rng(11)
    states, means = rng.normal(size=(40, 2)), 0.1 * rng.normal(size=(40, 1))
    kernel = Kernel(TASK.state_factors, np.ones(2))
    noise = []
    for target_variance in (0.0, 0.5):
        samples = PolicyTargets(
            states, means, np.full(40, 4.0), 160.0, np.full(40, target_variance)
        )
        x = reps.policy_hyperparameters(samples, kernel, settings_of(), None, rng)
        noise.append(float(np.exp(x[-1])))
    assert noise[1] == pytest.approx(0.5, rel=0.2)
    assert noise[0] < 0.1


# ---- the update -------------------------------------------------------------------------------


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
def test_one_seed_gives_one_learner_to_the_last_byte(approximation: str, tmp_path: Path) -> None:
    contents, actions = [], []
    for seed in (7, 7, 8):
        learner, info = updated(pushes(), seed, approximation=approximation)
        assert "imagined step" in info.seconds
        learner.save(tmp_path / "learner")
        contents.append((tmp_path / "learner").read_bytes())
        actions.append(learner.policy.process.greedy(np.eye(2)))
    assert contents[0] == contents[1]
    np.testing.assert_array_equal(actions[0], actions[1])
    assert np.abs(actions[2] - actions[0]).min() > 1e-6  # other actions were drawn


@pytest.mark.parametrize("model", ["dynamics", "change", "embedding"])
def test_in_low_rank_it_comes_near_the_exact_update(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (embedding, policies):  # the exact one leaves out what noise hides
        monkeypatch.setattr(module, "MAX_RESIDUAL_RATIO", 1e-9)
    full: dict[str, Any] = {"basis_tolerance": 1e-9, "max_rank": 5000, "rank": 5000}
    rollouts = pushes(terminated=True)
    exact, wanted = updated(rollouts, approximation="exact", model=model, **full)
    found, info = updated(rollouts, approximation="pivoted", model=model, **full)
    assert info.rank == wanted.rank
    assert info.ridge == pytest.approx(wanted.ridge, rel=1e-5)
    assert info.model_error == pytest.approx(wanted.model_error, rel=1e-5)
    assert (
        len(info.dual.weights)
        == len(wanted.dual.weights)
        == (2 if model == "dynamics" else 4) * 120
    )
    assert np.abs(info.dual.weights - wanted.dual.weights).sum() < 1e-4
    states = np.concatenate([r.observations for r in rollouts])
    for name in ("greedy", "standard_deviation"):
        mine, theirs = (getattr(each.policy.process, name)(states) for each in (found, exact))
        np.testing.assert_allclose(mine, theirs, atol=1e-3)


def test_a_set_of_samples_is_learnt_from_in_one_step(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*arguments: Any) -> None:
        raise AssertionError("nothing is imagined of a set")

    monkeypatch.setattr(low_rank, "imagine", never)
    _, info = updated(Dataset.from_rollouts(pushes()))
    assert len(info.dual.weights) == info.samples == 120
    with pytest.raises(AssertionError, match="imagined"):
        updated(pushes(), approximation="pivoted")


def test_a_sample_says_what_it_would_say_if_all_samples_were_like_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Four copies of each sample, of which one is in the sample: as if all four were there."""

    def every_fourth(numbers: IntArray, rng: np.random.Generator) -> IntArray:
        return numbers[: len(numbers) // copies]

    outlooks: list[WorldModel] = []
    draw = low_rank.generate

    def watch(world: WorldModel, *others: Any) -> Any:
        outlooks.append(world)
        return draw(world, *others)

    monkeypatch.setattr(low_rank, "some", every_fourth)
    monkeypatch.setattr(low_rank, "imagine", watch)
    fits: list[tuple[RegressionSums, float]] = []
    fit = FeatureRegression.fit

    def spy(basis: Any, sums: RegressionSums, regulariser: float) -> FeatureRegression:
        fits.append((sums, regulariser))
        return fit(basis, sums, regulariser)

    monkeypatch.setattr(FeatureRegression, "fit", spy)
    copies = 4
    learner, _ = updated(pushes() * copies, approximation="pivoted", window=None)
    (moves, _), (rewards, of_part) = fits
    assert moves.product.shape[1] == 3  # two coordinates, and whether the task ended
    assert rewards.product.shape[1] == 1
    # a quarter of the samples, and a quarter of their noise, make the same regression
    assert learner.state.reward_start is not None
    assert of_part == pytest.approx(np.exp(learner.state.reward_start[-1]) / copies)
    assert len(outlooks) == 2  # once for sampled states, once for those that are led to


@pytest.mark.parametrize("settings", [{"imagined": 0}, {"model": "sample", "recipe": "observed"}])
def test_no_outlook_is_made_where_nothing_is_imagined(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*arguments: Any, **named: Any) -> None:
        raise AssertionError("an outlook")

    monkeypatch.setattr(low_rank, "WorldModel", never)
    _, info = updated(pushes(), approximation="pivoted", **settings)
    assert len(info.dual.weights) == info.samples


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
def test_each_step_begins_with_v_of_the_one_before_and_a_temperature_anew(
    approximation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module: Any = reps if approximation == "exact" else low_rank
    solved: list[tuple[Any, Any, Any]] = []
    sample: list[tuple[FloatArray, StochasticPolicy]] = []
    solve, draw = module.solve_dual, module.generate

    def spy(problem: Any, start: Any = None) -> Any:
        solved.append((problem, start, solve(problem, start=start)))
        return solved[-1][2]

    def watch(world: WorldModel, weights: FloatArray, policy: Any, *others: Any) -> Any:
        sample.append((weights, policy))
        return draw(world, weights, policy, *others)

    monkeypatch.setattr(module, "solve_dual", spy)
    monkeypatch.setattr(module, "imagine", watch)
    learner, info = updated(pushes(), approximation=approximation)
    (first, _, one), (second, start, two), (third, again, three) = solved
    assert start == (1.0, one.theta) and again == (1.0, two.theta)
    assert info.dual is three
    (weights, policy), (same, better) = sample
    np.testing.assert_allclose(weights, one.weights, rtol=1e-12)
    np.testing.assert_array_equal(same, weights)
    assert len({id(p) for p in (policy, better, learner.policy.process)}) == 3
    assert second.ridge * 240 == third.ridge * 240 == pytest.approx(info.ridge)
    assert first.kl_bound == second.kl_bound == third.kl_bound == info.kl_bound
    assert first.eta_floor == second.eta_floor == third.eta_floor == info.eta_floor


def test_each_fit_of_the_policy_starts_from_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    starts: list[FloatArray] = []
    ends: list[FloatArray] = []

    def spy(loss: Any, prior: Prior, *given: FloatArray) -> FloatArray:
        starts.append(given[0])
        ends.append(minimise(loss, prior, *given))
        return ends[-1]

    for module in (reps, transition_model):
        monkeypatch.setattr(module, "minimise", spy)
    learner, info = updated(pushes())
    assert len(starts) == 5  # of the dynamics, the policy, the reward, and the policy twice again
    np.testing.assert_array_equal(starts[3], ends[1])
    np.testing.assert_array_equal(starts[4], ends[3])
    assert learner.state.policy_start is not None
    np.testing.assert_array_equal(learner.state.policy_start, ends[4])
    np.testing.assert_array_equal(info.policy_parameters, np.exp(ends[4]))
    assert learner.state.reward_start is not None
    np.testing.assert_array_equal(learner.state.reward_start, ends[2])


def test_the_support_is_at_most_one_point_for_each_state() -> None:
    learner, info = updated(pushes(), from_generated=20, imagined_rollouts=0.0)
    assert len(info.dual.weights) == 20 * 120
    assert 30 < info.support <= 120
    assert info.support == len(learner.policy.process.states)
    seen = {s.tobytes() for r in pushes() for s in r.observations[:-1]}
    assert {s.tobytes() for s in learner.policy.process.states} <= seen


def test_the_spread_of_actions_within_a_state_is_unbiased() -> None:
    rng = np.random.default_rng(0)
    n, each = 3000, 3
    data = Transitions.from_rollouts(
        [Rollout(rng.normal(size=(n + 1, 2)), np.zeros((n, 1)), np.zeros(n))]
    )
    rows = np.repeat(np.arange(n), each)
    actions = 2.0 * rng.normal(0.0, 0.3, size=(n * each, 1)) + 5.0 * data.states[rows, :1]
    problem = DualProblem(np.zeros(n * each), np.zeros((n * each, 1)), 1.0, 1.0, 0.1)
    p = np.full(n * each, 1.0 / (n * each))
    from_generated = GeneratedSamples(data.states, rows, actions, problem)
    samples = PolicyTargets.from_generated(from_generated, p, TASK)
    assert samples.spread == pytest.approx(0.09, rel=0.05)  # in units of half the range
    assert np.mean(samples.target_variance) == pytest.approx(0.06, rel=0.05)
    alone = GeneratedSamples(data.states, np.arange(n), actions[:n], problem)
    assert PolicyTargets.from_generated(alone, p[:n], TASK).spread == np.inf
    assert PolicyTargets.of(data, p[:n], TASK).spread == np.inf


def test_actions_are_drawn_with_no_more_noise_than_they_spread_within_a_state() -> None:
    rng = np.random.default_rng(0)
    states, targets = rng.normal(size=(40, 2)), rng.normal(size=(40, 1))
    kernel = Kernel((SquaredExponential((0,)), SquaredExponential((1,))), np.ones(2))
    x = np.log([1.0, 1.0, 0.8, 0.5])
    weights = rng.uniform(0.5, 1.0, size=40)
    samples = PolicyTargets(states, targets, weights, 30.0, np.zeros(40))
    asked = 3.0 * rng.normal(size=(20, 2))
    fitted = fit_policy(samples, kernel, TASK, x)
    calm = fit_policy(replace(samples, spread=0.02), kernel, TASK, x)
    np.testing.assert_allclose(calm.greedy(asked), fitted.greedy(asked), atol=1e-9)
    less = fitted.standard_deviation(asked) ** 2 - calm.standard_deviation(asked) ** 2
    np.testing.assert_allclose(less, 4.0 * (0.5 - 0.02), atol=1e-6)
    wide = fit_policy(replace(samples, spread=0.7), kernel, TASK, x)
    np.testing.assert_array_equal(wide.standard_deviation(asked), fitted.standard_deviation(asked))


def test_the_deviation_of_a_policy_can_be_less_and_its_mean_the_same() -> None:
    rng = np.random.default_rng(0)
    states, targets = rng.normal(size=(40, 2)), rng.normal(size=(40, 1))
    kernel = Kernel((SquaredExponential((0,)), SquaredExponential((1,))), np.ones(2))
    x = np.log([1.0, 1.0, 0.8, 0.5])
    samples = PolicyTargets(states, targets, rng.uniform(0.5, 1.0, size=40), 30.0, np.zeros(40))
    asked = 3.0 * rng.normal(size=(20, 2))
    basis, features = RKHSBasis.fit(kernel, states, tolerance=1e-6, max_rank=20)
    sums = PolicySums.from_samples(features, samples.weights, targets)
    sparse = SparseGP.fit(TASK, basis, sums, signal=0.8, noise=0.5)
    pairs: list[tuple[Any, ...]] = [
        tuple(fit_policy(replace(samples, spread=s), kernel, TASK, x, n) for n in (1.0, 2.0))
        for s in (0.02, np.inf)
    ]
    for wide, narrow in (*pairs, (sparse, sparse.deflated(2.0))):
        np.testing.assert_allclose(narrow.greedy(asked), wide.greedy(asked), atol=1e-9)
        np.testing.assert_allclose(
            narrow.standard_deviation(asked), 0.5 * wide.standard_deviation(asked), atol=1e-9
        )


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
def test_actions_are_imagined_wider_and_then_taken_narrower(
    approximation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module: Any = reps if approximation == "exact" else low_rank
    sample: list[FloatArray] = []
    spreads: list[float] = []
    of_imagined = PolicyTargets.from_generated

    def watch(
        world: WorldModel, weights: FloatArray, policy: StochasticPolicy, *others: Any
    ) -> GeneratedSamples:
        found = generate(world, weights, policy, *others)
        states = found.states[found.of]
        mean = policy.act(states, np.zeros((len(states), 1)))
        deviation = policy.act(states, np.ones((len(states), 1))) - mean
        sample.append((found.actions - mean) / deviation)
        return found

    def samples(*arguments: Any) -> PolicyTargets:
        found = of_imagined(*arguments)
        spreads.append(found.spread)
        return found

    monkeypatch.setattr(module, "imagine", watch)
    monkeypatch.setattr(PolicyTargets, "imagined", samples)
    for wider in (1.0, 1.7):
        learner, info = updated(
            pushes(), approximation=approximation, from_generated=20, imagined_noise=wider
        )
        signal, fitted = info.policy_parameters[-2:]
        assert learner.policy.process.signal == pytest.approx(signal / wider**2)
        least, most = sorted(spreads[-2:])  # that of both places lies between theirs
        assert min(fitted, least) <= info.noise * wider**2 * (1.0 + 1e-9)
        assert info.noise * wider**2 <= min(fitted, most) * (1.0 + 1e-9)
    for plain, wide in zip(sample[:2], sample[2:], strict=True):  # in either place
        assert np.std(plain) == pytest.approx(1.0, rel=0.1)
        assert np.std(wide) == pytest.approx(1.7, rel=0.1)
    np.testing.assert_allclose(sample[2], 1.7 * sample[0], atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_it_finds_actions_beyond_those_that_the_weights_can_choose_among(seed: int) -> None:
    """The reward is best at an action of 1, while those that were tried lie around -0.5."""
    rng = np.random.default_rng(seed)
    rollouts = []
    for _ in range(15):
        observations = rng.uniform(-1.0, 1.0, size=(9, 2))
        actions = rng.normal(-0.5, 0.6, size=(8, 1))
        rewards = -((actions[:, 0] - 1.0) ** 2) - 1e-3 * observations[:-1, 0] ** 2
        rollouts.append(Rollout(observations, actions, rewards))
    states = rng.uniform(-0.8, 0.8, size=(50, 2))
    one, two = (
        float(updated(rollouts, **changes)[0].policy.process.greedy(states).mean())
        for changes in ({"recipe": "observed"}, {"optimism": 0.0})
    )
    assert -0.5 < one < two < 1.3
    assert abs(two - 1.0) < 0.8 * abs(one - 1.0)


# ---- clipped commands -------------------------------------------------------------------------


def test_the_share_of_clipped_commands() -> None:
    task = TaskSpec(1, np.array([-1.0, 0.0]), np.array([1.0, 4.0]))
    actions = np.array([[0.0, 2.0], [-1.0, 4.0], [1.5, 3.0], [-2.0, -0.1]])  # limits are within
    assert share_clipped(actions, task) == 3.0 / 8.0
    assert share_clipped(actions[:2], task) == 0.0


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
def test_clipping_is_told_of_the_new_rollouts(approximation: str) -> None:
    tame = [replace(r, actions=0.1 * r.actions) for r in pushes(4)]
    wild = [replace(r, actions=np.sign(r.actions) * 9.0) for r in pushes(2, seed=1)]
    learner, info = updated(tame, approximation=approximation)
    assert info.clipped < 0.05
    assert learner.update(wild).clipped == 1.0  # type: ignore[attr-defined]
    kept = np.concatenate([r.actions for r in learner.state.window.rollouts])
    rng = np.random.default_rng(0)
    if approximation == "exact":
        _, again = reps.update(learner.state, [], TASK, learner.settings, rng)
    else:
        _, again = low_rank.update(learner.state, [], TASK, learner.settings, rng, learner.compute)
    assert again.clipped == share_clipped(kept, TASK) < 0.5


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
def test_new_rollouts_that_the_window_does_not_keep_are_told_too(approximation: str) -> None:
    wild = [replace(r, actions=np.sign(r.actions) * 9.0) for r in pushes(2, seed=1)]
    tame = [replace(r, actions=0.1 * r.actions) for r in pushes(2)]
    _, info = updated([*wild, *tame], approximation=approximation, window=2)
    assert info.samples == 30 and 0.5 <= info.clipped < 0.6
