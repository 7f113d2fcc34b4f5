"""Value iteration as the authors' scripts have it: the hard maximum, and a known reward.

``Q(s, a) = r(s, a) + gamma sum_i beta_i(s, a) V(s'_i)`` and V is the largest Q of the candidates.
The sweeps begin at V = max r and end when V changes by one per cent.  Far from the data, where the
strengths beta vanish, V is the best reward of a single step.  Unlike in the scripts it is limited
to the returns that are possible: the strengths may sum to more than one, and V would diverge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.regression import KernelEmbedding
from kreps.policies.relative_softmax import RelativeSoftmaxPolicy

RewardFunction = Callable[[FloatArray, FloatArray], FloatArray]
"""Rewards (m,) of actions (m, da) in states (m, ds), in the task's units."""

MAX_RELATIVE_SWEEPS = 100
"""Largest number of sweeps of the scripts."""

RELATIVE_TOLERANCE = 1e-2
"""Norm of the change of V in the last sweep, as a share of that of V, that ends the sweeps."""

SEPARABLE_RTOL = 1e-9
"""Largest deviation of a known reward from a function of the state plus one of the action, as a
share of its largest absolute value."""


@dataclass(frozen=True)
class QFunction:
    """``Q(s, a_k) = offset + sum_i k_s(s_i, s) table_ik``.

    Attributes:
        table: (n, k) of samples and candidate actions.
        offset: value far from the data.
        sweeps: number of sweeps.
        change: range of the change of V in the last sweep.
    """

    table: FloatArray
    offset: float
    sweeps: int
    change: float


def known_rewards(
    known_reward: RewardFunction, points: FloatArray, actions: FloatArray
) -> FloatArray:
    """Rewards (m, k) of each of k actions in each of m states.

    Args:
        known_reward: the reward function.
        points: (m, ds) states.
        actions: (k, da) in the task's units.

    Raises:
        ConfigurationError: the reward is not a function of the state plus one of the action.  Only
            such a reward can be left to the policy as numbers, one for each action.
    """
    m, k = len(points), len(actions)
    repeated, tiled = np.repeat(points, k, axis=0), np.tile(actions, (m, 1))
    rewards = known_reward(repeated, tiled).reshape(m, k)
    interaction = rewards - rewards[:, :1] - (rewards[0] - rewards[0, 0])
    if np.abs(interaction).max() > SEPARABLE_RTOL * np.abs(rewards).max():
        raise ConfigurationError(
            "known_reward = True, but the reward of this task is not a function of the state plus "
            "one of the action; set known_reward=False to learn it"
        )
    return rewards


def iterate_to_one_percent(
    model: KernelEmbedding,
    data: Transitions,
    known: FloatArray | None,
    candidates: FloatArray,
    gamma: float,
) -> QFunction:
    """Q after the sweeps; its table is of the sum over samples, in units of the reward.

    Args:
        model: embedding on states and scaled actions, fitted to ``data``.
        data: n transitions.  After a termination V is zero.
        known: (points, k) rewards of each candidate at each point; None if the observed rewards are
            summed with the values of the successors instead.
        candidates: (k, da) scaled actions.
        gamma: discount.
    """
    ds, da = data.points.shape[1], candidates.shape[1]
    states = model.kernel.part(slice(-da)).gram(data.states, data.points).T  # (points, n)
    padded = np.pad(candidates, ((0, 0), (ds, 0)))  # the factors select columns after the states
    actions = model.kernel.part(slice(-da, None)).gram(model.inputs, padded)  # (n, k)
    observed = data.rewards if known is None else 0.0
    added = 0.0 if known is None else known
    values = np.zeros(len(data.points)) if known is None else known.max(axis=1)
    earned = data.rewards if known is None else known
    # after a termination nothing is earned, so that zero is possible as well
    ends = [0.0] if data.terminated.any() else []
    low, high = (limit(np.append(earned, ends)) / (1.0 - gamma) for limit in (np.min, np.max))
    sweeps, change, table = 0, np.inf, actions
    while change > RELATIVE_TOLERANCE and sweeps < MAX_RELATIVE_SWEEPS:
        sweeps += 1
        targets = observed + gamma * np.where(data.terminated, 0.0, values[data.successor])
        table = model.factor.solve(targets)[:, None] * actions
        new_values = np.clip((states @ table + added).max(axis=1), low, high)
        size = float(np.linalg.norm(new_values))
        change = float(np.linalg.norm(new_values - values)) / size if size > 0.0 else 0.0
        values = new_values
    return QFunction(table, 0.0, sweeps, change)


def relative_policy(
    model: KernelEmbedding,
    data: Transitions,
    task: TaskSpec,
    q: QFunction,
    known: FloatArray | None,
    candidates: FloatArray,
    temperature: float,
) -> RelativeSoftmaxPolicy:
    """The softmax of Q over its standard deviation in each state; arguments as before."""
    of_actions = np.zeros(len(candidates)) if known is None else known[0] - known[0].mean()
    return RelativeSoftmaxPolicy(
        task,
        model.kernel.part(slice(-task.action_size)),
        data.states,
        q.table,
        q.offset,
        candidates,
        temperature,
        of_actions,
    )
