"""The weighted targets of the policy, its hyper-parameters and its exploration noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from kreps.algorithms.dual import DualProblem, effective_sample_size
from kreps.algorithms.exact import ExactBatch
from kreps.algorithms.generated import GeneratedSamples
from kreps.algorithms.low_rank import LowRankBatch
from kreps.algorithms.policy_targets import (
    PolicyTargets,
    exploration_noise,
    policy_hyperparameters,
    policy_prior,
)
from kreps.algorithms.state import Stopwatch
from kreps.data.compute import Compute
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.hyperparameters import PolicyLoss, factor_distances
from kreps.kernels.kernel import Kernel, SquaredExponential, factors_of
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP
from kreps.presets import settings_of
from kreps.settings import LowRank

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]))


def transitions(count: int = 24, ds: int = 2, da: int = 1) -> Transitions:
    """Random states and actions of one rollout."""
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(count + 1, ds)), rng.normal(0.0, 2.0, size=(count, da))
    return Transitions.from_rollouts([Rollout(states, actions, np.zeros(count))])


def generated(states: FloatArray, state_of: IntArray, actions: FloatArray) -> GeneratedSamples:
    n = len(actions)
    problem = DualProblem(np.zeros(n), np.zeros((n, 1)), 1.0, 1.0, 1.0)
    return GeneratedSamples(states, state_of, actions, problem, np.zeros(n), np.zeros(n))


# ---- targets ----------------------------------------------------------------------------------


def test_samples_of_negligible_weight_are_left_out() -> None:
    data = transitions()
    task = TaskSpec(2, np.array([1.0]), np.array([5.0]))
    n = len(data)
    p = np.full(n, 1.0)
    p[[1, 4]] = 1e-4
    p /= p.sum()
    found = PolicyTargets.from_samples(data, p, task)
    kept = np.setdiff1d(np.arange(n), [1, 4])
    np.testing.assert_array_equal(found.states, data.states[kept])
    np.testing.assert_allclose(found.targets, (data.actions[kept] - 3.0) / 2.0)
    np.testing.assert_allclose(found.weights, p[kept] / np.sum(p**2))
    assert found.weights.sum() == pytest.approx(1.0 / np.sum(p**2), rel=1e-3)
    assert found.total_weight == pytest.approx(found.weights.sum())
    assert not found.target_variance.any() and found.action_variance == np.inf


@pytest.mark.parametrize(("relative", "kept"), [(0.049, 23), (0.051, 24)])
def test_a_weight_is_negligible_below_a_twentieth_of_the_mean(relative: float, kept: int) -> None:
    p = np.full(24, (1.0 - relative / 24) / 23)
    p[5] = relative / 24
    assert len(PolicyTargets.from_samples(transitions(24), p, TASK).weights) == kept


def test_targets_are_the_weighted_means_of_the_actions_in_each_state() -> None:
    data = transitions(24)
    task = TaskSpec(2, np.array([-2.0, 0.0]), np.array([2.0, 10.0]))
    rng = np.random.default_rng(9)
    rows = np.sort(rng.choice(len(data), 60))
    actions = rng.normal([0.0, 5.0], [2.0, 3.0], size=(60, 2))
    p = np.exp(rng.normal(size=60))
    p[rows == rows[30]] = 1e-9  # one state of negligible weight, and some samples
    p[::7] = 1e-9
    p /= p.sum()
    found = PolicyTargets.from_generated(generated(data.states, rows, actions), p, task)

    scaled = (actions - [0.0, 5.0]) / [2.0, 5.0]
    w = p * effective_sample_size(p)
    kept = 60 * p >= 0.05
    states = [i for i in np.unique(rows) if kept[rows == i].any()]
    assert rows[30] not in states and 10 < len(states) < len(np.unique(rows))
    np.testing.assert_array_equal(found.states, data.states[states])
    for row, i in enumerate(states):
        here = kept & (rows == i)
        mean = np.average(scaled[here], axis=0, weights=w[here])
        variance = np.average((scaled[here] - mean) ** 2, axis=0, weights=w[here])
        assert found.weights[row] == pytest.approx(w[here].sum())
        np.testing.assert_allclose(found.targets[row], mean, atol=1e-12)
        assert found.target_variance[row] == pytest.approx(variance.sum(), abs=1e-12)
    assert found.total_weight == pytest.approx(w[kept].sum())


def test_with_one_action_per_state_the_targets_are_the_samples() -> None:
    data = transitions()
    p = np.random.default_rng(10).uniform(0.01, 2.0, len(data))
    p /= p.sum()
    wanted = PolicyTargets.from_samples(data, p, TASK)
    samples = generated(data.states, np.arange(len(data)), data.actions)
    found = PolicyTargets.from_generated(samples, p, TASK)
    for name, value in vars(wanted).items():
        np.testing.assert_allclose(getattr(found, name), value, atol=1e-14)


def test_the_variance_of_actions_within_a_state_is_unbiased() -> None:
    rng = np.random.default_rng(0)
    n, each = 3000, 3
    data = transitions(n)
    rows = np.repeat(np.arange(n), each)
    actions = 2.0 * rng.normal(0.0, 0.3, size=(n * each, 1)) + 5.0 * data.states[rows, :1]
    p = np.full(n * each, 1.0 / (n * each))
    found = PolicyTargets.from_generated(generated(data.states, rows, actions), p, TASK)
    assert found.action_variance == pytest.approx(0.09, rel=0.05)  # in units of half the range
    assert np.mean(found.target_variance) == pytest.approx(0.06, rel=0.05)
    alone = generated(data.states, np.arange(n), actions[:n])
    uniform = np.full(n, 1.0 / n)
    assert PolicyTargets.from_generated(alone, uniform, TASK).action_variance == np.inf
    assert PolicyTargets.from_samples(data, uniform, TASK).action_variance == np.inf


def test_the_heaviest_targets_stay_in_order() -> None:
    weights = np.array([3.0, 1.0, 4.0, 1.0, 5.0])
    targets = PolicyTargets(
        np.arange(10.0).reshape(5, 2), np.arange(5.0)[:, None], weights, 14.0, np.arange(5.0)
    )
    found = targets.top_by_weight(3)
    np.testing.assert_array_equal(found.weights, [3.0, 4.0, 5.0])
    np.testing.assert_array_equal(found.targets[:, 0], [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(found.target_variance, [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(found.states[:, 0], [0.0, 4.0, 8.0])
    assert found.total_weight == 14.0
    assert targets.top_by_weight(5) is targets


def test_targets_of_two_steps_are_concatenated() -> None:
    new, earlier = (
        PolicyTargets(
            np.full((m, 2), float(m)), np.ones((m, 1)), np.full(m, w), m * w, np.zeros(m), variance
        )
        for m, w, variance in ((3, 2.0, 0.5), (4, 6.0, 0.1))
    )
    both = new.concat(earlier)
    np.testing.assert_array_equal(both.states[:, 0], [3.0] * 3 + [4.0] * 4)
    np.testing.assert_allclose(both.weights, [2.0] * 3 + [6.0] * 4)
    assert both.total_weight == pytest.approx(both.weights.sum())
    assert both.action_variance == pytest.approx((6.0 * 0.5 + 24.0 * 0.1) / 30.0)


# ---- hyper-parameters -------------------------------------------------------------------------


def test_hyperparameters_minimise_the_loss_plus_the_prior() -> None:
    """Leave-one-out loss plus ``1/2 sum ((x - c) / sd)^2 / sum w``, minimised again by BFGS."""
    rng = np.random.default_rng(13)
    states, actions = rng.normal(size=(25, 2)), rng.normal(0.0, 0.8, size=(25, 1))
    weights = rng.uniform(0.2, 2.0, 25)
    targets = PolicyTargets(states, actions, weights, float(weights.sum()), np.zeros(25))
    kernel = Kernel(factors_of(2), np.array([0.9, 1.4]))
    found = policy_hyperparameters(targets, kernel, "map", None, rng)

    share = weights / weights.sum()
    log_variance = np.log(share @ (actions[:, 0] - share @ actions[:, 0]) ** 2)
    centre = np.append(np.log([0.9, 1.4]) - 0.5, [log_variance - 0.3, log_variance - 1.0])
    std = np.array([0.7, 0.7, 1.0, 1.0])
    loss = PolicyLoss(factor_distances(kernel.factors, states), actions, weights)

    def objective(x: FloatArray) -> float:
        return float(loss(x)[0] + 0.5 * np.sum(((x - centre) / std) ** 2) / weights.sum())

    best = scipy.optimize.minimize(objective, centre, method="BFGS", options={"gtol": 1e-6})
    np.testing.assert_allclose(found, best.x, atol=0.05)
    assert objective(found) == pytest.approx(best.fun, abs=1e-3)


def test_the_prior_counts_less_with_more_weight() -> None:
    rng = np.random.default_rng(15)
    kernel = Kernel(factors_of(2), np.array([0.9, 1.4]))
    states, actions = rng.normal(size=(2, 30, 2))
    for total in (30.0, 500.0):  # of all samples, of which these are a part
        targets = PolicyTargets(states, actions, np.ones(30), total, np.zeros(30))
        prior = policy_prior(targets, kernel, "map")
        assert prior.strength == pytest.approx(1.0 / total)
        np.testing.assert_allclose(prior.low[:2], np.log([0.9, 1.4]) - 4.0)
        np.testing.assert_allclose(prior.high[:2], np.log([0.9, 1.4]) + 3.0)
        np.testing.assert_allclose(np.exp(prior.low[2:]), 1e-4)
        np.testing.assert_allclose(np.exp(prior.high[2:]), 1e2)


def test_bounded_hyperparameters_stay_in_their_ranges() -> None:
    rng = np.random.default_rng(14)
    kernel = Kernel(factors_of(2), np.array([0.9, 1.4]))
    states = rng.normal(size=(40, 2))
    low = np.log([0.3 * 0.9, 0.3 * 1.4, 0.01, 1e-4])
    high = np.log([0.9, 1.4, 3.0, 4.0])
    # pure noise fits a long lengthscale, zeros fit no variance
    for actions in (rng.normal(size=(40, 1)), np.zeros((40, 1)), 100.0 * states[:, :1]):
        targets = PolicyTargets(states, actions, np.ones(40), 40.0, np.zeros(40))
        found = policy_hyperparameters(targets, kernel, "bounded", None, rng)
        assert (found >= low - 1e-12).all()
        assert (found <= high + 1e-12).all()
        assert (np.minimum(found - low, high - found) < 1e-6).any()
        assert policy_prior(targets, kernel, "bounded").strength == 0.0


def test_the_fitted_noise_includes_the_variance_of_the_targets() -> None:
    """Equal means, but of actions that agree in one case and differ in the other."""
    rng = np.random.default_rng(11)
    states, means = rng.normal(size=(40, 2)), 0.1 * rng.normal(size=(40, 1))
    kernel = Kernel(TASK.state_factors, np.ones(2))
    noise = []
    for variance in (0.0, 0.5):
        targets = PolicyTargets(states, means, np.full(40, 4.0), 160.0, np.full(40, variance))
        x = policy_hyperparameters(targets, kernel, "map", None, rng)
        noise.append(float(np.exp(x[-1])))
    assert noise[1] == pytest.approx(0.5, rel=0.2)
    assert noise[0] < 0.1


# ---- the fitted policy ------------------------------------------------------------------------


def batch_of(task: TaskSpec, kind: str) -> Any:
    """A batch of random samples; only its `fit_policy` is used here."""
    ds, da = task.observation_size, task.action_size
    rng = np.random.default_rng(1)
    rollouts = [Rollout(rng.normal(size=(9, ds)), rng.normal(size=(8, da)), rng.normal(size=8))]
    window, settings = ReplayWindow(task, None).append(rollouts), settings_of("single_step")
    if kind == "exact":
        return ExactBatch(window, rollouts, settings, Stopwatch())
    low_rank = LowRank(rank=40)
    return LowRankBatch(window, rollouts, settings, low_rank, Stopwatch(), Compute(), rng)


def fit(targets: PolicyTargets, kernel: Kernel, kind: str = "exact", std_scale: float = 1.0) -> Any:
    rng = np.random.default_rng(0)
    task = TaskSpec(len(kernel.factors), np.array([-2.0]), np.array([2.0]))
    return batch_of(task, kind).fit_policy(targets, kernel, None, rng, std_scale)


@pytest.mark.parametrize("kind", ["exact", "low rank"])
@pytest.mark.parametrize("ds", [2, 3, 5])
def test_the_policy_has_the_fitted_hyperparameters_of_every_state_factor(
    kind: str, ds: int
) -> None:
    """``x`` is (g + 2,): g log lengthscales, log sf2 and log l, whatever g is."""
    rng = np.random.default_rng(2)
    states, actions = rng.normal(size=(40, ds)), rng.normal(size=(40, 1))
    targets = PolicyTargets(states, actions, np.ones(40), 40.0, np.zeros(40))
    kernel = Kernel(factors_of(ds), np.linspace(0.6, 1.4, ds))
    found = fit(targets, kernel, kind)
    x = policy_hyperparameters(targets, kernel, "map", None, np.random.default_rng(0))
    np.testing.assert_array_equal(found.x, x)
    assert len(x) == ds + 2 and len(set(x)) == ds + 2
    np.testing.assert_array_equal(found.policy.kernel.lengthscales, np.exp(x[:ds]))
    assert found.policy.signal == float(np.exp(x[ds]))
    assert found.policy.noise == found.noise == float(np.exp(x[ds + 1]))


def test_the_noise_is_at_most_the_variance_of_actions_within_a_state() -> None:
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(40, 2)), rng.normal(size=(40, 1))
    targets = PolicyTargets(states, actions, rng.uniform(0.5, 1.0, size=40), 30.0, np.zeros(40))
    for variance, noise in [(np.inf, 0.5), (0.7, 0.5), (0.02, 0.02), (1e-9, 1e-4)]:
        weights, found = exploration_noise(replace(targets, action_variance=variance), 0.5)
        assert found == noise
        np.testing.assert_allclose(found / weights, 0.5 / targets.weights)  # l / w stays


@pytest.mark.parametrize("kind", ["exact", "low rank"])
def test_less_noise_leaves_the_mean_of_the_policy(kind: str) -> None:
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(40, 2)), rng.normal(size=(40, 1))
    kernel = Kernel((SquaredExponential((0,)), SquaredExponential((1,))), np.ones(2))
    targets = PolicyTargets(states, actions, rng.uniform(0.5, 1.0, size=40), 30.0, np.zeros(40))
    queries = 3.0 * rng.normal(size=(20, 2))
    fitted, calm = (fit(replace(targets, action_variance=v), kernel, kind) for v in (np.inf, 0.02))
    np.testing.assert_allclose(
        calm.policy.greedy(queries), fitted.policy.greedy(queries), atol=1e-9
    )
    less = fitted.policy.standard_deviation(queries) ** 2
    less -= calm.policy.standard_deviation(queries) ** 2
    np.testing.assert_allclose(less, 4.0 * (fitted.noise - 0.02), atol=1e-6)
    assert fitted.noise > 0.1


@pytest.mark.parametrize("kind", ["exact", "low rank"])
@pytest.mark.parametrize("variance", [0.02, np.inf])
def test_deflating_the_standard_deviation_leaves_the_mean(kind: str, variance: float) -> None:
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(40, 2)), rng.normal(size=(40, 1))
    kernel = Kernel((SquaredExponential((0,)), SquaredExponential((1,))), np.ones(2))
    weights = rng.uniform(0.5, 1.0, size=40)
    targets = PolicyTargets(states, actions, weights, 30.0, np.zeros(40), variance)
    queries = 3.0 * rng.normal(size=(20, 2))
    plain, deflated = (fit(targets, kernel, kind, scale) for scale in (1.0, 2.0))
    np.testing.assert_allclose(
        deflated.policy.greedy(queries), plain.policy.greedy(queries), atol=1e-9
    )
    np.testing.assert_allclose(
        deflated.policy.standard_deviation(queries),
        0.5 * plain.policy.standard_deviation(queries),
        atol=1e-9,
    )
    assert deflated.noise == pytest.approx(plain.noise / 4.0)
    assert isinstance(plain.policy, CostSensitiveGP if kind == "exact" else SparseGP)


def test_an_exact_policy_has_at_most_six_thousand_support_points() -> None:
    """The heaviest targets are kept.  All states are equal, so that the fit is quick."""
    n = 6010
    weights = np.ones(n)
    weights[[3, 100, 4000]] = 0.5
    weights[-7:] = 0.5
    targets = PolicyTargets(
        np.zeros((n, 2)), np.ones((n, 1)), weights, float(weights.sum()), np.zeros(n)
    )
    found = fit(targets, Kernel(factors_of(2), np.ones(2)))
    assert found.support == len(found.policy.states) == 6000
    assert np.ptp(found.policy.weights) == 0.0  # the ten light ones are left out
