"""The learning curve of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from kreps.app.diagnosis.columns import Row, column, effective_share
from kreps.plotting import BLUE, GREY, ORANGE, STYLE, draw_references


def learning_curve(
    rows: Sequence[Row],
    references: Mapping[str, float],
    evaluation: Mapping[str, Any] | None,
    title: str,
) -> Figure:
    """Average reward against environment steps, above KL divergence and effective sample size.

    Args:
        rows: of ``progress.csv``.
        references: reference rewards per step by name, drawn as lines.
        evaluation: of ``evaluation.json``, drawn at the last step.
        title: of the figure.
    """
    steps = column(rows, "steps")
    # a batch was collected by the policy learnt from the steps before it
    steps_before = np.concatenate([[0.0], steps[:-1]])
    with rc_context(STYLE):
        figure = Figure(figsize=(7.0, 6.0))
        top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(4, 1, 1))
        rewards = column(rows, "average_reward")
        top.plot(steps_before, rewards, "o-", color=BLUE, ms=4, label="training rollouts")
        if evaluation:
            for name, marker, size in (("stochastic", "D", 6), ("greedy", "*", 9)):
                mean = evaluation[name]["mean"]
                label = f"{name} policy, evaluated: {mean:.4g}"
                top.plot(steps[-1], mean, marker, color=ORANGE, ms=size, label=label)
        draw_references(top, references)
        top.set_ylabel("average reward per step")
        top.set_title(title)
        top.legend(loc="lower right", bbox_to_anchor=(1.0, 0.12))
        middle.plot(steps, column(rows, "kl"), "o-", color=BLUE, ms=3)
        middle.plot(steps, column(rows, "kl_bound"), color=GREY, lw=0.8, ls="--")
        middle.set_ylabel("KL and bound\n[nats]")
        middle.set_ylim(bottom=0)
        bottom.plot(steps, effective_share(rows), "o-", color=BLUE, ms=3)
        bottom.set_ylabel("effective\nsample share")
        bottom.set_ylim(0, 1)
        bottom.set_xlabel("environment steps")
    return figure
