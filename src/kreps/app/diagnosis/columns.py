"""Columns of ``progress.csv`` as numbers, and what is computed from several of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kreps.app.diagnosis.thresholds import RECENT
from kreps.data.task import is_period
from kreps.kernels.arrays import FloatArray

Row = Mapping[str, Any]
"""One iteration of ``progress.csv``."""


def column(rows: Sequence[Row], name: str) -> FloatArray:
    """All values of a column: (m,) for m iterations."""
    return np.array([float(row[name]) for row in rows])


def latest(rows: Sequence[Row], name: str) -> float:
    """Value of the last iteration, for settings that may change on the way; NaN if unknown."""
    return float(rows[-1][name])


def recent(rows: Sequence[Row], name: str) -> float:
    """Median over the latest iterations that have a value; NaN if none has."""
    known = _recently_known(rows, name)
    return float(np.median(known)) if len(known) else float("nan")


def recent_share(rows: Sequence[Row], name: str) -> float:
    """Mean of a column of zeros and ones, over the same iterations as `recent`."""
    known = _recently_known(rows, name)
    return float(known.mean()) if len(known) else float("nan")


def _recently_known(rows: Sequence[Row], name: str) -> FloatArray:
    values = column(rows[-RECENT:], name)
    return values[np.isfinite(values)]


def all_recorded(rows: Sequence[Row]) -> bool:
    """Whether the last update was made by a version that records the columns of the diagnosis."""
    return bool(np.isfinite(latest(rows, "clipped")))


def weighted_samples(rows: Sequence[Row]) -> FloatArray:
    """Number of samples with a weight, generated ones included: (m,)."""
    found = column(rows, "weighted")
    return np.where(np.isfinite(found), found, column(rows, "samples"))


def effective_share(rows: Sequence[Row]) -> FloatArray:
    """Effective sample size as a share of the samples with a weight: (m,)."""
    return column(rows, "effective_samples") / weighted_samples(rows)


def policy_targets(rows: Sequence[Row]) -> FloatArray:
    """Number of targets of the policy fit: (m,).  Actions of one state are merged into one."""
    return np.minimum(weighted_samples(rows), column(rows, "samples"))


def kl_share(rows: Sequence[Row]) -> float:
    """Share of the KL bound that the latest updates used: their median."""
    late = rows[-RECENT:]
    return float(np.median(column(late, "kl") / column(late, "kl_bound")))


def rollout_lengths(rows: Sequence[Row]) -> FloatArray:
    """Mean number of steps of the new rollouts of each iteration: (m,)."""
    steps, rollouts = column(rows, "steps"), column(rows, "rollouts")
    return np.diff(steps, prepend=0.0) / np.maximum(np.diff(rollouts, prepend=0.0), 1.0)


def action_repeats(rows: Sequence[Row]) -> FloatArray:
    """Steps for which an action was held, 1 in runs of versions that could not hold it: (m,)."""
    found = column(rows, "action_repeat")
    return np.where(np.isfinite(found), found, 1.0)


def control_period(rows: Sequence[Row]) -> float | None:
    """Seconds of robot time per step of the environment; None if they are not recorded."""
    period = latest(rows, "robot_seconds") / latest(rows, "steps")
    return period if is_period(period) else None


def ends_episodes(rows: Sequence[Row]) -> bool:
    """Whether the task ends episodes: by a time limit, or by terminations that were observed."""
    return bool(np.isfinite(latest(rows, "time_limit")) or (column(rows, "terminated") > 0.0).any())


def recent_length(rows: Sequence[Row]) -> float:
    """Median over the latest iterations of the mean number of steps of a rollout."""
    return float(np.median(rollout_lengths(rows)[-RECENT:]))


def average_rewards(rows: Sequence[Row]) -> FloatArray:
    """Training reward per step of the restarting process: (m,).

    As in an evaluation, the steps from a termination to the restart count with reward zero; without
    terminations it is the column ``average_reward``.
    """
    rewards, ended = column(rows, "average_reward"), column(rows, "terminated")
    probability = column(rows, "restart_probability") / action_repeats(rows)
    steps = rollout_lengths(rows)
    known = (ended > 0.0) & (probability > 0.0) & (steps > 0.0)
    waiting = np.where(known, ended, 0.0) / np.where(known, probability * steps, 1.0)
    return rewards / (1.0 + waiting)


def learnt_rewards(rows: Sequence[Row]) -> FloatArray:
    """Training rewards per step of the batches that learnt policies collected: (k,), k < m.

    The first batch, and those after an update without a state-dependent reward, are of an
    exploration policy, whose reward may be of any size.
    """
    learnt = ~(column(rows[:-1], "exploring") > 0.0)
    return average_rewards(rows)[1:][learnt]


def reward_range(rows: Sequence[Row]) -> float:
    """Range of the training reward that learnt policies have covered, the worst and best left out.

    No single batch can set it.  0 with fewer than four batches.
    """
    rewards = np.sort(learnt_rewards(rows))
    return float(np.ptp(rewards[1:-1])) if len(rewards) >= 4 else 0.0
