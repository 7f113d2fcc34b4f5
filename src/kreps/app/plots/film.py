"""A rollout as an animated GIF."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from PIL import Image

from kreps.algorithms.state import LearnerState
from kreps.app.environments import Labels
from kreps.app.plots.plane import (
    label_axes,
    mark_start_and_goal,
    opacity,
    opaque,
    path_of,
    state_grid,
)
from kreps.app.recording import Recording
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.learning.storage import write_atomically
from kreps.plotting import GREY, ORANGE, STYLE

COLUMN, HEIGHT, DPI = 4.0, 4.0, 100
"""Width of the camera and of the map, height of the film in inches, and pixels per inch."""

SHOWN_ACTIONS = 3
"""Largest number of action coordinates that are drawn below the camera."""

FILM_COLOURS = 256
"""Colours of the palette that all pictures of a film share."""

MIN_DURATION = 20
"""Of a picture in ms: viewers show faster ones much more slowly."""


def check_film_name(path: Path) -> None:
    """Raise `ConfigurationError` unless the name ends in ``.gif``."""
    if path.suffix != ".gif":
        raise ConfigurationError(f"{path.name!r} is not the name of a film; end it in .gif")


def film(
    recording: Recording, state: LearnerState, task: TaskSpec, labels: Labels, path: Path
) -> Path:
    """Write a recording as a GIF; for two-dimensional states beside its path over the policy.

    Args:
        recording: of at least one picture.
        state: of the learner, with the policy to draw.
        task: whose states and actions they are.
        labels: of their coordinates.
        path: ending in ``.gif``.

    Raises:
        ConfigurationError: the path does not end in ``.gif``.
        StorageError: the file cannot be written.
    """
    check_film_name(path)
    plane = task.state_size == 2
    width = COLUMN * (2.0 if plane else 1.0)
    with rc_context({**STYLE, "figure.constrained_layout.use": False}):
        figure = Figure(figsize=(width, HEIGHT), dpi=DPI)
        canvas = FigureCanvasAgg(figure)
        rows = min(task.action_size, SHOWN_ACTIONS)
        bottom = 0.04 + 0.13 * rows
        camera = figure.add_axes((0.15 / width, bottom, 3.7 / width, 0.90 - bottom))
        camera.set_axis_off()
        picture = camera.imshow(recording.frames[0], animated=True)
        time = figure.text(0.2 / width, 0.925, "", fontsize=12, fontweight="bold", animated=True)
        gauges = [
            Gauge.draw(
                figure, (0.35 / width, bottom - 0.13 * (i + 1), 3.3 / width), task, labels, i
            )
            for i in range(rows)
        ]
        panel = PolicyPanel.draw(figure, recording, state, task, labels) if plane else None
        moving: list[Artist] = [picture, time, *(part for gauge in gauges for part in gauge.parts)]
        if panel is not None:
            moving += panel.parts
        canvas.draw()  # type: ignore[no-untyped-call]
        still = canvas.copy_from_bbox(figure.bbox)  # type: ignore[no-untyped-call]
        images = []
        for t, frame in enumerate(recording.frames):
            picture.set_data(frame)
            time.set_text(f"t = {t / recording.fps:.2f} s")
            for gauge, action in zip(gauges, recording.actions[t], strict=False):
                gauge.show(float(action))
            if panel is not None:
                panel.show(recording.observations[: t + 1], task)
            canvas.restore_region(still)  # type: ignore[no-untyped-call]
            for artist in moving:
                figure.draw_artist(artist)
            pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
            images.append(Image.fromarray(pixels[..., :3].copy()))
    _write_gif(images, recording.fps, path)
    return path


@dataclass(frozen=True)
class Gauge:
    """An action between its limits, as an arrow from no action (or the nearest limit) and in words.

    Attributes:
        limits: of the action.
        arrow, text: that move.
    """

    limits: tuple[float, float]
    arrow: FancyArrowPatch
    text: Text

    @classmethod
    def draw(
        cls,
        figure: Figure,
        place: tuple[float, float, float],
        task: TaskSpec,
        labels: Labels,
        i: int,
    ) -> Gauge:
        """Draw the scale of action i at a place: left, bottom and width in shares of the figure."""
        low, high = float(task.action_low[i]), float(task.action_high[i])
        left, bottom, width = place
        axes = figure.add_axes((left, bottom + 0.015, width, 0.045))
        axes.set_axis_off()
        axes.set_xlim(low, high)
        axes.set_ylim(-1.0, 1.0)
        axes.plot([low, high], [0.0, 0.0], color=GREY, lw=1.0)
        for value in sorted({low, min(max(0.0, low), high), high}):
            axes.plot([value, value], [-0.7, 0.7], color=GREY, lw=1.0)
        figure.text(left, bottom + 0.068, labels.actions[i], fontsize=10)
        arrow = FancyArrowPatch(
            (0.0, 0.0),
            (1.0, 0.0),
            arrowstyle="simple,head_width=0.55,head_length=0.6,tail_width=0.22",
            mutation_scale=20.0,
            shrinkA=0.0,
            shrinkB=0.0,
            color=ORANGE,
            lw=0.0,
            clip_on=False,
            animated=True,
        )
        axes.add_patch(arrow)
        text = figure.text(
            left + width,
            bottom + 0.068,
            "",
            fontsize=10,
            ha="right",
            fontweight="bold",
            animated=True,
        )
        return cls((low, high), arrow, text)

    @property
    def parts(self) -> tuple[Artist, Artist]:
        return self.arrow, self.text

    def show(self, action: float) -> None:
        """Show an action, clipped to the limits as the environment applies it."""
        low, high = self.limits
        applied, start = min(max(action, low), high), min(max(0.0, low), high)
        self.arrow.set_positions((start, 0.0), (applied, 0.0))
        self.arrow.set_visible(abs(applied - start) > 0.01 * (high - low))
        self.text.set_text(f"{applied:.3g}")


@dataclass(frozen=True)
class PolicyPanel:
    """A map of the policy's mean with the path so far.

    Attributes:
        trail: the path.
        dot: its end.
        marks: of start and goal, which do not move but lie above the path.
    """

    trail: Line2D
    dot: Line2D
    marks: Sequence[Line2D]

    @property
    def parts(self) -> list[Line2D]:
        return [self.trail, *self.marks, self.dot]

    @classmethod
    def draw(
        cls,
        figure: Figure,
        recording: Recording,
        state: LearnerState,
        task: TaskSpec,
        labels: Labels,
    ) -> PolicyPanel:
        """Draw the map in the right half of the figure."""
        assert state.policy is not None
        axes = figure.add_axes((0.585, 0.21, 0.335, 0.69))
        x, y, states = state_grid(state, task)
        low, high = task.action_low[0], task.action_high[0]
        mean = np.clip(state.policy.greedy(states)[:, 0], low, high).reshape(len(y), len(x))
        picture = axes.imshow(
            mean,
            origin="lower",
            aspect="auto",
            extent=(x[0], x[-1], y[0], y[-1]),
            cmap="RdBu_r",
            vmin=low,
            vmax=high,
            alpha=opacity(x, y, states, state, task),
            interpolation="bilinear",
        )
        bar = figure.colorbar(opaque(picture), cax=figure.add_axes((0.935, 0.21, 0.013, 0.69)))
        bar.set_ticks(sorted({low, min(max(0.0, low), high), high}))
        label_axes(axes, task, labels.observations)
        axes.set_title(f"Policy mean: {labels.actions[0]}", fontsize=10)
        marks = mark_start_and_goal(axes, state, recording.observations[:1])
        handles, names = axes.get_legend_handles_labels()
        figure.legend(handles, names, loc="lower right", ncols=2, bbox_to_anchor=(0.99, -0.01))
        halo = [withStroke(linewidth=3.6, foreground="white")]
        (trail,) = axes.plot([], [], color="black", lw=1.6, path_effects=halo, animated=True)
        (dot,) = axes.plot([], [], "o", color="black", ms=8, mec="white", animated=True)
        return cls(trail, dot, marks)

    def show(self, observations: FloatArray, task: TaskSpec) -> None:
        """Show the path of observations (t, 2)."""
        self.trail.set_data(*path_of(observations, task))
        self.dot.set_data(observations[-1:, 0], observations[-1:, 1])


def _write_gif(images: Sequence[Image.Image], fps: float, path: Path) -> None:
    # one palette without dithering: successive pictures then differ only where things move
    middle, method = images[len(images) // 2], Image.Quantize.MAXCOVERAGE  # keeps rare colours
    palette = middle.quantize(FILM_COLOURS, method, dither=Image.Dither.NONE)
    first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = max(round(1000 / fps), MIN_DURATION)
    content = io.BytesIO()
    first.save(content, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    write_atomically(path, content.getvalue())
