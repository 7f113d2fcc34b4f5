"""The number of threads that BLAS uses.

At the sizes of an update (n about 1500) a second thread gains little.  On a machine with other busy
processes, threads wait for each other in spin locks, which can multiply the time by ten.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from threadpoolctl import threadpool_limits


def blas_threads(count: int | None) -> AbstractContextManager[object]:
    """A context in which BLAS uses ``count`` threads; None leaves the number as it is."""
    if count is None:
        return nullcontext()
    return threadpool_limits(limits=count, user_api="blas")
