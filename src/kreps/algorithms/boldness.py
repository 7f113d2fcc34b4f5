"""How bold an update may be: bolder where its policy is judged before it acts.

A low temperature and imagined actions that are wider than those taken both gain most of the time
and go wrong some of the time.  Where `kreps.algorithms.judgement` keeps what went wrong from
acting, both pay; where nothing can be simulated, as in images, neither does.
"""

from __future__ import annotations

from kreps.algorithms.imagined_rollouts import Simulator
from kreps.dual import ETA_LEAST
from kreps.settings import Settings

ETA_FLOOR_JUDGED = 0.01
ETA_FLOOR_NOT_JUDGED = 0.05
"""Least temperatures where none is asked for, in standard deviations of the reward.  At the higher
one a task with a dear beginning is learnt no further than that beginning: what is lost at each step
of keeping a goal, a hundredth of a deviation, the soft maximum does not see."""


def is_judged(simulator: Simulator | None, settings: Settings) -> bool:
    """Whether an update's policy is followed in the learnt dynamics before it acts."""
    return simulator is not None and settings.judging_rollouts > 0


def least_temperature(simulator: Simulator | None, settings: Settings) -> float:
    """Of the dual, in standard deviations of the reward: ``eta_floor``, and above zero."""
    floor = settings.eta_floor
    if floor is None:
        judged = is_judged(simulator, settings)
        floor = ETA_FLOOR_JUDGED if judged else ETA_FLOOR_NOT_JUDGED
    return max(floor, ETA_LEAST)


def widening(simulator: Simulator | None, settings: Settings) -> float:
    """With how many deviations of a policy its actions are imagined: ``imagined_noise``.

    One that then acts with as much less is soon sure of itself, so it has to be judged: where
    it is not, 1.
    """
    return settings.imagined_noise if is_judged(simulator, settings) else 1.0
