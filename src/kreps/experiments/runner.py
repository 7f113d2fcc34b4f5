"""Runs trials on any executor and keeps each result in a file as soon as it is there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from pathlib import Path
from typing import Any

from rich import get_console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Column

from kreps.errors import TrialFailure
from kreps.experiments.fingerprint import changes
from kreps.experiments.provenance import commit
from kreps.experiments.search import tuned_options
from kreps.experiments.specs import EXTRA_EXPERIMENTS, FIGURES, FIRST_SEED, TASKS
from kreps.experiments.trials import (
    Trial,
    read_trial,
    run_recorded,
    run_trial,
    trial_of,
    write_trial,
)
from kreps.learning.evaluate import EPISODES

Result = dict[str, Any]


def figure_trials(figure: str, trials: int, iterations: int | None) -> list[Trial]:
    """The trials of a figure, all curves of one seed before those of the next.

    In this order the results of an unfinished experiment can already be compared.

    Args:
        figure: key of `FIGURES` or `EXTRA_EXPERIMENTS`.
        trials: seeds of each curve.
        iterations: policy updates; None takes the number that each task prescribes.
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


class _ResultFolder:
    """The results of some trials: those in the folder, and new ones with a progress display."""

    def __init__(self, trials: Sequence[Trial], folder: Path, bar: Progress) -> None:
        self.trials = list({trial.name: trial for trial in trials}.values())
        self.folder, self.bar = folder, bar
        self.results: dict[str, Result] = {}
        for trial in self.trials:
            if (result := read_trial(trial, folder)) is not None:
                self.results[trial.name] = result
        self._drop_stale()
        self.recorded = {t.curve for t in self.trials if self._code(t)}
        """Curves with a fingerprint: the first trial that runs of each other one makes it."""
        self.missing: dict[str, list[Trial]] = {}
        """Trials without a result, by their work."""
        for trial in self.trials:
            if trial.name not in self.results:
                self.missing.setdefault(trial.work, []).append(trial)
        self.count = len(self.trials)
        self.display = bar.add_task(
            "trials", total=self.count, completed=len(self.results), last=""
        )

    def _code(self, trial: Trial) -> dict[str, str]:
        code: dict[str, str] = self.results.get(trial.name, {}).get("code", {})
        return code

    def _drop_stale(self) -> None:
        """Forget the results of curves whose code has changed since, so that they are run again."""
        stale = {t.curve for t in self.trials if changes(self._code(t))}
        for task, method, _ in stale:
            self.bar.console.print(f"{task}, {method}: its code has changed, so it runs again")
        for trial in self.trials:
            if trial.curve in stale:
                self.results.pop(trial.name, None)

    def function(self, work: str) -> Callable[[Trial], Result]:
        """What runs a work: the first one of a curve is recorded."""
        new = {trial.curve for trial in self.missing[work]} - self.recorded
        self.recorded |= new
        return run_recorded if new else run_trial

    def keep(self, work: str, result: Mapping[str, Any]) -> None:
        """Write the result of all trials with this work."""
        for trial in self.missing[work]:
            self.results[trial.name] = renamed = trial.renamed(result)
            write_trial(trial, self.folder, renamed)
            self.bar.update(self.display, advance=1, last=trial.name)
            if not self.bar.console.is_terminal:  # a log file: one line per trial
                done = self.bar.tasks[0].completed
                print(f"{done:g}/{self.count} trials: {trial.name}", flush=True)

    def keep_known_work(self) -> None:
        """Take over results of trials that differ from a missing one in their names only."""
        known = {t.work: self.results[t.name] for t in self.trials if t.name in self.results}
        for work in self.missing.keys() & known.keys():
            self.keep(work, known[work])
            del self.missing[work]


def run_trials(trials: Sequence[Trial], executor: Executor, folder: Path) -> list[Result]:
    """The result of each trial, from its file in the folder or by running it.

    Trials that differ in their displayed names only are run once.  Each result is written when it
    arrives.  If a trial fails, the others are run all the same.

    Args:
        trials: in the order of the results; repeated ones count once.
        executor: runs `run_trial`.
        folder: of the result files.

    Raises:
        TrialFailure: at least one trial failed; the error of the first one is its cause.
    """
    whole = Column(no_wrap=True)  # in a narrow terminal only the trial's name is cut
    bar = Progress(
        TextColumn("{task.description}", table_column=whole),
        BarColumn(bar_width=20),
        MofNCompleteColumn(table_column=whole),
        TimeRemainingColumn(elapsed_when_finished=True, table_column=whole),
        TextColumn("{task.fields[last]}", table_column=Column(no_wrap=True, ratio=1)),
        disable=not get_console().is_terminal,
        expand=True,
    )
    with bar:
        kept = _ResultFolder(trials, folder, bar)
        kept.keep_known_work()
        failures = _run_missing(kept, executor)
    if failures:
        name, first = next(iter(failures.items()))
        raise TrialFailure(
            f"{len(failures)} of {kept.count} trials failed, first {name}: "
            f"{type(first).__name__}: {first}; the others are kept, so call it again"
        ) from first
    return [kept.results[trial.name] for trial in kept.trials]


def _run_missing(kept: _ResultFolder, executor: Executor) -> dict[str, Exception]:
    """Run what is missing; the errors of trials that failed, by the name of the trial."""
    source = commit()  # now: the source tree may change while the trials run
    failures: dict[str, Exception] = {}
    running = {
        executor.submit(kept.function(work), same[0]): work for work, same in kept.missing.items()
    }
    try:
        for future in as_completed(running):
            work = running[future]
            try:
                result = {"commit": source, **future.result()}
            except Exception as error:
                failures[kept.missing[work][0].name] = error
                continue
            kept.keep(work, result)
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        raise
    return failures
