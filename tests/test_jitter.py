"""The jitter of factorisations: used consistently by those who factorise, and reported."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.algorithms.policy_targets import PolicyTargets
from kreps.algorithms.reps import reps_step
from kreps.algorithms.state import LearnerState
from kreps.algorithms.update import batch_of, report
from kreps.data.compute import Compute
from kreps.data.window import ReplayWindow
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel, factors_of
from kreps.kernels.linalg import cholesky
from kreps.kernels.regression import FeatureRegression, KernelEmbedding, RegressionSums
from kreps.policies.cost_sensitive_gp import CostSensitiveGP

TASK = kreps.TaskSpec(2, np.array([-2.0]), np.array([2.0]))
KERNEL = Kernel(factors_of(1), np.array([1.0]))
STATE_KERNEL = Kernel(factors_of(2), np.array([1.0, 1.0]))


# ---- kernels and policies ---------------------------------------------------------------------


def test_an_embedding_counts_its_jitter_as_regulariser() -> None:
    """Without it, the expectation at equal inputs would be each sample's own target."""
    model = KernelEmbedding.fit(KERNEL, np.zeros((4, 1)), 1e-18)
    assert model.factor.jitter > 0.0
    targets = np.array([[0.0], [2.0], [4.0], [6.0]])
    np.testing.assert_allclose(model.expected_features(targets), 3.0, atol=0.01)
    at_samples = model.strengths(model.inputs).T @ targets
    np.testing.assert_allclose(model.expected_features(targets), at_samples, atol=0.01)


@pytest.mark.parametrize("singular", [True, False])
def test_a_regression_reports_the_jitter_of_its_factorisation(singular: bool) -> None:
    points = np.linspace(-1.0, 1.0, 6)[:, None]
    basis, psi = RKHSBasis.fit(KERNEL, points, tolerance=1e-4, max_rank=3)
    psi = np.tile(psi[:1], (6, 1)) if singular else psi
    sums = RegressionSums.from_samples(psi, points)
    found = FeatureRegression.fit(basis, sums, 0.0)
    assert found.jitter == cholesky(sums.gram).jitter
    assert (found.jitter > 0.0) == singular


def duplicated(count: int) -> CostSensitiveGP:
    """A policy of ``count`` equal states between two others, with next to no noise."""
    states = np.concatenate([np.zeros((count, 2)), np.ones((1, 2)), -np.ones((1, 2))])
    n = len(states)
    return CostSensitiveGP(TASK, STATE_KERNEL, states, np.ones((n, 1)), np.ones(n), 1.0, 1e-18)


def test_a_policy_on_all_its_support_points_reports_its_jitter() -> None:
    policy = duplicated(2)  # three pivots would be more than half of four points
    assert len(policy.predictor.states) == 4
    assert policy.jitter == policy.factor.jitter > 0.0


def test_a_policy_on_few_centres_reports_none() -> None:
    policy = duplicated(5)
    assert len(policy.predictor.states) == 3
    assert policy.factor.jitter > 0.0
    assert policy.jitter == 0.0


# ---- updates ----------------------------------------------------------------------------------


def rollouts(count: int = 6, steps: int = 15) -> list[kreps.Rollout]:
    """A point mass with random pushes."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(count):
        actions = rng.normal(0.0, 1.0, (steps, 1))
        velocity = np.concatenate([[0.0], np.cumsum(0.3 * actions[:, 0])])
        states = np.column_stack([rng.normal() + np.cumsum(0.3 * velocity), velocity])
        found.append(kreps.Rollout(states, actions, -np.sum(states[:-1] ** 2, axis=1)))
    return found


def batch(**settings: Any) -> Any:
    settings = {"preset": "single_step", **settings}
    state = LearnerState(ReplayWindow(TASK, None))
    chosen = kreps.KREPS(TASK, **settings).settings
    return batch_of(state, rollouts(), chosen, np.random.default_rng(1), Compute()), state


LOW_RANK = {"low_rank": kreps.LowRank(above=0)}


@pytest.mark.parametrize(
    ("settings", "count"),
    [
        ({}, 2),  # of the transition model and the policy
        ({"model": "change"}, 2),
        ({"model": "sample"}, 1),  # of the policy
        (LOW_RANK, 1),  # of the transition model
        (LOW_RANK | {"model": "sample"}, 0),
    ],
)
def test_an_update_reports_the_largest_jitter(settings: dict[str, Any], count: int) -> None:
    samples, state = batch(**settings)
    step = reps_step(samples, state, 0.05, np.random.default_rng(2))
    assert samples.jitters == [0.0] * count
    assert report(samples, step, None, None, None).jitter == 0.0
    samples.jitters += [1e-9, 3e-7, 2e-8]
    assert report(samples, step, None, None, None).jitter == 3e-7
    larger = replace(step, dual=replace(step.dual, jitter=1e-6))
    assert report(samples, larger, None, None, None).jitter == 1e-6


def test_an_exact_update_takes_note_of_the_jitter_of_its_policy() -> None:
    samples, _ = batch()
    states = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    weights = np.full(3, 1e18)  # so that the noise l / w does not regularise
    targets = PolicyTargets(states, np.ones((3, 1)), weights, 3e18, np.zeros(3))
    found = samples.fit_policy(targets, STATE_KERNEL, None, np.random.default_rng(3))
    assert samples.jitters == [found.policy.jitter]
    assert found.policy.jitter > 0.0
