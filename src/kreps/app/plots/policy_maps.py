"""Maps of the policy and of V over a two-dimensional state space."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kreps.algorithms.state import LearnerState
from kreps.app.environments import Labels
from kreps.app.plots.plane import label_axes, path_of, state_grid
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.plotting import STYLE
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP

SHOWN_ROLLOUTS = 10
"""Latest rollouts that are drawn into the maps."""


def policy_maps(state: LearnerState, task: TaskSpec, labels: Labels) -> Figure:
    """Maps of the policy's mean, its standard deviation and V, of the first action coordinate.

    The latest rollouts are drawn into them: far from these the maps are extrapolation.

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
    low, high = task.action_low[0], task.action_high[0]
    mean = np.clip(state.policy.greedy(states)[:, 0], low, high)
    std = state.policy.standard_deviation(states)[:, 0]
    panels = (
        ("Policy mean", mean, "RdBu_r", (low, high), labels.actions[0]),
        ("Policy standard deviation", std, "viridis", (0.0, None), labels.actions[0]),
        ("Value function V", state.value(states), "magma", (None, None), "reward"),
    )
    with rc_context(STYLE):
        figure = Figure(figsize=(12.5, 3.9))
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
                interpolation="bilinear",
            )
            _draw_rollouts(axes, state, task)
            label_axes(axes, task, labels.observations)
            axes.set_title(name)
            figure.colorbar(picture, ax=axes, label=unit, pad=0.02)
        for axes in plots[1:]:
            axes.set_ylabel("")
    return figure


def _draw_rollouts(axes: Axes, state: LearnerState, task: TaskSpec) -> None:
    limits = axes.axis()
    for rollout in state.window.rollouts[-SHOWN_ROLLOUTS:]:
        axes.plot(*path_of(rollout.observations, task), color="white", lw=1.6, alpha=0.5)
        axes.plot(*path_of(rollout.observations, task), color="black", lw=0.7, alpha=0.8)
    axes.axis(limits)
