"""The greedy policy over time: states, commands, rewards, and what the model predicts of them."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from kreps.app.diagnosis.finding import counted
from kreps.app.environments import Labels
from kreps.app.plots.plane import angle_ticks
from kreps.data.rollouts import Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.plotting import BLUE, GREY, ORANGE, PURPLE, STYLE
from kreps.policies.base import LearntPolicy

SHOWN_COORDINATES, SHOWN_ACTIONS = 8, 4
"""Largest number of panels of states and of actions: those of the first coordinates."""

BEYOND = 0.5
"""Largest share of the range of what happened by which predictions extend an axis on each side."""

OTHERS: dict[str, Any] = {"color": "#a9c4dc", "lw": 0.8, "label": "other rollouts"}
FIRST: dict[str, Any] = {"color": BLUE, "lw": 1.6, "label": "first rollout", "zorder": 2.5}


def trajectories(
    rollouts: Rollouts,
    predicted: FloatArray | None,
    steps: int,
    policy: LearntPolicy,
    labels: Labels,
    title: str,
) -> Figure:
    """Panels over time of each state coordinate, each action, the reward and the return so far.

    The first rollout is emphasised, and the model's prediction from its start is drawn beside it.

    Args:
        rollouts: of the greedy policy.
        predicted: (steps + 1, m, ds) states of m rollouts in the model from the start of the first
            rollout, NaN after their end; None if there are none.
        steps: shown.
        policy: that acted, with its task.
        labels: of the coordinates.
        title: of the figure.
    """
    task = policy.task
    states = 0 if task.image_shape else min(task.observation_size, SHOWN_COORDINATES)
    actions = min(task.action_size, SHOWN_ACTIONS)
    rows = ceil((states + actions + 2) / 2)
    parts = [counted(len(rollouts), "evaluated rollout")]
    if states < task.observation_size and not task.image_shape:
        parts.append(f"{states} of {task.observation_size} coordinates")
    if actions < task.action_size:
        parts.append(f"{actions} of {task.action_size} actions")
    with rc_context(STYLE):
        figure = Figure(figsize=(8.4, 0.9 + 1.6 * rows))
        panels = list(figure.subplots(rows, 2, sharex=True, squeeze=False).flat)
        for i in range(states):
            _draw_state(panels[i], rollouts, predicted, task, i, labels.observations[i])
        commands = _commands(predicted, policy)
        for i in range(actions):
            _draw_action(panels[states + i], rollouts, commands, task, i, labels.actions[i])
        reward, total, *unused = panels[states + actions :]
        _draw_curves(reward, [rollout.rewards for rollout in rollouts], None)
        reward.set_title("reward per step")
        _draw_returns(total, rollouts, steps)
        for axes in (reward, total):  # the lowest ones
            axes.set_xlabel("step")
            axes.xaxis.set_tick_params(labelbottom=True)
        reward.set_xlim(0, steps)
        figure.suptitle(
            f"{title}: greedy policy, {', '.join(parts)}",
            x=0.02,
            ha="left",
            fontsize=10,
            fontweight="bold",
        )
        _draw_legend(figure, panels, unused)
    return figure


def _draw_state(
    axes: Axes,
    rollouts: Rollouts,
    predicted: FloatArray | None,
    task: TaskSpec,
    i: int,
    label: str,
) -> None:
    """State coordinate i; an angle counts whole turns."""
    curves = [rollout.observations[:, i] for rollout in rollouts]
    if i in task.periodic:
        curves = [np.unwrap(curve) for curve in curves]
    _draw_curves(axes, curves, None if predicted is None else predicted[..., i])
    if i in task.periodic:
        angle_ticks(axes.yaxis, 4)
    axes.set_title(label)


def _commands(predicted: FloatArray | None, policy: LearntPolicy) -> FloatArray | None:
    """Greedy actions (k, m, da) in predicted states (k, m, ds); NaN where these are NaN."""
    if predicted is None:
        return None
    commands = np.full((*predicted.shape[:2], policy.task.action_size), np.nan)
    known = np.isfinite(predicted).all(axis=2)
    commands[known] = policy.greedy(predicted[known])
    return commands


def _draw_action(
    axes: Axes,
    rollouts: Rollouts,
    commands: FloatArray | None,
    task: TaskSpec,
    i: int,
    label: str,
) -> None:
    """Action coordinate i as commanded, with its limits."""
    low, high = task.action_low[i], task.action_high[i]
    _draw_curves(
        axes,
        [rollout.actions[:, i] for rollout in rollouts],
        None if commands is None else commands[..., i],
    )
    for limit in (low, high):
        axes.axhline(limit, color=GREY, lw=0.9, ls="--", label="limits of the action")
    bottom, top = axes.get_ylim()
    room = BEYOND * (high - low)  # far beyond a limit the number does not matter
    axes.set_ylim(
        max(min(bottom, low - 0.1 * room), low - room),
        min(max(top, high + 0.1 * room), high + room),
    )
    axes.set_title(f"command: {label}")


def _draw_curves(axes: Axes, curves: Sequence[FloatArray], predicted: FloatArray | None) -> None:
    """Curves of all rollouts, each (T,), and of predictions (k, m) of the first one."""
    for curve in curves[1:]:
        axes.plot(curve, **_style(curve), **OTHERS)
    axes.plot(curves[0], **_style(curves[0]), **FIRST)
    low, high = min(map(np.min, curves)), max(map(np.max, curves))
    if predicted is not None:
        going = np.isfinite(predicted).any(axis=1)
        lower, middle, upper = np.nanquantile(predicted[going], (0.05, 0.5, 0.95), axis=1)
        time = np.flatnonzero(going)
        name = f"90 % of {predicted.shape[1]} predictions"
        axes.fill_between(time, lower, upper, color=ORANGE, alpha=0.2, lw=0, label=name)
        name = "model's prediction of it (median)"
        axes.plot(time, middle, color=ORANGE, lw=1.3, ls="--", label=name, zorder=3)
        room = BEYOND * (high - low)
        low, high = max(min(low, lower.min()), low - room), min(max(high, upper.max()), high + room)
    if high > low:
        axes.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
    axes.yaxis.set_major_locator(MaxNLocator(5))


def _style(curve: FloatArray) -> dict[str, Any]:
    """A single value would be invisible as a line."""
    return {"marker": "o", "ms": 4} if len(curve) == 1 else {}


def _draw_returns(axes: Axes, rollouts: Rollouts, steps: int) -> None:
    """The sum of the rewards so far of each rollout, and their spread."""
    sums = np.empty((len(rollouts), steps + 1))
    for row, rollout in zip(sums, rollouts, strict=True):
        rewards = np.zeros(steps)  # after the end of an episode there are none
        rewards[: len(rollout)] = rollout.rewards[:steps]
        row[0], row[1:] = 0.0, np.cumsum(rewards)
    for row in sums[1:]:
        axes.plot(row, **OTHERS)
    axes.plot(sums[0], **FIRST)
    lower, middle, upper = np.quantile(sums, (0.25, 0.5, 0.75), axis=0)
    time = np.arange(steps + 1)
    axes.fill_between(
        time, lower, upper, color=PURPLE, alpha=0.25, lw=0, label="middle half of the returns"
    )
    axes.plot(middle, color=PURPLE, lw=1.6, label="median return", zorder=3)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    spread = f"{lower[-1]:.4g} to {upper[-1]:.4g}"
    axes.set_title(f"return so far: {middle[-1]:.4g} ({spread})")


def _draw_legend(figure: Figure, panels: Sequence[Axes], unused: Sequence[Axes]) -> None:
    """All names of lines and bands once, in an unused panel or below the panels."""
    named: dict[str, Any] = {}
    for axes in panels:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(name, handle)
    handles, names = list(named.values()), list(named)
    for axes in unused:
        axes.set_axis_off()
        axes.legend(handles, names, loc="center")
    if not unused:
        figure.legend(handles, names, loc="outside lower center", ncols=4)
