"""The clock of a session: when control cycles are due, and who acts if none comes."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from threading import Event, Thread
from typing import Protocol

LATE = 0.5
"""An action is late by more than this part of the period: it is then nearer to the next cycle."""

OFF = 0.1
"""Relative difference of the mean cycle from the period above which it is told."""


class Clock(Protocol):
    """What a session needs of a clock; the module `time` is one."""

    def monotonic(self) -> float:
        """Seconds since any fixed moment."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait for so long."""
        ...


class Pace:
    """The control cycles of one rollout.

    A cycle is due a period after the one before was; after a late one, a period after it came.  The
    first one is not timed: a robot that waits for its first action needs time to start.

    Args:
        period: of control, in s.

    Attributes:
        cycles: so far.
        late: number of those that were late by more than half a period.
        latest: largest lateness, in s.
        due: when the next cycle is due, by the session's clock; None before the first.
        last: when the last one was; None before the first.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.cycles = self.late = 0
        self.latest = 0.0
        self.due: float | None = None
        self.last: float | None = None
        self._first = 0.0

    def tick(self, now: float) -> None:
        """Count a cycle whose action is handed out now."""
        due = now if self.due is None or self.cycles == 1 else self.due
        lateness = now - due
        self.latest = max(self.latest, lateness)
        if lateness > LATE * self.period:
            self.late += 1
            due = now
        if self.cycles <= 1:
            self._first = now
        self.due, self.last = due + self.period, now
        self.cycles += 1

    def complaint(self) -> str:
        """What was wrong with the timing; empty if nothing was."""
        said = []
        if self.late:
            said.append(
                f"{self.late} of {self.cycles} actions came more than half a period late, one of "
                f"them by {self.latest:.3g} s"
            )
        intervals = self.cycles - 2
        if intervals > 0 and self.last is not None:
            elapsed = self.last - self._first
            drift = abs(elapsed - intervals * self.period)
            if drift > max(self.period, OFF * intervals * self.period):
                said.append(
                    f"a cycle took {elapsed / intervals:.3g} s on average, and the period of the "
                    f"session is {self.period:g} s"
                )
        return "; ".join(said)


class Watchdog:
    """A thread that calls ``check`` as soon as it may be due.

    An error of ``check`` is printed, and the watch goes on.

    Args:
        check: returns the seconds after which to call it again; it must not be due earlier.
        clock: that waits.
    """

    def __init__(self, check: Callable[[], float], clock: Clock) -> None:
        self._check, self._clock = check, clock
        self._closed = Event()
        self._thread = Thread(target=self._run, name="kreps watchdog", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                left = self._check()
            except Exception:  # of the user's function that stops the robot
                traceback.print_exc()
                continue
            self._clock.sleep(left)

    def close(self) -> None:
        """Do not call ``check`` any more, and wait until the thread has ended."""
        self._closed.set()
        self._thread.join()
