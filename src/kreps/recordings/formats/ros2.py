"""ROS 2 bags, MCAP or sqlite3, by rosbags: no ROS is needed.

A column is ``/topic.field``, and ``/topic.field.part`` of nested messages.  The messages of one
topic begin the steps, usually those of the actions.  Of the other topics a row has the last message
before, as a controller does; of reward and flags of the end, the last one before the next step.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from kreps.errors import ConfigurationError, DataError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.recordings.columns import Columns
from kreps.recordings.table import Table

HELD_PERIODS = 3.0
"""Age of the last message of a topic, in median periods of the topic, from which on its value is
missing."""


@dataclass
class _Topic:
    """The messages of a topic: times in ns, and the numbers of each by name of the column."""

    times: list[int] = field(default_factory=list)
    messages: list[Mapping[str, Any]] = field(default_factory=list)


def read(path: Path, columns: Columns) -> Table:
    """A bag: its folder, or its .mcap or .db3 file.

    Raises:
        ConfigurationError: a topic that is named is not there.
        DataError: an array of a message changes its length.
    """
    store = get_typestore(Stores.LATEST)  # of messages whose definition the bag lacks
    topics: dict[str, _Topic] = {}
    with AnyReader([path], default_typestore=store) as reader:
        present = ", ".join(sorted({c.topic for c in reader.connections}))
        chosen = [c for c in reader.connections if _is_wanted(c.topic, columns)]
        if not chosen:  # all would be read
            raise ConfigurationError(f"none of its topics is named; they are {present}")
        for connection, time, raw in reader.messages(connections=chosen):
            topic = topics.setdefault(connection.topic, _Topic())
            message = reader.deserialize(raw, connection.msgtype)
            numbers = dict(_numbers(connection.topic, message))
            topic.times.append(time)
            topic.messages.append(
                {n: v for n, v in numbers.items() if columns.needs(n, np.size(v))}
            )
    if not topics:
        raise StorageError("its topics have no message; check that the recording was closed")
    clock = columns.clock or _clock(columns, topics)
    if clock not in topics:
        raise ConfigurationError(f"clock = {clock!r:.80} has no message; choose one of {present}")
    times = np.array(topics[clock].times)
    arrays: dict[str, NDArray[Any]] = {"time": (times - times[0]) / 1e9}
    for topic in topics.values():
        arrays |= _held(topic, times)
    for name in (columns.reward, columns.terminated, columns.truncated):
        if name in arrays:
            arrays[name] = np.concatenate(
                [arrays[name][1:], np.full_like(arrays[name][:1], np.nan)]
            )
    return Table.from_columns(arrays, path.name)


def _is_wanted(topic: str, columns: Columns) -> bool:
    named = any(name.startswith(f"{topic}.") for name in columns.names)
    return named or topic == columns.clock or not columns.names


def _clock(columns: Columns, topics: Mapping[str, _Topic]) -> str:
    """The topic of the first action; the most frequent one where no action is named."""
    of_action = [t for t in topics if columns.actions and columns.actions[0].startswith(f"{t}.")]
    counts = Counter({name: len(topic.times) for name, topic in topics.items()})
    return max(of_action, key=len) if of_action else counts.most_common(1)[0][0]


def _numbers(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The numbers and arrays of a message by name; texts and lists of messages are left out."""
    if is_dataclass(value):
        if hasattr(value, "sec") and hasattr(value, "nanosec"):
            yield name, value.sec + 1e-9 * value.nanosec
            return
        for part in value.__dataclass_fields__:
            if part != "__msgtype__":
                yield from _numbers(f"{name}.{part}", getattr(value, part))
    elif isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        yield name, value


def _held(topic: _Topic, times: NDArray[np.int64]) -> dict[str, FloatArray]:
    """The columns of a topic at some times: of the last message before each, if it is not old."""
    own = np.array(topic.times)
    order = np.argsort(own, kind="stable")
    last = np.searchsorted(own[order], times, side="right") - 1
    intervals = np.diff(own[order])
    longest = HELD_PERIODS * np.median(intervals) if len(intervals) else np.inf
    known = (last >= 0) & (times - own[order][last] <= longest)
    found = {}
    for name in topic.messages[0]:
        values = _array(name, [topic.messages[i][name] for i in order])
        if values[0].size:
            held = np.full((len(times), *values.shape[1:]), np.nan)
            held[known] = values[last[known]]
            found[name] = held
    return found


def _array(name: str, values: Sequence[Any]) -> FloatArray:
    """The values of all messages (m, ...)."""
    try:
        return np.array(values, dtype=np.float64)
    except ValueError as error:
        raise DataError(
            f"column {name}: the messages have arrays of different lengths; name a topic whose "
            "arrays stay as long"
        ) from error
