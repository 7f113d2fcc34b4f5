"""What all pictures share: style, colours, reference lines, and writing to a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from kreps.errors import StorageError

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
BLUE, ORANGE, GREY = "#20639b", "#d1603d", "#8a8d91"
COLOURS = ("#20639b", "#d1603d", "#c29b19", "#8e5ea2", "#5b6068", "#3caea3")
"""Of the curves of a figure, in their order."""
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), (0, (7, 2)))
"""Likewise the line styles, which distinguish the curves without their colours."""


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
