"""What a learner carries from one update to the next, whatever its method."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from kreps.data.rollout import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import Window, extended
from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import LinearFunction
from kreps.policies.base import LearntPolicy
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT


@dataclass(frozen=True)
class LearnerState:
    """Everything that is carried from one update to the next: a checkpoint is exactly this.

    Attributes:
        window: the roll-outs kept.
        iteration: updates made.
        rollouts, steps: roll-outs and environment steps seen, forgotten ones included.
        policy: that acts next: of the latest update, or the one before if that was refused.
        value: V of the latest update, refused or not, if the method has one in an RKHS.
        embedding_start, reward_start, policy_start: log hyper-parameters to start the next fits
            from, if the method fits any.
    """

    window: Window
    iteration: int = 0
    rollouts: int = 0
    steps: int = 0
    policy: LearntPolicy | None = None
    value: LinearFunction | None = None
    embedding_start: FloatArray | None = None
    reward_start: FloatArray | None = None
    policy_start: FloatArray | None = None

    def extended(self, rollouts: Sequence[Rollout], task: TaskSpec) -> tuple[Window, Transitions]:
        """The window with new roll-outs, and its transitions.

        Raises:
            DataError: no roll-outs at all, or some of another width than the task's.
            ConfigurationError: more samples than an exact update can serve.
        """
        window = self.extended_window(rollouts, task)
        data = window.transitions
        if len(data) > MAX_SUPPORT:
            raise ConfigurationError(
                f"{len(data)} samples are kept, but the exact update takes at most {MAX_SUPPORT}, "
                f"as it costs their cube; keep fewer than {len(window.rollouts)} roll-outs: set a "
                'smaller window (or let KREPS approximate: approximation="auto")'
            )
        return window, data

    def extended_window(self, rollouts: Sequence[Rollout], task: TaskSpec) -> Window:
        """The window with new roll-outs.

        Raises:
            DataError: no roll-outs at all, or some of another width than the task's.
        """
        for rollout in rollouts:
            rollout.check(task)
        window = extended(self.window, rollouts, task)
        if not window.rollouts:
            raise DataError("there is no roll-out to learn from; give at least one")
        return window

    def after(self, rollouts: Sequence[Rollout], window: Window, **learnt: Any) -> LearnerState:
        """The state after an update from new ``rollouts``, with what was ``learnt`` replaced."""
        return self.after_data(len(rollouts), sum(map(len, rollouts)), window=window, **learnt)

    def after_data(self, rollouts: int, steps: int, **learnt: Any) -> LearnerState:
        """The same after so many new roll-outs and steps, wherever they were."""
        return replace(
            self,
            iteration=self.iteration + 1,
            rollouts=self.rollouts + rollouts,
            steps=self.steps + steps,
            **learnt,
        )


class UpdateReport(Protocol):
    """What every method reports of an update."""

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
        """What a progress display shows, by column."""
        ...


class Stopwatch:
    """CPU seconds between laps, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.process_time()

    def lap(self, stage: str) -> None:
        now = time.process_time()
        self.seconds[stage] = now - self._last
        self._last = now
