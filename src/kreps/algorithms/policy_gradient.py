"""Gradient ascent of the return in the model, which the paper has not.

The bounded steps of the model-based step need V, which few samples do not determine in many
dimensions.  Derivatives of the return through rollouts in the model need no V.  They are local, so
they improve the policy that the bounded steps have found.

A step moves the mean of the policy in the direction in which the return grows fastest per mean
squared change of the actions in visited states.  That is the natural gradient: with a constant
variance the KL divergence between two policies is this change.  Its size grows after a gain and
shrinks without one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kreps.algorithms.acceptance import ModelComparison
from kreps.kernels.arrays import FloatArray
from kreps.kernels.linalg import cholesky, with_diagonal
from kreps.models.model_env import step_shares
from kreps.models.return_gradient import (
    TINY,
    FixedNoise,
    RolloutRecord,
    StepRewards,
    action_gradient,
    average_return,
    limited,
    roll_out,
)
from kreps.policies.sparse_gp import SparseGP

FIRST_STEP, SMALLEST_STEP = 0.05, 0.003
"""Root mean square change of the actions of the first step, and of that after which there is no
further one, in units of the action scale."""

LARGER, SMALLER = 1.5, 0.4
"""Factors of the size of a step after a gain and without one."""

MAX_RELATIVE_GRADIENT = 0.5
"""Largest derivative of the return by an action, relative to the mean one: few states with large
derivatives would decide the direction otherwise."""

RIDGE, JITTER = 1e-3, 1e-9
"""Of the metric: weight of the squared RKHS norm of a change, relative to its mean square in the
visited states, and what is added for a stable factorisation."""

GRADIENT = 1
"""Second part of the seed of the rollouts of the ascent: other starts and noise than those by which
its result is compared, so that a gain on these alone is not taken for one."""

MAX_METRIC_STATES = 1_000
"""Largest number of visited states from which a direction is computed."""


@dataclass(frozen=True)
class Ascent:
    """The objective of the ascent: the return in the model, with fixed random numbers.

    Attributes:
        comparison: of policies in the model.
        noise: of its rollouts.
    """

    comparison: ModelComparison
    noise: FixedNoise

    def evaluate(self, policy: SparseGP) -> tuple[float, RolloutRecord, StepRewards]:
        """The return of a policy, its rollouts and their rewards."""
        env = self.comparison.from_starts
        record = roll_out(env, policy, self.noise)
        rewards = StepRewards.of(record, self.comparison.world.reward_model)
        return float(average_return(env, record, rewards.values).mean()), record, rewards

    def direction(
        self, policy: SparseGP, record: RolloutRecord, rewards: StepRewards
    ) -> FloatArray:
        """Change (r, da) of the mean's weights, for a mean squared change of the actions of one."""
        env = self.comparison.from_starts
        gradient = action_gradient(env, policy, record, rewards)
        every = -(-gradient[:, :, 0].size // MAX_METRIC_STATES)
        states = record.states.reshape(-1, record.states.shape[2])[::every]
        gradient = gradient.reshape(-1, gradient.shape[2])[::every]
        shares = step_shares(len(record.alive), env.restart_probability)
        weights = (shares[:, None] * record.alive).reshape(-1)[::every]
        weights = weights / weights.sum()
        return natural_direction(policy, states, gradient, weights)


def natural_direction(
    policy: SparseGP, states: FloatArray, gradient: FloatArray, weights: FloatArray
) -> FloatArray:
    """The natural gradient (r, da), scaled to a mean squared change of the actions of one.

    Args:
        policy: with r centres.
        states: (m, ds) visited.
        gradient: (m, da) derivatives of the return by the actions there.
        weights: (m,) of the states, which sum to one.
    """
    lengths = np.linalg.norm(gradient, axis=1)
    # in a state of no weight there is no gradient
    relative = np.divide(lengths, weights, out=np.zeros_like(lengths), where=weights > 0.0)
    limit = MAX_RELATIVE_GRADIENT * float(lengths.sum())
    gradient = limited(gradient, relative, max(limit, TINY))
    k = policy.kernel_values(states)
    metric = k.T @ (weights[:, None] * k) + RIDGE * policy.kernel.gram(policy.states)
    found = cholesky(with_diagonal(metric, JITTER)).solve(k.T @ gradient)
    change = np.sqrt(weights @ np.sum((k @ found) ** 2, axis=1))
    direction: FloatArray = found / max(change, TINY)
    return direction


def improve(comparison: ModelComparison, policy: SparseGP, steps: int) -> SparseGP:
    """The policy after at most ``steps`` steps, with the exploration noise that it had.

    Args:
        comparison: of policies in the model, whose return is maximised.
        policy: from which the ascent starts.
        steps: that are tried.
    """
    best, env = policy, comparison.from_starts
    rng = np.random.default_rng((comparison.seed, GRADIENT))
    ascent = Ascent(comparison, FixedNoise.of_policy(env, best, comparison.rollouts, rng))
    value, record, rewards = ascent.evaluate(best)
    direction, size = ascent.direction(best, record, rewards), FIRST_STEP
    for _ in range(steps):
        weights = np.ascontiguousarray(best.mean_weights + size * direction)
        trial = replace(best, mean_weights=weights)
        new_value, record, rewards = ascent.evaluate(trial)
        if new_value > value:
            best, value, size = trial, new_value, LARGER * size
            direction = ascent.direction(best, record, rewards)
        else:
            size *= SMALLER
        if size < SMALLEST_STEP:
            break
    return best
