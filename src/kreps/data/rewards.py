"""Whether rewards depend on the state, or only on the cost of actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import BoolArray, FloatArray

REWARD_RTOL = 2e-7
"""Differences of rewards below this fraction of the largest magnitude count as rounding: it is what
32-bit numbers lose in a sum or a product."""

IDENTIFIED_RTOL, IDENTIFIED_ATOL = 1e-10, 1e-6
"""Squared variation of terms, as a share of the largest, that counts as none; and the part of a
term, each of which is at most about one, that may be missed."""

BETTER_RTOL = 1e-4
"""Part of the range of rewards by which another action must be better than the zero action."""


def reward_depends_on_state(data: Rollout | Rollouts, task: TaskSpec) -> bool:
    """Whether the rewards of at least one step are more than a constant minus an action cost.

    Until some rollout reaches a sparse goal, the reward is a constant minus an action cost, and
    learning from it only teaches inaction.  It is detected by a least-squares fit of the rewards by
    a quadratic in the actions: the fit is exact, and no action is better than the zero action,
    neither one that was taken nor, by the fit, another one.

    The data must identify what the zero action costs.  Actions at their limits alone do not: any
    rewards of two actions are those of some cost.

    In rollouts of one step no action leads to a goal that could be reached later: their reward is
    what there is to learn, whatever it depends on.

    After a termination there is no reward.  So the reward depends on the state if any episode
    terminated and any reward is not zero.
    """
    rewards = data.rewards
    if len(rewards) == np.size(data.terminated):  # rollouts of one step
        return True
    if np.any(data.terminated) and rewards.any():
        return True
    tolerance = REWARD_RTOL * np.abs(rewards).max()
    if np.ptp(rewards) <= tolerance:
        return False
    actions = task.scaled_applied(data.actions)
    terms = quadratic_terms(actions)
    if len(terms) <= terms.shape[1]:  # a quadratic fits so few rewards exactly, whatever they are
        return True
    zero = task.scaled_applied(np.zeros((1, task.action_size)))
    coefficients = np.linalg.lstsq(terms, rewards)[0]
    if np.abs(rewards - terms @ coefficients).max() > tolerance or not _identified(terms, zero)[0]:
        return True
    value = quadratic_terms(zero) @ coefficients
    others = _best_on_lines(coefficients, zero[0])
    others = others[_identified(terms, others)]
    better = quadratic_terms(others) @ coefficients > value + BETTER_RTOL * np.ptp(rewards)
    return bool(rewards.max() > value + tolerance or better.any())


def is_informative(rollout: Rollout, task: TaskSpec) -> bool:
    """Whether a rollout is long enough to decide it, and its reward depends on the state."""
    return is_long_enough(rollout, task) and reward_depends_on_state(rollout, task)


def is_long_enough(rollout: Rollout, task: TaskSpec) -> bool:
    """Whether a rollout has more steps than a quadratic in the actions has coefficients."""
    return len(rollout) > (task.action_size + 1) * (task.action_size + 2) // 2


def _identified(terms: FloatArray, actions: FloatArray) -> BoolArray:
    """Whether a fit to terms (n, q) determines the values at scaled actions (m, da), (m,).

    It does if the terms of the data span theirs.
    """
    gram, wanted = terms.T @ terms, quadratic_terms(actions).T
    spanned = gram @ np.linalg.lstsq(gram, wanted, rcond=IDENTIFIED_RTOL)[0]
    return np.abs(spanned - wanted).max(axis=0) <= IDENTIFIED_ATOL


def _best_on_lines(coefficients: NDArray[Any], start: FloatArray) -> FloatArray:
    """Scaled actions (da, da), the best ones that differ from ``start`` in one coordinate.

    Args:
        coefficients: (q,) of `quadratic_terms`.
        start: (da,) scaled action.
    """
    size = len(start)
    lines = np.repeat(start[None], size, axis=0)
    for i in range(size):
        along = np.repeat(start[None], 3, axis=0)
        along[:, i] = -1.0, 0.0, 1.0
        low, middle, high = quadratic_terms(along) @ coefficients
        slope, curvature = 0.5 * (high - low), 0.5 * (high + low) - middle
        best = np.sign(slope) if curvature >= 0.0 else np.clip(-0.5 * slope / curvature, -1.0, 1.0)
        lines[i, i] = best
    return lines


def quadratic_terms(actions: FloatArray) -> FloatArray:
    """One, each coordinate of actions (n, da), and each product of two of them: (n, q)."""
    i, j = np.triu_indices(actions.shape[1])
    return np.column_stack([np.ones(len(actions)), actions, actions[:, i] * actions[:, j]])
