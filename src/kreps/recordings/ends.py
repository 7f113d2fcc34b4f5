"""Where the episodes of a recording end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.errors import DataError
from kreps.kernels.arrays import BoolArray, IntArray
from kreps.recordings.columns import Columns
from kreps.recordings.table import Table


@dataclass(frozen=True, eq=False)
class Ends:
    """Where episodes end, of N rows.

    Attributes:
        terminated, done: (N,) whether the task terminated, or the episode ended, with the step.
        same: (N - 1,) whether the next row is of the same episode, as far as sections and episode
            numbers tell.
        numbered: whether they tell where all episodes end.
    """

    terminated: BoolArray
    done: BoolArray
    same: BoolArray
    numbered: bool

    @classmethod
    def from_table(cls, table: Table, columns: Columns) -> Ends:
        """The ends of a table.

        Raises:
            ConfigurationError: there is no such column.
            DataError: flags that are none, or that contradict the numbers of the episodes.
        """
        terminated = table.flags(columns.terminated)
        done = terminated | table.flags(columns.truncated)
        same = np.diff(table.section) == 0
        if columns.episode is not None:
            episode = table.column(columns.episode)
            same = same & (episode[1:] == episode[:-1])
        ends = cls(terminated, done, same, columns.episode is not None or table.episodes)
        inside = done[:-1] & same & ~ends.last[1:]
        if ends.numbered and inside.any():
            row = int(np.flatnonzero(inside)[0])
            flags = " or ".join(each for each in (columns.terminated, columns.truncated) if each)
            raise DataError(
                f"{table.place(row)}: the episode ends by {flags}, but goes on for more than one "
                "row; correct the flags, or the numbers of the episodes"
            )
        return ends

    @property
    def last(self) -> BoolArray:
        """(N,) whether the row is the last one of its episode."""
        return np.append(~self.same, True)

    def successor_recorded(self, chosen: BoolArray) -> BoolArray:
        """(N - 1,) whether the next row is the next observation, also where the episode ends.

        After the last step of an episode it is if it has no action, or if the episode's number says
        so.  Otherwise it is the start of the next episode.

        Args:
            chosen: (N,) whether the row has an action.
        """
        belongs = ~chosen[1:] | (self.last[1:] if self.numbered else np.zeros(1, bool))
        found: BoolArray = ~self.done[:-1] | belongs
        return found

    def terminated_after(self, steps: IntArray, chosen: BoolArray | None) -> BoolArray:
        """Whether the task terminated with each of these steps, or in the row after it.

        The row after it counts if it has no action: it is the one of the terminal observation.

        Args:
            steps: their rows.
            chosen: (N,) whether the row has an action; None if the next observation is in the row
                of the step.
        """
        if chosen is None:
            return self.terminated[steps]
        found: BoolArray = self.terminated[steps] | (
            self.terminated[steps + 1] & ~chosen[steps + 1]
        )
        return found

    def incomplete(self, chosen: BoolArray, is_step: BoolArray) -> IntArray:
        """Rows in which the task terminated, but that are no step as the rest was not recorded."""
        repeated = np.append(False, self.done[:-1] & self.same)
        return np.flatnonzero(self.terminated & chosen & ~is_step & ~repeated)
