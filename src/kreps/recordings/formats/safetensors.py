"""Rollouts of kreps itself: what `kreps.save_rollouts`, ``kreps import`` and robots wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kreps.kernels.arrays import FloatArray
from kreps.learning.storage import load_rollouts
from kreps.recordings.columns import Columns
from kreps.recordings.table import Table


def read(path: Path, columns: Columns) -> Table:
    """A file with the columns observations, actions, rewards, terminated and time."""
    rollouts = load_rollouts(path)
    starts = rollouts.offsets[:-1] + np.arange(len(rollouts))
    is_step = np.ones(len(rollouts.points), bool)
    is_step[rollouts.offsets[1:] + np.arange(len(rollouts))] = False

    def of_steps(values: FloatArray) -> FloatArray:
        rows = np.full((len(is_step), *values.shape[1:]), np.nan)
        rows[is_step] = values
        return rows

    arrays = {
        "observations": rollouts.points,
        "actions": of_steps(rollouts.actions),
        "rewards": of_steps(rollouts.rewards),
        "terminated": of_steps(rollouts.transitions.terminated.astype(np.float64)),
    }
    if rollouts.times is not None:
        arrays["time"] = rollouts.times
    names = tuple(f"rollout {number}" for number in range(len(rollouts)))
    return Table(arrays, starts, names, episodes=True)
