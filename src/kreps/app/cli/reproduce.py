"""The commands that repeat experiments: reproduce and search."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kreps.app.cli.paths import PATH
from kreps.app.console import say_command
from kreps.errors import ConfigurationError
from kreps.experiments.executors import executor
from kreps.experiments.figures import draw_features, write_figure
from kreps.experiments.runner import figure_trials, run_trials
from kreps.experiments.search import CANDIDATES, search_trials, write_search
from kreps.experiments.specs import EXTRA_EXPERIMENTS, FIGURES, FIRST_SEED, PICTURES
from kreps.experiments.trials import name_of
from kreps.experiments.verdicts import write_claims

REPRODUCE_EXAMPLES = (
    "kreps reproduce figure-1b --trials 10 --workers 2",
    "kreps reproduce all",
    "kreps reproduce figure-1a --trials 2 --iterations 3 --out small",
    "kreps reproduce figure-1b --scheduler tcp://head-node:8786",
)
SEARCH_EXAMPLES = ("kreps search --workers 2", "kreps search reaching --out try")

OF_THE_PAPER = (*FIGURES, *PICTURES)

WorkersOption = Annotated[int, typer.Option(min=1, help="Number of parallel processes.")]
SchedulerOption = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Run on the Dask cluster of this scheduler instead."),
]
ResultsOption = Annotated[Path, typer.Option(help="Folder for results.", **PATH)]


def reproduce(
    figure: Annotated[
        str,
        typer.Argument(
            help=f"One of: {', '.join((*OF_THE_PAPER, 'all'))} (these); beyond the paper: "
            f"{', '.join(EXTRA_EXPERIMENTS)}."
        ),
    ],
    trials: Annotated[
        int,
        typer.Option(
            min=1,
            help="Number of seeds: from 0, or in experiments that confirm others from "
            f"{max(FIRST_SEED.values())}.",
        ),
    ] = 10,
    workers: WorkersOption = 2,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Policy updates; the task's own number if not given.")
    ] = None,
    out: ResultsOption = Path("results"),
    scheduler: SchedulerOption = None,
) -> None:
    """Repeat a figure of the paper over many seeds, draw it and test the paper's claims.

    Each trial (method x task x seed) is stored when it ends: stop at any time and repeat the
    command.  Figures share trials, so [bold]all[/bold] costs less than its parts.
    """
    known = (*OF_THE_PAPER, "all", *EXTRA_EXPERIMENTS)
    if figure not in known:
        raise ConfigurationError(f"figure {figure!r} is unknown; choose one of {', '.join(known)}")
    figures = OF_THE_PAPER if figure == "all" else (figure,)
    command = f"kreps reproduce {figure} --trials {trials}"
    if iterations is not None:
        command += f" --iterations {iterations}"
    planned = {
        name: figure_trials(name, trials, iterations) for name in figures if name not in PICTURES
    }
    results = []
    if planned:
        with executor(workers, scheduler) as pool:
            all_trials = [trial for of_figure in planned.values() for trial in of_figure]
            results = run_trials(all_trials, pool, out / "trials")
    for name in figures:
        if name in PICTURES:
            say_command("drew ", str(draw_features(out / f"{name}.png")))
            continue
        names = {trial.name for trial in planned[name]}
        chosen = [result for result in results if name_of(result) in names]
        for path in write_figure(out, name, command, chosen):
            say_command("wrote ", str(path))
    for path in write_claims(out):
        say_command("wrote ", str(path))


def search(
    tasks: Annotated[
        list[str] | None,
        typer.Argument(help=f"Any of: {', '.join(CANDIDATES)}; all if not given."),
    ] = None,
    workers: WorkersOption = 2,
    out: ResultsOption = Path("results"),
    scheduler: SchedulerOption = None,
) -> None:
    """Search the parameters of every compared method: as many candidates for each, same seeds.

    The outcome is OUT/search.json.  Figures use src/kreps/experiments/search.json: copy it there.
    """
    unknown = [task for task in tasks or () if task not in CANDIDATES]
    if unknown:
        raise ConfigurationError(
            f"task {unknown[0]!r} is unknown; choose from {', '.join(CANDIDATES)}"
        )
    all_trials = [
        trial
        for task in tasks or CANDIDATES
        for method in CANDIDATES[task]
        for of_candidate in search_trials(task, method)
        for trial in of_candidate
    ]
    with executor(workers, scheduler) as pool:
        results = run_trials(all_trials, pool, out / "trials" / "search")
    command = " ".join(["kreps search", *(tasks or ())])
    path = write_search(out / "search.json", command, tasks or list(CANDIDATES), results)
    say_command("wrote ", str(path))
