"""Writing a file as a whole or not at all, and only where a regular file is or can be."""

from __future__ import annotations

import os
import secrets
import stat
from contextlib import suppress
from glob import escape
from pathlib import Path
from typing import Any

from kreps.errors import StorageError

KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}
"""What a path may be besides a regular file."""


PART = ".{}.{}.part"
"""Name of a temporary file: of the target's name and of what makes it unique."""


def given_path(path: Any) -> Path:
    """A path that a user gave.

    Raises:
        StorageError: it is neither text nor a path, is empty, or holds a character of code 0.
    """
    with suppress(TypeError):
        if path != "" and "\0" not in str(Path(path)):
            return Path(path)
    raise StorageError(f"path = {path!r:.40}, but a name is needed, such as 'policy.safetensors'")


def file_path(path: Any) -> Path:
    """The path of a file that a user gave.

    Raises:
        StorageError: as `given_path`, or it names no file.
    """
    found = given_path(path)
    if not found.name:
        raise StorageError(f"{str(path)!r:.200} does not name a file; add its name")
    return found


def write_atomically(path: str | Path, content: bytes) -> None:
    """Replace a file as a whole: at any moment, also if the process is killed, it is old or new.

    The content goes to a temporary file of a unique name in the same folder, which then takes the
    place of the old one.  Of several writers the last one counts.  A link stays a link and what it
    points to is replaced.  A new file has the mode of the old one.

    Raises:
        StorageError: ``path`` names a folder, a device, a pipe or a read-only file, or the folder
            does not exist or cannot be written to.
    """
    path = file_path(path)
    target = Path(os.path.realpath(path))
    part = target.with_name(PART.format(target.name[:40], secrets.token_hex(8)))
    try:
        mode = _mode(path, target)
        try:
            with open(part, "xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            if mode is not None:
                part.chmod(mode)
            part.replace(target)
        finally:  # also when the user interrupts
            with suppress(OSError):
                part.unlink()
        _sync_folder(target.parent)
    except OSError as error:
        if isinstance(error, StorageError):
            raise
        raise StorageError(
            f"cannot write {path}: {error}; check the folder and its space"
        ) from error


def remove_parts(path: Path) -> None:
    """Remove the temporary files beside a path that killed processes left.

    No other process may write this path in the meantime.
    """
    parts = path.parent.glob(PART.format(escape(path.name[:40]), "*"))
    for part in parts:
        with suppress(OSError):
            part.unlink()


def _mode(path: Path, target: Path) -> int | None:
    """The permissions of the file that is replaced; None if there is none yet.

    Raises:
        StorageError: it is no regular file, or is read-only.
    """
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "no regular file")
        raise StorageError(f"cannot write {path}: it is {kind}; give the name of a file")
    if not (mode & 0o222 and os.access(target, os.W_OK)):  # the superuser has access to all
        raise StorageError(
            f"cannot write {path}: the file is read-only; make it writable, or choose another name"
        )
    return stat.S_IMODE(mode)


def _sync_folder(folder: Path) -> None:
    """Store the new entry of a folder, so that it survives a loss of power."""
    with suppress(OSError):  # not every system can
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
