"""The learning curve of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from kreps.app.diagnosis.columns import (
    Row,
    column,
    control_period,
    effective_share,
    ends_episodes,
    rollout_lengths,
)
from kreps.plotting import (
    BLUE,
    GREY,
    ORANGE,
    PURPLE,
    SECOND_AXIS_HEIGHT,
    STYLE,
    add_robot_time,
    draw_references,
    limits_of_most,
    mark_beyond,
)

EVALUATED = {"stochastic": ("D", ORANGE, -5.0), "greedy": ("s", PURPLE, 5.0)}
"""Marker, colour and horizontal offset in points of each evaluated policy."""


COMPARABLE_LENGTH = 0.8
"""Mean length of training rollouts, as a share of that of evaluated episodes, from which on returns
are drawn on one axis."""


def learning_curve(
    rows: Sequence[Row],
    references: Mapping[str, float],
    evaluation: Mapping[str, Any] | None,
    title: str,
) -> Figure:
    """Average reward against environment steps, above KL divergence and effective sample size.

    A second axis has the robot time of the steps, where the control period is known.
    Where the task ends episodes, the return is between them.

    Args:
        rows: of ``progress.csv``.
        references: reference rewards per step by name, drawn as lines.
        evaluation: of ``evaluation.json``, drawn at the last step.
        title: of the figure.
    """
    steps, period = column(rows, "steps"), control_period(rows)
    below = 0.0 if period is None else SECOND_AXIS_HEIGHT
    with rc_context(STYLE):
        if ends_episodes(rows):
            figure = Figure(figsize=(7.0, 8.5 + below))
            plots = figure.subplots(4, 1, sharex=True, height_ratios=(4, 2, 1, 1))
            top, returns, middle, bottom = plots
            draw_returns(returns, rows, evaluation)
        else:
            figure = Figure(figsize=(7.0, 6.0 + below))
            top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(4, 1, 1))
        draw_rewards(top, rows, references, evaluation)
        figure.suptitle(title, x=0.02, ha="left", fontsize=10, fontweight="bold")
        middle.plot(steps, column(rows, "kl"), "o-", color=BLUE, ms=3)
        middle.plot(steps, column(rows, "kl_bound"), color=GREY, lw=0.8, ls="--")
        middle.set_ylabel("KL and bound\n[nats]")
        middle.set_ylim(0.0, 1.15 * max(column(rows, name).max() for name in ("kl", "kl_bound")))
        bottom.plot(steps, effective_share(rows), "o-", color=BLUE, ms=3)
        bottom.set_ylabel("effective\nsample share")
        bottom.set_ylim(0.0, 1.05)
        bottom.set_xlabel("environment steps")
        add_robot_time(bottom, period)
    return figure


def draw_rewards(
    axes: Axes,
    rows: Sequence[Row],
    references: Mapping[str, float],
    evaluation: Mapping[str, Any] | None,
) -> None:
    """The training reward with its spread, the evaluated policies and the references.

    A few batches far from the others do not set the axis: arrows with their values show them.
    """
    steps = column(rows, "steps")
    # a batch was collected by the policy learnt from the steps before it
    steps_before = np.concatenate([[0.0], steps[:-1]])
    rewards = column(rows, "average_reward")
    spread = [column(rows, f"reward_{side}_quartile") for side in ("lower", "upper")]
    intervals = {name: _interval(evaluation[name]) for name in EVALUATED} if evaluation else {}
    ends = [(mean - error, mean + error) for mean, error in intervals.values()]
    always = [*references.values(), *np.ravel(ends)]
    droppable = 3 * (1 + len(rows) // 8)  # mean and quartiles of so many batches
    limits = limits_of_most(np.concatenate([rewards, *spread]), droppable, always)
    low, high = limits or (-np.inf, np.inf)
    shown = np.clip(rewards, low, high)
    axes.plot(steps_before, shown, "o-", color=BLUE, ms=4, label="training rollouts")
    if np.isfinite(spread).any():
        label = "middle half of the rollouts"
        lower, upper = np.clip(spread, low, high)
        axes.fill_between(steps_before, lower, upper, color=BLUE, alpha=0.15, lw=0, label=label)
    draw_references(axes, references)
    _draw_evaluation(axes, steps[-1], intervals)
    if intervals:  # beside the last step they are in no data coordinates, so no axis heeds them
        axes.update_datalim([(steps[-1], value) for value in np.ravel(ends)])
    if limits is not None:
        mark_beyond(axes, steps_before, rewards, limits, BLUE)
    axes.set_ylabel("average reward per step")
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=2, columnspacing=1.5)


def draw_returns(axes: Axes, rows: Sequence[Row], evaluation: Mapping[str, Any] | None) -> None:
    """Mean sum of the rewards of the new rollouts, and the return of evaluated episodes.

    Random restarts cut rollouts.  Where they are much shorter than an episode, their returns are
    not comparable, and those of the episodes are given in numbers only.
    """
    steps, length = column(rows, "steps"), rollout_lengths(rows)
    before = np.concatenate([[0.0], steps[:-1]])
    axes.plot(
        before,
        column(rows, "mean_return"),
        "o-",
        color=BLUE,
        ms=4,
        label=f"training rollouts ({length[-1]:.3g} steps)",
    )
    for name, (marker, colour, _) in EVALUATED.items():
        episodic = evaluation[name].get("episodic") if evaluation else None
        if episodic is None:
            continue
        comparable = length[-1] > COMPARABLE_LENGTH * episodic["length"]
        mean, error = _interval(episodic)
        axes.errorbar(
            [steps[-1]],
            [mean if comparable else np.nan],
            [error],
            fmt=marker,
            color=colour,
            ms=5,
            capsize=3,
            label=f"{name}: {mean:.4g} ± {error:.2g} ({episodic['length']:.3g} steps)",
        )
    axes.set_ylabel("return\nper rollout")
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=2, columnspacing=1.5)


def _interval(evaluation: Mapping[str, Any]) -> tuple[float, float]:
    """Mean and two standard errors of an evaluation."""
    mean, error = evaluation["mean"], 2.0 * evaluation.get("standard_error", 0.0)
    return mean, error if error > 1e-12 * abs(mean) else 0.0  # equal rollouts differ by rounding


def _draw_evaluation(axes: Axes, step: float, intervals: Mapping[str, tuple[float, float]]) -> None:
    """The evaluated policies beside each other, so that neither covers the other."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    for name, (mean, error) in intervals.items():
        marker, colour, points = EVALUATED[name]
        beside = ScaledTranslation(points / 72.0, 0.0, figure.dpi_scale_trans)
        axes.errorbar(
            [step],
            [mean],
            [error],
            fmt=marker,
            color=colour,
            ms=5,
            capsize=3,
            label=f"{name} policy: {mean:.4g} ± {error:.2g} (2 s.e.)",
            transform=axes.transData + beside,
        )
