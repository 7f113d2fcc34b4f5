"""Pictures of experiments: learning curves over many seeds, and the features of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from kreps.kernels.arrays import FloatArray
from kreps.plotting import (
    BLUE,
    COLOURS,
    GREY,
    LINES,
    ORANGE,
    STYLE,
    add_robot_time,
    draw_references,
)


def comparison(
    rows: Sequence[Mapping[str, Any]],
    references: Mapping[str, Mapping[str, float]],
    title: str,
    source: str,
    period: float | None = None,
) -> Figure:
    """A curve per seed against environment steps, and their mean, in two panels per method.

    The upper panel shows the stochastic policy, the lower one the greedy policy.

    Args:
        rows: of an experiment, one per method, seed and iteration.
        references: per method, values that are drawn as lines, by name.  If they differ between
            methods, the methods are on different tasks and their panels have different scales.
        title: of the figure.
        source: command and commit, printed below.
        period: seconds per environment step, if all methods have the same.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    across = min(len(methods), 4)
    deep = -(-len(methods) // across)
    with rc_context(STYLE):
        figure = Figure(figsize=(4.6 * across + 1.4, 6.4 * deep))
        one_task = all(references[m] == references[methods[0]] for m in methods)
        plots = figure.subplots(2 * deep, across, sharex=True, sharey=one_task, squeeze=False)
        for axes in plots[-2:, len(methods) - across * (deep - 1) :].flat:
            axes.set_axis_off()
        for number, method in enumerate(methods):
            mine = [row for row in rows if row["method"] == method]
            row, column = divmod(number, across)
            pair = plots[2 * row : 2 * row + 2, column]
            if not one_task:
                pair[0].sharey(pair[1])
            for axes, name in zip(pair, ("stochastic", "greedy"), strict=True):
                _draw_seeds(axes, mine, name)
                named = not one_task or column == across - 1 or method == methods[-1]
                draw_references(axes, references[method], named=named)
                axes.set_title(f"{method}: {name}")
        for axes in plots[:, 0]:
            axes.set_ylabel("average reward per step")
        for axes in plots[-1]:
            axes.set_xlabel("environment steps")
            add_robot_time(axes, period if axes.axison else None)
        figure.suptitle(title, fontweight="bold")
        figure.supxlabel(source, fontsize=6.5, color=GREY)
    return figure


def _draw_seeds(axes: Axes, rows: Sequence[Mapping[str, Any]], name: str) -> None:
    seeds = sorted({row["seed"] for row in rows})
    curves = []
    for seed in seeds:
        mine = sorted((r for r in rows if r["seed"] == seed), key=lambda r: r["iteration"])
        curves.append(([r["steps"] for r in mine], [r[name] for r in mine]))
        axes.plot(*curves[-1], color=BLUE, lw=0.7, alpha=0.45)
    steps = np.mean([c[0] for c in curves], axis=0)
    values = np.array([c[1] for c in curves])
    mean = values.mean(axis=0)
    axes.plot(steps, mean, color=ORANGE, lw=2, label=f"mean of {len(seeds)} seeds")
    if len(seeds) > 1:
        band = 2 * values.std(axis=0, ddof=1) / np.sqrt(len(seeds))
        axes.fill_between(
            steps, mean - band, mean + band, color=ORANGE, alpha=0.25, lw=0, label="± 2 s.e."
        )
    axes.legend(loc="lower right", frameon=True, framealpha=1.0, edgecolor="none")  # above lines


ROWS = {"stochastic": "with exploration", "greedy": "without exploration"}
"""What the rows of learning curves show: column of the results, and its title."""

LEGEND_WIDTH = 52
"""Characters of a line of a legend."""


@dataclass(frozen=True)
class Column:
    """Learning curves in the same axes; the n-th one has the same colour in each column.

    Attributes:
        title: above them.
        task: columns of the same task share their axes.
        curves: by their names in the legend, the rows of a curve: one per seed and iteration.
        references: values to draw as lines, by name.
        period: seconds per environment step, if all curves have the same.
    """

    title: str
    task: str
    curves: Mapping[str, Sequence[Mapping[str, Any]]]
    references: Mapping[str, float]
    period: float | None = None

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest reward to show: without the lowest hundredth."""
        shown = [row[name] for rows in self.curves.values() for row in rows for name in ROWS]
        values = [*self.references.values(), *np.quantile(shown, (0.01, 1.0))]
        return float(min(values)), float(max(values))


def learning_curves(columns: Sequence[Column], title: str, source: str) -> Figure:
    """Mean and twice the standard error of each curve by environment steps.

    The evaluated reward is above with exploration, and below without.  A curve with a single
    iteration is drawn as a horizontal line.

    Args:
        columns: from left to right; each has a legend below.
        title: of the figure.
        source: command and commit, printed below.
    """
    names = max(len(column.curves) for column in columns)
    with rc_context(STYLE):
        figure = Figure(figsize=(3.9 * len(columns) + 1.4, 7.2 + 0.24 * names))
        plots = figure.subplots(
            3, len(columns), squeeze=False, height_ratios=(3.4, 3.4, 0.4 + 0.24 * names)
        )
        first = {column.task: plots[0, i] for i, column in reversed(list(enumerate(columns)))}
        for column, (*pair, below) in zip(columns, plots.T, strict=True):
            for axes, (value, heading) in zip(pair, ROWS.items(), strict=True):
                if axes is not first[column.task]:
                    axes.sharex(first[column.task])
                    axes.sharey(first[column.task])
                for colour, line, (name, rows) in zip(
                    cycle(COLOURS), cycle(LINES), column.curves.items(), strict=False
                ):
                    _draw_mean(axes, rows, value, name, color=colour, ls=line)
                draw_references(axes, column.references, named=column is columns[-1])
                axes.set_title("\n".join(filter(None, (column.title, heading))))
                axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
            pair[1].set_xlabel("environment steps")
            add_robot_time(pair[1], column.period)
            below.set_axis_off()
            below.legend(*pair[0].get_legend_handles_labels(), loc="upper left", fontsize=8)
        for task, axes in first.items():
            limits = np.array([column.limits for column in columns if column.task == task])
            low, high = limits[:, 0].min(), limits[:, 1].max()
            axes.set_ylim(low - 0.06 * (high - low), high + 0.10 * (high - low))
        for axes in plots[:2, 0]:
            axes.set_ylabel("average reward per step")
        figure.suptitle(title, fontweight="bold")
        figure.supxlabel(source, fontsize=6.5, color=GREY)
    return figure


def _draw_mean(
    axes: Axes, rows: Sequence[Mapping[str, Any]], value: str, name: str, **look: Any
) -> None:
    """One curve with its band; a horizontal line if there is a single iteration."""
    iterations = sorted({row["iteration"] for row in rows})
    steps, mean, error = np.transpose(
        [_moments([row for row in rows if row["iteration"] == i], value) for i in iterations]
    )
    band = {"color": look["color"], "alpha": 0.18, "lw": 0}
    if len(iterations) == 1:
        axes.axhline(mean[0], label=fill(f"{name}, one iteration", LEGEND_WIDTH), lw=1.6, **look)
        axes.axhspan(mean[0] - error[0], mean[0] + error[0], **band)
        return
    axes.plot(steps, mean, label=fill(name, LEGEND_WIDTH), lw=1.6, **look)
    axes.fill_between(steps, mean - error, mean + error, **band)


def _moments(rows: Sequence[Mapping[str, Any]], value: str) -> tuple[float, float, float]:
    """Mean steps, mean value and twice its standard error, over seeds."""
    values = np.array([row[value] for row in rows])
    error = 2.0 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    return float(np.mean([row["steps"] for row in rows])), float(values.mean()), float(error)


def image_features(observations: FloatArray, times: Sequence[float], pixels: int) -> Figure:
    """Images, and below them their differences to the previous image (Fig. 2a).

    Args:
        observations: (m, 2 pixels^2) images and differences.
        times: (m,) in s.
        pixels: number along each side of an image.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(1.5 * len(times), 3.5))
        plots = figure.subplots(2, len(times))
        for column, (observation, time) in enumerate(zip(observations, times, strict=True)):
            both = observation.reshape(2, pixels, pixels)
            plots[0, column].imshow(both[0], cmap="gray", vmin=0.0, vmax=1.0)
            plots[1, column].imshow(both[1], cmap="gray", vmin=-1.0, vmax=1.0)
            plots[0, column].set_title(f"{time:.2f} s", fontweight="normal", loc="center")
        for axes in plots.flat:
            axes.set_xticks([])
            axes.set_yticks([])
        plots[0, 0].set_ylabel("image")
        plots[1, 0].set_ylabel("difference")
    return figure
