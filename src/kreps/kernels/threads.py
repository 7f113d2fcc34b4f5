"""BLAS threads, set on purpose.

At the sizes of an update (n ~ 1500) a second thread gains little, and beside a busy neighbour it
waits on spinning partners and can cost ten times the time.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from threadpoolctl import threadpool_limits


def blas_threads(count: int | None) -> AbstractContextManager[object]:
    """Within this context BLAS uses ``count`` threads; None leaves it as it is."""
    if count is None:
        return nullcontext()
    return threadpool_limits(limits=count, user_api="blas")
