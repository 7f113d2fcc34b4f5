"""Policies that linear-quadratic regulators are part of, which the paper has not.

Bounded steps and the gradient improve a policy by small changes.  Where the dynamics are unstable
their results stay far behind what the model allows: from 330 steps of a double pendulum they keep
it up for 20 steps, and the feedback that is optimal for the linearised model for 200 or more.

Near its equilibrium a regulator is the better policy, and only there.  So in a switching policy it
acts in states from which the linearised model expects a small cost, and another policy in all
others; which regulator and up to which cost is decided by the return in the model (R. Tedrake et
al., IJRR 2010, verify such regions in place of comparing returns).  Where episodes end, a regulator
is also a candidate alone.

The control loop and the files know Gaussian process policies only.  So a switching policy is the
teacher of one: it is fitted in states that the teacher visits in the model, and once more in those
that the fit visits (S. Ross, G. Gordon and D. Bagnell, AISTATS 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kreps.algorithms.acceptance import ModelComparison
from kreps.algorithms.policy_targets import MIN_ACTION_VARIANCE
from kreps.algorithms.regulators import Regulator
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel, as_wide_as_spread
from kreps.kernels.linalg import solve_lower_transposed
from kreps.policies.base import StochasticPolicy
from kreps.policies.sparse_gp import SparseGP

REGION_SIZES = (1.0, 4.0, 16.0, 64.0)
"""Expected costs up to which a regulator acts, relative to the one up to which its feedback alone
changes no scaled action by more than one.  There is a switching policy for each."""

ROUNDS = ((4, 4), (20, 1))
"""Rounds in which switching policies are compared: model rollouts of each, and how many remain.
The fit to the last one is then compared by as many rollouts as all other policies."""

FIT_ROLLOUTS, MAX_FIT_STATES = 30, 2_000
"""Rollouts of a switching policy in whose states another is fitted to it, and the largest number of
these states."""

FIT_PART = 2
"""Second part of the seed of these rollouts."""

LIMIT = 3.0
"""Of the scaled actions that are fitted: beyond, noise does not bring them back into the limits of
the action."""

LENGTHSCALES, RIDGE = 2.0, 1e-6
"""Of that fit: lengthscales relative to those of the policy, and ridge for features of norm one."""

WIDER, LINEAR_RIDGE = 3.0, 1e-9
"""The same of the fit to a regulator alone, with lengthscales in spreads of the samples.  A linear
function needs long lengthscales."""

MAX_CENTRES, MAX_RESIDUAL = 300, 1e-10
"""Of both fits: number of centres, and the squared residual of the kernel at which fewer are
enough."""

NO_SIGNAL = 1e-12
"""Signal variance of a fitted policy: its standard deviation is that of the noise everywhere."""


@dataclass(frozen=True)
class SwitchingPolicies:
    """Policies that a regulator replaces where the linearised model expects a small cost.

    Each acts in an equal part of the rows of a call, so that they are compared side by side.

    Attributes:
        policy: that acts elsewhere, with its exploration noise everywhere.
        switches: of each policy the regulator that acts near its equilibrium, and the expected cost
            up to which it does.
    """

    policy: SparseGP
    switches: Sequence[tuple[Regulator, float]]

    def scaled(self, states: FloatArray) -> FloatArray:
        """Scaled actions (m, da) around the centre, without noise, at states (m, ds)."""
        return self._switched(states, self.policy.scaled_mean(states))

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        mean, deviation = self.policy.scaled_mean_and_deviation(states)
        return self.policy.task.unscaled(self._switched(states, mean) + deviation * noise)

    def _switched(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        size, actions = len(states) // len(self.switches), actions.copy()
        for number, (regulator, max_cost) in enumerate(self.switches):
            rows = slice(number * size, (number + 1) * size)
            feedback, costs = regulator.with_expected_costs(states[rows])
            near = costs <= max_cost
            actions[rows][near] = feedback[near]
        return actions

    def best(self, comparison: ModelComparison, count: int) -> SwitchingPolicies:
        """Those with the largest mean returns in the model, so many at most."""
        returns = comparison.returns(self, len(self.switches))
        order = np.argsort(-returns.reshape(len(self.switches), -1).mean(axis=1), kind="stable")
        return replace(self, switches=[self.switches[k] for k in order[:count]])


def best_switching_policy(
    comparison: ModelComparison, policy: SparseGP, regulators: Sequence[Regulator]
) -> SparseGP:
    """A fit to the switching policy with the largest return in the model.

    Args:
        comparison: of policies in the model.
        policy: that acts far from the equilibria, and whose noise the fit has.
        regulators: one or more.
    """
    switches = [(r, size * r.cost_of_unit_feedback) for r in regulators for size in REGION_SIZES]
    teacher = SwitchingPolicies(policy, switches)
    for rollouts, remaining in ROUNDS:
        teacher = teacher.best(replace(comparison, rollouts=rollouts), remaining)
    kernel = policy.kernel.with_lengthscales(LENGTHSCALES * policy.kernel.lengthscales)
    rng = np.random.default_rng((comparison.seed, FIT_PART))

    def fit(states: FloatArray) -> SparseGP:
        targets = np.clip(teacher.scaled(states), -LIMIT, LIMIT)
        return fitted(policy, kernel, states, targets, RIDGE)

    states = visited(comparison, teacher, rng)
    return fit(np.concatenate([states, visited(comparison, fit(states), rng)]))


def visited(
    comparison: ModelComparison, policy: StochasticPolicy, rng: np.random.Generator
) -> FloatArray:
    """States (m, ds) of model rollouts of a policy, in random order."""
    env = comparison.from_starts
    starts = env.starts(FIT_ROLLOUTS, rng)
    states = env.trajectories(policy, starts, env.evaluation_steps, rng).reshape(
        -1, starts.shape[1]
    )
    return rng.permutation(states[~np.isnan(states).any(axis=1)])[:MAX_FIT_STATES]


def best_regulator(
    comparison: ModelComparison, policy: SparseGP, regulators: Sequence[Regulator], kernel: Kernel
) -> SparseGP:
    """A fit to the regulator with the largest return in the model, with the least noise.

    A policy that keeps an unstable state has to act precisely; the explorer is there to explore.

    Args:
        comparison: of policies in the model.
        policy: that all but kernel, centres, mean and variances are taken from.
        regulators: one or more.
        kernel: over states, at median lengthscales.
    """
    best = max(regulators, key=lambda each: float(comparison.returns(each).mean()))
    states = comparison.world.states
    kernel = as_wide_as_spread(kernel, states)
    wide = kernel.with_lengthscales(WIDER * kernel.lengthscales)
    fit = fitted(policy, wide, states, best.scaled(states), LINEAR_RIDGE)
    return replace(fit, noise=MIN_ACTION_VARIANCE)


def fitted(
    policy: SparseGP, kernel: Kernel, states: FloatArray, targets: FloatArray, ridge: float
) -> SparseGP:
    """A policy with another mean, and with its noise alone as variance.

    Args:
        policy: that task and noise are taken from.
        kernel: of the new mean.
        states: (n, ds), among which its centres are.
        targets: (n, da) scaled actions there, around the centre.
        ridge: of the fit, for features of norm one.
    """
    basis, features = RKHSBasis.fit(kernel, states, tolerance=MAX_RESIDUAL, max_rank=MAX_CENTRES)
    gram = features.T @ features + ridge * len(states) * np.eye(features.shape[1])
    theta = np.linalg.solve(gram, features.T @ targets)
    return replace(
        policy,
        kernel=kernel,
        states=np.ascontiguousarray(basis.pivots),
        mean_weights=np.ascontiguousarray(solve_lower_transposed(basis.lower, theta)),
        explained=np.zeros_like(basis.lower),
        signal=NO_SIGNAL,
    )
