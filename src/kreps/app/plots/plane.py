"""Drawing over a two-dimensional state space, with angles that wrap around.

Far from the data a policy and V are extrapolation, so maps fade there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from kreps.algorithms.state import LearnerState
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray

MAP_POINTS = 121
"""Grid points per axis of a map."""

FADE_FROM, FADE_TO = 0.04, 0.12
"""Distances to the nearest sample between which a map fades, as shares of the axes."""

FADED = 0.15
"""Opacity of a map far from all samples."""

START: dict[str, Any] = {
    "ls": "",
    "marker": "o",
    "ms": 6,
    "mfc": "white",
    "mec": "black",
    "mew": 1.2,
}
GOAL: dict[str, Any] = {
    "ls": "",
    "marker": "*",
    "ms": 13,
    "mfc": "#ffd21f",
    "mec": "black",
    "mew": 0.9,
}


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


def opacity(
    x: FloatArray, y: FloatArray, states: FloatArray, state: LearnerState, task: TaskSpec
) -> FloatArray:
    """Opacity of a map: 1 near the samples of the window, `FADED` far from all of them.

    Args:
        x, y: the axes, (k,) each.
        states: (k squared, 2) grid of `state_grid`.
        state: with the samples.
        task: which coordinates are angles.

    Returns:
        (k, k), rows along y.
    """
    from scipy.spatial import cKDTree  # takes 0.1 s to import

    low, length = np.array([x[0], y[0]]), np.array([x[-1] - x[0], y[-1] - y[0]])
    turns = np.array([1.0 if i in task.periodic else 0.0 for i in range(2)])

    def scaled(points: FloatArray) -> FloatArray:
        shares = (points - low) / length
        return np.where(turns > 0.0, shares % 1.0, shares)

    samples = cKDTree(scaled(state.window.transitions.points), boxsize=turns)
    distance, _ = samples.query(scaled(states))
    known = np.clip((FADE_TO - distance) / (FADE_TO - FADE_FROM), 0.0, 1.0)
    return (FADED + (1.0 - FADED) * known).reshape(len(y), len(x))


def opaque(picture: AxesImage) -> ScalarMappable:
    """The colours of a map without its opacity, for a colour bar."""
    return ScalarMappable(picture.norm, picture.cmap)


def mark_start_and_goal(axes: Axes, state: LearnerState, starts: FloatArray) -> list[Line2D]:
    """Mark start states (m, 2), and the state that the highest reward of the window led to.

    While no reward depends on the state there is no such goal.
    """
    marks = axes.plot(*starts.T, label="start", zorder=4, **START)
    if state.window.reward_depends_on_state:
        data = state.window.transitions
        goal = data.points[data.successor[np.argmax(data.rewards)]]
        name = "highest reward observed"
        marks += axes.plot(*goal[:, None], label=name, zorder=4, clip_on=False, **GOAL)
    return marks


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
