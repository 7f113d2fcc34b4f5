"""Parquet, by pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from kreps.errors import DataError
from kreps.recordings.columns import Columns
from kreps.recordings.table import Table


def read(path: Path, columns: Columns) -> Table:
    """A file whose columns are numbers, times, text, or lists of as many numbers in each row."""
    return Table.from_columns(read_arrays(path, columns), path.name)


def read_arrays(path: Path, columns: Columns) -> dict[str, NDArray[Any]]:
    """The columns that are needed, and those of common names; all if none are named."""
    schema = pq.read_schema(path)
    present = [name for name, kind in zip(schema.names, schema.types, strict=True) if _held(kind)]
    table = pq.read_table(path, columns=[n for n in present if columns.needs(n)])
    return {name: _array(name, table[name]) for name in table.column_names}


def _held(kind: pa.DataType) -> bool:
    """Whether a type is a number, a time, text or a list of numbers: not a picture, for example."""
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        return bool(_held(kind.value_type))
    return not (pa.types.is_nested(kind) or pa.types.is_binary(kind))


def _array(name: str, column: pa.ChunkedArray) -> NDArray[Any]:
    """A column as an array (N,), or (N, k) of lists of k."""
    kind = column.type
    if not pa.types.is_nested(kind):
        values: NDArray[Any] = column.to_numpy()
        return values if values.dtype.kind in "biufM" else values.astype(object)
    lengths = pc.list_value_length(column)
    sizes = set(lengths.unique().to_pylist())
    if len(sizes) > 1 or None in sizes:
        each = lengths.to_pylist()
        row = next(i for i, size in enumerate(each) if size is None or size != each[0])
        raise DataError(
            f"column {name}, row {row}: a list of another length than in the first row; a column "
            "needs as many numbers in each row"
        )
    flat = pa.chunked_array([chunk.flatten() for chunk in column.chunks], kind.value_type)
    return _array(name, flat).reshape(len(column), -1)
