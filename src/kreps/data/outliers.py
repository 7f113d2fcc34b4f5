"""Numbers so far from all others that one of them spoils an update: glitches of a sensor."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kreps.data.rollouts import NO_ROLLOUTS, Rollouts
from kreps.errors import DataWarning
from kreps.kernels.arrays import FloatArray, default_errstate

FAR = 500.0
"""Distance from the median, in units of the 90 % quantile of all distances, from which a number is
an outlier.  On the swing-up one velocity at twice this distance may cost half of the reward."""

FAR_GAIN = 10_000.0
"""The same of a reward above the median, which may be the first that a goal gives: beside action
costs it is hundreds of times as large."""

MIN_DISTANCES = 20
"""Smallest number of values that differ from the median for which this is judged."""

MAX_SHARE = 0.01
"""Largest share of outliers: what is more frequent belongs to the task."""

ROUNDING = 1e-7
"""Distances up to this share of the median are rounding."""

SUSPICIOUS = 10.0
"""Largest distance of a column in units of the mean one, from which its quantile is computed."""

MAX_SHOWN = 3


@dataclass(frozen=True)
class Outlier:
    """One number.

    Attributes:
        rollout: its number among the new ones, or in the data set.
        row: of its observations, or its step.
        name: what the number is.
        value: the number.
        distance: from the median, in units of the 90 % quantile of all distances.
    """

    rollout: int
    row: int
    name: str
    value: float
    distance: float

    def __str__(self) -> str:
        return (
            f"rollout {self.rollout}, row {self.row}: {self.name} is {self.value:.3g}, "
            f"{self.distance:,.0f} times as far from the median as nine in ten others"
        )


@default_errstate()
def find_outliers(new: Rollouts, before: Rollouts = NO_ROLLOUTS) -> list[Outlier]:
    """The outliers of new rollouts among their own numbers and those of rollouts before.

    The reward with which a task terminates is none: it may be rare and large.
    """
    found = []
    points, rewards = new.points, new.rewards[:, None]
    if len(before):
        points = np.concatenate([before.points, points])
        rewards = np.concatenate([before.rewards[:, None], rewards])
    for row, column, distance in _far(points):
        if (own := row - len(before.points)) >= 0:
            rollout, t = new.place(own, of_points=True)
            name = f"observation coordinate {column}"
            found.append(Outlier(rollout, t, name, float(new.points[own, column]), distance))
    for row, _, distance in _far(rewards):
        own = row - len(before.rewards)
        gain = rewards[row, 0] > np.median(rewards)
        if own < 0 or new.transitions.terminated[own] or (gain and distance < FAR_GAIN):
            continue
        rollout, t = new.place(own)
        found.append(Outlier(rollout, t, "the reward", float(new.rewards[own]), distance))
    return found


def _far(values: FloatArray) -> Iterator[tuple[int, int, float]]:
    """Row, column and distance of each outlier among values (n, k)."""
    median = np.median(values, axis=0)
    distances = np.abs(values - median)
    distances[distances <= ROUNDING * np.abs(median)] = 0.0
    count = np.count_nonzero(distances, axis=0)
    largest, total = distances.max(axis=0), distances.sum(axis=0)
    suspicious = (count >= MIN_DISTANCES) & (largest * count > SUSPICIOUS * total)
    for column in np.flatnonzero(suspicious).tolist():
        each = distances[:, column]
        spread = float(np.quantile(each[each > 0.0], 0.9))
        far = np.flatnonzero(each > FAR * spread)
        if len(far) <= max(1.0, MAX_SHARE * len(values)):
            yield from ((row, column, float(each[row]) / spread) for row in far.tolist())


def in_data_set(chunks: Iterable[tuple[int, Sequence[Outlier]]]) -> list[Outlier]:
    """Those of all chunks, of which the number of rollouts and the outliers are given."""
    found, first = [], 0
    for rollouts, outliers in chunks:
        found += [replace(each, rollout=first + each.rollout) for each in outliers]
        first += rollouts
    return found


def warn_of_outliers(found: Sequence[Outlier]) -> None:
    """A `DataWarning` that says where they are and how to leave them out, if there are any."""
    if not found:
        return
    shown = "; ".join(map(str, found[:MAX_SHOWN]))
    more = f"; and {len(found) - MAX_SHOWN} more" if len(found) > MAX_SHOWN else ""
    warnings.warn(
        f"{shown}{more}. Such numbers set the scale by which all are compared, and may spoil what "
        "is learnt. If they are errors of measurement, leave the rollout out of update(), or cut "
        "it before that row; where learn() collects, correct them in the environment "
        "(gymnasium.wrappers.TransformObservation, TransformReward). "
        'warnings.simplefilter("error", kreps.DataWarning) stops before anything is learnt from '
        'them, and "ignore" accepts them',
        DataWarning,
        stacklevel=4,
    )
