"""LeRobot datasets of versions 2 and 3: Parquet files, by pyarrow, without pictures and videos."""

from __future__ import annotations

import json
from pathlib import Path

from kreps.errors import StorageError
from kreps.recordings.columns import Columns
from kreps.recordings.formats import parquet
from kreps.recordings.table import Table

VERSIONS = ("v2", "v3")


def read(path: Path, columns: Columns) -> Table:
    """The folder of a dataset with ``meta/info.json`` and ``data/``.

    Raises:
        StorageError: it is of another version, or has not all of its frames.
    """
    info = json.loads((path / "meta/info.json").read_text(encoding="utf-8"))
    version, frames = str(info.get("codebase_version")), info.get("total_frames")
    if not version.startswith(VERSIONS):
        raise StorageError(
            f"it is of LeRobot's version {version:.20}, but {' and '.join(VERSIONS)} can be read; "
            "convert it with LeRobot"
        )
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise StorageError("it has no data/*/*.parquet; download the data of the dataset, too")
    table = Table.concat([parquet.read(file, columns) for file in files])
    if len(table) != frames:
        raise StorageError(
            f"it has {len(table)} frames, but meta/info.json says {frames!s:.20}; copy all of its "
            "files again"
        )
    return table
