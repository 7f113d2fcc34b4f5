"""What a benchmark is judged by: a number made of its times, and the limit asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

Work = Callable[[], object]


@dataclass(frozen=True)
class Times:
    """CPU seconds of each round, of the work and of the references timed between its rounds.

    Attributes:
        work: of the work.
        references: of each reference, by name.
        memory: peak of what the work allocated, in bytes; None if in another process.
        peak: operations per second of the best matrix product of the run.
    """

    work: list[float]
    references: dict[str, list[float]]
    memory: int | None
    peak: float


class Criterion(Protocol):
    """One line of the table."""

    @property
    def text(self) -> str:
        """What the number is."""
        ...

    @property
    def references(self) -> dict[str, Work]:
        """What is to be timed beside the work, by name."""
        ...

    @property
    def at_least(self) -> float | None: ...

    @property
    def at_most(self) -> float | None: ...

    def value(self, times: Times) -> float: ...


@dataclass(frozen=True)
class _Limited:
    """Either limit may be left open; with neither the line is for information."""

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
    """Judged against a reference timed in turns with the work."""

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
    """CPU seconds more than the reference."""

    @property
    def text(self) -> str:
        return f"CPU s beyond {self.name}"

    def value(self, times: Times) -> float:
        return min(times.work) - min(times.references[self.name])


class Seconds(_Limited):
    """CPU seconds of the best round."""

    text = "CPU s"

    def value(self, times: Times) -> float:
        return min(times.work)


class Milliseconds99(_Limited):
    """CPU milliseconds that 99 of 100 rounds stay below, in the median of blocks of 500 rounds.

    A neighbour's burst spoils one block; what the code itself does now and then is in all.
    """

    text = "CPU ms, p99"

    def value(self, times: Times) -> float:
        blocks = np.array_split(times.work, max(1, len(times.work) // 500))
        return 1e3 * float(np.median([np.percentile(block, 99) for block in blocks]))


@dataclass(frozen=True)
class Quality(_Limited):
    """A number that is no time: what the speed must not be bought with."""

    text: str
    measure: Callable[[], float]

    def value(self, times: Times) -> float:
        return self.measure()
