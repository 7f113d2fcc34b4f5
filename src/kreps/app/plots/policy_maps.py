"""Maps of the policy and of V over a two-dimensional state space."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from kreps.algorithms.state import LearnerState
from kreps.app.environments import Labels
from kreps.app.plots.plane import (
    FADED,
    label_axes,
    mark_start_and_goal,
    opacity,
    opaque,
    path_of,
    state_grid,
)
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.plotting import STYLE
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP

SHOWN_ROLLOUTS = 10
"""Latest rollouts that are drawn into the maps."""


def policy_maps(state: LearnerState, task: TaskSpec, labels: Labels) -> Figure:
    """Maps of the policy's mean, its standard deviation and V, of the first action coordinate.

    The latest rollouts are drawn into them.  The maps fade where the window has no data, as they
    are extrapolation there.

    Raises:
        ConfigurationError: the state space is not two-dimensional, or the window has no rollouts.
    """
    if not state.window.rollouts:
        raise ConfigurationError(
            "the window has no rollouts to draw, because all updates were from data sets; "
            "make an update from rollouts as well"
        )
    assert isinstance(state.policy, CostSensitiveGP | SparseGP) and state.value is not None
    x, y, states = state_grid(state, task)
    visible = opacity(x, y, states, state, task)
    low, high = task.action_low[0], task.action_high[0]
    mean = np.clip(state.policy.greedy(states)[:, 0], low, high)
    std = state.policy.standard_deviation(states)[:, 0]
    value = state.value(states)
    known = visible.ravel() == 1.0  # elsewhere the values may be of any size
    panels = (
        ("Policy mean", mean, "RdBu_r", (low, high), labels.actions[0]),
        ("Policy standard deviation", std, "viridis", (0.0, std[known].max()), labels.actions[0]),
        ("Value function V", value, "magma", (value[known].min(), value[known].max()), "reward"),
    )
    with rc_context(STYLE):
        figure = Figure(figsize=(8.4, 4.2))
        plots = figure.subplots(1, 3, sharey=True)
        for axes, (name, values, colours, (vmin, vmax), unit) in zip(plots, panels, strict=True):
            picture = axes.imshow(
                values.reshape(len(y), len(x)),
                origin="lower",
                aspect="auto",
                extent=(x[0], x[-1], y[0], y[-1]),
                cmap=colours,
                vmin=vmin,
                vmax=vmax,
                alpha=visible,
                interpolation="bilinear",
            )
            _draw_rollouts(axes, state, task)
            label_axes(axes, task, labels.observations)
            axes.set_title(name)
            bar = figure.colorbar(opaque(picture), ax=axes, location="bottom", label=unit, pad=0.03)
            bar.ax.xaxis.set_major_locator(MaxNLocator(5))
        for axes in plots[1:]:
            axes.set_ylabel("")
        legend_of_maps(figure, plots[0])
    return figure


def legend_of_maps(figure: Figure, axes: Axes) -> None:
    """What the lines and markers of a map mean, in a row below the figure."""
    handles, names = axes.get_legend_handles_labels()
    handles.append(Patch(facecolor="#1f4e79", alpha=FADED + 0.1))
    names.append("faded: no data")
    figure.legend(handles, names, loc="outside lower center", ncols=len(names))


def _draw_rollouts(axes: Axes, state: LearnerState, task: TaskSpec) -> None:
    limits = axes.axis()
    latest = state.window.rollouts[-SHOWN_ROLLOUTS:]
    for i, rollout in enumerate(latest):
        path = path_of(rollout.observations, task)
        axes.plot(*path, color="white", lw=1.8, alpha=0.6)
        axes.plot(*path, color="black", lw=0.8, alpha=0.8, label=None if i else "latest rollouts")
    starts = np.array([rollout.observations[0] for rollout in latest])
    mark_start_and_goal(axes, state, starts)
    axes.axis(limits)
