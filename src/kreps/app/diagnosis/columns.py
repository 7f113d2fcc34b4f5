"""Columns of ``progress.csv`` as numbers, and what is computed from several of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kreps.app.diagnosis.thresholds import RECENT
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
    """Mean over the latest iterations that have a value; NaN if none has."""
    values = column(rows[-RECENT:], name)
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


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
    """Mean share of the KL bound that the updates used."""
    return float(np.mean(column(rows, "kl") / column(rows, "kl_bound")))


def reward_range(rows: Sequence[Row]) -> float:
    """Largest less smallest training reward per step so far."""
    return float(np.ptp(column(rows, "average_reward")))
