"""The command that searches settings: tune."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from kreps.app.cli.envs import names_of_environments
from kreps.app.cli.flags import all_settings
from kreps.app.cli.paths import PATH
from kreps.app.cli.settings import parse_setting
from kreps.app.console import say, say_command
from kreps.app.environments import environment_of, literal
from kreps.app.run_folder import RunConfig, RunFolder
from kreps.app.tuning import (
    JOURNAL,
    Choice,
    Interval,
    Study,
    finished_rows,
    importances,
    open_study,
    run_study,
    shown,
    space_for,
)
from kreps.errors import ConfigurationError
from kreps.learning.storage import write_atomically
from kreps.presets import PRESETS

TUNE_EXAMPLES = (
    "kreps tune kreps/SwingUp-v0 --trials 30 --out studies/swing-up",
    "kreps tune Pendulum-v1 --trials 20 --iterations 15 --window 60 --out studies/pendulum",
    "kreps tune Pendulum-v1 --search kl_bound=0.1:3:log --search exploration=pink,gaussian "
    "--out studies/two",
)

SHOWN_TRIALS = 5


def tune(
    environment: Annotated[
        str,
        typer.Argument(
            help="Gymnasium name, or module:name to import the module first.",
            autocompletion=names_of_environments,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(help="Folder of the study; processes with the same one share it.", **PATH),
    ],
    trials: Annotated[
        int, typer.Option(min=1, help="Finished trials in the study, of all processes together.")
    ] = 30,
    iterations: Annotated[int, typer.Option(min=1, help="Policy updates of a trial.")] = 20,
    seeds: Annotated[int, typer.Option(min=1, help="Learners of a trial, averaged over.")] = 2,
    seed: Annotated[
        int, typer.Option(min=0, help="Of the first learner and of the sampled settings.")
    ] = 0,
    preset: Annotated[
        str, typer.Option(help="Preset of the settings that are not searched.")
    ] = next(iter(PRESETS)),
    search: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=RANGE",
            help="Search this setting in LOW:HIGH, in LOW:HIGH:log, or among A,B,C; may be "
            "repeated. If not given, five settings are searched.",
        ),
    ] = [],  # noqa: B006 (typer reads the default)
    set_: Annotated[
        list[str],
        typer.Option("--set", metavar="NAME=VALUE", help="Fix one setting; may be repeated."),
    ] = [],  # noqa: B006
    env_arg: Annotated[
        list[str],
        typer.Option(metavar="NAME=VALUE", help="An argument of the environment; may be repeated."),
    ] = [],  # noqa: B006
    periodic: Annotated[
        list[int],
        typer.Option(help="An observation coordinate that is an angle; may be repeated."),
    ] = [],  # noqa: B006
) -> None:
    """Search settings with Optuna, by the evaluated reward after the last update.

    The reward is the average per step without exploration noise, mean over the learners of a trial,
    in rollouts that are not learnt from.  A trial that is below the median of the others after the
    same update is pruned.  At the end there are a table of the best trials, the importance of each
    setting, and the command that learns with the best ones.  The same command goes on with a study
    that was stopped.  Flags of settings fix them.  It needs: pip install 'kreps\\[tune]'.
    """
    config = RunConfig(
        environment=environment,
        iterations=iterations,
        seed=seed,
        preset=preset,
        settings=dict(parse_setting(text) for text in set_),
        periodic=periodic or None,
        arguments=dict(parse_setting(text, "--env-arg") for text in env_arg),
    )
    space = space_for(config, dict(parse_range(text) for text in search))
    if not space:
        raise ConfigurationError("no setting is left to be searched; name one by --search")
    with environment_of(config) as env:
        RunFolder(out).make()
        study = open_study(out, config, seeds, space)
        try:
            run_study(study, trials, config, seeds, space, env)
        except KeyboardInterrupt:
            say("\nstopped; the same command goes on with the study")
            raise typer.Exit(130) from None
    _report(study, out, config, seeds)


def parse_range(text: str) -> tuple[str, Interval | Choice]:
    """Name and range of ``NAME=LOW:HIGH``, ``NAME=LOW:HIGH:log`` or ``NAME=A,B,C``.

    Raises:
        ConfigurationError: it is none of them.
    """
    name, equals, given = text.partition("=")
    if equals and "," in given:
        return name, Choice(tuple(parse_setting(f"x={each}")[1] for each in given.split(",")))
    numbers, log = given.removesuffix(":log"), given.endswith(":log")
    try:
        low, high = (float(each) for each in numbers.split(":"))
    except ValueError:
        low, high = 1.0, 0.0
    if not equals or not -float("inf") < low < high < float("inf") or (log and low <= 0.0):
        raise ConfigurationError(
            f"--search {text!r:.60} is not NAME=LOW:HIGH with LOW below HIGH, NAME=LOW:HIGH:log "
            "with LOW above 0, or NAME=A,B,C"
        )
    return name, Interval(low, high, log, whole=_is_whole(name))


def _is_whole(name: str) -> bool:
    """Whether a setting is a whole number; an unknown one is not."""
    return name in all_settings() and "INTEGER" in all_settings()[name].choices


def _report(study: Study, out: Path, config: RunConfig, seeds: int) -> None:
    """Print the best trials and the importance of settings; write all trials and a picture."""
    from kreps import plotting
    from kreps.app.plots.importance import importance

    rows, shares = finished_rows(study), importances(study)
    say(f"\nBest of {len(rows)} finished trials, average reward per step without noise:")
    for row in rows[:SHOWN_TRIALS]:
        settings = {name: row[name] for name in row if name in study.best_params}
        note = "" if row["state"] == "complete" else f" ({row['state']} after {row['updates']})"
        say(f"  {row['reward']:.5g}{note}  trial {row['trial']}: {shown(settings)}", indent=4)
    if shares:
        say("Importance, as share in the variance of the reward:")
        for name, share in shares.items():
            say(f"  {share:4.0%}  {name}")
    write_atomically(out / "trials.csv", _table(rows).encode())
    figure = importance(shares, rows, literal(config.environment))
    say_command("Trials:   ", f"{out / 'trials.csv'}, {out / JOURNAL}")
    say_command("Picture:  ", str(plotting.save(figure, out / "importance.png")))
    best = replace(
        config, settings={**config.settings, **study.best_params}, seed=config.seed + seeds
    )
    say("The best of many trials looks better than it is. Learn with it on a seed that is new:")
    say_command("  ", best.command("run"))


def _table(rows: Any) -> str:
    text = io.StringIO()
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
