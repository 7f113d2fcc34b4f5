"""The picture of a study: importance of its settings, and the rewards of its trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from kreps.plotting import BLUE, GREY, ORANGE, STYLE


def importance(
    shares: Mapping[str, float], rows: Sequence[Mapping[str, Any]], title: str
) -> Figure:
    """Bars of the shares in the variance of the reward, and the reward of each trial by number.

    Args:
        shares: by setting, the largest first.
        rows: "trial", "state" and "reward" of each finished trial.
        title: of the picture.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(9.0, 1.6 + 0.3 * max(len(shares), 4)))
        bars, trials = figure.subplots(1, 2)
        bars.barh([*shares][::-1], [*shares.values()][::-1], color=BLUE)
        bars.set_xlim(0.0, 1.0)
        bars.set_xlabel("share in the variance of the reward")
        bars.set_title("importance")
        for state, colour, marker in (("complete", BLUE, "o"), ("pruned", GREY, "x")):
            chosen = [row for row in rows if row["state"] == state]
            places = [row["trial"] for row in chosen], [row["reward"] for row in chosen]
            trials.scatter(*places, color=colour, marker=marker, label=state, s=18)
        complete = sorted(
            (row["trial"], row["reward"]) for row in rows if row["state"] == "complete"
        )
        if complete:
            numbers, rewards = zip(*complete, strict=True)
            best = np.maximum.accumulate(rewards)
            trials.step(numbers, best, where="post", color=ORANGE, label="best so far")
        trials.set_xlabel("trial")
        trials.set_ylabel("average reward per step")
        trials.set_title("trials")
        trials.legend()
        figure.suptitle(title)
    return figure
