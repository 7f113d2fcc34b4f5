"""The time scale of learning where the settings leave it open: how long rollouts are.

docs/decisions/0020-time-that-fits-the-task.md has the reasons and what was measured.
"""

from __future__ import annotations

from kreps.data.task import TaskSpec
from kreps.settings import USUAL_RESTART_PROBABILITY, LearnerSettings

LENGTHS = 50, 200
"""Smallest and largest number of steps of a rollout that is chosen, on average."""

ENDING = 0.005
"""Restart probability where an episode has terminated, and no time limit is known: what matters may
happen late in an episode."""


def restart_probability(settings: LearnerSettings, task: TaskSpec, terminated: bool) -> float:
    """p: that of the settings, or ``1 / clip(T, 50, 200)`` for episodes of at most T steps.

    Without a known time limit it is 0.02, as in the paper, until an episode has terminated, and
    0.005 from then on.

    Args:
        settings: of the learner.
        task: whose ``time_limit`` is T.
        terminated: whether any episode so far ended by a termination.
    """
    if settings.restart_probability is not None:
        return settings.restart_probability
    if task.time_limit is None:
        return ENDING if terminated else USUAL_RESTART_PROBABILITY
    least, most = LENGTHS
    return 1.0 / min(max(task.time_limit, least), most)
