"""The time scale of learning where the settings leave it open: how long rollouts are, and how
often a policy decides.

docs/decisions/0020-time-that-fits-the-task.md has the reasons and what was measured.
"""

from __future__ import annotations

from kreps.checks import MAX_ACTION_REPEAT
from kreps.data.task import TaskSpec
from kreps.settings import USUAL_RESTART_PROBABILITY, LearnerSettings, Settings

DECISION_PERIOD = 0.04
"""Seconds for which an action is held, where that can be chosen: 25 decisions per second."""

ENDING = 0.005
"""Restart probability where an episode has terminated: what matters may happen late in one."""


def action_repeat(settings: Settings, task: TaskSpec) -> int:
    """Steps for which an action is held: those of the settings, or about 0.04 s.

    1 where the control period is not known.
    """
    if settings.action_repeat is not None:
        return settings.action_repeat
    if task.dt is None:
        return 1
    return min(max(round(DECISION_PERIOD / task.dt), 1), MAX_ACTION_REPEAT)


def restart_probability(settings: LearnerSettings, terminated: bool) -> float:
    """p: that of the settings, or 0.02 until an episode has terminated, and 0.005 from then on.

    Args:
        settings: of the learner.
        terminated: whether any episode so far ended by a termination.
    """
    if settings.restart_probability is not None:
        return settings.restart_probability
    return ENDING if terminated else USUAL_RESTART_PROBABILITY


def choices(settings: LearnerSettings, task: TaskSpec, terminated: bool) -> str:
    """A line that says what was chosen and why; empty where all is as in the paper, or given."""
    repeat, said = task.action_repeat, []
    if repeat > 1 and getattr(settings, "action_repeat", repeat) is None:
        period = "" if task.dt is None else f" (control period {task.dt:g} s)"
        said.append(f"actions held {repeat} steps{period}")
    if settings.restart_probability is None and terminated:
        unit = "steps" if repeat == 1 else "decisions"
        said.append(f"rollouts of {1.0 / ENDING:.0f} {unit} on average (an episode has terminated)")
    return ", ".join(said)
