"""Runs the cells of an experiment on any executor; what is done stays done."""

from __future__ import annotations

import csv
import io
import json
import subprocess
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from kreps.errors import StorageError
from kreps.experiments.cells import Cell, read_cell, run_cell, write_cell
from kreps.experiments.specs import Experiment
from kreps.runs import versions
from kreps.storage import write_atomically


def cells_of(experiment: Experiment, trials: int, iterations: int | None) -> list[Cell]:
    """Seeds 0 to ``trials - 1`` of each method, seed by seed, so that partial results compare."""
    return [
        Cell(
            method=name,
            recipe=method.recipe,
            settings=dict(method.settings),
            environment=experiment.environment,
            iterations=experiment.iterations if iterations is None else iterations,
            seed=seed,
        )
        for seed in range(trials)
        for name, method in experiment.methods.items()
    ]


def run_cells(cells: Sequence[Cell], executor: Executor, folder: Path) -> list[dict[str, Any]]:
    """The result of each cell; what is not in the folder yet is run, and kept when it is there.

    A cell that fails does not keep the others from being run; its error is raised at the end.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {folder}: {error}") from error
    results = {cell.name: read_cell(cell, folder) for cell in cells}
    left = [cell for cell in cells if results[cell.name] is None]
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    )
    with bar:
        task = bar.add_task("cells", total=len(cells), completed=len(cells) - len(left))
        failures: list[Exception] = []
        running = {executor.submit(run_cell, cell): cell for cell in left}
        try:
            for future in as_completed(running):
                cell = running[future]
                try:
                    fresh = {"commit": commit(), **future.result()}
                except Exception as error:  # the other cells are worth having all the same
                    failures.append(error)
                    continue
                results[cell.name] = fresh
                write_cell(cell, folder, fresh)
                bar.update(task, advance=1)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise
    if failures:
        raise failures[0]
    return [result for cell in cells if (result := results[cell.name]) is not None]


def commit() -> str:
    """The commit of the source tree, "+" if it differs from it; "unknown" outside a checkout."""
    here = Path(__file__).parents[1]

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", *words], cwd=here, capture_output=True, text=True, check=True, timeout=20
        )
        return done.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--", ".")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def rows_of(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per method, seed and iteration."""
    return [row for result in results for row in result["rows"]]


def commits_of(results: Sequence[Mapping[str, Any]]) -> str:
    """The commits at which the cells were run: one, if all went well."""
    return ", ".join(sorted({result["commit"] for result in results}))


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Per method, at its last iteration: mean, twice the standard error and worst seed."""
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
                "by_seed": [round(float(value), 3) for value in values],
            }
        summary[method] = entry
    return summary


def write_results(
    folder: Path,
    name: str,
    command: str,
    experiment: Experiment,
    results: Sequence[Mapping[str, Any]],
) -> dict[str, dict[str, Any]]:
    """``NAME.csv`` with every row, ``NAME.json`` with summary, command and commit, ``NAME.md``."""
    rows = rows_of(results)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in r.items()} for r in rows
    )
    write_atomically(folder / f"{name}.csv", text.getvalue().encode())
    summary = summarise(rows)
    content = {
        "command": command,
        "commit": commits_of(results),
        "environment": experiment.environment,
        "versions": versions(),
        "summary": summary,
    }
    write_atomically(folder / f"{name}.json", (json.dumps(content, indent=2) + "\n").encode())
    write_atomically(folder / f"{name}.md", (markdown_table(summary) + "\n").encode())
    return summary


TABLE_HEADINGS = ("method", "stochastic policy", "worst seed", "greedy policy", "worst seed")


def table_rows(summary: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """The summary in words: a row per method under `TABLE_HEADINGS`."""
    largest = max(abs(entry["greedy"]["mean"]) for entry in summary.values())
    places = 2 if largest >= 1.0 else 3
    rows = []
    for method, entry in summary.items():
        row = [method]
        for name in ("stochastic", "greedy"):
            mean, error = entry[name]["mean"], entry[name]["two_standard_errors"]
            row.append(f"{mean:.{places}f} ± {error:.{places}f}")
            row.append(f"{entry[name]['worst']:.{places}f}")
        rows.append(row)
    return rows


def markdown_table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """The summary as the documentation shows it, with the CPU seconds of an update."""
    headings = [*TABLE_HEADINGS, "CPU s / update"]
    rows = [
        [*row, f"{entry['mean_update_cpu_seconds']:.2f}"]
        for row, entry in zip(table_rows(summary), summary.values(), strict=True)
    ]
    lines = [f"| {' | '.join(cells)} |" for cells in (headings, *rows)]
    return "\n".join([lines[0], "|---" * len(headings) + "|", *lines[1:]])
