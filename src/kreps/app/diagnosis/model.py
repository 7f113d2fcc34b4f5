"""Findings about the transition model and the basis of the value function."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kreps.app.diagnosis.columns import Row, all_recorded, column, latest, recent
from kreps.app.diagnosis.finding import Finding
from kreps.app.diagnosis.remedies import MORE_DATA
from kreps.app.diagnosis.thresholds import (
    DYNAMICS_ERROR_LIMIT,
    DYNAMICS_ERROR_NOTE,
    MIN_MODEL_ERROR_FALL,
    MODEL_ERROR_LIMIT,
    MODEL_ERROR_NOTE,
    RARELY,
    RESIDUAL_LIMIT,
    RESIDUAL_NOTE,
    REWARD_ERROR_LIMIT,
    REWARD_ERROR_NOTE,
    TERMINATION_ERROR_NOTE,
    WORST_COORDINATE_NOTE,
)
from kreps.app.diagnosis.trend import reward_course, trend


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


def dynamics(rows: Sequence[Row]) -> Finding | None:
    """Whether changes of state are predicted; None where no dynamics are learnt."""
    name = "dynamics"
    error, worst = recent(rows, "dynamics_error"), recent(rows, "worst_dynamics_error")
    if not np.isfinite(error):
        return None
    measured = f"Changes of state are predicted with an error of {error:.2f} of their size"
    coordinate = latest(rows, "worst_coordinate")
    if np.isfinite(coordinate):
        measured += f", and {worst:.2f} in the worst column of observations ({coordinate:.0f})"
    is_limit = error >= DYNAMICS_ERROR_LIMIT
    if not is_limit and error < DYNAMICS_ERROR_NOTE and not worst >= WORST_COORDINATE_NOTE:
        return Finding(name, "fine", error, DYNAMICS_ERROR_NOTE, f"{measured}.")
    return Finding(
        name,
        "limit" if is_limit else "note",
        error,
        DYNAMICS_ERROR_LIMIT if is_limit else DYNAMICS_ERROR_NOTE,
        f"{measured}. That nothing changes would have 1, and noise from step to step has 0.71.",
        f"more rollouts ({MORE_DATA}), or an observation from which the next one follows: with "
        "velocities, without columns of noise.",
    )


def terminations(rows: Sequence[Row]) -> Finding | None:
    """Whether terminations are predicted; None where none was observed."""
    name = "terminations"
    error, share = recent(rows, "termination_error"), recent(rows, "terminated")
    if not np.isfinite(error):
        return None
    measured = (
        f"Terminations are predicted with an error of {error:.2f} of their standard deviation"
    )
    if error < TERMINATION_ERROR_NOTE:
        return Finding(name, "fine", error, TERMINATION_ERROR_NOTE, f"{measured}.")
    if share < RARELY:
        measured = f"{measured}; but hardly any rollout terminates now"
        return Finding(name, "fine", error, TERMINATION_ERROR_NOTE, f"{measured}.")
    return Finding(
        name,
        "note",
        error,
        TERMINATION_ERROR_NOTE,
        f"{measured} (1 is no better than their share), and {share:.0%} of the rollouts terminate.",
        f"more rollouts ({MORE_DATA}), or an observation that shows what ends an episode.",
    )


def reward_model(rows: Sequence[Row], at_best: bool) -> Finding | None:
    """Whether the reward is predicted; None where no reward model is learnt.

    Args:
        rows: of ``progress.csv``.
        at_best: whether the reward is near the best reference, where only noise may be left of it.
    """
    name = "reward model"
    error = recent(rows, "reward_error")
    if not np.isfinite(error):
        return None
    explained = max(0.0, 1.0 - error * error) if error < 1.0 else 0.0
    measured = f"The reward model explains {explained:.0%} of the variance of rewards left out"
    if error < REWARD_ERROR_NOTE:
        return Finding(name, "fine", error, REWARD_ERROR_NOTE, f"{measured}.")
    poor = error >= REWARD_ERROR_LIMIT
    is_limit = poor and not at_best and reward_course(rows) != "rises"
    return Finding(
        name,
        "limit" if is_limit else "note",
        error,
        REWARD_ERROR_LIMIT if poor else REWARD_ERROR_NOTE,
        f"{measured}: generated samples and the acceptance test rely on it.",
        f"more rollouts ({MORE_DATA}), or an observation and a reward such that the one determines "
        "the other, without jumps. Noise of the reward itself remains.",
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
    full = f"The basis is at its cap of {rank} features, which costs a squared residual of"
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
