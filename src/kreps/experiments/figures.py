"""Result files of a figure: all rows as CSV, a summary as JSON, tables as Markdown, a picture."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kreps.envs.image_swing_up import PIXELS
from kreps.envs.references import REFERENCE_REWARDS
from kreps.envs.swing_up import TIME_STEP
from kreps.errors import StorageError
from kreps.experiments.search import tuned_options
from kreps.experiments.specs import COLUMNS, TASKS, Curve
from kreps.experiments.tables import markdown
from kreps.experiments.trials import code_of, commits_of
from kreps.learning.collect import simulate
from kreps.learning.control_period import control_period
from kreps.learning.environment import opened, task_of
from kreps.learning.storage import write_atomically
from kreps.policies.exploration import BangBang
from kreps.seeding import Purpose, generator, integer_seed
from kreps.versions import versions

if TYPE_CHECKING:
    from kreps.experiments.plots import Column


def rows_of(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows of all trials: one per method, seed and iteration."""
    return [row for result in results for row in result["rows"]]


def named_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows with ``method`` followed by the task, if there are several tasks of a method."""
    pairs = {(row["method"], row["task"]) for row in rows}
    if len(pairs) == len({method for method, _ in pairs}):
        return [{**row} for row in rows]
    return [{**row, "method": f"{row['method']}, {row['task']}"} for row in rows]


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Evaluated reward per step at the last iteration of each curve.

    Returns:
        Per curve: mean, twice its standard error, smallest and all values over seeds, for the
        stochastic and the greedy policy; and the mean CPU seconds of an update.
    """
    rows = named_rows(rows)
    summary = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        last = [row for row in mine if row["iteration"] == max(r["iteration"] for r in mine)]
        entry: dict[str, Any] = {
            "trials": len(last),
            "iteration": last[0]["iteration"],
            "mean_steps": float(np.mean([row["steps"] for row in last])),
            "mean_update_cpu_seconds": float(np.mean([row["update_cpu_seconds"] for row in mine])),
        }
        for name in ("stochastic", "greedy"):
            values = np.array([row[name] for row in last])
            error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
            entry[name] = {
                "mean": float(values.mean()),
                "two_standard_errors": float(2 * error),
                "worst": float(values.min()),
                "by_seed": [round(float(value), 4) for value in values],
            }
        summary[method] = entry
    return summary


