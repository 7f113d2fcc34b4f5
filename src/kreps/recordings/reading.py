"""Recordings of other programs as rollouts: `read_rollouts` and `read_recording`."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from kreps.data.rollouts import Rollouts
from kreps.errors import ConfigurationError, DataWarning, shown
from kreps.recordings.columns import Columns, columns_of
from kreps.recordings.formats import read_table
from kreps.recordings.recording import Recording, recording_of
from kreps.recordings.table import Table

Paths = str | Path | Sequence[str | Path]
Given = Columns | Mapping[str, Any] | str | Path | None


def read_rollouts(path: Paths, columns: Given = None) -> Rollouts:
    """Rollouts of a recording: CSV, Parquet, HDF5, Minari, LeRobot, a ROS 2 bag, or kreps' own.

    Args:
        path: of a file or folder, or several of the same format, each of which begins a rollout.
        columns: which columns are observations, actions and so on: `kreps.Columns`, a dictionary of
            its fields, or the path of a TOML file with a table ``[columns]``.  What is not named is
            looked for by common names.

    Returns:
        The rollouts.  One ends where an episode does, and where a row or a value is missing, of
        which there is a `DataWarning`.

    Raises:
        ConfigurationError: the library of the format is not installed (each is an extra of the
            package), or a column is missing.
        DataError: text in place of numbers, flags that contradict the episodes, or not one complete
            step.
        StorageError: a file is missing, damaged or of an unknown format.
    """
    recording = read_recording(path, columns)
    found = list(losses(recording))
    if found:
        warnings.warn(
            f"{' '.join(found)} Rollouts are cut there; `kreps import` has a report",
            DataWarning,
            stacklevel=2,
        )
    return recording.rollouts


def read_recording(path: Paths, columns: Given = None) -> Recording:
    """The same rollouts with the table that they were read from; there is no warning."""
    paths = [path] if isinstance(path, str | Path) else list(path)
    if not paths or not all(isinstance(each, str | Path) for each in paths):
        raise ConfigurationError(f"path = {shown(path)}, but at least one path is needed")
    given = columns_of(columns)
    return recording_of(Table.concat([read_table(Path(each), given) for each in paths]), given)


def losses(recording: Recording) -> Iterator[str]:
    """A sentence for each reason for which rollouts were cut within an episode."""
    table = recording.table
    for name, rows in recording.missing.items():
        yield f"{name} has no finite number in {table.places(rows)}."
    if len(recording.gaps):
        yield f"Rows are missing after {table.places(recording.gaps)}, by their time stamps."
    if len(recording.backwards):
        yield f"Time does not increase after {table.places(recording.backwards)}."
    if len(recording.incomplete):
        yield (
            f"The task terminated in {table.places(recording.incomplete)}, but the terminal "
            "observation was not recorded, so these steps are left out: name next_observations, or "
            "record one more row per episode, without an action."
        )
