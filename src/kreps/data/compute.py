"""Where sums over many samples are computed: here, on an executor's workers, on another device."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from kreps.kernels.arrays import Array, FloatArray, as_float
from kreps.kernels.threads import blas_threads

Result = TypeVar("Result")

AHEAD = 16
"""Chunks under way at once: enough for the workers of one machine, few enough for its memory."""


@dataclass(frozen=True)
class Compute:
    """How chunks of samples are worked on.

    Attributes:
        executor: any `concurrent.futures.Executor`, such as a process pool or a Dask client's
            ``get_executor()``; None works in this process.  Each worker process uses one BLAS
            thread; a thread pool shares those of this process.
        to_device: makes the arrays that the work is done in, such as ``cupy.asarray``; must be
            picklable if there is an executor.  By default NumPy.
    """

    executor: Executor | None = None
    to_device: Callable[[FloatArray], Array] = as_float

    def map(self, function: Callable[..., Result], *arguments: Iterable[Any]) -> Iterator[Result]:
        """Results in the order of the arguments, whoever was first: so sums never differ."""
        if self.executor is None:
            yield from map(function, *arguments)
            return
        # threads share this process's BLAS, and would undo each other's limits
        elsewhere = not isinstance(self.executor, ThreadPoolExecutor)
        work = partial(_on_one_thread, function) if elsewhere else function
        pending: deque[Future[Result]] = deque()
        try:
            for each in zip(*arguments, strict=True):
                pending.append(self.executor.submit(work, *each))
                if len(pending) == AHEAD:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


def _on_one_thread(function: Callable[..., Result], *arguments: Any) -> Result:
    with blas_threads(1):
        return function(*arguments)
