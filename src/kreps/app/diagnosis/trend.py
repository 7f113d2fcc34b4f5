"""The trend of a curve over the last half of its iterations, with a confidence interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from kreps.app.diagnosis.columns import Row, column, reward_range
from kreps.app.diagnosis.thresholds import CONFIDENCE, MIN_ITERATIONS, MIN_REWARD_RISE
from kreps.kernels.arrays import FloatArray


@dataclass(frozen=True)
class Trend:
    """A least-squares line through the last half of a curve.

    Attributes:
        iterations: number of points that it was fitted to.
        rise: from its first to its last iteration.
        error: quantile of its estimation error at the one-sided level `CONFIDENCE`.
    """

    iterations: int
    rise: float
    error: float

    def rises(self, minimum: float = 0.0) -> bool:
        """Whether the rise is significant and larger than a minimum."""
        return self.rise > max(self.error, minimum)

    def falls(self, minimum: float = 0.0) -> bool:
        """Whether the fall is significant and larger than a minimum."""
        return -self.rise > max(self.error, minimum)

    def below(self, maximum: float) -> bool:
        """Whether the rise is at most a maximum, with the confidence of the interval."""
        return self.rise + self.error <= maximum


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
    m = len(half)
    time = np.arange(m) - 0.5 * (m - 1)
    slope = float(time @ half / (time @ time))
    residuals = half - half.mean() - slope * time
    slope_error = float(np.sqrt(residuals @ residuals / (m - 2) / (time @ time)))
    return Trend(m, slope * (m - 1), float(stdtrit(m - 2, CONFIDENCE)) * slope_error * (m - 1))


def reward_trend(rows: Sequence[Row]) -> Trend | None:
    """Trend of the training reward; None where there is none."""
    return trend(column(rows, "average_reward"))


def reward_rises(rows: Sequence[Row]) -> bool:
    """Whether the training reward still rises."""
    found = reward_trend(rows)
    return found is not None and found.rises(MIN_REWARD_RISE * reward_range(rows))
