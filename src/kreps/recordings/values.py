"""The numbers of a recording by what they are, and which of them are there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kreps.errors import ConfigurationError
from kreps.intake import is_sane
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray
from kreps.recordings.columns import Columns
from kreps.recordings.table import Table

GAP = 1.5
"""Time between rows, in median control periods, from which on rows are missing between them."""


@dataclass(frozen=True, eq=False)
class Values:
    """Numbers of N rows; missing ones are NaN.

    Attributes:
        observations: (N, ds).
        actions: (N, da).
        next_observations: (N, ds); None if they are in the next row.
        rewards: (N,); None if they are computed.
        times: (N,) in s; None without time stamps.
        labels: (ds,) names of the observation coordinates.
        action_labels: (da,) of the action coordinates.
    """

    observations: FloatArray
    actions: FloatArray
    next_observations: FloatArray | None
    rewards: FloatArray | None
    times: FloatArray | None
    labels: tuple[str, ...]
    action_labels: tuple[str, ...]

    @classmethod
    def from_table(cls, table: Table, columns: Columns) -> Values:
        """The values of a table.

        Raises:
            ConfigurationError: a column is missing, or observations and next ones differ in width.
            DataError: text in place of numbers.
        """
        observations, labels = table.matrix(columns.observations)
        actions, action_labels = table.matrix(columns.actions)
        following = None
        if columns.next_observations:
            following, _ = table.matrix(columns.next_observations)
            if following.shape != observations.shape:
                raise ConfigurationError(
                    f"next_observations have {following.shape[1]} numbers and observations "
                    f"{observations.shape[1]}; name the same columns of both"
                )
        rewards = None
        if columns.reward is not None:
            column, _ = table.matrix([columns.reward])
            rewards = column[:, 0]
        times = None if columns.time is None else table.seconds(columns.time, columns.time_unit)
        return cls(observations, actions, following, rewards, times, labels, action_labels)

    @property
    def is_point(self) -> BoolArray:
        """(N,) whether observation and time stamp are there."""
        found: BoolArray = np.asarray(is_sane(self.observations).all(axis=1))
        return found if self.times is None else found & is_sane(self.times)

    @property
    def is_chosen(self) -> BoolArray:
        """(N,) whether the action is there."""
        found: BoolArray = np.asarray(is_sane(self.actions).all(axis=1))
        return found

    @property
    def is_step(self) -> BoolArray:
        """(N,) whether all of a step is there but its next observation."""
        found = self.is_point & self.is_chosen
        return found if self.rewards is None else found & is_sane(self.rewards)

    def missing(self, columns: Columns, last: BoolArray) -> Mapping[str, IntArray]:
        """The rows without a number, by column; last rows need no action and no reward.

        Args:
            columns: for names.
            last: (N,) whether the row is the last one of its episode.
        """
        found = dict(zip(self.labels, ~is_sane(self.observations).T, strict=True))
        if self.times is not None:
            found[str(columns.time)] = ~is_sane(self.times)
        for name, action in zip(self.action_labels, self.actions.T, strict=True):
            found[name] = ~is_sane(action) & ~last
        if self.rewards is not None:
            found[str(columns.reward)] = ~is_sane(self.rewards) & ~last
        return {name: np.flatnonzero(rows) for name, rows in found.items() if rows.any()}


@dataclass(frozen=True, eq=False)
class Clock:
    """The time from row to row.

    Attributes:
        intervals: (N - 1,) in s; NaN between episodes, or where a time stamp is missing.
        period: median of the positive ones, NaN if there is none.
    """

    intervals: FloatArray
    period: float

    @classmethod
    def from_times(cls, times: FloatArray | None, same: BoolArray) -> Clock:
        """The clock of time stamps (N,), given whether the next row is of the same episode."""
        if times is None:
            return cls(np.full(len(same), np.nan), float("nan"))
        intervals = np.where(same, np.diff(times), np.nan)
        positive = intervals[intervals > 0.0]
        return cls(intervals, float(np.median(positive)) if len(positive) else float("nan"))

    @property
    def is_gap(self) -> BoolArray:
        """(N - 1,) whether rows are missing between this one and the next."""
        return self.intervals > GAP * self.period

    @property
    def is_backwards(self) -> BoolArray:
        """(N - 1,) whether time does not increase."""
        return self.intervals <= 0.0

    @property
    def continues(self) -> BoolArray:
        """(N - 1,) whether the next row may follow this one in time."""
        return ~self.is_gap & ~self.is_backwards
