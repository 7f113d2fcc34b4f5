"""A rollout as an animated GIF."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from kreps.algorithms.state import LearnerState
from kreps.app.environments import Labels
from kreps.app.plots.plane import label_axes, path_of, state_grid
from kreps.app.recording import Recording
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.learning.storage import write_atomically
from kreps.plotting import STYLE

FILM_COLOURS = 96
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
    plane = task.observation_size == 2
    with rc_context({**STYLE, "figure.constrained_layout.use": False}):
        figure = Figure(figsize=(7.6 if plane else 3.8, 3.6), dpi=80)
        canvas = FigureCanvasAgg(figure)
        camera = figure.add_axes((0.01, 0.02, 0.46 if plane else 0.98, 0.86))
        camera.set_axis_off()
        picture = camera.imshow(recording.frames[0])
        text = figure.text(0.02, 0.92, "", family="monospace", fontsize=8)
        draw_path = _policy_panel(figure, state, task, labels) if plane else None
        images = []
        for t, frame in enumerate(recording.frames):
            picture.set_data(frame)
            action = recording.actions[t, 0]
            text.set_text(f"t = {t / recording.fps:5.2f} s   {labels.actions[0]} {action:9.3g}")
            if draw_path is not None:
                draw_path(recording.observations[: t + 1])
            canvas.draw()  # type: ignore[no-untyped-call]
            pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
            images.append(Image.fromarray(pixels[..., :3].copy()))
    _write_gif(images, recording.fps, path)
    return path


def _policy_panel(
    figure: Figure, state: LearnerState, task: TaskSpec, labels: Labels
) -> Callable[[FloatArray], None]:
    """A map of the policy's mean; the function returned draws a path (t, 2) into it."""
    assert state.policy is not None
    axes = figure.add_axes((0.57, 0.15, 0.40, 0.73))
    x, y, states = state_grid(state, task)
    low, high = task.action_low[0], task.action_high[0]
    mean = np.clip(state.policy.greedy(states)[:, 0], low, high).reshape(len(y), len(x))
    axes.contourf(x, y, mean, np.linspace(low, high, 12), cmap="RdBu_r")
    label_axes(axes, task, labels.observations)
    axes.set_title("policy mean and path", fontsize=8)
    (trail,) = axes.plot([], [], color="black", lw=1.2)
    (dot,) = axes.plot([], [], "o", color="black", ms=6)

    def draw_path(observations: FloatArray) -> None:
        trail.set_data(*path_of(observations, task))
        dot.set_data(observations[-1:, 0], observations[-1:, 1])

    return draw_path


def _write_gif(images: Sequence[Image.Image], fps: float, path: Path) -> None:
    # one palette without dithering: successive pictures then differ only where things move
    palette = images[len(images) // 2].quantize(FILM_COLOURS, dither=Image.Dither.NONE)
    first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = max(round(1000 / fps), MIN_DURATION)
    content = io.BytesIO()
    first.save(content, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    write_atomically(path, content.getvalue())
