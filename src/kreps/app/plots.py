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
from PIL import Image

from kreps.algorithms.state import LearnerState
from kreps.app.diagnosis import effective_share
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.plotting import BLUE, GREY, ORANGE, STYLE, draw_references
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP

MAP_POINTS = 121


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
