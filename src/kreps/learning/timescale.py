"""The time scale of learning where the settings leave it open: how long rollouts are, how often a
policy decides, and how many rollouts there are before an update.

docs/decisions/0020-time-that-fits-the-task.md has the reasons and what was measured; of batches,
docs/deviations.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from kreps.checks import MAX_ACTION_REPEAT
from kreps.data.task import TaskSpec
from kreps.settings import (
    USUAL_RESTART_PROBABILITY,
    LearnerSettings,
    OnPolicySettings,
    Settings,
)

AnyOnPolicy = TypeVar("AnyOnPolicy", bound=OnPolicySettings)

DECISION_PERIOD = 0.04
"""Seconds for which an action is held, where that can be chosen: 25 decisions per second."""

ENDING = 0.005
"""Restart probability where an episode has terminated: what matters may happen late in one."""

GROWTH = 0.25
"""New steps of an update as a share of those seen so far, where batches grow with the data."""

FEW_ROLLOUTS, MANY_ROLLOUTS = 3, 30
"""Rollouts before the first update: where batches grow, and as in the paper."""


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


def with_batches(settings: AnyOnPolicy, task: TaskSpec) -> AnyOnPolicy:
    """The settings with the size of the batches where it is left open.

    Batches grow with the data where policies can be rolled out in the model: a model of three
    rollouts is enough to find a better policy.  In images they cannot, and with small first batches
    learning stayed in a local optimum; so the batches there are those of the paper.

    Args:
        settings: ``growth`` and ``initial_rollouts`` stay if they are given.
        task: tells whether observations are images.
    """
    growth, first = settings.growth, settings.initial_rollouts
    if growth is None:
        growth = GROWTH if task.image_shape is None else 0.0
    if first is None:
        first = FEW_ROLLOUTS if growth else MANY_ROLLOUTS
    return replace(settings, growth=growth, initial_rollouts=first)


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
