"""Recordings on the command line: their options, and the command import."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from kreps.app.cli.paths import PATH
from kreps.app.cli.settings import parse_setting
from kreps.app.console import say, say_command
from kreps.app.data_report import data_report
from kreps.app.report import say_finding
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.learning.storage import save_rollouts
from kreps.recordings.formats import read_table
from kreps.recordings.recording import Recording, recording_of
from kreps.recordings.spec import Spec, column_flags, spec_of
from kreps.recordings.table import Table

IMPORT_EXAMPLES = (
    "kreps import recording.csv",
    "kreps import recording.parquet --spec robot.toml",
    "kreps import day1.csv day2.csv --spec robot.toml --out rollouts.safetensors",
    "kreps import log.csv --column observations=angle,velocity --column actions=torque "
    "--column reward=r --task action_low=[-2] --task action_high=[2]",
    "kreps import bag/ --column observations=/joint_states.position "
    "--column actions=/command.data --column reward_function=my_robot:reward",
)

SpecOption = Annotated[
    Path | None,
    typer.Option(
        help="TOML file with the tables columns and task; docs/recorded_data.md has one.", **PATH
    ),
]
ColumnOption = Annotated[
    list[str],
    typer.Option(
        metavar="NAME=COLUMN",
        help="A field of the columns: observations, actions, reward, terminated, truncated, "
        "episode, time and others; may be repeated, and lists are separated by commas.",
    ),
]
TaskOption = Annotated[
    list[str],
    typer.Option(
        metavar="NAME=VALUE",
        help="A field of the task: action_low, action_high, periodic, dt and others; may be "
        "repeated.",
    ),
]


def import_(
    data: Annotated[
        list[Path],
        typer.Argument(help="Files or folders.", show_default=False, **{**PATH, "metavar": "DATA"}),
    ],
    spec: SpecOption = None,
    column: ColumnOption = [],  # noqa: B006 (typer reads the default)
    task: TaskOption = [],  # noqa: B006
    out: Annotated[
        Path | None,
        typer.Option(help="A .safetensors file of rollouts, for kreps.load_rollouts.", **PATH),
    ] = None,
) -> None:
    """Read recorded data, report what is noticed in them, and write them as rollouts.

    CSV, Parquet, HDF5, Minari and LeRobot datasets, and ROS 2 bags (MCAP or sqlite3).  The report
    is about sampling rate, gaps, missing values, saturated actions, idle columns, angles that wrap
    and suspicious values, with row numbers.  [bold]limit[/bold]: correct it before learning;
    [bold]note[/bold]: it may limit; [bold]fine[/bold]: it does not.  Without any column the columns
    of the file are listed.
    """
    if out is not None and out.suffix != ".safetensors":
        raise ConfigurationError(f"--out {out}, but rollouts are a file that ends in .safetensors")
    given = given_spec(spec, column, task)
    recording, its_task = recorded(data, given)
    if its_task is None:
        say("Give the action limits in [task] for all findings.")
    if out is not None:
        save_rollouts(recording.rollouts, out)
        say_command("wrote ", f"{out}  (kreps.load_rollouts reads it)")


def given_spec(spec: Path | None, column: Sequence[str], task: Sequence[str]) -> Spec:
    """The spec of the options."""
    columns = [_name_and_text(each) for each in column]
    return spec_of(
        spec, column_flags(columns), dict(parse_setting(each, "--task") for each in task)
    )


def _name_and_text(text: str) -> tuple[str, str]:
    name, equals, column = text.partition("=")
    if not equals:
        raise ConfigurationError(f"--column {text!r} is not NAME=COLUMN, such as actions=torque")
    return name, column


def recorded(data: Sequence[Path], spec: Spec) -> tuple[Recording, TaskSpec | None]:
    """The recording at some paths, which is reported; and its task, if the limits are given."""
    table = Table.concat([read_table(path, spec.columns) for path in data])
    if not spec.columns.names:
        _say_columns(table)
    recording = recording_of(table, spec.columns)
    limits = {"action_low", "action_high"} <= spec.task.keys()
    task = spec.task_of(recording) if limits else None
    rollouts, values = recording.rollouts, recording.values
    terminated = int(rollouts.terminated.sum())
    say(
        f"{len(table)} rows; {len(rollouts)} rollouts of {rollouts.steps} steps, {terminated} of "
        f"them terminated; {len(values.labels)} observation coordinates "
        f"({', '.join(values.labels)!s:.200}) and {len(values.action_labels)} of actions "
        f"({', '.join(values.action_labels)!s:.200})"
    )
    for finding in data_report(recording, task):
        say_finding(finding)
    return recording, task


def _say_columns(table: Table) -> None:
    """List the columns of a table with the ranges of their numbers."""
    for name, values in table.columns.items():
        width = f" x {values[0].size}" if values.ndim > 1 else ""
        numbers = values.astype(np.float64) if values.dtype.kind in "biuf" else np.empty(0)
        numbers = numbers[np.isfinite(numbers)]
        about = f"{numbers.min():.4g} to {numbers.max():.4g}" if numbers.size else "no number"
        say(f"  {name}{width}: {about}")
