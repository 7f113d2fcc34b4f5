"""The commands that learn: train and resume."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from kreps.app.cli.paths import PATH
from kreps.app.cli.runs import RunArgument
from kreps.app.cli.settings import parse_setting
from kreps.app.console import say, say_command
from kreps.app.environments import environment_of
from kreps.app.report import evaluate_at_end, report_run
from kreps.app.run_folder import RunConfig, RunFolder
from kreps.errors import ConfigurationError, KrepsError
from kreps.learning.environment import Environment
from kreps.learning.evaluate import Evaluation
from kreps.learning.methods import KREPS
from kreps.legacy import present_preset
from kreps.presets import PRESETS, settings_of

TRAIN_EXAMPLES = (
    "kreps train kreps/SwingUp-v0 --iterations 20 --seed 0 --out runs/swing-up",
    "kreps train kreps/SwingUp-v0 --preset paper --out runs/paper-like",
    "kreps train kreps/SwingUp-v0 --set value=grid --set value.size=5 --out runs/grid",
    "kreps train kreps/SwingUp-v0 --set model_based=none --out runs/one-step",
    "kreps train kreps/ImageSwingUp-v0 --iterations 15 --out runs/images",
    "kreps train Pendulum-v1 --set kl_bound=0.5 --set window=60 --out runs/pendulum",
    "kreps train my_robot.envs:Arm-v0 --periodic 0 --periodic 1 --out runs/arm",
    "kreps train my_robot.envs:Arm-v0 --env-arg port=/dev/ttyUSB0 --out runs/arm",
)

RESUME_EXAMPLES = ("kreps resume runs/swing-up", "kreps resume runs/swing-up --iterations 40")

ReportOption = Annotated[bool, typer.Option(help="Evaluate and draw pictures at the end.")]


def train(
    environment: Annotated[
        str,
        typer.Argument(
            help="Gymnasium name, or module:name to import the module first, which may lie in the "
            "current folder."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the run; must not hold one yet.", **PATH)],
    iterations: Annotated[int, typer.Option(min=1, help="Policy updates to make.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same policy.")] = 0,
    preset: Annotated[
        str,
        typer.Option(
            help="model_based; single_step: one step on the sampled actions; paper: close to the "
            "printed method."
        ),
    ] = next(iter(PRESETS)),
    recipe: Annotated[str | None, typer.Option(hidden=True)] = None,
    set_: Annotated[
        list[str],
        typer.Option("--set", metavar="NAME=VALUE", help="Change one setting; may be repeated."),
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
    report: ReportOption = True,
) -> None:
    """Learn a policy, show the progress, and leave a run folder with the policy and pictures.

    Ctrl-C stops at any time: all finished updates are stored, and [bold]kreps resume[/bold]
    continues.
    """
    if recipe is not None:
        raise ConfigurationError(
            f"--recipe {recipe} is called --preset now; write --preset {present_preset(recipe)}"
        )
    config = RunConfig(
        environment=environment,
        iterations=iterations,
        seed=seed,
        preset=preset,
        settings=dict(parse_setting(text) for text in set_),
        periodic=periodic or None,
        arguments=dict(parse_setting(text, "--env-arg") for text in env_arg),
    )
    folder = RunFolder(out)
    with environment_of(config) as env:
        learner = _learner(config, env)  # settings are checked before a folder is made
        folder.make()
        with folder.learning():
            folder.create(config)
            evaluation = _learn(folder, learner, iterations, report)
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


def _learner(config: RunConfig, env: Environment) -> KREPS:
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
