"""Minari datasets, by minari: the folder of a dataset, as in ``~/.minari/datasets``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import minari
import numpy as np
from numpy.typing import NDArray

from kreps.recordings.columns import Columns
from kreps.recordings.table import Table, episode_table


def read(path: Path, columns: Columns) -> Table:
    """A dataset with the columns observations, actions, rewards, terminations and truncations.

    Parts of composite observations and actions are named ``observations/part``.
    """
    parts = []
    for episode in minari.MinariDataset(path / "data").iterate_episodes():
        arrays = {
            "rewards": np.asarray(episode.rewards),
            "terminations": np.asarray(episode.terminations),
            "truncations": np.asarray(episode.truncations),
            **dict(_parts("observations", episode.observations)),
            **dict(_parts("actions", episode.actions)),
        }
        needed = {name: values for name, values in arrays.items() if columns.needs(name)}
        parts.append(episode_table(needed, f"episode {episode.id}"))
    return Table.of_episodes(parts)


def _parts(name: str, values: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """The arrays of a composite space, by name."""
    if isinstance(values, dict | tuple):
        items = values.items() if isinstance(values, dict) else enumerate(values)
        for key, part in items:
            yield from _parts(f"{name}/{key}", part)
    else:
        yield name, np.asarray(values)
