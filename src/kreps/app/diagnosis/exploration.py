"""Findings about exploration: the policy's noise, and the actions beyond the limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kreps.app.diagnosis.columns import Row, recent, reward_range
from kreps.app.diagnosis.finding import Finding
from kreps.app.diagnosis.remedies import higher_floor
from kreps.app.diagnosis.thresholds import (
    CLIPPED_NOTE,
    MAX_POLICY_STD,
    MIN_POLICY_STD,
    NOISE_COST_NOTE,
)
from kreps.app.diagnosis.trend import reward_course


def exploration_noise(rows: Sequence[Row], evaluation: Mapping[str, Any] | None) -> Finding | None:
    """Whether the policy explores, and what that costs; None if its noise was not recorded."""
    name = "exploration noise"
    std = recent(rows, "policy_noise")
    if not np.isfinite(std):
        return None
    measured = (
        f"The policy's standard deviation near its data is {std:.2g} of half the action range"
    )
    if std < MIN_POLICY_STD:
        return Finding(
            name,
            "note" if reward_course(rows) == "rises" else "limit",
            std,
            MIN_POLICY_STD,
            f"{measured}, too small to try other actions.",
            "a new run with smaller steps (--set kl_bound=0.5) or a higher temperature floor "
            f"({higher_floor(rows)}), so that it decreases more slowly.",
        )
    if std > MAX_POLICY_STD:
        return Finding(
            name,
            "note",
            std,
            MAX_POLICY_STD,
            f"{measured}, beyond the action limits: the samples do not agree on an action.",
            "more iterations or rollouts; the finding about the transition model may have the "
            "cause.",
        )
    if evaluation is None:
        return Finding(name, "fine", std, MAX_POLICY_STD, f"{measured}.")
    cost = evaluation["greedy"]["mean"] - evaluation["stochastic"]["mean"]
    limit = NOISE_COST_NOTE * reward_range(rows)
    measured = f"{measured}; this noise costs {max(cost, 0.0):.3g} of reward per step"
    if cost > limit > 0.0:
        return Finding(
            name,
            "note",
            cost,
            limit,
            f"{measured}.",
            "the greedy policy, predict(observation, deterministic=True); or more iterations, "
            "which reduce the noise.",
        )
    return Finding(name, "fine", std, MAX_POLICY_STD, f"{measured}.")


def clipped_actions(rows: Sequence[Row]) -> Finding | None:
    """Whether most actions are clipped at the limits; None if that was not recorded."""
    name = "clipped actions"
    share = recent(rows, "clipped")
    if not np.isfinite(share):
        return None
    measured = f"{share:.0%} of the commanded actions lie beyond the limits"
    if share >= CLIPPED_NOTE:
        return Finding(
            name,
            "note",
            share,
            CLIPPED_NOTE,
            f"{measured}, where exploration noise has no effect.",
            "nothing if the task needs full force at all times; otherwise a new run with another "
            "--seed or smaller steps (--set kl_bound=0.5), or larger action limits.",
        )
    return Finding(name, "fine", share, CLIPPED_NOTE, f"{measured}.")
