"""The cost-sensitive Gaussian process policy, and the policies of the first rollouts."""

from __future__ import annotations

import gc
import tracemalloc
from typing import Any

import numpy as np
import pytest

from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel, factors_of
from kreps.learning.policy import Policy, mean_difference
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.exploration import BangBang, Gaussian
from kreps.policies.sparse_gp import SparseGP
from kreps.policies.value_based import LipschitzPolicy, SoftmaxPolicy

TASK = TaskSpec(2, np.array([-1.0, 10.0]), np.array([1.0, 30.0]))
KERNEL = Kernel(factors_of(2), np.array([0.8, 1.3]))
SIGNAL, NOISE = 0.7, 0.2


def samples(n: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States, targets in units of the action scale, weights below and above one."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, 2)), rng.normal(size=(n, 2)), rng.uniform(0.1, 4.0, size=n)


def fit(
    states: FloatArray, targets: FloatArray, weights: FloatArray, task: TaskSpec = TASK
) -> CostSensitiveGP:
    return CostSensitiveGP(task, KERNEL, states, targets, weights, SIGNAL, NOISE)


def test_mean_and_standard_deviation_follow_the_equations() -> None:
    states, targets, weights = samples(25, 0)
    policy = fit(states, targets, weights)
    query = np.random.default_rng(1).normal(size=(8, 2))
    c = SIGNAL * KERNEL.gram(states) + NOISE * np.diag(1.0 / weights)
    k = SIGNAL * KERNEL.gram(states, query)
    mean = k.T @ np.linalg.solve(c, targets)
    variance = SIGNAL - np.einsum("ij,ij->j", k, np.linalg.solve(c, k)) + NOISE
    centre, scale = np.array([0.0, 20.0]), np.array([1.0, 10.0])
    np.testing.assert_allclose(policy.alpha, np.linalg.solve(c, targets), rtol=1e-8)
    np.testing.assert_allclose(policy.mean(query), centre + scale * mean, atol=1e-5)
    np.testing.assert_allclose(
        policy.standard_deviation(query), scale * np.sqrt(variance)[:, None], rtol=1e-7
    )
    assert policy.factor.jitter == 0.0


def test_a_sample_of_weight_three_counts_as_three_samples() -> None:
    states, targets, _ = samples(15, 2)
    weights = np.random.default_rng(3).integers(1, 5, size=15)
    weighted = fit(states, targets, weights.astype(np.float64))
    rows = np.repeat(np.arange(15), weights)
    repeated = fit(states[rows], targets[rows], np.ones(len(rows)))
    query = np.random.default_rng(4).normal(size=(20, 2))
    np.testing.assert_allclose(weighted.mean(query), repeated.mean(query), atol=1e-5)
    np.testing.assert_allclose(
        weighted.standard_deviation(query), repeated.standard_deviation(query), rtol=1e-7
    )


def test_far_from_all_samples_the_policy_is_its_prior() -> None:
    policy = fit(*samples(15, 5))
    far = np.array([[1e3, -1e3]])
    np.testing.assert_allclose(policy.mean(far), [[0.0, 20.0]], atol=1e-12)
    wanted = np.sqrt(SIGNAL + NOISE) * np.array([[1.0, 10.0]])
    np.testing.assert_allclose(policy.standard_deviation(far), wanted, rtol=1e-12)


def test_at_a_sample_of_large_weight_the_mean_is_its_target_and_the_variance_the_noise() -> None:
    states, targets, weights = samples(10, 6)
    weights[4] = 1e7
    policy = fit(states, targets, weights)
    wanted = [[targets[4, 0], 20.0 + 10.0 * targets[4, 1]]]
    np.testing.assert_allclose(policy.mean(states[4:5]), wanted, atol=1e-5)
    spread = np.sqrt(NOISE) * np.array([[1.0, 10.0]])
    np.testing.assert_allclose(policy.standard_deviation(states[4:5]), spread, rtol=1e-5)


def test_a_sample_of_smaller_weight_has_less_effect() -> None:
    state, target = np.zeros((1, 2)), np.ones((1, 2))
    means = [fit(state, target, np.array([w])).mean(state)[0, 0] for w in (0.1, 1.0, 10.0)]
    # One sample: sf2 / (sf2 + l / w).
    np.testing.assert_allclose(means, [SIGNAL / (SIGNAL + NOISE / w) for w in (0.1, 1.0, 10.0)])


def test_dense_support_points_are_projected_on_few_centres() -> None:
    """The centres leave out at most 1e-4 of the noise of a support point's prior variance."""
    rng = np.random.default_rng(20)
    states, weights = rng.normal(size=(500, 2)), rng.uniform(0.1, 4.0, 500)
    targets = np.sign(rng.normal(size=(500, 2)))
    policy = fit(states, targets, weights)
    centres = policy.predictor.states
    assert len(centres) < 200
    across = KERNEL.gram(centres, states)
    left_out = 1.0 - np.einsum("ij,ij->j", across, np.linalg.solve(KERNEL.gram(centres), across))
    assert SIGNAL * left_out.max() < 1.001e-4 * NOISE / weights.max()
    query = rng.normal(size=(100, 2))
    c = SIGNAL * KERNEL.gram(states) + NOISE * np.diag(1.0 / weights)
    k = SIGNAL * KERNEL.gram(states, query)
    error = (policy.mean(query) - [0.0, 20.0]) / [1.0, 10.0] - k.T @ np.linalg.solve(c, targets)
    assert np.abs(error).max() < 0.01 * np.sqrt(NOISE)
    variance = SIGNAL - np.einsum("ij,ij->j", k, np.linalg.solve(c, k)) + NOISE
    np.testing.assert_allclose(policy.standard_deviation(query)[:, 0], np.sqrt(variance), rtol=1e-4)
    assert policy.jitter == 0.0


@pytest.mark.parametrize(("signal", "weight"), [(1e-200, 1e-200), (1e200, 1e200)])
def test_extreme_weights_give_finite_actions(signal: float, weight: float) -> None:
    states, targets, _ = samples(20, 24)
    policy = CostSensitiveGP(TASK, KERNEL, states, targets, np.full(20, weight), signal, NOISE)
    assert np.isfinite(policy.mean(states)).all()
    assert (policy.standard_deviation(states) > 0.0).all()


def test_a_tiny_noise_does_not_make_all_support_points_centres() -> None:
    states = np.random.default_rng(25).normal(size=(400, 2))
    policy = CostSensitiveGP(TASK, KERNEL, states, states, np.ones(400), 1.0, 1e-12)
    assert len(policy.predictor.states) < 200


def test_dissimilar_support_points_are_all_centres() -> None:
    states = 50.0 * np.random.default_rng(23).normal(size=(40, 2))
    targets, weights = np.ones((40, 2)), np.ones(40)
    policy = fit(states, targets, weights)
    np.testing.assert_array_equal(policy.predictor.states, states)
    assert policy.jitter == policy.factor.jitter


def test_duplicated_states_act_like_larger_weights() -> None:
    states, targets, weights = samples(20, 21)
    policy = fit(np.tile(states, (5, 1)), np.tile(targets, (5, 1)), np.tile(weights, 5))
    assert len(policy.predictor.coordinates) <= 20
    five_times = fit(states, targets, 5.0 * weights)
    query = np.random.default_rng(22).normal(size=(10, 2))
    np.testing.assert_allclose(policy.mean(query), five_times.mean(query), atol=1e-5)


def test_too_many_support_points_are_rejected() -> None:
    m = 6_001
    with pytest.raises(ConfigurationError, match=r"6001 support points, but at most 6000"):
        fit(np.zeros((m, 2)), np.zeros((m, 2)), np.ones(m))


def test_an_action_is_the_mean_plus_the_deviation_times_the_noise() -> None:
    policy = fit(*samples(20, 7))
    rng = np.random.default_rng(8)
    query, noise = rng.normal(size=(9, 2)), rng.normal(size=(9, 2))
    wanted = policy.mean(query) + policy.standard_deviation(query) * noise
    np.testing.assert_allclose(policy.act(query, noise), wanted, rtol=1e-10)
    np.testing.assert_array_equal(policy.act(query, np.zeros((9, 2))), policy.mean(query))


def test_commanded_actions_are_not_clipped() -> None:
    policy = fit(*samples(20, 9))
    actions = policy.act(np.zeros((2, 2)), np.array([[9.0, 9.0], [-9.0, -9.0]]))
    assert (actions[0] > TASK.action_high).all()
    assert (actions[1] < TASK.action_low).all()


def test_actions_scale_with_the_action_range() -> None:
    data = samples(20, 10)
    policy = fit(*data)
    unit = fit(*data, task=TaskSpec(2, np.full(2, -1.0), np.full(2, 1.0)))
    rng = np.random.default_rng(11)
    query, noise = rng.normal(size=(6, 2)), rng.normal(size=(6, 2))
    np.testing.assert_allclose(
        policy.act(query, noise), [0.0, 20.0] + unit.act(query, noise) * [1.0, 10.0], rtol=1e-12
    )


def test_duplicated_states_without_noise_need_jitter() -> None:
    states = np.zeros((3, 2))
    policy = CostSensitiveGP(TASK, KERNEL, states, np.ones((3, 2)), np.ones(3), 1.0, 1e-18)
    assert policy.factor.jitter > 0.0
    np.testing.assert_allclose(policy.mean(states), [[1.0, 30.0]] * 3, rtol=1e-3)


def test_bang_bang_actions_are_at_the_limits() -> None:
    noise = np.random.default_rng(12).normal(size=(2000, 2))
    actions = BangBang(TASK).act(np.zeros((2000, 2)), noise)
    np.testing.assert_array_equal(np.unique(actions[:, 0]), [-1.0, 1.0])
    np.testing.assert_array_equal(np.unique(actions[:, 1]), [10.0, 30.0])
    # Signs of the two actions are independent, each limit equally likely.
    high = actions == TASK.action_high
    assert np.abs(high.mean(axis=0) - 0.5).max() < 0.05
    assert abs(np.mean(high[:, 0] & high[:, 1]) - 0.25) < 0.05


@pytest.mark.parametrize("scale", [0.05, 1.0, 2.5])
def test_gaussian_exploration_has_the_given_scale_in_every_state(scale: float) -> None:
    rng = np.random.default_rng(13)
    states, noise = rng.normal(size=(4000, 2)), rng.normal(size=(4000, 2))
    actions = Gaussian(TASK, scale).act(states, noise)
    np.testing.assert_allclose(actions.std(axis=0), scale * np.array([1.0, 10.0]), rtol=0.05)
    np.testing.assert_allclose(
        actions, [0.0, 20.0] + scale * np.array([1.0, 10.0]) * noise, rtol=1e-12
    )


# ---- kreps.Policy -----------------------------------------------------------------------------


def test_a_compressed_policy_acts_as_its_compressed_process() -> None:
    process, query = fit(*samples(60, 30)), np.random.default_rng(31).normal(size=(8, 2))
    few = Policy(process, seed=3).compressed(10)
    assert isinstance(few.process, SparseGP) and len(few.process.states) == 10
    wanted = TASK.clip(process.compressed(10).greedy(query))
    np.testing.assert_array_equal(few.predict(query, deterministic=True)[0], wanted)
    again = Policy(few.process, seed=3).predict(query)[0]
    np.testing.assert_array_equal(few.predict(query)[0], again)


def test_compressing_does_not_change_the_policy() -> None:
    policy, query = Policy(fit(*samples(60, 32))), np.zeros((3, 2))
    before = policy.predict(query, deterministic=True)[0]
    policy.compressed(5)
    np.testing.assert_array_equal(policy.predict(query, deterministic=True)[0], before)


def test_a_compressed_policy_can_be_compressed_to_fewer_centres() -> None:
    many = Policy(fit(*samples(200, 33))).compressed(80)
    assert many.compressed(80) is many and many.compressed(81) is many
    differences = []
    for centres in (60, 30, 10):
        few = many.compressed(centres).process
        assert isinstance(few, SparseGP) and len(few.states) == centres
        assert few.explained.shape == (centres, centres)
        differences.append(mean_difference(many, Policy(few)))
        query = np.random.default_rng(centres).normal(size=(50, 2))
        variance = (few.standard_deviation(query) / TASK.action_scale) ** 2
        assert (variance >= few.noise * (1.0 - 1e-9)).all()
        assert (variance <= (few.signal + few.noise) * (1.0 + 1e-9)).all()
    assert differences[0] < 0.2 * differences[2] and differences == sorted(differences)
    # nearly all centres: nearly the same policy, also its noise
    close = many.compressed(79).process
    assert isinstance(close, SparseGP) and isinstance(many.process, SparseGP)
    states = many.process.states
    np.testing.assert_allclose(
        close.standard_deviation(states), many.process.standard_deviation(states), rtol=1e-2
    )


@pytest.mark.parametrize("centres", [0, -3, 2.5, "ten", None, np.array([3, 4])])
def test_an_invalid_number_of_centres_is_rejected(centres: Any) -> None:
    policy = Policy(fit(*samples(20, 34)))
    for each in (policy, policy.compressed(5)):
        with pytest.raises(ConfigurationError, match=r"centres = .*needed|centres = .*at least"):
            each.compressed(centres)


def test_only_gaussian_process_policies_can_be_compressed() -> None:
    kernel = Kernel(factors_of(2), np.ones(2))
    one, zero = np.zeros((1, 2)), np.zeros(1)
    for process in (
        LipschitzPolicy(TASK, kernel, one, one, zero, 1.0, 0.3, 0.3),
        SoftmaxPolicy(TASK, kernel, one, np.zeros((1, 3)), 0.0, np.zeros((3, 2)), 1.0),
    ):
        with pytest.raises(ConfigurationError, match=rf"{type(process).__name__}.*kreps\.KREPS"):
            Policy(process).compressed(5)


def test_the_difference_of_a_compressed_policy_is_the_rms_difference_of_means() -> None:
    exact = Policy(fit(*samples(200, 35)))
    differences = [mean_difference(exact, exact.compressed(c)) for c in (1, 10, 60)]
    assert differences[0] > 1.2 * differences[1] > 10.0 * differences[2]
    assert mean_difference(exact, exact) == 0.0
    assert isinstance(exact.process, CostSensitiveGP)
    states = exact.process.states
    a, b = (p.predict(states, deterministic=True)[0] for p in (exact, exact.compressed(10)))
    wanted = np.sqrt(np.mean(((a - b) / [1.0, 10.0]) ** 2))
    np.testing.assert_allclose(differences[1], wanted, rtol=1e-12)


def test_predicting_does_not_leak_memory() -> None:
    policy = Policy(fit(*samples(300, 36))).compressed(50)
    query = np.zeros(2)
    tracemalloc.start()
    try:
        for _ in range(100):
            policy.predict(query)
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(3000):
            policy.predict(query)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 2000  # bytes; one number held per call would be 24 times 3000
