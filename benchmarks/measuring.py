"""Times a piece of work in turns with its references, and tells what memory it took."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from criteria import Criterion, Times, Work

BUDGET = 3.0
"""CPU seconds to spend on the rounds of one benchmark, references included, if few suffice."""

ROUNDS = (3, 20)
"""Least and most rounds."""


@dataclass
class Measured:
    """A benchmark as it was measured.

    Attributes:
        work, size: what was done, and to how much.
        criteria: what it is judged by.
        times: CPU seconds by round.
        references: the same of each reference, by name.
        memory: peak of what the work allocated, in bytes; None if in another process.
        details: what else is worth keeping.
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
    """Peak of what a call allocates, in bytes; NumPy tells tracemalloc of its arrays."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@dataclass
class Measure:
    """What a benchmark calls, once: ``measure("Cholesky", "n = 1500", work, Share(...))``.

    Attributes:
        benchmark: pytest-benchmark's fixture.
        timer: gives CPU seconds.
        done: filled with what was measured.
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
            work: called without arguments; whatever it needs is prepared before.
            criteria: what it is judged by; their references are timed before each round.
            rounds: how often; None chooses from the time that one call takes.
        """
        references = {
            name: call for criterion in criteria for name, call in criterion.references.items()
        }
        seconds: dict[str, list[float]] = {name: [] for name in references}

        def time_references() -> None:
            for name, call in references.items():
                seconds[name].append(self._time(call))

        started = time.process_time()
        memory: int | None = allocated(work)  # also warms caches and lazy imports up
        if self.timer is not time.process_time:  # the work is done in another process
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
