"""Settings that several findings suggest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kreps.algorithms.dual import MIN_ETA
from kreps.app.diagnosis.columns import Row, latest, recent

MORE_DATA = "--set rollouts_per_iteration=20 --set window=60"
"""Twice the default number of rollouts per update, in a window of twice the default length."""


def higher_floor(rows: Sequence[Row]) -> str:
    """Twice the temperature floor; 0.2 where the floor is unknown or only the safeguard."""
    floor = latest(rows, "eta_floor")
    return f"--set eta_floor={2.0 * floor if floor > 2.0 * MIN_ETA else 0.2:.2g}"


def larger_ridge(rows: Sequence[Row]) -> str:
    """Ten times the ridge, and at least 1."""
    ridge = np.fmax(1.0, 10.0 * recent(rows, "ridge"))
    return f"--set ridge={float(f'{ridge:.2g}'):g}"
