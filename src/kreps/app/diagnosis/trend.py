"""The trend of a curve over the last half of its iterations, and the course of the reward.

A trend is a Theil-Sen line: its slope is the median of the slopes between any two iterations, and
its confidence interval lies between two of these slopes.  One bad batch turns neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kreps.app.diagnosis.columns import Row, average_rewards, reward_range
from kreps.app.diagnosis.thresholds import (
    CONFIDENCE,
    MAX_LEVEL_RISE,
    MIN_ITERATIONS,
    MIN_REWARD_RISE,
)
from kreps.kernels.arrays import FloatArray

Course = Literal["unknown", "rises", "hardly rises", "does not rise", "varies", "falls"]
"""What the training reward does.  "varies": its noise would hide a rise that matters."""


@dataclass(frozen=True)
class Trend:
    """A robust line through the last half of a curve.

    Attributes:
        iterations: number of points that it was fitted to.
        rise: from its first to its last iteration.
        low, high: bounds of the rise, each with the one-sided confidence `CONFIDENCE`.
    """

    iterations: int
    rise: float
    low: float
    high: float

    def rises(self, minimum: float = 0.0) -> bool:
        """Whether the rise is significant and larger than a minimum."""
        return self.low > 0.0 and self.rise > minimum

    def falls(self, minimum: float = 0.0) -> bool:
        """Whether the fall is significant and larger than a minimum."""
        return self.high < 0.0 and -self.rise > minimum

    def below(self, maximum: float) -> bool:
        """Whether the rise is at most a maximum, with the confidence of the interval."""
        return self.high <= maximum

    def __str__(self) -> str:
        between = f"{2.0 * CONFIDENCE - 1.0:.0%} interval {self.low:+.2g} to {self.high:+.2g}"
        return f"{self.rise:+.3g} ({between}) over the last {self.iterations} iterations"


def trend(values: FloatArray) -> Trend | None:
    """Trend of the last half of a curve.

    Args:
        values: (m,), one per iteration.

    Returns:
        None for fewer than `MIN_ITERATIONS` values, or if some of the last half are NaN.
    """
    if len(values) < MIN_ITERATIONS:
        return None
    half = values[len(values) // 2 :] - values[-1]
    if not np.isfinite(half).all():
        return None
    from scipy.stats import theilslopes  # slow to import, and only needed here

    found = theilslopes(half, alpha=2.0 * CONFIDENCE - 1.0)
    steps = len(half) - 1
    slopes = (found.slope, found.low_slope, found.high_slope)
    return Trend(len(half), *(steps * float(slope) for slope in slopes))


def reward_trend(rows: Sequence[Row]) -> Trend | None:
    """Trend of the training reward; None where there is none."""
    return trend(average_rewards(rows))


def reward_course(rows: Sequence[Row]) -> Course:
    """What the training reward has done lately, in one word for all findings."""
    found, scale = reward_trend(rows), reward_range(rows)
    if found is None:
        return "unknown"
    if found.rises(MIN_REWARD_RISE * scale):
        return "rises"
    if found.falls(MIN_REWARD_RISE * scale):
        return "falls"
    if not found.below(MAX_LEVEL_RISE * scale):
        return "varies"
    return "hardly rises" if found.rises() else "does not rise"
