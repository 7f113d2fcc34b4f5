"""Times work alternately with its references, and measures the memory it allocates."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from criteria import Criterion, Times, Work

BUDGET = 3.0
"""CPU seconds for the rounds of one benchmark, references included, within `ROUNDS`."""

ROUNDS = (3, 20)
"""Smallest and largest number of rounds."""


@dataclass
class Measured:
    """The measurements of one benchmark.

    Attributes:
        work, size: first columns of the table.
        criteria: one per row of the table.
        times: CPU seconds by round.
        references: CPU seconds by round of each reference, by name.
        memory: peak of the memory allocated by the work, in bytes; None in another process.
        details: further entries of the JSON file.
    """

    work: str
    size: str
    criteria: Sequence[Criterion]
    times: list[float]
    references: dict[str, list[float]]
    memory: int | None
    details: dict[str, Any] = field(default_factory=dict)

    def numbers(self, peak: float) -> list[tuple[Criterion, float]]:
        times = Times(self.times, self.references, self.memory, peak)
        return [(criterion, criterion.value(times)) for criterion in self.criteria]


def allocated(work: Work) -> int:
    """Peak of the memory that a call allocates, in bytes, NumPy arrays included."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@dataclass
class Measure:
    """Called once by each benchmark: ``measure("Cholesky", "n = 1500", work, Share(...))``.

    Attributes:
        benchmark: pytest-benchmark's fixture.
        timer: returns CPU seconds.
        done: list that measurements are added to.
    """

    benchmark: Any
    timer: Callable[[], float]
    done: list[Measured]

    def __call__(
        self,
        work_name: str,
        size: str,
        work: Work,
        *criteria: Criterion,
        rounds: int | None = None,
    ) -> Measured:
        """Measure ``work``.

        Args:
            work_name, size: first columns of the table.
            work: called without arguments; preparations are not timed.
            criteria: their references are timed before each round.
            rounds: number of calls; None derives it from the time of one call.
        """
        references = {
            name: call for criterion in criteria for name, call in criterion.references.items()
        }
        seconds: dict[str, list[float]] = {name: [] for name in references}

        def time_references() -> None:
            for name, call in references.items():
                seconds[name].append(self._time(call))

        started = time.process_time()
        memory: int | None = allocated(work)  # also fills caches, and imports
        if self.timer is not time.process_time:  # the work runs in another process
            memory = None
        if rounds is None:
            once = self._time(work) + sum(map(self._time, references.values()))
            rounds = min(max(int(BUDGET / max(once, 1e-9)), ROUNDS[0]), ROUNDS[1])
        self.benchmark.extra_info["warm_up_seconds"] = time.process_time() - started
        self.benchmark.pedantic(work, setup=time_references, rounds=rounds, iterations=1)
        measured = Measured(
            work_name,
            size,
            criteria,
            times=list(self.benchmark.stats.stats.data),
            references=seconds,
            memory=memory,
        )
        self.done.append(measured)
        return measured

    def _time(self, call: Work) -> float:
        started = self.timer()
        call()
        return self.timer() - started
