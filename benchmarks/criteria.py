"""The criteria of benchmarks: a number computed from times, and a limit on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

Work = Callable[[], object]


@dataclass(frozen=True)
class Times:
    """CPU seconds of each round of the work, and of the references timed between the rounds.

    Attributes:
        work: of the work.
        references: of each reference, by name.
        memory: peak of the memory allocated by the work, in bytes; None in another process.
        peak: operations per second of the fastest matrix product of the run.
    """

    work: list[float]
    references: dict[str, list[float]]
    memory: int | None
    peak: float


class Criterion(Protocol):
    """A number with limits: one row of the table."""

    @property
    def text(self) -> str:
        """Name of the number."""
        ...

    @property
    def references(self) -> dict[str, Work]:
        """Calls to be timed together with the work, by name."""
        ...

    @property
    def at_least(self) -> float | None: ...

    @property
    def at_most(self) -> float | None: ...

    def value(self, times: Times) -> float: ...


@dataclass(frozen=True)
class _Limited:
    """Either limit may be None; with neither, the row is for information only."""

    at_least: float | None = field(default=None, kw_only=True)
    at_most: float | None = field(default=None, kw_only=True)

    @property
    def references(self) -> dict[str, Work]:
        return {}


@dataclass(frozen=True)
class Share(_Limited):
    """Operations per second as a share of the peak."""

    flops: int
    nominal: bool = False

    @property
    def text(self) -> str:
        return "x peak, nominal" if self.nominal else "x peak"

    def value(self, times: Times) -> float:
        return self.flops / min(times.work) / times.peak


@dataclass(frozen=True)
class _Compared(_Limited):
    """A comparison with a reference that is timed alternately with the work."""

    name: str
    reference: Work

    @property
    def references(self) -> dict[str, Work]:
        return {self.name: self.reference}


class TimesAsLong(_Compared):
    """Time of the work over that of the reference."""

    @property
    def text(self) -> str:
        return f"x the time of {self.name}"

    def value(self, times: Times) -> float:
        return min(times.work) / min(times.references[self.name])


class TimesFaster(_Compared):
    """Time of the reference over that of the work."""

    @property
    def text(self) -> str:
        return f"x faster than {self.name}"

    def value(self, times: Times) -> float:
        return min(times.references[self.name]) / min(times.work)


class Beyond(_Compared):
    """CPU seconds of the work minus those of the reference."""

    @property
    def text(self) -> str:
        return f"CPU s beyond {self.name}"

    def value(self, times: Times) -> float:
        return min(times.work) - min(times.references[self.name])


class Seconds(_Limited):
    """CPU seconds of the fastest round."""

    text = "CPU s"

    def value(self, times: Times) -> float:
        return min(times.work)


class Milliseconds99(_Limited):
    """99th percentile of the CPU milliseconds of a round: the median over blocks of 500 rounds.

    Another process on the machine disturbs single blocks only; slow calls of the code itself are in
    all of them.
    """

    text = "CPU ms, p99"

    def value(self, times: Times) -> float:
        blocks = np.array_split(times.work, max(1, len(times.work) // 500))
        return 1e3 * float(np.median([np.percentile(block, 99) for block in blocks]))


@dataclass(frozen=True)
class Quality(_Limited):
    """A measure of accuracy, with a limit so that speed is not gained by a loss of accuracy."""

    text: str
    measure: Callable[[], float]

    def value(self, times: Times) -> float:
        return self.measure()
