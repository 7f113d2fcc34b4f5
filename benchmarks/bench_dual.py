"""Newton's method on the dual of the bounded update."""

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
from kreps.settings import PRESETS


class Counting(DualProblem):
    """Counts the Hessians that a solve asks for."""

    asked = 0

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        Counting.asked += with_covariance
        return super().moments(eta, theta, with_covariance=with_covariance)


def hessians(problem: DualProblem) -> int:
    """How many a solve of the problem needs."""
    Counting.asked = 0
    assert solve_dual(Counting(**vars(problem))).converged
    return Counting.asked


@pytest.mark.parametrize("n", [1500, 3000])
def bench_newton_iteration(measure: Measure, n: int) -> None:
    """As many features as samples; the time of a whole solve counts all its iterations."""
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
    """From a cold start, on features and rewards of the swing-up."""
    data = swing_up(1500)
    learner, transitions, observed = data.learner, data.transitions, PRESETS["observed"]
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
        observed.kl_bound,
        stationarity_ridge(observed, None) / len(rewards),
        observed.eta_floor,
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
