"""Executors of trials: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

from kreps.errors import ConfigurationError


@contextmanager
def executor(workers: int, scheduler: str | None) -> Iterator[Executor]:
    """An executor that lives as long as the context.

    Args:
        workers: processes on this machine; unused with a scheduler.
        scheduler: address of a Dask scheduler, such as ``tcp://head-node:8786``; None stays on
            this machine.

    Raises:
        ConfigurationError: Dask is not installed, or there is no scheduler at the address.
    """
    if scheduler is None:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            yield pool
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError(
            f"--scheduler {scheduler} needs Dask, which is not installed: "
            'pip install "kreps[cluster]"'
        ) from error
    try:
        client = Client(scheduler, timeout=20)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"no Dask scheduler answers at {scheduler!r} ({error}); start one with "
            "`dask scheduler` and `dask worker ADDRESS`, in an environment where kreps is installed"
        ) from error
    with client:
        yield client.get_executor(pure=False)  # type: ignore[no-untyped-call]
