"""What is known of a vector of actions or observations: its limits, angles and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gymnasium as gym
import numpy as np

from kreps.kernels.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Signal:
    """A vector of d coordinates.

    Attributes:
        low, high: (d,) limits, perhaps infinite.
        angle: (d,) which coordinates are angles in rad.
        labels: d names with units.
    """

    low: FloatArray
    high: FloatArray
    angle: BoolArray
    labels: tuple[str, ...]

    @classmethod
    def from_space(
        cls, space: gym.spaces.Box, angles: Sequence[int], labels: Sequence[str]
    ) -> Signal:
        """The vectors of a space of one axis; labels of another number are replaced by numbers."""
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        numbered = [f"coordinate {i}" for i in range(len(low))]
        names = tuple(labels if len(labels) == len(low) else numbered)
        return cls(low, high, np.isin(np.arange(len(low)), angles), names)

    @classmethod
    def concat(cls, parts: Sequence[Signal]) -> Signal:
        """Signals side by side; none of them is a signal of no coordinate."""
        parts = (NOTHING, *parts)
        return cls(
            np.concatenate([part.low for part in parts]),
            np.concatenate([part.high for part in parts]),
            np.concatenate([part.angle for part in parts]),
            tuple(label for part in parts for label in part.labels),
        )

    def __len__(self) -> int:
        """Number of coordinates d."""
        return len(self.low)

    def select(self, chosen: BoolArray) -> Signal:
        """The coordinates where ``chosen`` (d,) is true."""
        labels = tuple(np.array(self.labels, dtype=object)[chosen])
        return Signal(self.low[chosen], self.high[chosen], self.angle[chosen], labels)

    def renamed(self, pattern: str) -> Signal:
        """The same coordinates, with a pattern such as ``"lagged {}"`` filled with each label."""
        return replace(self, labels=tuple(pattern.format(label) for label in self.labels))

    @property
    def neutral(self) -> FloatArray:
        """(d,) zero, or the nearest value within the limits."""
        return self.clip(np.zeros(len(self)))

    def clip(self, values: FloatArray) -> FloatArray:
        """Values (..., d) clipped to the limits."""
        return np.clip(values, self.low, self.high)

    def difference(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """``a - b`` (m, d); of angles the smaller way round, in [-pi, pi)."""
        gap = a - b
        return np.where(self.angle, (gap + np.pi) % (2.0 * np.pi) - np.pi, gap)

    def wrap(self, values: FloatArray) -> FloatArray:
        """Values (m, d) with bounded angles brought back into the turn that begins at ``low``."""
        low = np.where(self.angle & np.isfinite(self.low), self.low, -np.inf)
        wraps = np.isfinite(low)
        base = np.where(wraps, low, 0.0)
        return np.where(wraps, base + (values - base) % (2.0 * np.pi), values)


NOTHING = Signal(np.empty(0), np.empty(0), np.empty(0, bool), ())
"""The signal of no coordinate."""
