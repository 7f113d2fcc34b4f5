"""The number of threads that BLAS uses.

At the sizes of an update (n about 1500) a second thread gains little.  On a machine with other busy
processes, threads wait for each other in spin locks, which can multiply the time by ten.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock, get_ident
from typing import Any

import threadpoolctl

from kreps.errors import ConfigurationError


@contextmanager
def blas_threads(count: int | None, *, exact: bool = False) -> Iterator[None]:
    """A context in which BLAS uses ``count`` threads; None leaves the number as it is.

    Contexts may be nested, and open in several threads of Python at once.  Most BLAS libraries have
    one number for the whole process, so it is the smallest that any thread asks for, and what it
    was before is restored when the last context ends.

    Args:
        count: threads of BLAS.
        exact: whether it must be this number, as another one changes the last bits of results.

    Raises:
        ConfigurationError: another thread has a context with ``exact`` and another count, too.
    """
    if count is None:
        yield
        return
    libraries = threadpoolctl.ThreadpoolController().select(user_api="blas")
    own = libraries.select(internal_api="openblas").select(threading_layer="openmp")
    _process.enter(libraries, count, exact)
    try:
        with own.limit(limits=count, user_api="blas"):  # these have a number for each thread
            yield
    finally:
        _process.leave(libraries)


class _ProcessLimit:
    """What the threads of this process ask for, and the numbers before the first one did."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._contexts: dict[int, list[tuple[int, bool]]] = {}
        """Count and ``exact`` of each thread's contexts, by its identifier, outermost first."""
        self._before: Any = None

    def enter(self, libraries: Any, count: int, exact: bool) -> None:
        thread = get_ident()
        with self._lock:
            for key, contexts in self._contexts.items():
                other, must = contexts[-1]
                if exact and must and key != thread and other != count:
                    raise ConfigurationError(
                        f"threads = {count}, but a learner in another thread of this process has "
                        f"threads = {other}, and BLAS has one number for all; give both the same "
                        "number, or run them in processes of their own"
                    )
            self._contexts.setdefault(thread, []).append((count, exact))
            self._apply(libraries)

    def leave(self, libraries: Any) -> None:
        thread = get_ident()
        with self._lock:
            contexts = self._contexts.get(thread, [])
            del contexts[-1:]
            if not contexts:
                self._contexts.pop(thread, None)
            self._apply(libraries)

    def _apply(self, libraries: Any) -> None:
        _clear_owner()
        if self._contexts:
            smallest = min(contexts[-1][0] for contexts in self._contexts.values())
            limiter = libraries.limit(limits=smallest, user_api="blas")
            self._before = self._before or limiter
        elif self._before is not None:
            self._before.restore_original_limits()
            self._before = None
        _clear_owner()


def _clear_owner() -> None:
    """Allow every thread to set the number: `_ProcessLimit` orders who does.

    From version 3.8 on, threadpoolctl ignores all threads but the first that has set it.
    """
    clear = getattr(threadpoolctl.OpenBLASController, "clear_controlling_thread", None)
    if clear is not None:
        clear(force=True)


_process = _ProcessLimit()
if hasattr(os, "register_at_fork"):  # a forked worker has none of the other threads
    os.register_at_fork(after_in_child=_process.__init__)  # type: ignore[misc]
