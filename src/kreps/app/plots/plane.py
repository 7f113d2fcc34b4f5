"""Drawing over a two-dimensional state space, with angles that wrap around.

Far from the data a policy and V are extrapolation, so maps fade there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MultipleLocator

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
    if task.state_size != 2:
        raise ConfigurationError(
            f"maps need a two-dimensional state space, this one has {task.state_size}"
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
        angle_ticks(axes.xaxis, 4)


def angle_ticks(axis: Axis, count: int) -> None:
    """About so many ticks at multiples of pi / 2, if the axis is long enough for two of them."""
    length = np.ptp(axis.get_view_interval())
    if length < np.pi:
        return
    step = max(1, round(2.0 * length / np.pi / count))
    axis.set_major_locator(MultipleLocator(step * np.pi / 2))
    axis.set_major_formatter(FuncFormatter(lambda value, _: half_turns(value)))


def half_turns(angle: float) -> str:
    """A multiple of pi / 2, such as ``"-π/2"``."""
    count = round(angle / (np.pi / 2))
    if count == 0:
        return "0"
    number, divided = (count, "/2") if count % 2 else (count // 2, "")
    return f"{'-' if number < 0 else ''}{abs(number) if abs(number) > 1 else ''}π{divided}"
