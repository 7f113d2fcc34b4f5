"""Pictures of experiments: learning curves over many seeds, and the features of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


PANELS = (
    ("training_reward", "iteration", "As in the paper: training rollouts"),
    ("stochastic", "steps", "Evaluated, with exploration"),
    ("greedy", "steps", "Evaluated, without exploration"),
)
"""Column, horizontal axis and title of each panel."""


def learning_curves(
    rows: Sequence[Mapping[str, Any]],
    references: Mapping[str, float],
    title: str,
    source: str,
    known: Sequence[str] = (),
    period: float | None = None,
) -> Figure:
    """Mean and twice the standard error of each method, by iteration and by environment steps.

    A method with a single iteration is drawn as a horizontal line, in the first panel at its
    evaluated reward.

    Args:
        rows: of a figure, one per method, seed and iteration.
        references: values to draw as lines, by name.
        title: of the figure.
        source: command and commit, printed below.
        known: methods with the same colour in all figures.
        period: seconds per environment step, if all methods have the same.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    index = {name: i for i, name in enumerate(dict.fromkeys([*known, *methods]))}
    with rc_context(STYLE):
        figure = Figure(figsize=(13.0, 5.0))
        plots = figure.subplots(1, len(PANELS), sharey=True)
        for method in methods:
            colour = COLOURS[index[method] % len(COLOURS)]
            line = LINES[index[method] % len(LINES)]
            mine = [row for row in rows if row["method"] == method]
            for axes, (value, by, _) in zip(plots, PANELS, strict=True):
                _draw_mean(axes, mine, value, by, method, color=colour, ls=line)
        shown = [row[name] for row in rows for name in ("stochastic", "greedy")]
        low, high = min([*references.values(), *_quantiles(shown)]), max(references.values())
        for axes, (_, by, heading) in zip(plots, PANELS, strict=True):
            axes.set_title(heading)
            axes.set_xlabel("iteration" if by == "iteration" else "environment steps")
            add_robot_time(axes, None if by == "iteration" else period)
            axes.xaxis.set_major_locator(MaxNLocator(7, integer=True))
            axes.set_ylim(low - 0.06 * (high - low), high + 0.10 * (high - low))
            draw_references(axes, references, named=axes is plots[-1])
        plots[0].set_ylabel("average reward per step")
        handles, labels = plots[0].get_legend_handles_labels()
        legend = figure.legend(
            handles, labels, loc="outside upper left", ncols=3, title=title, alignment="left"
        )
        legend.get_title().set_fontweight("bold")
        figure.supxlabel(source, fontsize=6.5, color=GREY)
    return figure


def _quantiles(values: Sequence[float]) -> list[float]:
    return [float(q) for q in np.quantile(values, (0.01, 0.99))]


def _draw_mean(
    axes: Axes,
    rows: Sequence[Mapping[str, Any]],
    value: str,
    by: str,
    name: str,
    **look: Any,
) -> None:
    """One curve with its band; a horizontal line if there is a single iteration."""
    iterations = sorted({row["iteration"] for row in rows})
    once = len(iterations) == 1
    if once and value == "training_reward":
        value = "stochastic"  # its training data is not from a policy
    columns = [[row for row in rows if row["iteration"] == i] for i in iterations]
    x = np.array([np.mean([row[by] for row in column]) for column in columns])
    mean = np.array([np.mean([row[value] for row in column]) for column in columns])
    error = np.array(
        [
            2 * np.std([row[value] for row in c], ddof=1) / np.sqrt(len(c)) if len(c) > 1 else 0.0
            for c in columns
        ]
    )
    if once:
        axes.axhline(mean[0], label=f"{name}, one iteration", lw=1.6, **look)
        axes.axhspan(mean[0] - error[0], mean[0] + error[0], color=look["color"], alpha=0.15, lw=0)
        return
    axes.plot(x, mean, label=name, lw=1.6, **look)
    axes.fill_between(x, mean - error, mean + error, color=look["color"], alpha=0.18, lw=0)


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
