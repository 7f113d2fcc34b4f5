"""The learnt policy in a control loop, and in a batch of rollouts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from criteria import Milliseconds99, TimesAsLong, TimesFaster
from data import policy_with_support, swing_up
from measuring import Measure
from scipy.linalg import solve_triangular

from kreps.kernels.arrays import FloatArray
from kreps.learning.collect import simulate
from kreps.learning.policy import Policy
from kreps.policies.base import StochasticPolicy
from kreps.policies.cost_sensitive_gp import CostSensitiveGP

SUPPORT, ROLLOUTS, STEPS = 1500, 10, 50


@dataclass(frozen=True)
class TriangularSolve:
    """The textbook Gaussian process: mean from alpha, variance from one triangular solve."""

    exact: CostSensitiveGP

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        gp = self.exact
        k = gp.signal * gp.kernel.gram(gp.states, states)
        explained = solve_triangular(gp.factor.lower, k, lower=True, check_finite=False)
        variance = gp.signal - np.einsum("ij,ij->j", explained, explained) + gp.noise
        return gp.task.unscaled(k.T @ gp.alpha + np.sqrt(variance)[:, None] * noise)


@dataclass(frozen=True)
class OneStateAtATime:
    """The same with a separate solve for each state."""

    policy: TriangularSolve

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        pairs = zip(states[:, None], noise[:, None], strict=True)
        return np.concatenate([self.policy.act(s, z) for s, z in pairs])


@pytest.mark.parametrize(("greedy", "limit"), [(True, 0.1), (False, 1.0)])
@pytest.mark.parametrize(("kernel", "stretch"), [("learnt", 1.0), ("rough", 0.05)])
def bench_predict(
    measure: Measure, kernel: str, stretch: float, greedy: bool, limit: float
) -> None:
    """With a rough kernel no support point can be predicted from the others."""
    policy = Policy(policy_with_support(SUPPORT, stretch))
    observation = np.array([0.5, -1.0])
    measure(
        f"predict, {'greedy' if greedy else 'with noise'}, {kernel} kernel",
        f"{SUPPORT} support points",
        lambda: policy.predict(observation, deterministic=greedy),
        Milliseconds99(at_most=limit),
        rounds=3000,
    )


def bench_rollouts(measure: Measure) -> None:
    exact = policy_with_support(SUPPORT)
    learner = swing_up(SUPPORT).learner
    assert learner.env is not None
    env = learner.env

    def simulate_with(policy: StochasticPolicy) -> None:
        noises = [np.random.default_rng(j).standard_normal((STEPS, 1)) for j in range(ROLLOUTS)]
        simulate(env, learner.task, policy, range(ROLLOUTS), noises)

    solved = TriangularSolve(exact)
    singly = OneStateAtATime(solved)
    states, noise = exact.states[::50], np.ones((30, 1))
    difference = exact.act(states, noise) - solved.act(states, noise)
    assert np.abs(difference / learner.task.action_scale).max() < 1e-3
    measure(
        f"{ROLLOUTS} rollouts of {STEPS} steps",
        f"{SUPPORT} support points",
        lambda: simulate_with(exact),
        TimesAsLong("triangular solves in batches", lambda: simulate_with(solved), at_most=1.3),
        TimesFaster("a solve per state", lambda: simulate_with(singly), at_least=5.0),
    )
