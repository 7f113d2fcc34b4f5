"""What is learnt from: the task's shape, roll-outs, the window kept of them, its transitions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from kreps.data.rewards import (
    tells_alone,
)
from kreps.data.rollout import Rollout, Transitions
from kreps.data.task import TaskSpec


@dataclass(frozen=True)
class Window:
    """The latest ``capacity`` roll-outs: the forgetting mechanism of Sec. 4.1; None keeps all."""

    capacity: int | None
    rollouts: tuple[Rollout, ...] = field(default=())

    def extend(self, rollouts: Iterable[Rollout]) -> Window:
        kept = (*self.rollouts, *rollouts)
        if self.capacity is not None:
            kept = kept[-self.capacity :]
        return Window(self.capacity, kept)

    @cached_property
    def transitions(self) -> Transitions:
        return Transitions.of(self.rollouts)


def extended(window: Window, rollouts: Sequence[Rollout], task: TaskSpec) -> Window:
    """The window with new roll-outs: the latest, a third of it kept for those that tell of states.

    Where a goal is seldom reached, the latest roll-outs may hold none, and say that to do nothing
    is best.  Where each roll-out tells of the states, as it mostly does, these are the latest.
    """
    seen = (*window.rollouts, *rollouts)
    kept = len(window.extend(rollouts).rollouts)
    if kept == len(seen):
        return replace(window, rollouts=seen)
    telling = [i for i, rollout in enumerate(seen) if tells_alone(rollout, task)]
    spared = telling[max(len(telling) - _reserved(window), 0) :]
    others = sorted(set(range(len(seen))) - set(spared))
    places = sorted(spared + others[len(spared) - kept :])
    return replace(window, rollouts=tuple(seen[i] for i in places))


def latest(window: Window) -> Sequence[Rollout]:
    """Roll-outs that are in the window for being new."""
    if window.capacity is None:
        return window.rollouts
    return window.rollouts[-(window.capacity - _reserved(window)) :]


def _reserved(window: Window) -> int:
    return 0 if window.capacity is None else window.capacity // 3
