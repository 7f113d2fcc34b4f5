"""Findings about the transition model and the basis of the value function."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kreps.app.diagnosis.columns import Row, all_recorded, column, latest, recent
from kreps.app.diagnosis.finding import Finding
from kreps.app.diagnosis.remedies import MORE_DATA
from kreps.app.diagnosis.thresholds import (
    MIN_MODEL_ERROR_FALL,
    MODEL_ERROR_LIMIT,
    MODEL_ERROR_NOTE,
    RESIDUAL_LIMIT,
    RESIDUAL_NOTE,
)
from kreps.app.diagnosis.trend import trend


def transition_model(rows: Sequence[Row]) -> Finding | None:
    """Whether the transition model predicts; None if there is none."""
    name = "transition model"
    error = recent(rows, "model_error")
    if not np.isfinite(error):
        return None
    measured = f"Its relative leave-one-out error is {error:.2f} (1 is no better than no model)"
    if error < MODEL_ERROR_NOTE:
        return Finding(name, "fine", error, MODEL_ERROR_NOTE, f"{measured}.")
    found = trend(column(rows, "model_error"))
    if found is None:
        sentence, more = f"{measured}.", "more iterations or rollouts"
    elif found.falls(MIN_MODEL_ERROR_FALL * error):
        sentence = f"{measured}, and it falls."
        more = "more iterations or rollouts, which reduce it further"
    else:
        falls = "it hardly falls" if found.falls() else "it does not fall"
        sentence, more = f"{measured}, and {falls}.", f"more rollouts ({MORE_DATA})"
    is_limit = error >= MODEL_ERROR_LIMIT
    return Finding(
        name,
        "limit" if is_limit else "note",
        error,
        MODEL_ERROR_LIMIT if is_limit else MODEL_ERROR_NOTE,
        sentence,
        f"{more}; declaring angles (--periodic) or the shape of images (image_shape); removing "
        "uninformative coordinates; a shorter time step. Noise of the task itself remains.",
    )


def basis_of_value(rows: Sequence[Row]) -> Finding | None:
    """Whether the basis of V ended at its largest rank; None if that was not recorded."""
    name = "basis of V"
    if not all_recorded(rows):
        return None
    rank, max_rank = int(rows[-1]["rank"]), latest(rows, "max_rank")
    if not np.isfinite(max_rank):
        return Finding(
            name,
            "note",
            rank,
            max_rank,
            f"V has a fixed number of features, {rank}; the error of this choice is not measured.",
            "a larger grid (value.size), or features of the kernel (--set value=rkhs).",
        )
    residual = latest(rows, "rank_residual")
    if rank < max_rank:
        return Finding(
            name,
            "fine",
            rank,
            max_rank,
            f"The basis is complete with {rank} features; at most {max_rank:.0f} are allowed.",
        )
    full = f"The basis has the largest number of features, {rank}, with a squared residual of"
    if residual < RESIDUAL_NOTE:
        return Finding(name, "fine", residual, RESIDUAL_NOTE, f"{full} only {residual:.1g}.")
    is_limit = residual >= RESIDUAL_LIMIT
    return Finding(
        name,
        "limit" if is_limit else "note",
        residual,
        RESIDUAL_LIMIT if is_limit else RESIDUAL_NOTE,
        f"{full} up to {residual:.2g} (1 is a state that V cannot represent).",
        f"more features (--set value.max_rank={2 * rank}); the time of an update grows with the "
        "square of their number.",
    )
