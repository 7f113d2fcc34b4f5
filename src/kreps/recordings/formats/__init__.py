"""Formats of recordings, each read by the library that knows it; the path tells which one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from kreps.errors import ConfigurationError, KrepsError, StorageError
from kreps.recordings.columns import Columns
from kreps.recordings.table import Table

Reader = Callable[[Path, Columns], Table]
"""Reads a recording: its path, and the columns that are needed; all columns if none are named."""

SUFFIXES: Mapping[str, tuple[str, ...]] = {
    "csv": (".csv", ".tsv", ".csv.gz"),
    "parquet": (".parquet", ".pq"),
    "hdf5": (".h5", ".hdf5"),
    "ros2": (".mcap", ".db3"),
    "safetensors": (".safetensors",),
}
"""Names of files by format; each but the last is also the name of an extra of the package."""

CONTENTS: Mapping[str, tuple[str, ...]] = {
    "lerobot": ("meta/info.json",),
    "minari": ("data/metadata.json",),
    "ros2": ("metadata.yaml",),
}
"""What a folder of a format has."""


def format_of(path: Path) -> str:
    """The format of a file or folder.

    Raises:
        StorageError: there is nothing, or nothing that is known.
    """
    if not path.exists():
        raise StorageError(f"there is no {path}; check the path")
    if path.is_dir():
        for name, contents in CONTENTS.items():
            if all((path / each).is_file() for each in contents):
                return name
    for name, suffixes in SUFFIXES.items():
        if path.is_file() and path.name.lower().endswith(suffixes):
            return name
    known = ", ".join(each for suffixes in SUFFIXES.values() for each in suffixes)
    raise StorageError(
        f"{path} is no recording that can be read: a file {known}, or the folder of a ROS 2 bag, "
        "a Minari or a LeRobot dataset"
    )


def read_table(path: Path, columns: Columns) -> Table:
    """The table of a recording.

    Args:
        path: of a file or folder.
        columns: that are needed; all columns are read if none are named.

    Raises:
        ConfigurationError: the library of the format is not installed, or a column is missing.
        DataError: what the columns hold cannot be learnt from.
        StorageError: nothing is there, or it is damaged.
    """
    name = format_of(path)
    with _readable(path, name):
        reader: Reader = import_module(f"kreps.recordings.formats.{name}").read
        table = reader(path, columns)
        if not len(table):
            raise StorageError("it has no row; check that the recording was closed")
        return table


@contextmanager
def _readable(path: Path, name: str) -> Iterator[None]:
    """Errors of a format's library as errors of the file."""
    try:
        yield
    except KrepsError as error:
        raise type(error)(f"{path}: {error}") from error
    except ImportError as error:
        raise ConfigurationError(
            f"reading {path} needs {error.name}, which is not installed: "
            f"pip install 'kreps[{name}]'"
        ) from error
    except MemoryError:
        raise
    except Exception as error:  # whatever the library raises about a damaged file
        raise StorageError(
            f"cannot read {path} as {name}: {type(error).__name__}: {error}; it is damaged, or of "
            "another format than its name says"
        ) from error
