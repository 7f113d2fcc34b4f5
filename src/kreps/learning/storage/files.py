"""Files of named arrays (safetensors) with one JSON header, written atomically and read warily.

Before any array is read, a file is checked for its size, checksum, kind, version and names, and for
types and shapes of its arrays.  Whatever is wrong with it is raised as `StorageError`.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import safetensors
import safetensors.numpy

from kreps import legacy
from kreps.errors import KrepsError, StorageError
from kreps.learning.storage.atomic import file_path, write_atomically
from kreps.learning.storage.checksum import BLANK, DAMAGED, NAME, sealed, stored_checksum
from kreps.learning.storage.codec import StoredArrays, Tensors, check_sane

VERSION = 4
MAX_FILE_BYTES = 2**30
MAX_HEADER_BYTES = 2**22

OPENINGS = 20
"""How often a file is opened again that is replaced in the same moment."""

NO_CHECKSUM = (
    "it is of an earlier version and has no checksum, so damage to it would go unnoticed; save it "
    "again with this version"
)

Header = dict[str, Any]


def write_arrays(
    path: str | Path,
    kind: str,
    tensors: Tensors,
    header: Header,
    max_bytes: int = MAX_FILE_BYTES,
) -> None:
    """Write arrays and a JSON header.  The same content gives the same bytes.

    Args:
        path: the file to replace.
        kind: "policy", "rollouts" or "checkpoint".
        tensors: arrays by name.
        header: anything that JSON can hold, beside the kind and version of the file.
        max_bytes: largest size of the file, as when it is read.

    Raises:
        StorageError: the file cannot be written, or would be too large to be read.
    """
    path = file_path(path)
    text = json.dumps({"kind": kind, "version": VERSION, NAME: BLANK, **header}, sort_keys=True)
    limit = MAX_HEADER_BYTES // 2  # quoting in the file may double it
    if len(text) > limit:
        raise StorageError(
            f"the header of {path} would have {len(text)} bytes, the limit is {limit}; observe "
            "with fewer coordinates, such as smaller images"
        )
    arrays = {name: tensors[name] for name in sorted(tensors)}
    content = safetensors.numpy.save(arrays, metadata={"kreps": text})
    if len(content) > max_bytes:
        raise StorageError(
            f"{path} would have {len(content)} bytes, the limit is {max_bytes}; keep fewer "
            "rollouts by a smaller window, or observe with fewer coordinates"
        )
    write_atomically(path, sealed(content))


@contextmanager
def reading(
    path: str | Path, kind: str, max_bytes: int = MAX_FILE_BYTES, *, verify: bool = True
) -> Iterator[tuple[StoredArrays, Header]]:
    """The arrays and the header of an open file, in the names of the present version.

    Arrays must be read before the block ends.  Errors of the block are those of the file.  What
    users should be told of the file is under ``"notes"`` in the header, for `warn_of`.

    Args:
        path: of the file.
        kind: "policy", "rollouts" or "checkpoint".
        max_bytes: largest size of the file.
        verify: whether to compare the checksum with all bytes, without which no value may be used.

    Raises:
        StorageError: missing, unreadable, damaged, too large, or of another kind or version.
    """
    path = file_path(path)
    try:
        if not path.is_file():
            raise StorageError(f"{path} is not a file; check the path")
        _check_size(path, max_bytes)
        with _opened(path) as (file, raw):
            header = _header(file.metadata(), kind, raw if verify else None)
            layout = {
                name: (part.get_dtype(), tuple(part.get_shape()))
                for name in list(file.keys())
                for part in (file.get_slice(name),)
            }
            arrays = StoredArrays(layout, lambda name: np.asarray(file.get_tensor(name)))
            notes = [] if header["version"] == VERSION else [NO_CHECKSUM]
            if header["version"] in legacy.FILE_VERSIONS:
                arrays, header = _present(kind, arrays, header)
                notes += header.get("notes", [])
            yield arrays, {**header, "notes": notes}
    except KrepsError as error:
        raise StorageError(f"cannot read {path} as a kreps {kind}: {error}") from error
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        OverflowError,
        MemoryError,
        RecursionError,
        safetensors.SafetensorError,
    ) as error:
        raise StorageError(
            f"cannot read {path} as a kreps {kind}: {type(error).__name__}: {error}; "
            "the file is damaged or comes from another program"
        ) from error


def warn_of(path: str | Path, header: Header, stacklevel: int) -> None:
    """Warn of what is under ``"notes"`` in the header of a file that was read."""
    for note in header["notes"]:
        warnings.warn(f"{path}: {note}", UserWarning, stacklevel=stacklevel + 1)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, BinaryIO]]:
    """The same file as safetensors and as bytes, though it may be replaced while it is opened."""
    for _ in range(OPENINGS):
        with open(path, "rb") as raw, safetensors.safe_open(path, framework="numpy") as file:
            if os.path.samestat(os.fstat(raw.fileno()), path.stat()):
                yield file, raw
                return
    raise StorageError("another process replaces it all the time; read it again later")


def _check_size(path: Path, max_bytes: int) -> None:
    """Limit what parsing the file may allocate, before it is parsed."""
    size = path.stat().st_size
    if size > max_bytes:
        raise StorageError(f"it has {size} bytes, the limit is {max_bytes}")
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
    if size < 8 or length > min(MAX_HEADER_BYTES, size - 8):
        raise StorageError(
            f"its header would have {length} bytes, the limit is {MAX_HEADER_BYTES} "
            f"in a file of {size}; it is damaged or not a safetensors file"
        )


def _header(metadata: dict[str, str] | None, kind: str, raw: BinaryIO | None) -> Header:
    """The header of a file, once its checksum and version are known to be right.

    Args:
        metadata: of the file.
        kind: that is needed.
        raw: the bytes of the file; None if they need not fit the checksum.
    """
    header = json.loads((metadata or {}).get("kreps", "null"))
    if not isinstance(header, dict) or "kind" not in header:
        raise StorageError("it has no kreps header: it comes from another program")
    version, checksum = header.get("version"), header.pop(NAME, None)
    has_version = type(version) is int and 1 <= version <= VERSION
    if raw is not None and checksum is not None and stored_checksum(raw) != checksum:
        raise StorageError(DAMAGED)
    if header["kind"] != kind:
        raise StorageError(f"it is a kreps {header['kind']!s:.40}")
    if not has_version:
        raise StorageError(
            f"it has format version {version!s:.20}, this release reads 1 to {VERSION}; "
            "read it with the release that wrote it"
        )
    if (checksum is not None) != (version == VERSION):
        raise StorageError(f"its checksum is {checksum!r:.80}, in format {version}: it is damaged")
    return header


def _present(kind: str, arrays: StoredArrays, header: Header) -> tuple[StoredArrays, Header]:
    """Arrays and header of an earlier version in the names of the present one."""
    for name, (dtype, _) in arrays.layout.items():
        if name not in legacy.FILE_ARRAYS[kind]:
            raise StorageError(f"a {kind} has no array {name!r:.60}")
        if dtype != "F64":
            raise StorageError(f"array {name!r} has numbers of type {dtype!s:.20}, not F64")
    tensors = {name: arrays.load(name) for name in arrays.layout}
    for name, values in tensors.items():
        check_sane(name, values)
    tensors, header = legacy.present_file(kind, tensors, header)
    return StoredArrays.from_memory(tensors), header
