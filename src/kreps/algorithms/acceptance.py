"""How bold an update may be: bolder where its policy is judged before it acts.

A low temperature and imagined actions that are wider than those taken both gain most of the time
and go wrong some of the time.  Where `kreps.algorithms.judgement` keeps from acting what went
wrong, both pay; where nothing can be simulated, as in images, neither does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kreps.algorithms.dual import ETA_LEAST
from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import Followed, Simulator, average_reward
from kreps.models.world_model import Outlook
from kreps.policies.base import StochasticPolicy
from kreps.settings import Settings


def refuses(
    new: StochasticPolicy,
    before: StochasticPolicy | None,
    outlook: Outlook,
    settings: Settings,
    rng: np.random.Generator,
) -> bool | None:
    """Whether a new policy earns less than the one before, by more than the standard error.

    That error is of starts and noise; of its own errors the model knows nothing.

    Args:
        new, before: with their noise; None before the first update.
        outlook: what the model says.
        settings: ``judging_rollouts`` of each policy.
        rng: of the roll-outs.

    Returns:
        None where nothing can be judged, or is to be.
    """
    count = settings.judging_rollouts
    if before is None or outlook.simulator is None or not count:
        return None
    process = replace(outlook.simulator, exploring_starts=0.0)
    followed, followed_before = process.follow((new, before), outlook.rewards_of, count, rng)
    typical = max(float(np.median(followed_before.likeness)), np.finfo(np.float64).tiny)

    def earned(each: Followed) -> FloatArray:
        hope = outlook.optimism
        if hope is None:
            rewards = each.feared_rewards(outlook.rewards.min(), typical)
        else:
            rewards = hope.hoped_rewards(each)
        return average_reward(rewards, process.restart_probability)

    gain = earned(followed) - earned(followed_before)
    return bool(gain.mean() < -gain.std(ddof=1) / np.sqrt(count))


ETA_FLOOR_JUDGED = 0.01
ETA_FLOOR_NOT_JUDGED = 0.05
"""Least temperatures where none is asked for, in standard deviations of the reward.  Where a task
begins with large costs these are the deviation, and what a goal held badly loses at each step,
about a hundredth of it, is not seen at the higher floor.  Not judged, the lower one lets errors of
the model through."""


def is_judged(simulator: Simulator | None, settings: Settings) -> bool:
    """Whether new policies are followed in the learnt dynamics beside the one before.

    The first one has none beside it, and follows noise, from which there is little to fall.
    """
    return simulator is not None and settings.judging_rollouts > 0


def least_temperature(judged: bool, settings: Settings) -> float:
    """Of the dual, in standard deviations of the reward: ``eta_floor`` if there is one."""
    floor = settings.eta_floor
    if floor is None:
        floor = ETA_FLOOR_JUDGED if judged else ETA_FLOOR_NOT_JUDGED
    return max(floor, ETA_LEAST)


def widening(judged: bool, settings: Settings) -> float:
    """With how many deviations of a policy its actions are imagined: ``imagined_noise``.

    One that then acts with as much less is soon sure of itself, so it has to be judged: where
    it is not, 1.
    """
    return settings.imagined_noise if judged else 1.0
