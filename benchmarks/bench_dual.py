"""Newton's method on the dual of the KL-bounded update."""

from __future__ import annotations

import flops
import numpy as np
import pytest
from criteria import Seconds, Share
from data import swing_up
from measuring import Measure

from kreps.algorithms.dual import DualProblem, Moments, standardise
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.reps import stationarity_ridge
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.models.transition import feature_differences, state_kernel, successor_features
from kreps.presets import SINGLE_STEP


class Counting(DualProblem):
    """A dual problem that counts the Hessians computed."""

    hessians = 0

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        Counting.hessians += with_covariance
        return super().moments(eta, theta, with_covariance=with_covariance)


def hessians(problem: DualProblem) -> int:
    """Number of Hessians that solving the problem takes."""
    Counting.hessians = 0
    assert solve_dual(Counting(**vars(problem))).converged
    return Counting.hessians


@pytest.mark.parametrize("n", [1500, 3000])
def bench_newton_iteration(measure: Measure, n: int) -> None:
    """As many features as samples; all iterations of a solve are timed."""
    rng = np.random.default_rng(n)
    rewards, _ = standardise(rng.standard_normal(n))
    problem = DualProblem(rewards, rng.standard_normal((n, n)), 0.5, 100.0, 1e-6)
    count = hessians(problem)
    measured = measure(
        "Newton iterations, m = n",
        f"n = {n}",
        lambda: solve_dual(problem),
        Share(count * flops.newton(n, n), at_least=0.55),
    )
    measured.details["hessians"] = count


def bench_newton_solve(measure: Measure) -> None:
    """Without a start value, on features and rewards of the swing-up."""
    data, settings = swing_up(1500), SINGLE_STEP
    learner, transitions = data.learner, data.transitions
    kernel = state_kernel(transitions, learner.task, np.random.default_rng(0))
    basis, features = RKHSBasis.fit(kernel, transitions.points, tolerance=0.0, max_rank=300)
    assert features.shape[1] == 300, basis.residual
    rewards, _ = standardise(transitions.rewards)
    problem = DualProblem(
        rewards,
        feature_differences(
            features[transitions.state],
            successor_features(transitions, features),
            features[transitions.start].mean(axis=0),
            0.02,
        ),
        settings.kl_bound,
        stationarity_ridge(settings, None) / len(rewards),
        settings.eta_floor,
    )
    count = hessians(problem)
    measured = measure(
        "Newton solve, m = 300",
        f"n = {len(rewards)}",
        lambda: solve_dual(problem),
        Seconds(at_most=0.03),
        Share(count * flops.newton(len(rewards), 300)),
    )
    measured.details["hessians"] = count
