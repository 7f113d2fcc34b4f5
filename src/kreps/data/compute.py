"""Where sums over chunks of samples are computed: by an executor's workers, on another device."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from kreps.kernels.arrays import Array, FloatArray, as_float, default_errstate
from kreps.kernels.threads import blas_threads

Result = TypeVar("Result")

CHUNK_SIZE = 8192
"""Samples per chunk, about: 64 MB for each 1000 features."""

MAX_PENDING = 16
"""Chunks submitted and not yet collected: enough for the workers of one machine, few enough for its
memory."""


@dataclass(frozen=True)
class Compute:
    """Where and in which parts sums over samples are computed.

    Attributes:
        executor: any `concurrent.futures.Executor`, such as a process pool or a Dask client's
            ``get_executor()``; None computes in this process.  Each worker process uses one BLAS
            thread; a thread pool shares those of this process.
        to_device: converts a NumPy array to the type that is computed with, such as
            ``cupy.asarray``; must be picklable if there is an executor.  By default NumPy.
        chunk_size: samples per chunk of the replay window, about: a chunk ends with the rollout
            that fills so many.  It changes the last bits of sums.  A `kreps.Dataset` has chunks of
            its own.
    """

    executor: Executor | None = None
    to_device: Callable[[FloatArray], Array] = as_float
    chunk_size: int = CHUNK_SIZE

    @property
    def shares_memory(self) -> bool:
        """Whether the work is done in this process, so that arguments are not copied."""
        return self.executor is None or isinstance(self.executor, ThreadPoolExecutor)

    def map(self, function: Callable[..., Result], *arguments: Iterable[Any]) -> Iterator[Result]:
        """The results in the order of the arguments, so that sums do not depend on timing."""
        if self.executor is None:
            yield from map(function, *arguments)
            return
        # threads share the BLAS of this process and would override each other's limits
        work = function if self.shares_memory else partial(_on_one_thread, function)
        pending: deque[Future[Result]] = deque()
        try:
            for each in zip(*arguments, strict=True):
                pending.append(self.executor.submit(work, *each))
                if len(pending) == MAX_PENDING:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


def _on_one_thread(function: Callable[..., Result], *arguments: Any) -> Result:
    with blas_threads(1), default_errstate():
        return function(*arguments)
