"""Drawing over a two-dimensional state space, with angles that wrap around."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from kreps.algorithms.state import LearnerState
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray

MAP_POINTS = 121
"""Grid points per axis of a map."""


def state_grid(state: LearnerState, task: TaskSpec) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A grid over the states of the window; an angle gets a whole turn.

    Returns:
        The two axes, each (`MAP_POINTS`,), and the states (`MAP_POINTS` squared, 2), of which the
        first coordinate varies fastest.

    Raises:
        ConfigurationError: the states are not two-dimensional.
    """
    if task.observation_size != 2:
        raise ConfigurationError(
            f"maps need a two-dimensional state space, this one has {task.observation_size}"
        )
    points = state.window.transitions.points
    axes = []
    for i in range(2):
        low, high = points[:, i].min(), points[:, i].max()
        if low == high:
            low, high = low - 1.0, high + 1.0
        if i in task.periodic:  # the turn around the middle of the data, in eighths of a turn
            middle = 0.5 * (low + high)
            low, high = middle - np.pi, middle + np.pi
            low, high = round(low / (np.pi / 4)) * np.pi / 4, round(high / (np.pi / 4)) * np.pi / 4
        axes.append(np.linspace(low, high, MAP_POINTS))
    x, y = np.meshgrid(*axes)
    return axes[0], axes[1], np.stack([x.ravel(), y.ravel()], axis=1)


def path_of(observations: FloatArray, task: TaskSpec) -> FloatArray:
    """The path (2, m) of observations (n, 2), with a gap of NaN wherever an angle wraps around."""
    path = observations[:, :2]
    angles = [i for i in task.periodic if i < 2]
    jumps = np.flatnonzero((np.abs(np.diff(path[:, angles], axis=0)) > np.pi).any(axis=1)) + 1
    return np.insert(path, jumps, np.nan, axis=0).T


def label_axes(axes: Axes, task: TaskSpec, labels: Sequence[str]) -> None:
    """Name both axes; an angle on the first one has ticks at multiples of pi / 2."""
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    if 0 in task.periodic:
        ticks = np.arange(-4, 5) * np.pi / 2
        names = ["-2π", "-3π/2", "-π", "-π/2", "0", "π/2", "π", "3π/2", "2π"]
        low, high = axes.get_xlim()
        inside = [i for i, t in enumerate(ticks) if low - 1e-9 <= t <= high + 1e-9]
        axes.set_xticks(ticks[inside], [names[i] for i in inside])
