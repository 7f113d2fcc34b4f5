"""From the table of a recording to rollouts, and what had to be left out of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from kreps.data.rollouts import Rollouts
from kreps.errors import ConfigurationError, DataError
from kreps.intake import is_sane
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray
from kreps.recordings.columns import Columns
from kreps.recordings.ends import Ends
from kreps.recordings.table import Table
from kreps.recordings.values import Clock, Values

SAME = 1e-6
"""Largest difference of a recorded next observation and the next row, relative to their size, at
which the row continues the rollout."""


@dataclass(frozen=True, eq=False)
class Recording:
    """R rollouts of n steps that were cut out of the N rows of a table.

    A rollout ends where an episode does, where rows are missing, where a value is missing, and
    where time does not increase.

    Attributes:
        table: the rows.
        columns: what they were taken for.
        values: the numbers of all rows.
        clock: the time from row to row.
        rollouts: with time stamps, if there are any.
        rows: (n + R,) row of the table that each point of the rollouts was read from.
        missing: rows without a number, by column; a last row of an episode needs an observation
            only.
        incomplete: rows in which the task terminated and whose next observation was not recorded.
    """

    table: Table
    columns: Columns
    values: Values
    clock: Clock
    rollouts: Rollouts
    rows: IntArray
    missing: Mapping[str, IntArray]
    incomplete: IntArray

    @property
    def step_rows(self) -> IntArray:
        """(n,) row of the table that each step was read from."""
        is_last = np.zeros(len(self.rows), bool)
        is_last[self.rollouts.offsets[1:] + np.arange(len(self.rollouts))] = True
        return self.rows[~is_last]

    @property
    def gaps(self) -> IntArray:
        """Rows after which rows are missing, by their time stamps."""
        return np.flatnonzero(self.clock.is_gap)

    @property
    def backwards(self) -> IntArray:
        """Rows after which time does not increase."""
        return np.flatnonzero(self.clock.is_backwards)


def recording_of(table: Table, given: Columns) -> Recording:
    """The rollouts of a table.

    Args:
        table: N rows.
        given: the columns; those that it lacks are completed from common names.

    Raises:
        ConfigurationError: a column is missing, or none is given for observations, actions or
            rewards.
        DataError: text in place of numbers, ends that contradict the episodes, or not one complete
            step.
    """
    columns = given.completed(table.columns)
    _require(columns, table)
    values, ends = Values.from_table(table, columns), Ends.from_table(table, columns)
    clock = Clock.from_times(values.times, ends.same)
    missing = values.missing(columns, ends.last)
    is_step, chained, successors = _steps(values, ends, ends.same & clock.continues)
    if not is_step.any():
        raise DataError(
            f"none of the {len(table)} rows is a complete step, with observation, action, reward "
            f"and next observation; {_reasons(missing)}check the columns"
        )
    steps = np.flatnonzero(is_step)
    first = np.flatnonzero(is_step & ~np.append(False, chained))
    last = np.flatnonzero(is_step & ~np.append(chained, False))
    in_row = values.next_observations is not None
    rows = np.insert(steps, np.searchsorted(steps, last) + 1, last if in_row else last + 1)
    points = values.observations[rows]
    points[np.cumsum(last - first + 2) - 1] = successors[last]
    rollouts = Rollouts.from_arrays(
        points,
        values.actions[steps],
        _rewards(values, columns, steps, successors),
        last - first + 1,
        ends.terminated_after(last, None if in_row else values.is_chosen),
    )
    if values.times is not None and not in_row:
        rollouts = replace(rollouts, times=values.times[rows])
    incomplete = ends.incomplete(values.is_chosen, is_step)
    return Recording(table, columns, values, clock, rollouts, rows, missing, incomplete)


def _steps(
    values: Values, ends: Ends, continues: BoolArray
) -> tuple[BoolArray, BoolArray, FloatArray]:
    """Which rows are steps, and what follows them.

    Args:
        values: of N rows.
        ends: of the episodes.
        continues: (N - 1,) whether the next row is of the same episode and in time.

    Returns:
        (N,) whether the row is a complete step; (N - 1,) whether the next row is one, too, of the
        same rollout; (N, ds) the next observations of the steps.
    """
    going_on = continues & ~ends.done[:-1]
    if values.next_observations is None:
        following = values.is_point[1:] & continues & ends.successor_recorded(values.is_chosen)
        is_step = np.append(values.is_step[:-1] & following, False)
        successors = np.roll(values.observations, -1, axis=0)
    else:
        successors = values.next_observations
        is_step = values.is_step & is_sane(successors).all(axis=1)
        near = np.isclose(successors[:-1], values.observations[1:], rtol=SAME, atol=SAME)
        going_on = going_on & near.all(axis=1)
    return is_step, is_step[:-1] & is_step[1:] & going_on, successors


def _require(columns: Columns, table: Table) -> None:
    """Raise `ConfigurationError` unless observations, actions and rewards are known."""
    for name in ("observations", "actions", "reward"):
        if getattr(columns, name) or (name == "reward" and columns.reward_function):
            continue
        other = " or a reward_function" if name == "reward" else ""
        raise ConfigurationError(
            f"no column is named for {name}{other}; name one of {', '.join(table.columns)!s:.400}"
        )


def _reasons(missing: Mapping[str, IntArray]) -> str:
    """The column with the most missing values, for a message; empty if there is none."""
    if not missing:
        return ""
    name = max(missing, key=lambda each: len(missing[each]))
    return f"{name} has no number in {len(missing[name])} rows; "


def _rewards(
    values: Values, columns: Columns, steps: IntArray, successors: FloatArray
) -> FloatArray:
    """Rewards (n,) of n steps, as recorded or computed."""
    if columns.reward_function is None:
        assert values.rewards is not None
        return values.rewards[steps]
    given = values.observations[steps], values.actions[steps], successors[steps]
    found = np.asarray(columns.reward_function(*given), np.float64)
    if found.shape != (len(steps),) or not is_sane(found).all():
        raise DataError(
            f"the reward_function returned an array of shape {found.shape}, but {len(steps)} "
            "finite numbers are needed, one for each step"
        )
    return found
