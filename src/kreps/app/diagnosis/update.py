"""Findings about the policy update: its solver, its step, its weights and its acceptance test."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kreps.algorithms.acceptance import ETA_FLOOR_WITH_ACCEPTANCE_TEST
from kreps.algorithms.dual import Outcome
from kreps.app.diagnosis.columns import (
    Row,
    column,
    effective_share,
    kl_share,
    latest,
    policy_targets,
    recent_share,
)
from kreps.app.diagnosis.finding import Finding, counted
from kreps.app.diagnosis.remedies import MORE_DATA, higher_floor, larger_ridge
from kreps.app.diagnosis.thresholds import (
    HIGH_KL_SHARE,
    JITTER_NOTE,
    LOW_KL_SHARE,
    MIN_EFFECTIVE_SAMPLES,
    MIN_EFFECTIVE_SHARE,
    RECENT,
    REJECTED_NOTE,
)
from kreps.app.diagnosis.trend import reward_course


def dual_solver(rows: Sequence[Row]) -> Finding:
    """Whether all dual problems were solved, with well-conditioned matrices."""
    name = "dual solver"
    failed = [row["iteration"] for row in rows if row["outcome"] == Outcome.NOT_CONVERGED.name]
    jitter = float(column(rows[-RECENT:], "jitter").max())
    if failed:
        is_recent = any(row["iteration"] in failed for row in rows[-RECENT:])
        return Finding(
            name,
            "limit" if is_recent else "note",
            len(failed),
            0.0,
            f"{counted(len(failed), 'update')} of {len(rows)} did not converge, the last one in "
            f"iteration {failed[-1]}. The weights of such an update have no certificate.",
            f"a larger ridge ({larger_ridge(rows)}), or a higher temperature floor "
            f"({higher_floor(rows)}).",
        )
    if jitter > JITTER_NOTE:
        return Finding(
            name,
            "note",
            jitter,
            JITTER_NOTE,
            f"All updates converged, but some matrices were nearly singular: a jitter of "
            f"{jitter:.0e} was added to factorise them.",
            "removing coordinates that are redundant or constant, or ending the basis earlier "
            "(--set value.tolerance=1e-5).",
        )
    gap = float(column(rows, "gap").max())
    return Finding(
        name,
        "fine",
        len(failed),
        0.0,
        "All updates converged and have a certificate; the largest duality gap is "
        f"{max(gap, 0.0):.0e}.",
    )


def kl_bound(rows: Sequence[Row]) -> Finding:
    """Whether the KL bound or the temperature floor limits the step."""
    name = "KL bound"
    late = rows[-RECENT:]
    share = kl_share(rows)
    used = f"The updates use {share:.0%} of the KL bound ({latest(rows, 'kl_bound'):g})"
    if share >= HIGH_KL_SHARE and reward_course(rows) == "rises":
        return Finding(
            name,
            "limit",
            share,
            HIGH_KL_SHARE,
            f"{used}, and the reward still rises: the run ended while it was learning.",
            f"more iterations (kreps resume RUN --iterations {2 * len(rows)}).",
        )
    at_floor = np.mean([row["outcome"] == Outcome.AT_FLOOR.name for row in late]) > 0.5
    if at_floor and share < LOW_KL_SHARE:
        return _at_floor(rows, name, share, used)
    return Finding(name, "fine", share, HIGH_KL_SHARE, f"{used}.")


def _at_floor(rows: Sequence[Row], name: str, share: float, used: str) -> Finding:
    """The finding where the temperature floor limits the step and not the KL bound."""
    floor = latest(rows, "eta_floor")
    shown = f" ({floor:.2g})" if np.isfinite(floor) else ""
    course = reward_course(rows)
    if course not in ("does not rise", "hardly rises"):
        return Finding(
            name,
            "fine",
            share,
            LOW_KL_SHARE,
            f"{used}: eta is at its floor{shown}, which limits the step.",
        )
    lower = "" if floor <= ETA_FLOOR_WITH_ACCEPTANCE_TEST else ", and only then a lower eta_floor"
    return Finding(
        name,
        "note",
        share,
        LOW_KL_SHARE,
        f"{used}, because eta is at its floor{shown}, and the reward {course}: the run has "
        "converged, given its data and its model.",
        f"more data for each update if the reward is too low ({MORE_DATA}){lower}.",
    )


def effective_samples(rows: Sequence[Row]) -> Finding:
    """Whether enough samples have a weight after the update."""
    name = "effective sample size"
    late = rows[-RECENT:]
    count = float(np.median(effective_share(late) * policy_targets(late)))
    share = float(np.median(effective_share(late)))
    remedy = f"smaller steps (--set kl_bound=0.5), or more rollouts ({MORE_DATA})."
    if count < MIN_EFFECTIVE_SAMPLES:
        return Finding(
            name,
            "limit",
            count,
            MIN_EFFECTIVE_SAMPLES,
            f"The effective sample size is {count:.0f}, too small to fit a policy to.",
            remedy,
        )
    if share < MIN_EFFECTIVE_SHARE:
        return Finding(
            name,
            "note",
            share,
            MIN_EFFECTIVE_SHARE,
            f"The effective sample size is {count:.0f}, {share:.1%} of the samples: most samples "
            "have almost no influence.",
            remedy,
        )
    return Finding(
        name,
        "fine",
        count,
        MIN_EFFECTIVE_SAMPLES,
        f"The effective sample size is {count:.0f}, {share:.0%} of the samples.",
    )


def acceptance_test(rows: Sequence[Row]) -> Finding | None:
    """Whether new policies pass the acceptance test; None if no update had one."""
    name = "acceptance test"
    share = recent_share(rows, "rejected")
    if not np.isfinite(share):
        return None
    rejected = f"The acceptance test rejected {share:.0%} of the latest policies"
    if share <= REJECTED_NOTE:
        return Finding(name, "fine", share, REJECTED_NOTE, f"{rejected}.")
    return Finding(
        name,
        "note",
        share,
        REJECTED_NOTE,
        f"{rejected}: model rollouts do not confirm the gains that V predicts, and the previous "
        "policy was kept.",
        "nothing if the reward is good enough, as it is where no episode ends early any more; "
        f"otherwise more data for each update ({MORE_DATA}).",
    )
