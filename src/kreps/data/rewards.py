"""What a learner explores with before there is a policy, for how long, and what it remembers of it.

White noise averages out: what one step pushes the next one takes back, and a task whose states
change slowly is never seen to change.  Noise with a power spectrum of ``1 / f^beta`` has slow parts
as well: pink noise, beta = 1, as much in every octave, so that it needs no time scale (Eberhard et
al. 2023 explore with it by default); red noise, beta = 2, is the random walk that goes farthest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kreps.data.rollout import Rollout
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray

UNTOLD = 2e-7
"""Part of the largest reward that is none: what 32-bit numbers lose in a sum or a product."""


def tells_of_states(rollouts: Sequence[Rollout], task: TaskSpec) -> bool:
    """Whether the rewards of some roll-outs depend on more than a price of the actions.

    A goal that was never reached is a constant, and what else there is may be what actions cost,
    quadratic as it mostly is.  Learnt from, it says that to do nothing is best.
    """
    rewards = np.concatenate([rollout.rewards for rollout in rollouts])
    least = UNTOLD * np.abs(rewards).max()
    if np.ptp(rewards) <= least:
        return False
    actions = task.scaled(task.clip(np.concatenate([rollout.actions for rollout in rollouts])))
    idle = task.scaled(task.clip(np.zeros((1, task.action_size))))
    terms, of_idle = quadratic_terms(actions), quadratic_terms(idle)
    if len(terms) <= terms.shape[1]:  # anything can be made of so many
        return True
    price = np.linalg.lstsq(terms, rewards)[0]
    exact = np.abs(rewards - terms @ price).max() <= least
    return not (exact and rewards.max() <= of_idle @ price + least)


def each_tells(rollouts: Sequence[Rollout], task: TaskSpec) -> bool:
    """Whether the rewards of each roll-out tell of its states: if not, a goal is known from others.

    Those too short to know are taken to tell.
    """
    return all(tells_alone(rollout, task) for rollout in rollouts if is_long_enough(rollout, task))


def tells_alone(rollout: Rollout, task: TaskSpec) -> bool:
    """Whether the rewards of one roll-out tell of states, and it is long enough to know."""
    return is_long_enough(rollout, task) and tells_of_states([rollout], task)


def is_long_enough(rollout: Rollout, task: TaskSpec) -> bool:
    """Whether a price of the actions cannot explain just any rewards of a roll-out."""
    return len(rollout) > quadratic_terms(np.zeros((1, task.action_size))).shape[1]


def quadratic_terms(actions: FloatArray) -> FloatArray:
    """One, each coordinate of actions (n, da), and each product of two of them."""
    i, j = np.triu_indices(actions.shape[1])
    return np.column_stack([np.ones(len(actions)), actions, actions[:, i] * actions[:, j]])