def write_results(
    folder: Path, name: str, command: str, results: Sequence[Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Write NAME.csv with all rows, NAME.json with summary and provenance, and NAME.md.

    Args:
        folder: of the files, which exists.
        name: of the experiment.
        command: that made the results.
        results: of the trials.

    Returns:
        The summary.
    """
    rows = rows_of(results)
    columns = list(dict.fromkeys(column for row in rows for column in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows(
        {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in r.items()} for r in rows
    )
    write_atomically(folder / f"{name}.csv", text.getvalue().encode())
    summary = summarise(rows)
    trials = [result["trial"] for result in results]
    content = {
        "command": command,
        "commit": commits_of(results),
        "options": {f"{t['task']}: {t['method']}": t["options"] for t in trials},
        "settings": {
            f"{r['trial']['task']}: {r['trial']['method']}": r["settings"] for r in results
        },
        "versions": versions(),
        "summary": summary,
        "code": code_of(results),
    }
    write_atomically(folder / f"{name}.json", (json.dumps(content, indent=2) + "\n").encode())
    write_atomically(folder / f"{name}.md", (markdown_table(summary) + "\n").encode())
    return summary


TABLE_HEADINGS = ("method", "stochastic policy", "worst seed", "greedy policy", "worst seed")


def table_rows(summary: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """The summary as text: one row per method, columns as in `TABLE_HEADINGS`."""
    rows = []
    for method, entry in summary.items():
        places = 2 if abs(entry["greedy"]["mean"]) >= 1.0 else 3
        row = [method]
        for name in ("stochastic", "greedy"):
            mean, error = entry[name]["mean"], entry[name]["two_standard_errors"]
            spread = f" ± {error:.{places}f}" if entry["trials"] > 1 else ""
            row.append(f"{mean:.{places}f}{spread}")
            row.append(f"{entry[name]['worst']:.{places}f}")
        rows.append(row)
    return rows


def markdown_table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """The documentation's table of a summary, with iterations and CPU seconds per update."""
    rows = [
        [*row, f"{entry['iteration']}", f"{entry['mean_update_cpu_seconds']:.2f}"]
        for row, entry in zip(table_rows(summary), summary.values(), strict=True)
    ]
    return markdown([*TABLE_HEADINGS, "iterations", "CPU s / update"], rows)


@cache
def period_of(task: str) -> float | None:
    """Control period of a key of `TASKS`, in s; None if its environment does not tell it."""
    with opened(TASKS[task].environment) as env:
        return control_period(env)


def robot_time(steps: int, period: float) -> str:
    """The seconds that steps of a control period take, as text."""
    return f"{steps * period:.4g} s"


MARKS = (300, 500, 750, 1000, 3000, 5000, 6000, 8000, 20_000)
"""Numbers of environment steps at which the tables give the reward."""

UNKNOWN = "–"
"""Cell of a table without a value."""


def at_most(curve: Sequence[Mapping[str, Any]], steps: float) -> Mapping[str, Any]:
    """The row of the latest policy that was learnt from at most so many environment steps."""
    return max(
        (row for row in curve if float(row["steps"]) <= steps), key=lambda row: float(row["steps"])
    )


def value_at(curves: Sequence[Sequence[Mapping[str, Any]]], name: str, mark: float) -> str:
    """Mean over seeds and, in brackets, the worst seed, at a number of environment steps.

    Args:
        curves: the rows of each seed.
        name: column that is read.
        mark: number of steps.

    Returns:
        A dash if some curve starts after the mark, or if the curves end before it (at fewer than
        95 % of it on average).
    """
    steps = [[float(row["steps"]) for row in curve] for curve in curves]
    if max(map(min, steps)) > mark or np.mean([max(s) for s in steps]) < 0.95 * mark:
        return UNKNOWN
    values = [float(at_most(curve, mark)[name]) for curve in curves]
    places = 1 if min(values) < -10.0 else 2 if min(values) < -1.0 else 3
    return f"{np.mean(values):.{places}f} ({min(values):.{places}f})"


def steps_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The documentation's table of reward by environment steps: mean and worst seed at `MARKS`.

    Marks without any value are left out.  The first row of each task has the robot time of the
    steps, where its control period is known.
    """
    grouped: dict[tuple[str, str], dict[int, list[Mapping[str, Any]]]] = {}
    for row in rows:
        of_seed = grouped.setdefault((row["task"], row["method"]), {})
        of_seed.setdefault(int(row["seed"]), []).append(row)
    curves = {
        names: [of_seed[seed] for seed in sorted(of_seed)] for names, of_seed in grouped.items()
    }
    marks = [
        mark
        for mark in MARKS
        if any(value_at(each, "greedy", mark) != UNKNOWN for each in curves.values())
    ]
    lines, tasks = [], list(dict.fromkeys(task for task, _ in curves))
    for task in tasks:
        period, suffix = period_of(task), "" if len(tasks) == 1 else f", {task}"
        if period is not None:
            lines.append([f"robot time{suffix}", *(robot_time(mark, period) for mark in marks)])
        for (of_task, method), each in curves.items():
            for name in ("stochastic", "greedy") if of_task == task else ():
                values = (value_at(each, name, mark) for mark in marks)
                lines.append([f"{method}, {name}", *values])
    return markdown(["mean (worst seed)", *(f"{mark} steps" for mark in marks)], lines)


TITLES = {
    "figure-1a": "Reaching: learning progress of the methods (Fig. 1a)",
    "figure-1b": "Swing-up: learning progress of the methods (Fig. 1b)",
    "figure-2b": "Swing-up from images and from joint values (Fig. 2b)",
    "swing-up": "kreps/SwingUp-v0: all seeds",
    "untuned": "KREPS(env) without further arguments: all seeds",
    "ablation": "The default with one part replaced: all seeds",
    "low-rank": "Exact and low-rank updates: all seeds",
    "golden": "Trials that the tests run again",
    "forgetting": "Swing-up with and without a replay window of 30 rollouts",
}
SEED_BY_SEED = ("swing-up", "untuned", "ablation", "low-rank")
"""Experiments whose picture has a panel per method, with a curve per seed."""

STEP_BY_STEP = ("swing-up", "untuned", "ablation")
"""Experiments with a table of reward by environment steps."""


def write_figure(
    folder: Path, name: str, command: str, results: Sequence[Mapping[str, Any]]
) -> list[Path]:
    """Write the result files of a figure and its picture.

    Args:
        folder: of the files, which exists.
        name: key of `TITLES`.
        command: that made the results.
        results: of the trials.

    Returns:
        The paths of the CSV, JSON, Markdown and PNG files.
    """
    from kreps import plotting  # Matplotlib is slow to import
    from kreps.experiments import plots

    write_results(folder, name, command, results)
    if name in STEP_BY_STEP:  # from the rounded numbers of the file, so that it can be repeated
        with open(folder / f"{name}.csv", newline="") as file:
            table = steps_table(named_rows(list(csv.DictReader(file))))
        write_atomically(folder / f"{name}-steps.md", (table + "\n").encode())
    source = f"{command}   (commit {commits_of(results)})"
    if name in SEED_BY_SEED:
        rows = named_rows(rows_of(results))
        references = {row["method"]: _references(row["task"]) for row in rows}
        period = _common_period([row["task"] for row in rows])
        figure = plots.comparison(rows, references, TITLES[name], source, period)
    else:
        figure = plots.learning_curves(columns_of(name, results), TITLES[name], source)
    picture = plotting.save(figure, folder / f"{name}.png")
    return [folder / f"{name}.{ending}" for ending in ("csv", "json", "md")] + [picture]


def _references(task: str) -> Mapping[str, float]:
    return REFERENCE_REWARDS.get(TASKS[task].environment, {})


def _common_period(tasks: Sequence[str]) -> float | None:
    periods = {period_of(task) for task in tasks}
    return periods.pop() if len(periods) == 1 else None


def columns_of(name: str, results: Sequence[Mapping[str, Any]]) -> list[Column]:
    """What each column of a figure shows; a figure that is not of the paper has one column.

    The name of a curve ends with the options that the search has chosen.
    """
    from kreps.experiments.plots import Column  # Matplotlib is slow to import

    names: dict[Curve, str] = {}
    rows_of_curve: dict[Curve, list[Mapping[str, Any]]] = {}
    rows = rows_of(results)
    for row, named in zip(rows, named_rows(rows), strict=True):
        curve = row["task"], row["method"]
        chosen = ", ".join(f"{k}={v!r}" for k, v in tuned_options(*curve).items())
        names[curve] = f"{named['method']}{': ' if chosen else ''}{chosen}"
        rows_of_curve.setdefault(curve, []).append(row)
    columns = []
    for title, shown in COLUMNS.get(name, {"": tuple(names)}).items():
        curves = [curve for curve in shown if curve in names]
        if curves:
            tasks = [task for task, _ in curves]
            by_name = {names[curve]: rows_of_curve[curve] for curve in curves}
            references = _references(tasks[0])
            columns.append(Column(title, tasks[0], by_name, references, _common_period(tasks)))
    return columns


def draw_features(path: Path) -> Path:
    """Draw Fig. 2a: the images of a rollout of the first policy, and their differences.

    Args:
        path: of the picture; its folder is made if there is none.

    Raises:
        StorageError: the folder cannot be made, or the picture not written.
    """
    from kreps import plotting  # Matplotlib is slow to import
    from kreps.experiments import plots

    seeds = [integer_seed(0, Purpose.ENVIRONMENT, 0, 0)]
    noise = [generator(0, Purpose.POLICY, 0, 0).standard_normal((41, 1))]
    with opened("kreps/ImageSwingUp-v0") as env:
        task = task_of(env)
        (rollout,) = simulate(env, task, BangBang(task), seeds, noise)
    shown = np.arange(1, 41, 5)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {path.parent}: {error}") from error
    figure = plots.image_features(
        rollout.observations[shown], [float(t * TIME_STEP) for t in shown], PIXELS
    )
    return plotting.save(figure, path)
