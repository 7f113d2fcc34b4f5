"""A checksum of all bytes of a file, inside the file.

Somewhere in the file are the name ``sha256`` and then 64 hexadecimal digits: the SHA-256 of the
file with zeros in the place of these digits.  A change of any byte, of the digits too, makes them
differ.  This holds for every kind of file, and can be checked in any language.
"""

from __future__ import annotations

import hashlib
import mmap
import re
from pathlib import Path
from typing import BinaryIO

from kreps.errors import StorageError
from kreps.learning.storage.atomic import file_path

NAME = "sha256"
BLANK = "0" * 64
"""What stands in the place of the digits while the checksum is computed."""

_DIGITS = re.compile(rb"sha256\W{1,12}([0-9a-f]{64})")
"""Between name and digits is what JSON or a protocol buffer has there."""

DAMAGED = (
    "its bytes do not fit its checksum: it is damaged; take another copy of it, or make it again"
)


def sealed(content: bytes) -> bytes:
    """The content of a file that has `NAME` and `BLANK`, with its checksum."""
    found = _DIGITS.search(content)
    assert found is not None and found[1] == BLANK.encode()
    digits = hashlib.sha256(content).hexdigest().encode()
    return content[: found.start(1)] + digits + content[found.end(1) :]


def stored_checksum(file: BinaryIO) -> str | None:
    """The digits in an open file, if its bytes fit them; None if it has none.

    Raises:
        StorageError: the bytes do not fit.
    """
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        found = _DIGITS.search(content)
        if found is None:
            return None
        (start, end), digits = found.span(1), found[1].decode()
        computed = hashlib.sha256()
        with memoryview(content) as all_, all_[:start] as before, all_[end:] as after:
            for part in (before, BLANK.encode(), after):
                computed.update(part)
        if computed.hexdigest() != digits:
            raise StorageError(DAMAGED)
        return digits


def check_file(path: str | Path) -> None:
    """Raise an error unless every byte of a file is as kreps wrote it.

    For policies, checkpoints, rollouts and ONNX models.  What kreps loads it checks itself; this
    function is for models, and for files that are copied.

    Raises:
        StorageError: the file is missing, damaged, or has no checksum.
    """
    path = file_path(path)
    try:
        if not path.is_file():
            raise StorageError(f"{path} is not a file; check the path")
        with open(path, "rb") as file:
            digits = stored_checksum(file) if path.stat().st_size else None
    except StorageError as error:
        raise StorageError(f"cannot rely on {path}: {error}") from error
    except (OSError, ValueError) as error:
        raise StorageError(f"cannot read {path}: {error}") from error
    if digits is None:
        raise StorageError(
            f"cannot rely on {path}: it has no checksum, as files of earlier versions and of other "
            "programs; save it again with this version"
        )
