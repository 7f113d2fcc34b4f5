"""What a user says of a recording: its columns, and the task that it is of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, shown
from kreps.recordings.columns import Columns, columns_of, read_toml
from kreps.recordings.recording import Recording

TASK_FIELDS = (
    "action_low",
    "action_high",
    "periodic",
    "dt",
    "time_limit",
    "delay",
    "history",
)
"""Fields of a `TaskSpec` that ``[task]`` may have."""

PERIOD_DIGITS = 4
"""Significant digits of a control period that is taken from time stamps."""


@dataclass(frozen=True)
class Spec:
    """The columns of a recording, and what is known of its task.

    Attributes:
        columns: of the recording.
        task: `TASK_FIELDS` of the task; ``periodic`` may hold names of observation coordinates.

    Raises:
        ConfigurationError: another field of the task.
    """

    columns: Columns
    task: Mapping[str, Any]

    def __post_init__(self) -> None:
        unknown = [name for name in self.task if name not in TASK_FIELDS]
        if unknown:
            raise ConfigurationError(
                f"the task of a recording has no field {unknown[0]!r:.60}; choose among "
                f"{', '.join(TASK_FIELDS)}"
            )

    def task_of(self, recording: Recording) -> TaskSpec:
        """The task of a recording; without ``dt`` that is the median control period.

        Raises:
            ConfigurationError: no action limits, or values that are none for a `TaskSpec`.
        """
        given = dict(self.task)
        if not {"action_low", "action_high"} <= given.keys():
            actions = recording.rollouts.actions
            raise ConfigurationError(
                "the limits of the actions are not known, which are the scale of the actions; the "
                f"recorded actions go from {_shown(actions.min(axis=0))} to "
                f"{_shown(actions.max(axis=0))}; give those of the robot, as action_low and "
                "action_high of [task]"
            )
        labels = recording.values.labels
        given["periodic"] = [_coordinate(each, labels) for each in _list(given.get("periodic", ()))]
        if "dt" not in given and np.isfinite(recording.clock.period):
            given["dt"] = float(f"{recording.clock.period:.{PERIOD_DIGITS}g}")
        return TaskSpec(observation_size=len(labels), **given)


def spec_of(
    path: str | Path | None,
    columns: Mapping[str, Any] | None = None,
    task: Mapping[str, Any] | None = None,
) -> Spec:
    """The content of a TOML file with ``[columns]`` and ``[task]``, and what is given beside it.

    Args:
        path: of the file; None if all is given beside it.
        columns: fields of `Columns` that replace those of the file.
        task: `TASK_FIELDS` that replace those of the file.

    Raises:
        ConfigurationError: unknown fields, or values that are none for them.
        StorageError: the file cannot be read.
    """
    content = {} if path is None else read_toml(path)
    merged = {**content.get("columns", {}), **(columns or {})}
    return Spec(columns_of(merged), {**content.get("task", {}), **(task or {})})


def column_flags(given: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Fields of `Columns` from names and texts of the command line; lists are split at commas."""
    listed = [field.name for field in fields(Columns) if field.type == "tuple[str, ...]"]
    return {name: text.split(",") if name in listed else text for name, text in given}


def _coordinate(name: Any, labels: Sequence[str]) -> int:
    """The number of an observation coordinate that is given by its number or label."""
    if isinstance(name, int) and not isinstance(name, bool):
        return name
    if name in labels:
        return labels.index(name)
    raise ConfigurationError(
        f"periodic = {shown(name)} is no observation coordinate; choose among {', '.join(labels)}"
    )


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]


def _shown(values: Any) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"
