"""What rollouts of a policy say of it, beside what the model says.

Where a policy keeps episodes going, samples of falling become rare, and the model can take it for
one that falls.  Then others that fall in truth seem better in it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kreps.algorithms.candidates import on_its_centres
from kreps.algorithms.reps import Batch
from kreps.data.rollouts import Transitions
from kreps.kernels.arrays import BoolArray
from kreps.policies.base import LearntPolicy

STANDARD_ERRORS = 5.0
"""By how many the mean squared deviation of the actions of a rollout from a policy, in its standard
deviations, may exceed one if the policy is to have made it."""

MAX_SHARE_OF_ENDS = 0.5
"""Share of the rollouts that end, from which on the return of a policy in truth is not used: then
few rollouts say little, and a policy that falls is to be replaced soon."""


def real_return(batch: Batch[Any, Any], policy: LearntPolicy, end_reward: float) -> float | None:
    """Average reward per step of the acting policy in its rollouts of the window, standardised.

    That of the new ones alone if it is larger: what has just been seen of a policy is not given up
    for a prediction that is only better than what was seen of it before.

    Args:
        batch: the samples, new rollouts last.
        policy: that acted in some rollouts.
        end_reward: reward zero, standardised; it is earned for a mean rollout after an end.

    Returns:
        None if there is no such rollout, or if half of them or more ended.
    """
    made = made_by(policy, batch.data)
    new = np.arange(len(made)) >= len(made) - batch.seen[0]
    returns = [_return_in(batch, rollouts, end_reward) for rollouts in (made, made & new)]
    return max((each for each in returns if each is not None), default=None)


def _return_in(batch: Batch[Any, Any], rollouts: BoolArray, end_reward: float) -> float | None:
    rows = rollouts[batch.data.rollout]
    ends = int(batch.data.terminated[rows].sum())
    if not rollouts.any() or ends >= MAX_SHARE_OF_ENDS * rollouts.sum():
        return None
    without = ends / batch.settings.p
    rewards = float(batch.rewards[rows].sum()) + without * end_reward
    return rewards / (float(rows.sum()) + without)


def made_by(policy: LearntPolicy, data: Transitions) -> BoolArray:
    """Which of R rollouts a policy can have made (R,): its noise explains their actions."""
    task = policy.task
    mean, deviation = on_its_centres(policy).scaled_mean_and_deviation(data.states)
    z = (data.actions - task.unscaled(mean)) / (task.action_scale * deviation)
    count = z.shape[1] * np.bincount(data.rollout, minlength=len(data.start))
    squares = np.bincount(data.rollout, np.sum(z**2, axis=1), minlength=len(data.start))
    found: BoolArray = squares <= count + STANDARD_ERRORS * np.sqrt(2.0 * count)
    return found
