"""Comma-separated values, by pandas."""

from __future__ import annotations

import csv
import gzip
import warnings
from pathlib import Path
from typing import Any

import pandas as pd
from numpy.typing import NDArray

from kreps.recordings.columns import Columns
from kreps.recordings.table import Table

DELIMITERS = ",;\t|"


def read(path: Path, columns: Columns) -> Table:
    """A file with the names of its columns in the first line.

    A row with too few values has missing ones at its end; one with too many is an error.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)  # of values without a column
        frame = pd.read_csv(
            path,
            sep=_delimiter(path),
            index_col=False,
            skipinitialspace=True,
        )
    frame.columns = [str(name).strip() for name in frame.columns]
    time = columns.completed(frame.columns).time
    if time in frame and not pd.api.types.is_numeric_dtype(frame[time]):
        dates = pd.to_datetime(frame[time], format="ISO8601", utc=True)
        frame[time] = dates.dt.tz_localize(None)
    return Table.from_columns({name: _array(frame[name]) for name in frame.columns}, path.name)


def _array(series: pd.Series) -> NDArray[Any]:
    """The values of a column; text has None where it is missing."""
    if series.dtype.kind in "biufM":
        return series.to_numpy()
    return series.astype(object).where(series.notna(), None).to_numpy()


def _delimiter(path: Path) -> str:
    """The delimiter of the first line."""
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", encoding="utf-8-sig") as file:
        line = file.readline()
    try:
        return csv.Sniffer().sniff(line, DELIMITERS).delimiter
    except csv.Error:  # a single column
        return ","
