"""The state of a learner between updates, and the report of an update, for all methods."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from kreps.data.rollouts import Rollout, Transitions
from kreps.data.window import ReplayWindow
from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import LinearFunction
from kreps.policies.base import LearntPolicy
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT


@dataclass(frozen=True)
class LearnerState:
    """Everything that is carried from one update to the next; a checkpoint stores it.

    Attributes:
        window: the replay window.
        iteration: updates made.
        rollouts, steps: rollouts and environment steps seen, forgotten ones included.
        terminated: whether any of these rollouts ended by a termination.
        policy: the one that acts: that of the latest update, or the previous one if that was
            rejected; None before the first update.
        explorer: policy that collects half of the next rollouts, as it was learnt with the
            exploration bonus; None where there is none.
        value: V of the latest update, also if its policy was rejected; None for methods whose V is
            not linear in features.
        embedding_start, reward_start, policy_start: log hyper-parameters from which the next fits
            of the transition model, the reward model and the policy start.
    """

    window: ReplayWindow
    iteration: int = 0
    rollouts: int = 0
    steps: int = 0
    terminated: bool = False
    policy: LearntPolicy | None = None
    explorer: LearntPolicy | None = None
    value: LinearFunction | None = None
    embedding_start: FloatArray | None = None
    reward_start: FloatArray | None = None
    policy_start: FloatArray | None = None

    def append(self, rollouts: Sequence[Rollout]) -> ReplayWindow:
        """The window with new rollouts.

        Raises:
            DataError: no rollouts at all, or some of another width than the task's.
        """
        window = self.window.append(rollouts)
        if not window.rollouts:
            raise DataError("there is no rollout to learn from; give at least one")
        return window

    def with_history(self, delay: int, history: int) -> LearnerState:
        """The state for an update with other states of the task.

        If they differ from those before, nothing that was learnt with them is kept but the window:
        policies, V and hyper-parameters are of states of another width.
        """
        task = self.window.task
        if (delay, history) == (task.delay, task.history):
            return self
        window = replace(self.window, task=replace(task, delay=delay, history=history))
        return LearnerState(window, self.iteration, self.rollouts, self.steps, self.terminated)

    def after(self, rollouts: int, steps: int, window: ReplayWindow, **learnt: Any) -> LearnerState:
        """The state after an update from so many new rollouts and steps, with what was learnt."""
        return replace(
            self,
            iteration=self.iteration + 1,
            rollouts=self.rollouts + rollouts,
            steps=self.steps + steps,
            terminated=self.terminated or bool(window.rollouts.terminated.any()),
            window=window,
            **learnt,
        )


def exact_transitions(window: ReplayWindow) -> Transitions:
    """The transitions of the window, for an update whose cost is cubic in their number.

    Raises:
        ConfigurationError: more than `MAX_SUPPORT` transitions.
    """
    data = window.transitions
    if len(data) > MAX_SUPPORT:
        raise ConfigurationError(
            f"{len(data)} samples are kept, but the exact update takes at most {MAX_SUPPORT}, as "
            f"its cost is cubic; keep fewer than {len(window.rollouts)} rollouts by a smaller "
            "window, or let KREPS approximate: low_rank=kreps.LowRank()"
        )
    return data


class UpdateReport(Protocol):
    """The diagnostics of an update that every method has."""

    @property
    def samples(self) -> int:
        """n."""
        ...

    @property
    def seconds(self) -> dict[str, float]:
        """CPU seconds by stage."""
        ...

    def numbers(self) -> dict[str, float]:
        """The diagnostics of the method, by name."""
        ...

    def shown(self) -> dict[str, str]:
        """The columns of a progress display."""
        ...


class Stopwatch:
    """CPU seconds between laps, summed by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.process_time()

    def lap(self, stage: str) -> None:
        now = time.process_time()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now
