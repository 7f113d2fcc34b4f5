"""Findings about episodes: their returns against the average reward, and the rollouts' lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kreps.app.diagnosis.columns import (
    Row,
    action_repeats,
    latest,
    recent,
    recent_length,
    reward_range,
)
from kreps.app.diagnosis.finding import Finding
from kreps.app.diagnosis.thresholds import (
    EARLY_END,
    LATE_RISE_NOTE,
    MOSTLY,
    RETURN_GAP_NOTE,
    SHORT_ROLLOUTS,
)
from kreps.app.diagnosis.trend import reward_course
from kreps.data.rollouts import Rollouts


def episodes(rows: Sequence[Row], evaluation: Mapping[str, Any] | None) -> Finding | None:
    """Episodic return against average reward; None where no episode was evaluated."""
    name = "episodes"
    found = evaluation["greedy"].get("episodic") if evaluation else None
    if evaluation is None or found is None:
        return None
    average, length, limit = (
        evaluation["greedy"]["mean"],
        found["length"],
        latest(rows, "time_limit"),
    )
    per_step = found["mean"] / max(length, 1.0)
    within = f" of at most {limit:.0f}" if np.isfinite(limit) else ""
    measured = (
        f"A greedy episode returns {found['mean']:.4g} in {length:.4g} steps{within}, "
        f"{per_step:.3g} per step; the average reward, which is optimised, is {average:.3g}"
    )
    if found["terminated"] >= MOSTLY and length < EARLY_END * limit and per_step > 0.0:
        return Finding(
            name,
            "note" if reward_course(rows) == "rises" else "limit",
            length,
            EARLY_END * limit,
            f"{measured}. Most episodes end by a termination, although a step earns reward: the "
            "task is not solved.",
            "more data: more iterations (kreps resume RUN "
            f"--iterations {2 * len(rows)}), or more rollouts for each (--set "
            "rollouts_per_iteration=20).",
        )
    gap, allowed = average - per_step, RETURN_GAP_NOTE * reward_range(rows)
    if found["terminated"] < MOSTLY and gap > allowed > 0.0:
        return Finding(
            name,
            "note",
            gap,
            allowed,
            f"{measured}. It counts the first steps of an episode most, and the later ones earn "
            "less.",
            longer_rollouts(rows),
        )
    return Finding(name, "fine", gap, allowed, f"{measured}.")


def rollout_length(rows: Sequence[Row], greedy: Rollouts | None) -> Finding | None:
    """Whether rollouts are too short for the task; None if there is nothing to compare them with.

    Args:
        rows: of ``progress.csv``.
        greedy: evaluated rollouts of the greedy policy, without restarts.
    """
    name = "rollout length"
    length, limit = recent_length(rows), latest(rows, "time_limit")
    repeat = action_repeats(rows)[-1]
    rise = late_rise(greedy, int(length / repeat)) / repeat
    allowed = LATE_RISE_NOTE * reward_range(rows)
    measured = f"Rollouts have {length:.4g} steps on average"
    if rise > allowed > 0.0:
        return Finding(
            name,
            "limit",
            rise,
            allowed,
            f"{measured}, but the greedy policy's reward still rises there: in as many steps "
            f"more it is higher by {rise:.3g} per step than before.",
            longer_rollouts(rows),
        )
    if not np.isfinite(limit):
        if np.isnan(rise):
            return None
        after = "after them the reward of the greedy policy does not rise"
        return Finding(name, "fine", rise, allowed, f"{measured}; {after}.")
    measured = f"{measured}, and an episode up to {limit:.0f}"
    if length < SHORT_ROLLOUTS * limit and not recent(rows, "terminated") >= MOSTLY:
        return Finding(
            name,
            "note",
            length,
            SHORT_ROLLOUTS * limit,
            f"{measured}: what happens later in an episode is hardly seen.",
            longer_rollouts(rows),
        )
    return Finding(name, "fine", length, SHORT_ROLLOUTS * limit, f"{measured}.")


def late_rise(greedy: Rollouts | None, length: int) -> float:
    """Mean reward of as many steps after a rollout's mean length, less that of its second half.

    NaN where fewer than two rollouts are that long; 0 where it is within two standard errors.

    Args:
        greedy: rollouts without restarts.
        length: mean number of steps of a training rollout.
    """
    long = [r.rewards for r in greedy or () if len(r) >= 2 * length]
    if len(long) < 2 or length < 2:
        return float("nan")
    rises = np.array([r[length : 2 * length].mean() - r[length // 2 : length].mean() for r in long])
    error = float(rises.std(ddof=1)) / np.sqrt(len(rises))
    rise = float(rises.mean())
    return rise if abs(rise) > 2.0 * error else 0.0


def longer_rollouts(rows: Sequence[Row]) -> str:
    """Rollouts of half the time limit, or twice as long as they are."""
    longer = np.fmax(0.5 * latest(rows, "time_limit"), 2.0 * recent_length(rows))
    decisions = longer / action_repeats(rows)[-1]
    probability = float(f"{1.0 / max(decisions, 2.0):.2g}")
    return f"a new run with longer rollouts (--set restart_probability={probability:g})."
