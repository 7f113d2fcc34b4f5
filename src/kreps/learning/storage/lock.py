"""A lock on a folder in which a process learns; the system releases it however a process ends."""

from __future__ import annotations

import os
import platform
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TextIO

from kreps.errors import StorageError

try:
    import fcntl
except ImportError:  # Windows has another kind of lock
    fcntl = None  # type: ignore[assignment]


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of a folder as long as the block lasts.

    The file has the process and its computer while the lock is held, and is removed afterwards.  On
    Windows, and where a file system has no locks, with a warning there, the block runs without.

    Args:
        path: of the lock, in the folder.

    Raises:
        StorageError: another process holds the lock, or the file cannot be made.
    """
    with ExitStack() as stack:
        while fcntl is not None:
            try:
                file = stack.enter_context(open(path, "a+", errors="replace"))
            except OSError as error:
                raise StorageError(f"cannot write {path}: {error}; check the folder") from error
            if not _take(file, path):
                break
            if _is_at(file, path):
                stack.callback(path.unlink, missing_ok=True)
                file.truncate(0)
                file.write(f"process {os.getpid()} on {platform.node()}\n")
                file.flush()
                break
            file.close()  # the holder before has just removed it
        yield


def _take(file: TextIO, path: Path) -> bool:
    """Lock an open file; False if its file system has no locks.

    Raises:
        StorageError: another process has locked it.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.seek(0)
        holder = file.read(200).strip() or "another process"
        raise StorageError(
            f"{path.parent} is in use by {holder}, which learns in it; wait until it ends, or "
            "choose another folder"
        ) from error
    except OSError as error:
        warnings.warn(
            f"{path.parent} cannot be locked ({error}): let no other process learn in it",
            stacklevel=4,
        )
        return False
    return True


def _is_at(file: TextIO, path: Path) -> bool:
    """Whether an open file is still the one at a path."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
