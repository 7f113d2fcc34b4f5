"""HDF5, by h5py: a data set is a column, and its path is the name."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from kreps.errors import DataError
from kreps.recordings.columns import Columns
from kreps.recordings.table import Table

EPISODE = re.compile(r"(.*?[^/\d])(\d+)/(.+)")
"""A path below a numbered group: the episode, its number, and the name of the column."""


def read(path: Path, columns: Columns) -> Table:
    """A file with data sets (N, ...) of an episode or more.

    Numbered groups, such as ``data/demo_0`` and ``episode_0``, are episodes, and the paths below
    them are the names of the columns; data sets elsewhere are left out then.  Columns with one row
    less than the others of an episode have none for its last observation.
    """
    with h5py.File(path) as file:
        flat: dict[str, NDArray[Any]] = {}
        groups: dict[tuple[str, int], dict[str, NDArray[Any]]] = defaultdict(dict)
        for name, found in _datasets(file):
            below = EPISODE.fullmatch(name)
            if found.ndim and columns.needs(below[3] if below else name):
                into = groups[below[1], int(below[2])] if below else flat
                into[below[3] if below else name] = found[()]
    if not groups:
        return _episode(flat, path.name)
    parts = [_episode(groups[key], f"{key[0]}{key[1]}") for key in sorted(groups)]
    joined = Table.concat(parts)
    return Table(joined.columns, joined.starts, joined.names, episodes=True)


def _datasets(group: h5py.Group, above: str = "") -> Iterator[tuple[str, h5py.Dataset]]:
    for name, item in group.items():
        if isinstance(item, h5py.Dataset):
            yield above + name, item
        elif isinstance(item, h5py.Group):
            yield from _datasets(item, f"{above}{name}/")


def _episode(arrays: Mapping[str, NDArray[Any]], name: str) -> Table:
    """The columns of one episode, with a missing last row where a column has none.

    Raises:
        DataError: columns of other lengths.
    """
    rows = max((len(values) for values in arrays.values()), default=0)
    columns = {}
    for column, values in arrays.items():
        if rows - len(values) not in (0, 1):
            raise DataError(
                f"column {column} of {name} has {len(values)} rows and another one {rows}; of an "
                "episode, observations may have one row more than the others"
            )
        columns[column] = values if len(values) == rows else with_missing_row(values)
    return Table.from_columns(columns, name)


def with_missing_row(values: NDArray[Any]) -> NDArray[Any]:
    """Values (N, ...) and a row of missing ones."""
    if values.dtype.kind in "biuf":
        return np.concatenate([values, np.full((1, *values.shape[1:]), np.nan)])
    return np.concatenate([values, np.full((1, *values.shape[1:]), None)])
