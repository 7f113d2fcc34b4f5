"""How bold an update may be: bolder where its policy is judged before it acts.

A low temperature and imagined actions that are wider than those taken both gain most of the time
and go wrong some of the time.  Where `kreps.algorithms.judgement` keeps from acting what went
wrong, both pay; where nothing can be simulated, as in images, neither does.
"""

from __future__ import annotations

from kreps.algorithms.imagined_rollouts import Simulator
from kreps.dual import ETA_LEAST
from kreps.settings import Settings

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
