"""Findings about the reward: whether it contains a goal, a local optimum, or a trend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kreps.app.diagnosis.columns import Row, average_rewards, column, kl_share
from kreps.app.diagnosis.finding import Finding, Severity, counted
from kreps.app.diagnosis.remedies import MORE_DATA, higher_floor
from kreps.app.diagnosis.thresholds import (
    LOW_KL_SHARE,
    MIN_ITERATIONS,
    MOSTLY,
    RECENT,
    REFERENCE_TOLERANCE,
)
from kreps.app.diagnosis.trend import Course, Trend, reward_course, reward_trend

Evaluation = Mapping[str, Any]
"""Of ``evaluation.json``."""


def goal(rows: Sequence[Row], evaluation: Evaluation | None) -> Finding | None:
    """Whether no reward depends on the state; None if one does, or if that was not recorded.

    Where staying alive is all that is rewarded, none does once no rollout terminates.
    """
    exploring = column(rows, "exploring")
    if not exploring[-1] > 0.0:
        return None
    episodic = evaluation["greedy"].get("episodic") if evaluation else None
    if (column(rows, "terminated") > 0.0).any():
        lasts = "" if episodic is None else f"; greedy episodes last {episodic['length']:.4g} steps"
        falls = episodic is not None and episodic["terminated"] >= MOSTLY
        return Finding(
            "goal",
            "note",
            float(np.sum(exploring > 0.0)),
            0.0,
            f"Earlier rollouts terminated and none of the newest does{lasts}. What is left of the "
            "reward is at most a cost of actions, so the next rollouts explore.",
            "longer rollouts, which end as evaluated episodes do (--set restart_probability=0.01)."
            if falls
            else "the policy as it is: it avoids terminations, and nothing else is rewarded.",
        )
    return Finding(
        "goal",
        "limit",
        float(np.sum(exploring > 0.0)),
        0.0,
        "No rollout in the window has a state-dependent reward, so the goal was not reached; "
        "exploring until one does.",
        f"more rollouts (kreps resume RUN --iterations {2 * len(rows)}), or a new run with longer "
        "ones (--set restart_probability=0.01); in Python, update(rollouts) with rollouts that "
        "reach the goal.",
    )


def best_estimate(rows: Sequence[Row], evaluation: Evaluation | None) -> float:
    """Reward per step of the greedy policy if evaluated, else of the latest training rollouts."""
    if evaluation:
        return evaluation["greedy"]["mean"]
    return float(np.median(average_rewards(rows)[-RECENT:]))


def near_best(
    rows: Sequence[Row], evaluation: Evaluation | None, references: Mapping[str, float]
) -> bool:
    """Whether the reward is near the best reference."""
    values = list(references.values())
    if not values:
        return False
    missing = values[0] - best_estimate(rows, evaluation)
    return missing < REFERENCE_TOLERANCE * (values[0] - values[-1])


def nearest_reference(references: Mapping[str, float], reward: float) -> tuple[str, float] | None:
    """The reference near a reward, best and worst excepted: a known local optimum."""
    values = list(references.values())
    for name, value in list(references.items())[1:-1]:
        if abs(reward - value) < REFERENCE_TOLERANCE * abs(values[0] - values[-1]):
            return name, value
    return None


def local_optimum(
    rows: Sequence[Row], evaluation: Evaluation | None, references: Mapping[str, float]
) -> Finding | None:
    """Whether the reward stays near a known local optimum; None if not, or if that is unknown."""
    reward, course = best_estimate(rows, evaluation), reward_course(rows)
    near = nearest_reference(references, reward)
    if near is None or course in ("unknown", "rises", "falls"):
        return None
    name, value = near
    doing = "varies without a clear rise" if course == "varies" else course
    return Finding(
        "local optimum",
        "limit",
        reward,
        value,
        f"The reward, {reward:.4g}, {doing} and is near a reference below "
        f"the best one: {name} ({value:g}).",
        "a new run with another --seed, more initial rollouts (--set initial_rollouts=60) or "
        "smaller steps (--set kl_bound=0.5). More iterations seldom help.",
    )


def progress(
    rows: Sequence[Row], evaluation: Evaluation | None, references: Mapping[str, float]
) -> Finding:
    """Whether the training reward rises, falls or is level."""
    found, course = reward_trend(rows), reward_course(rows)
    if found is None:
        return Finding(
            "progress",
            "note",
            len(rows),
            MIN_ITERATIONS,
            f"The trend of the reward is unknown after {counted(len(rows), 'iteration')}; "
            f"{MIN_ITERATIONS} are needed.",
            "more iterations (kreps resume RUN --iterations 20).",
        )
    if course == "falls":
        return _progress(
            "limit",
            found,
            f"The reward falls: {found}.",
            "smaller steps (--set kl_bound=0.3) with more rollouts for each (--set "
            "rollouts_per_iteration=20). Only the latest policy is stored; the same run with "
            "fewer iterations reproduces an earlier one.",
        )
    if course == "rises":
        return _progress("fine", found, f"The reward rises: {found}.")
    if near_best(rows, evaluation, references):
        best = next(iter(references.values()))
        return _progress(
            "fine",
            found,
            f"The reward {course}, {found}, and is near the best reference value ({best:g}).",
        )
    return _level(rows, found, course)


def _level(rows: Sequence[Row], found: Trend, course: Course) -> Finding:
    """The finding where the reward neither rises nor falls and is not near the best reference."""
    if course == "varies":
        return _progress(
            "note",
            found,
            f"The reward varies too much for a trend: {found}.",
            f"more iterations (kreps resume RUN --iterations {2 * len(rows)}), or more rollouts "
            "for each (--set rollouts_per_iteration=20).",
        )
    share = kl_share(rows)
    if share > LOW_KL_SHARE:
        return _progress(
            "limit",
            found,
            f"The reward {course}, {found}, although the updates use {share:.0%} of the "
            "KL bound: the gains that they predict are errors of the model, or noise.",
            f"more data ({MORE_DATA}), or smaller steps (--set kl_bound=0.5 {higher_floor(rows)}).",
        )
    return _progress(
        "fine",
        found,
        f"The reward {course}, {found}, and the updates use {share:.0%} of the KL bound: "
        "the run has converged.",
    )


def _progress(severity: Severity, found: Trend, sentence: str, remedy: str = "") -> Finding:
    return Finding("progress", severity, found.rise, float("nan"), sentence, remedy)
