"""The commands that learn: train and resume."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from kreps.app.cli.envs import names_of_environments
from kreps.app.cli.paths import PATH
from kreps.app.cli.recorded import ColumnOption, SpecOption, TaskOption, given_spec, recorded
from kreps.app.cli.runs import RunArgument
from kreps.app.cli.settings import parse_setting
from kreps.app.console import say, say_command
from kreps.app.environments import environment_of
from kreps.app.report import diagnosis_of, evaluate_at_end, report_run, say_finding
from kreps.app.run_folder import RunConfig, RunFolder
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, KrepsError
from kreps.learning.environment import Environment
from kreps.learning.evaluate import Evaluation
from kreps.learning.methods import KREPS
from kreps.legacy import present_preset
from kreps.presets import PRESETS, settings_of
from kreps.recordings.spec import Spec

TRAIN_EXAMPLES = (
    "kreps train kreps/SwingUp-v0 --iterations 20 --seed 0 --out runs/swing-up",
    "kreps train kreps/SwingUp-v0 --preset paper --out runs/paper-like",
    "kreps train kreps/SwingUp-v0 --value grid --value.size 5 --out runs/grid",
    "kreps train kreps/SwingUp-v0 --set model_based=none --out runs/one-step",
    "kreps train kreps/ImageSwingUp-v0 --iterations 15 --out runs/images",
    "kreps train Pendulum-v1 --kl-bound 0.5 --window 60 --out runs/pendulum",
    "kreps train my_robot.envs:Arm-v0 --periodic 0 --periodic 1 --out runs/arm",
    "kreps train my_robot.envs:Arm-v0 --env-arg port=/dev/ttyUSB0 --out runs/arm",
    "kreps train --data recording.parquet --spec robot.toml --out runs/first",
)

RESUME_EXAMPLES = ("kreps resume runs/swing-up", "kreps resume runs/swing-up --iterations 40")

ITERATIONS = 20

ALL_DATA = {"window": None}
"""Settings of a run from recorded data: all of them are learnt from."""

ReportOption = Annotated[bool, typer.Option(help="Evaluate and draw pictures at the end.")]


def train(
    out: Annotated[Path, typer.Option(help="Folder for the run; must not hold one yet.", **PATH)],
    environment: Annotated[
        str | None,
        typer.Argument(
            help="Gymnasium name, or module:name to import the module first, which may lie in the "
            "current folder.  With --data there is none.",
            autocompletion=names_of_environments,
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            min=1, help=f"Policy updates to make; {ITERATIONS} if not given, and 1 with --data."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same policy.")] = 0,
    preset: Annotated[
        str,
        typer.Option(
            help="model_based; single_step: one step on the sampled actions; paper: close to the "
            "printed method; authors: as in the authors' scripts.",
            autocompletion=lambda: list(PRESETS),
        ),
    ] = next(iter(PRESETS)),
    recipe: Annotated[str | None, typer.Option(hidden=True)] = None,
    set_: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Change one setting, as the flag of its name does; may be repeated.",
        ),
    ] = [],  # noqa: B006 (typer reads the default)
    env_arg: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=VALUE",
            help="An argument of the environment, as for gymnasium.make; may be repeated.",
        ),
    ] = [],  # noqa: B006
    periodic: Annotated[
        list[int],
        typer.Option(help="An observation coordinate that is an angle; may be repeated."),
    ] = [],  # noqa: B006
    data: Annotated[
        list[Path],
        typer.Option(
            help="Recorded data to learn from in place of an environment; may be repeated.", **PATH
        ),
    ] = [],  # noqa: B006
    spec: SpecOption = None,
    column: ColumnOption = [],  # noqa: B006
    task: TaskOption = [],  # noqa: B006
    report: ReportOption = True,
) -> None:
    """Learn a policy, show the progress, and leave a run folder with the policy and pictures.

    Settings have flags, and are explained in full by [bold]kreps settings[/bold].

    Ctrl-C stops at any time: all finished updates are stored, and [bold]kreps resume[/bold]
    continues.

    With --data the policy is learnt from recorded data alone, as [bold]kreps import[/bold] reads
    them.
    """
    if recipe is not None:
        raise ConfigurationError(
            f"--recipe {recipe} is called --preset now; write --preset {present_preset(recipe)}"
        )
    if (environment is None) != bool(data):
        raise ConfigurationError(
            "give either an environment, such as kreps/SwingUp-v0, or recorded data by --data"
        )
    config = RunConfig(
        environment=environment or "",
        iterations=iterations or (1 if data else ITERATIONS),
        seed=seed,
        preset=preset,
        settings={**(ALL_DATA if data else {}), **dict(map(parse_setting, set_))},
        periodic=periodic or None,
        arguments=dict(parse_setting(text, "--env-arg") for text in env_arg),
        data=[str(path) for path in data],
    )
    folder = RunFolder(out)
    if data:
        _train_from_data(folder, config, given_spec(spec, column, task))
        return
    with environment_of(config) as env:
        learner = _learner(config, env)  # settings are checked before a folder is made
        folder.make()
        with folder.learning():
            folder.create(config)
            evaluation = _learn(folder, learner, config.iterations, report)
    _finish(folder, learner, evaluation)


def resume(
    run: RunArgument,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Updates in total; those of the run if not given.")
    ] = None,
    report: ReportOption = True,
) -> None:
    """Continue a run from its last update; the result is that of an uninterrupted run."""
    folder = RunFolder(run)
    config = folder.config()
    with folder.learning(), environment_of(config) as env:
        if folder.checkpoint_file.exists():
            learner = KREPS.resume(folder.checkpoint_file, env)
        else:  # stopped before the first update
            learner = _learner(config, env)
        if iterations is not None:  # stored, so that resuming after another stop needs no option
            config = replace(config, iterations=iterations)
            folder.write_config(config)
        done = learner.state.iteration
        say(f"{run}: {done} updates made, {max(config.iterations - done, 0)} to go")
        evaluation = _learn(folder, learner, config.iterations, report)
    _finish(folder, learner, evaluation)


def _train_from_data(folder: RunFolder, config: RunConfig, spec: Spec) -> None:
    """Report the recordings of a run, and learn from them."""
    if config.iterations != 1 or config.periodic or config.arguments:
        raise ConfigurationError(
            "--iterations, --periodic and --env-arg are about an environment: recorded data give "
            "one update, and angles are periodic in [task]; leave them out with --data"
        )
    recording, task = recorded([Path(path) for path in config.data], spec)
    learner = _learner(config, task or spec.task_of(recording))
    folder.make()
    with folder.learning():
        folder.create(config)
        learner.learn_from(recording.rollouts, folder)
    say(f"Extrapolation: {learner.policy.extrapolation(recording.rollouts)}.")
    for finding in diagnosis_of(folder):
        if finding.severity != "fine":
            say_finding(finding)
    say_command("Findings:  ", f"kreps diagnose {folder.path}")
    say_command("Policy:    ", f"{folder.policy_file}  (kreps.load_policy reads it)")


def _learner(config: RunConfig, env: Environment | TaskSpec) -> KREPS:
    settings_of(config.preset, **config.settings)  # rejects names of other arguments of `KREPS`
    return KREPS(
        env,
        seed=config.seed,
        preset=config.preset,
        periodic=config.periodic,
        **config.settings,
    )


def _learn(
    folder: RunFolder, learner: KREPS, target: int, report: bool
) -> dict[str, Evaluation] | None:
    """Make the updates that are missing; the evaluation of the policy for a report."""
    left = target - learner.state.iteration
    folder.rows()  # a damaged file is an error now, not after the first update
    try:
        if left > 0:
            learner.learn(left, callback=folder)
        return evaluate_at_end(folder, learner) if report else None
    except KeyboardInterrupt:
        say(f"\nstopped after {learner.state.iteration} of {target} updates; continue with:")
        say_command("  ", f"kreps resume {folder.path}")
        raise typer.Exit(130) from None
    except KrepsError:  # of the environment, or a disk that is full
        say("once the cause of the error below is removed, continue with:")
        say_command("  ", f"kreps resume {folder.path}")
        raise


def _finish(folder: RunFolder, learner: KREPS, evaluation: Mapping[str, Evaluation] | None) -> None:
    """Report a run whose environment is closed."""
    if evaluation is None:
        say_command("policy: ", str(folder.policy_file))
    else:
        report_run(folder, learner, evaluation)
