"""Pictures, drawn from what runs and experiments wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from kreps.algorithms.state import LearnerState
from kreps.app.diagnosis import effective_share
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP

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
MAP_POINTS = 121


def save(figure: Figure, path: Path) -> Path:
    FigureCanvasAgg(figure)
    try:
        with rc_context(STYLE):
            figure.savefig(path)
    except OSError as error:
        raise StorageError(f"cannot write the picture {path}: {error}; check the folder") from error
    return path


def learning_curve(
    rows: Sequence[Mapping[str, str]],
    references: Mapping[str, float],
    evaluation: Mapping[str, Any] | None,
    title: str,
) -> Figure:
    """Average reward against environment steps, above realised KL and effective sample size.

    Args:
        rows: of ``progress.csv``.
        references: values to draw as lines, by name.
        evaluation: of ``evaluation.json``, drawn at the last step.
        title: of the figure.
    """
    steps = np.array([int(row["steps"]) for row in rows])
    # a batch was collected by the policy learnt from the steps before it
    known = np.concatenate([[0], steps[:-1]])

    def column(name: str) -> FloatArray:
        return np.array([float(row[name]) for row in rows])

    with rc_context(STYLE):
        figure = Figure(figsize=(7.0, 6.0))
        top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(4, 1, 1))
        top.plot(
            known, column("average_reward"), "o-", color=BLUE, ms=4, label="training roll-outs"
        )
        if evaluation:
            for name, marker in (("stochastic", "D"), ("greedy", "*")):
                top.plot(
                    steps[-1],
                    evaluation[name]["mean"],
                    marker,
                    color=ORANGE,
                    ms=9 if marker == "*" else 6,
                    label=f"{name} policy, evaluated: {evaluation[name]['mean']:.4g}",
                )
        draw_references(top, references)
        top.set_ylabel("average reward per step")
        top.set_title(title)
        top.legend(loc="lower right", bbox_to_anchor=(1.0, 0.12))
        middle.plot(steps, column("kl"), "o-", color=BLUE, ms=3)
        middle.plot(steps, column("kl_bound"), color=GREY, lw=0.8, ls="--")
        middle.set_ylabel("KL and bound\n[nats]")
        middle.set_ylim(bottom=0)
        bottom.plot(steps, effective_share(rows), "o-", color=BLUE, ms=3)
        bottom.set_ylabel("effective\nsample share")
        bottom.set_ylim(0, 1)
        bottom.set_xlabel("environment steps seen before")
    return figure


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


def policy_maps(
    state: LearnerState, task: TaskSpec, labels: Sequence[str], action_labels: Sequence[str]
) -> Figure:
    """Maps of policy mean, policy standard deviation and V over a two-dimensional state space.

    The latest roll-outs are drawn in: away from them the maps are extrapolation.

    Raises:
        ConfigurationError: the state space has not two dimensions, or no roll-outs are kept.
    """
    if not state.window.rollouts:
        raise ConfigurationError(
            "no roll-outs are kept to draw: all was learnt from data sets; update from some, too"
        )
    assert isinstance(state.policy, CostSensitiveGP | SparseGP) and state.value is not None
    axes_x, axes_y, states = _grid(state, task)
    low, high = task.action_low[0], task.action_high[0]
    spread = state.policy.standard_deviation(states)[:, 0]
    panels = (
        ("Policy mean", np.clip(state.policy.greedy(states)[:, 0], low, high), "RdBu_r", low, high),
        ("Policy standard deviation", spread, "viridis", 0.0, None),
        ("Value function V", state.value(states), "magma", None, None),
    )
    units = (action_labels[0], action_labels[0], "reward")
    with rc_context(STYLE):
        figure = Figure(figsize=(12.5, 3.9))
        plots = figure.subplots(1, 3, sharey=True)
        for axes, (name, values, colours, least, most), unit in zip(
            plots, panels, units, strict=True
        ):
            image = _show_map(axes, axes_x, axes_y, values, colours, least, most)
            _draw_trajectories(axes, state, task)
            _label_axes(axes, task, labels)
            axes.set_title(name)
            figure.colorbar(image, ax=axes, label=unit, pad=0.02)
        for axes in plots[1:]:
            axes.set_ylabel("")
    return figure


def check_film_name(path: Path) -> None:
    """Raise `ConfigurationError` unless the name ends in ``.gif``."""
    if path.suffix != ".gif":
        raise ConfigurationError(f"{path.name!r} is no film; end its name in .gif")


def film(
    frames: Sequence[Any],
    observations: FloatArray,
    actions: FloatArray,
    state: LearnerState,
    task: TaskSpec,
    labels: Sequence[str],
    action_labels: Sequence[str],
    fps: float,
    path: Path,
) -> Path:
    """A roll-out as a GIF: what the camera sees and, for two-dimensional states, the path.

    Args:
        frames: T pictures (height, width, 3).
        observations: (T, ds) and actions (T, da) that go with them.
        fps: pictures per second of the environment.
        path: ending in ``.gif``.
    """
    check_film_name(path)
    plane = task.observation_size == 2
    with rc_context({**STYLE, "figure.constrained_layout.use": False}):
        figure = Figure(figsize=(7.6 if plane else 3.8, 3.6), dpi=80)
        canvas = FigureCanvasAgg(figure)
        camera = figure.add_axes((0.01, 0.02, 0.46 if plane else 0.98, 0.86))
        camera.set_axis_off()
        picture = camera.imshow(frames[0])
        text = figure.text(0.02, 0.92, "", family="monospace", fontsize=8)
        if plane:
            axes = figure.add_axes((0.57, 0.15, 0.40, 0.73))
            x, y, states = _grid(state, task)
            assert state.policy is not None
            low, high = task.action_low[0], task.action_high[0]
            mean = np.clip(state.policy.greedy(states)[:, 0], low, high)
            axes.contourf(
                x, y, mean.reshape(len(y), len(x)), np.linspace(low, high, 12), cmap="RdBu_r"
            )
            _label_axes(axes, task, labels)
            axes.set_title("policy mean and path", fontsize=8)
            (trail,) = axes.plot([], [], color="black", lw=1.2)
            (dot,) = axes.plot([], [], "o", color="black", ms=6)
        images = []
        for t, frame in enumerate(frames):
            picture.set_data(frame)
            text.set_text(f"t = {t / fps:5.2f} s   {action_labels[0]} {actions[t, 0]:7.2f}")
            if plane:
                trail.set_data(*_unwrapped(observations[: t + 1], task))
                dot.set_data(observations[t : t + 1, 0], observations[t : t + 1, 1])
            canvas.draw()  # type: ignore[no-untyped-call]
            pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
            images.append(Image.fromarray(pixels[..., :3].copy()))
    # one palette without dithering: neighbouring pictures then differ only where things move
    palette = images[len(images) // 2].quantize(96, dither=Image.Dither.NONE)
    still = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    try:
        still[0].save(
            path, save_all=True, append_images=still[1:], duration=round(1000 / fps), loop=0
        )
    except OSError as error:
        raise StorageError(f"cannot write the film {path}: {error}; check the folder") from error
    return path


def _grid(state: LearnerState, task: TaskSpec) -> tuple[FloatArray, FloatArray, FloatArray]:
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
        if i in task.periodic:  # a whole turn, cut where the task cuts it
            middle = 0.5 * (low + high)
            low, high = middle - np.pi, middle + np.pi
            low, high = round(low / (np.pi / 4)) * np.pi / 4, round(high / (np.pi / 4)) * np.pi / 4
        axes.append(np.linspace(low, high, MAP_POINTS))
    x, y = np.meshgrid(*axes)
    return axes[0], axes[1], np.stack([x.ravel(), y.ravel()], axis=1)


def _show_map(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    values: FloatArray,
    colours: str,
    least: float | None,
    most: float | None,
) -> Any:
    return axes.imshow(
        values.reshape(len(y), len(x)),
        origin="lower",
        aspect="auto",
        extent=(x[0], x[-1], y[0], y[-1]),
        cmap=colours,
        vmin=least,
        vmax=most,
        interpolation="bilinear",
    )


def _draw_trajectories(axes: Axes, state: LearnerState, task: TaskSpec, count: int = 10) -> None:
    limits = axes.axis()
    for rollout in state.window.rollouts[-count:]:
        axes.plot(*_unwrapped(rollout.observations, task), color="white", lw=1.6, alpha=0.5)
        axes.plot(*_unwrapped(rollout.observations, task), color="black", lw=0.7, alpha=0.8)
    axes.axis(limits)


def _unwrapped(observations: FloatArray, task: TaskSpec) -> FloatArray:
    """The path (2, m) with a gap wherever an angle jumps across its cut."""
    path = observations[:, :2]
    angles = [i for i in task.periodic if i < 2]
    jumps = np.flatnonzero((np.abs(np.diff(path[:, angles], axis=0)) > np.pi).any(axis=1)) + 1
    return np.insert(path, jumps, np.nan, axis=0).T


def _label_axes(axes: Axes, task: TaskSpec, labels: Sequence[str]) -> None:
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    if 0 in task.periodic:
        ticks = np.arange(-4, 5) * np.pi / 2
        names = ["-2π", "-3π/2", "-π", "-π/2", "0", "π/2", "π", "3π/2", "2π"]
        low, high = axes.get_xlim()
        inside = [i for i, t in enumerate(ticks) if low - 1e-9 <= t <= high + 1e-9]
        axes.set_xticks(ticks[inside], [names[i] for i in inside])


def comparison(
    rows: Sequence[Mapping[str, Any]],
    references: Mapping[str, Mapping[str, float]],
    title: str,
    source: str,
) -> Figure:
    """Every seed of every method against environment steps, stochastic above greedy, and means.

    Args:
        rows: of an experiment, one per method, seed and iteration.
        references: values to draw as lines, by name, for each method; where they differ, so do
            the tasks, and each has a scale of its own.
        title: of the figure.
        source: command and commit that made it, printed below.
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


