"""Runs cells on any executor; what is done stays done."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, as_completed
from pathlib import Path
from typing import Any

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from kreps.errors import CellFailure
from kreps.experiments.search import tuned_options
from kreps.experiments.specs import EXTRA_EXPERIMENTS, FIGURES, FIRST_SEED, TASKS
from kreps.experiments.trials import Trial, read_cell, run_cell, trial_of, write_cell
from kreps.learning.evaluate import EPISODES


def figure_trials(figure: str, trials: int, iterations: int | None) -> list[Trial]:
    """The cells that a figure shows: ``trials`` seeds of each of its curves.

    They come seed by seed, so that partial results compare.
    """
    first = FIRST_SEED.get(figure, 0)
    return [
        trial_of(
            task,
            method,
            seed,
            tuned_options(task, method),
            iterations=iterations,
            episodes=(TASKS[task].episodes, EPISODES),
        )
        for seed in range(first, first + trials)
        for task, method in (FIGURES | EXTRA_EXPERIMENTS)[figure]
    ]


def run_trials(cells: Sequence[Trial], executor: Executor, folder: Path) -> list[dict[str, Any]]:
    """The result of each cell; what is not in the folder yet is run, and kept when it is there.

    Cells of the same work under different names are run once.
    A cell that fails does not keep the others from being run.

    Raises:
        CellFailure: some failed; the first error is its cause.
    """
    cells = list({cell.name: cell for cell in cells}.values())
    results = {cell.name: read_cell(cell, folder) for cell in cells}
    left = [cell for cell in cells if results[cell.name] is None]
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[last]}"),
    )
    with bar:
        task = bar.add_task("cells", total=len(cells), completed=len(cells) - len(left), last="")
        failures: dict[str, Exception] = {}
        source = commit()  # the code that is about to run, whatever happens to the tree meanwhile
        done = {cell.work: result for cell in cells if (result := results[cell.name])}
        same: dict[str, list[Trial]] = {}
        for cell in left:
            same.setdefault(cell.work, []).append(cell)

        def keep(work: str, fresh: Mapping[str, Any]) -> None:
            for cell in same[work]:
                results[cell.name] = result = cell.named(fresh)
                write_cell(cell, folder, result)
                bar.update(task, advance=1, last=cell.name)
                if not bar.console.is_terminal:  # a log: a line each
                    print(f"{bar.tasks[0].completed:g}/{len(cells)} cells: {cell.name}", flush=True)

        for work in same.keys() & done.keys():
            keep(work, done[work])
        running = {
            executor.submit(run_cell, mine[0]): work
            for work, mine in same.items()
            if work not in done
        }
        try:
            for future in as_completed(running):
                work = running[future]
                try:
                    fresh = {"commit": source, **future.result()}
                except Exception as error:  # the other cells are worth having all the same
                    failures[same[work][0].name] = error
                    continue
                keep(work, fresh)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise
    if failures:
        name, first = next(iter(failures.items()))
        raise CellFailure(
            f"{len(failures)} of {len(cells)} cells failed, first {name}: "
            f"{type(first).__name__}: {first}; the others are kept, so call it again"
        ) from first
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
