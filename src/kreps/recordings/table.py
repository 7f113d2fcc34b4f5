"""The content of a recording as named columns with a row per time, whatever its format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray
from kreps.recordings.columns import ELEMENT

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

SHOWN = 3
"""Rows that a message names."""

MAX_NAMED = 20
"""Columns that a message lists."""


@dataclass(frozen=True, eq=False)
class Table:
    """N rows of named columns, in sections that do not continue each other.

    Attributes:
        columns: arrays (N, ...) of numbers, flags, times or text; missing values are NaN, NaT or
            None.
        starts: (S,) first row of each section: of a file, or of an episode that the format keeps
            apart.
        names: (S,) of the sections.
        episodes: whether the sections are all the episodes that there are.
    """

    columns: Mapping[str, NDArray[Any]]
    starts: IntArray
    names: tuple[str, ...]
    episodes: bool = False

    @classmethod
    def from_columns(cls, columns: Mapping[str, NDArray[Any]], name: str) -> Table:
        """The table of one section."""
        return cls(columns, np.zeros(1, np.intp), (name,))

    @classmethod
    def concat(cls, parts: Sequence[Table]) -> Table:
        """The sections of all parts, in order, with the columns that every part has.

        Raises:
            DataError: a column whose shape or type differs from part to part.
        """
        if len(parts) == 1:
            return parts[0]
        lengths = [len(part) for part in parts]
        before = np.cumsum([0, *lengths[:-1]])
        shared = [n for n in parts[0].columns if all(n in part.columns for part in parts)]
        joined = {}
        for name in shared:
            arrays = [part.columns[name] for part in parts]
            try:
                joined[name] = np.concatenate(arrays)
            except (ValueError, TypeError) as error:
                raise DataError(
                    f"column {name} differs between {parts[0].names[0]} and another one: {error}; "
                    "read them apart"
                ) from error
        return cls(
            joined,
            np.concatenate(
                [part.starts + first for part, first in zip(parts, before, strict=True)]
            ),
            tuple(name for part in parts for name in part.names),
            all(part.episodes for part in parts),
        )

    @classmethod
    def of_episodes(cls, parts: Sequence[Table]) -> Table:
        """A table of which each part is a whole episode.

        Raises:
            DataError: there is none, or as `concat`.
        """
        if not parts:
            raise DataError("it has no episode; check that the recording was closed")
        joined = cls.concat(parts)
        return cls(joined.columns, joined.starts, joined.names, episodes=True)

    def __len__(self) -> int:
        """Number of rows N."""
        return len(next(iter(self.columns.values()), ()))

    def place(self, row: int) -> str:
        """A row for messages; with its section where there are several."""
        if len(self.starts) == 1:
            return f"row {row}"
        section = int(np.searchsorted(self.starts, row, side="right")) - 1
        return f"row {row - self.starts[section]} of {self.names[section]}"

    def places(self, rows: IntArray) -> str:
        """The first of some rows for messages, and how many more there are."""
        named = ", ".join(map(self.place, rows[:SHOWN].tolist()))
        return named if len(rows) <= SHOWN else f"{named} and {len(rows) - SHOWN} more"

    @property
    def section(self) -> IntArray:
        """(N,) number of the section of each row."""
        return np.searchsorted(self.starts, np.arange(len(self)), side="right") - 1

    def column(self, name: str) -> NDArray[Any]:
        """A column by its name, or one number of it as (N,) by ``name[index]``.

        Raises:
            ConfigurationError: there is no such column.
        """
        if name in self.columns:
            return self.columns[name]
        element = ELEMENT.fullmatch(name)
        if element and element[1] in self.columns:
            whole = self.columns[element[1]]
            flat = whole.reshape(len(whole), prod(whole.shape[1:]))
            if int(element[2]) < flat.shape[1]:
                return flat[:, int(element[2])]
        names = list(self.columns)
        more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
        raise ConfigurationError(
            f"there is no column {name!r:.80}; there are {', '.join(names[:MAX_NAMED])}{more}"
        )

    def matrix(self, names: Sequence[str]) -> tuple[FloatArray, tuple[str, ...]]:
        """Columns side by side (N, k), and a label for each number of a row.

        Raises:
            ConfigurationError: there is no such column.
            DataError: text in place of a number.
        """
        parts, labels = [], []
        for name in names:
            values = self.numbers(name).reshape(len(self), -1)
            parts.append(values)
            width = values.shape[1]
            labels += [name] if width == 1 else [f"{name}[{i}]" for i in range(width)]
        return np.concatenate(parts, axis=1), tuple(labels)

    def numbers(self, name: str) -> FloatArray:
        """A column as float64 (N, ...); missing values are NaN.

        Raises:
            ConfigurationError: there is no such column.
            DataError: text in place of a number, with its row.
        """
        values = self.column(name)
        if values.dtype.kind in "biuf":
            return values.astype(np.float64)
        if values.dtype.kind not in "OUST":
            raise DataError(f"column {name} has {values.dtype}, but numbers are needed")
        found = np.array([_number(value) for value in values.ravel()], object)
        wrong = np.flatnonzero([value is None for value in found])
        if len(wrong):
            row = int(wrong[0]) // max(values[0].size, 1) if values.ndim > 1 else int(wrong[0])
            raise DataError(
                f"column {name}, {self.place(row)}: {values.ravel()[wrong[0]]!r:.40} is no number; "
                "correct it, or leave it empty where the value is missing"
            )
        return found.astype(np.float64).reshape(values.shape)

    def flags(self, name: str | None) -> BoolArray:
        """A column of flags (N,); missing ones are false, as are those of no column.

        Raises:
            ConfigurationError: there is no such column.
            DataError: something else than 0 and 1, with its row.
        """
        if name is None:
            return np.zeros(len(self), bool)
        values = self.numbers(name).reshape(len(self), -1)
        wrong = ~((values == 0.0) | (values == 1.0) | np.isnan(values))
        if wrong.any() or values.shape[1] != 1:
            row = int(np.argwhere(wrong)[0, 0]) if wrong.any() else 0
            raise DataError(
                f"column {name}, {self.place(row)}: {self.column(name)[row]!s:.40}, but a flag is "
                "needed: true or false, 1 or 0"
            )
        return values[:, 0] == 1.0

    def seconds(self, name: str, unit: str) -> FloatArray:
        """A column of time stamps (N,) in s after the first one; missing ones are NaN."""
        values = self.column(name).reshape(len(self), -1)[:, 0]
        if values.dtype.kind == "M":
            stamps = values.astype("datetime64[ns]")
            known = stamps[~np.isnat(stamps)]
            first = known.min() if len(known) else np.datetime64("NaT")
            return (stamps - first) / np.timedelta64(1, "s")
        if values.dtype.kind in "iu":  # before rounding: nanoseconds since 1970 have 19 digits
            return (values - values.min()).astype(np.float64) * SECONDS[unit]
        numbers = self.numbers(name).reshape(len(self), -1)[:, 0] * SECONDS[unit]
        return numbers - np.nanmin(numbers) if np.isfinite(numbers).any() else numbers


def _number(value: Any) -> float | None:
    """A number, NaN where it is missing, or None where it is something else."""
    if value is None or value == "":
        return float("nan")
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def episode_table(arrays: Mapping[str, NDArray[Any]], name: str) -> Table:
    """The table of an episode, with a missing last row where a column has one row less.

    Observations may have a row more than actions and rewards, for the last observation.

    Raises:
        DataError: columns of other lengths.
    """
    rows = max((len(values) for values in arrays.values()), default=0)
    columns = {}
    for column, values in arrays.items():
        if rows - len(values) not in (0, 1):
            raise DataError(
                f"column {column} of {name} has {len(values)} rows and another one {rows}; of an "
                "episode, observations may have one row more than the others"
            )
        missing: Any = np.nan if values.dtype.kind in "biuf" else None
        last = np.full((rows - len(values), *values.shape[1:]), missing)
        columns[column] = np.concatenate([values, last]) if len(last) else values
    return Table.from_columns(columns, name)