COLOURS = ("#20639b", "#d1603d", "#c29b19", "#8e5ea2", "#5b6068", "#3caea3")
"""Of the curves of a figure, in their order; so are the line styles, for who sees no colours."""
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), (0, (7, 2)))

PANELS = (
    ("training_reward", "iteration", "As in the paper: training roll-outs"),
    ("stochastic", "steps", "Evaluated, with exploration"),
    ("greedy", "steps", "Evaluated, without exploration"),
)


def learning_curves(
    rows: Sequence[Mapping[str, Any]],
    references: Mapping[str, float],
    title: str,
    source: str,
    known: Sequence[str] = (),
) -> Figure:
    """Mean and twice the standard error of every method: by iteration, and by environment steps.

    A method with one iteration only is a level line, in the first panel at its evaluated reward.

    Args:
        rows: of a figure, one per method, seed and iteration.
        references: values to draw as lines, by name.
        title: of the figure.
        source: command and commit that made it, printed below.
        known: methods that keep their colour from figure to figure.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    places = {name: i for i, name in enumerate(dict.fromkeys([*known, *methods]))}
    with rc_context(STYLE):
        figure = Figure(figsize=(13.0, 5.0))
        plots = figure.subplots(1, len(PANELS), sharey=True)
        for method in methods:
            colour = COLOURS[places[method] % len(COLOURS)]
            line = LINES[places[method] % len(LINES)]
            mine = [row for row in rows if row["method"] == method]
            for axes, (value, by, _) in zip(plots, PANELS, strict=True):
                _draw_mean(axes, mine, value, by, method, colour, line)
        shown = [row[name] for row in rows for name in ("stochastic", "greedy")]
        low, high = min([*references.values(), *_quantiles(shown)]), max(references.values())
        for axes, (_, by, heading) in zip(plots, PANELS, strict=True):
            axes.set_title(heading)
            axes.set_xlabel("iteration" if by == "iteration" else "environment steps")
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
    colour: str,
    line: Any,
) -> None:
    """One curve with its band; a level line if there is one iteration only."""
    iterations = sorted({row["iteration"] for row in rows})
    once = len(iterations) == 1
    if once and value == "training_reward":
        value = "stochastic"  # no roll-outs of a policy were trained on
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
        axes.axhline(mean[0], color=colour, ls=line, lw=1.6, label=f"{name}, one iteration")
        axes.axhspan(mean[0] - error[0], mean[0] + error[0], color=colour, alpha=0.15, lw=0)
        return
    axes.plot(x, mean, color=colour, ls=line, lw=1.6, label=name)
    axes.fill_between(x, mean - error, mean + error, color=colour, alpha=0.18, lw=0)


def image_features(observations: FloatArray, times: Sequence[float], pixels: int) -> Figure:
    """Images above their differences to the one before (Fig. 2a).

    Args:
        observations: (m, 2 pixels^2).
        times: (m,) in s.
        pixels: of each side of an image.
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
