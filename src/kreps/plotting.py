"""What all pictures share: style, colours, reference lines, and writing to a file."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

if "MPLBACKEND" in os.environ:  # one that Matplotlib does not know would end its import
    _backend = os.environ.pop("MPLBACKEND")
    import matplotlib

    with suppress(ValueError):  # pictures in files need none
        matplotlib.rcParams["backend"] = _backend
        os.environ["MPLBACKEND"] = _backend

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from kreps.errors import StorageError
from kreps.kernels.arrays import FloatArray

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "figure.constrained_layout.use": True,
    "legend.frameon": False,
    "savefig.dpi": 150,
}
BLUE, ORANGE, PURPLE, GREY = "#20639b", "#d1603d", "#8e5ea2", "#8a8d91"
COLOURS = ("#20639b", "#d1603d", "#c29b19", "#8e5ea2", "#5b6068", "#3caea3")
"""Of the curves of a figure, in their order."""
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), (0, (7, 2)))
"""Likewise the line styles, which distinguish the curves without their colours."""

SECOND_AXIS = 32.0
"""Distance of a second x-axis from the first one, in points: below its numbers and its label."""
SECOND_AXIS_HEIGHT = 0.5
"""Of a second x-axis with its numbers and its label, in inches."""

OFF_SCALE = 5.0
"""Few values are left out of an axis if it is shorter by more than this factor without them."""


def save(figure: Figure, path: Path) -> Path:
    FigureCanvasAgg(figure)
    try:
        with rc_context(STYLE):
            figure.savefig(path)
    except OSError as error:
        raise StorageError(f"cannot write the picture {path}: {error}; check the folder") from error
    return path


def draw_references(axes: Axes, references: Mapping[str, float], *, named: bool = True) -> None:
    """A dashed line per value, named on the right; lower where the line above is too near."""
    spread = max(references.values(), default=0.0) - min(references.values(), default=0.0)
    above = np.inf
    for name, value in sorted(references.items(), key=lambda item: -item[1]):
        near = above - value < 0.05 * spread
        axes.axhline(value, color=GREY, lw=0.8, ls="--", zorder=0)
        if not named:
            continue
        axes.annotate(
            f"{name.replace(' (', chr(10) + '(')}  {value:g}",
            (1.0, value),
            xycoords=("axes fraction", "data"),
            xytext=(4, 0),
            textcoords="offset points",
            va="top" if near else "center",
            color=GREY,
            fontsize=7.5,
        )
        above = value


def add_robot_time(axes: Axes, period: float | None) -> None:
    """A second axis below that of the environment steps, in seconds of robot time.

    Args:
        axes: with environment steps on their x-axis.
        period: seconds per step; None adds no axis.
    """
    if period is None:
        return
    seconds, steps = partial(np.multiply, period), partial(np.multiply, 1.0 / period)
    below = axes.secondary_xaxis("bottom", functions=(seconds, steps))
    below.spines["bottom"].set_position(("outward", SECOND_AXIS))
    below.set_xlabel("robot time [s]")


def limits_of_most(
    values: FloatArray, droppable: int, always: Sequence[float] = ()
) -> tuple[float, float] | None:
    """Limits of an axis on which a few values far from the others do not flatten a curve.

    Args:
        values: (n,) to be shown; NaN are left out.
        droppable: largest number of them that may lie beyond the limits; at most half do.
        always: values that must be within.

    Returns:
        None if all of them fit on one axis.
    """
    ordered = np.sort(values[np.isfinite(values)])
    fixed = [value for value in always if np.isfinite(value)]
    found, shortest = None, np.inf
    for dropped in range(min(droppable, len(ordered) // 2) + 1):
        kept = len(ordered) - dropped
        spans = [
            (min([ordered[i], *fixed]), max([ordered[i + kept - 1], *fixed]))
            for i in range(dropped + 1 if kept else 0)
        ]
        low, high = min(spans, key=lambda span: span[1] - span[0], default=(0.0, 0.0))
        if dropped == 0:
            shortest = high - low
        elif 0.0 < OFF_SCALE * (high - low) < shortest:
            found, shortest = (low, high), high - low
    if found is None:
        return None
    margin = 0.12 * (found[1] - found[0])
    return found[0] - margin, found[1] + margin


def mark_beyond(
    axes: Axes, x: FloatArray, y: FloatArray, limits: tuple[float, float], colour: str
) -> None:
    """Set the limits of the y-axis; an arrow and the value show each point (n,) beyond them."""
    axes.set_ylim(limits)
    for beyond, edge, marker, up in ((y < limits[0], 0.0, "v", 1), (y > limits[1], 1.0, "^", -1)):
        for time, value in zip(x[beyond], y[beyond], strict=True):
            axes.annotate(
                f"{value:.4g}",
                (time, edge),
                xycoords=("data", "axes fraction"),
                xytext=(8, 3 * up),
                textcoords="offset points",
                va="bottom" if up > 0 else "top",
                color=colour,
                fontsize=8,
                bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "lw": 0, "alpha": 0.8},
            )
            arrow = axes.get_xaxis_transform()
            axes.plot(time, edge, marker, transform=arrow, color=colour, ms=9, clip_on=False)
