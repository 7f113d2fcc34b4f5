"""Whether rewards depend on the state, or only on the cost of actions."""

from __future__ import annotations

import numpy as np

from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray

REWARD_RTOL = 2e-7
"""Differences of rewards below this fraction of the largest magnitude count as rounding: it is what
32-bit numbers lose in a sum or a product."""


def reward_depends_on_state(data: Rollout | Rollouts, task: TaskSpec) -> bool:
    """Whether the rewards of at least one step are more than a constant minus an action cost.

    Until some rollout reaches a sparse goal, the reward is a constant minus an action cost, and
    learning from it only teaches inaction.  It is detected by a least-squares fit of the rewards by
    a quadratic in the actions: the fit is exact, and no reward is above that of the zero action.

    After a termination there is no reward.  So the reward depends on the state if any episode
    terminated and any reward is not zero.
    """
    rewards = data.rewards
    if np.any(data.terminated) and rewards.any():
        return True
    tolerance = REWARD_RTOL * np.abs(rewards).max()
    if np.ptp(rewards) <= tolerance:
        return False
    terms = quadratic_terms(task.scaled_applied(data.actions))
    terms_of_zero = quadratic_terms(task.scaled_applied(np.zeros((1, task.action_size))))
    if len(terms) <= terms.shape[1]:  # a quadratic fits so few rewards exactly, whatever they are
        return True
    coefficients = np.linalg.lstsq(terms, rewards)[0]
    exact = np.abs(rewards - terms @ coefficients).max() <= tolerance
    return not (exact and rewards.max() <= terms_of_zero @ coefficients + tolerance)


def is_informative(rollout: Rollout, task: TaskSpec) -> bool:
    """Whether a rollout is long enough to decide it, and its reward depends on the state."""
    return is_long_enough(rollout, task) and reward_depends_on_state(rollout, task)


def is_long_enough(rollout: Rollout, task: TaskSpec) -> bool:
    """Whether a rollout has more steps than a quadratic in the actions has coefficients."""
    return len(rollout) > (task.action_size + 1) * (task.action_size + 2) // 2


def quadratic_terms(actions: FloatArray) -> FloatArray:
    """One, each coordinate of actions (n, da), and each product of two of them: (n, q)."""
    i, j = np.triu_indices(actions.shape[1])
    return np.column_stack([np.ones(len(actions)), actions, actions[:, i] * actions[:, j]])
