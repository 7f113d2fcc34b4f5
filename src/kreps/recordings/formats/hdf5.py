"""HDF5, by h5py: a data set is a column, and its path is the name."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any

import h5py
from numpy.typing import NDArray

from kreps.recordings.columns import Columns
from kreps.recordings.table import Table, episode_table

EPISODE = re.compile(r"(.*?[^/\d])(\d+)/(.+)")
"""A path below a numbered group: the episode, its number, and the name of the column."""


def read(path: Path, columns: Columns) -> Table:
    """A file with data sets (N, ...) of an episode or more.

    Numbered groups, such as ``data/demo_0`` and ``episode_0``, are episodes, and the paths below
    them are the names of the columns; data sets elsewhere are left out then.  They are no episodes
    if a column is named by its whole path.  Columns with one row less than the others of an episode
    have none for its last observation.
    """
    with h5py.File(path) as file:
        flat: dict[str, NDArray[Any]] = {}
        groups: dict[tuple[str, int], dict[str, NDArray[Any]]] = defaultdict(dict)
        datasets = dict(_datasets(file))
        whole = not columns.bases.isdisjoint(datasets)
        for name, found in datasets.items():
            below = None if whole else EPISODE.fullmatch(name)
            column = below[3] if below else name
            if found.ndim and columns.needs(column, prod(found.shape[1:])):
                into = groups[below[1], int(below[2])] if below else flat
                into[column] = found[()]
    if not groups:
        return episode_table(flat, path.name)
    parts = [episode_table(groups[key], f"{key[0]}{key[1]}") for key in sorted(groups)]
    return Table.of_episodes(parts)


def _datasets(group: h5py.Group, above: str = "") -> Iterator[tuple[str, h5py.Dataset]]:
    for name, item in group.items():
        if isinstance(item, h5py.Dataset):
            yield above + name, item
        elif isinstance(item, h5py.Group):
            yield from _datasets(item, f"{above}{name}/")
