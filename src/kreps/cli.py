"""The command line: kreps train | resume | evaluate | plot | video | reproduce."""

from __future__ import annotations

import json
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from kreps.controller import Policy
from kreps.data import TaskSpec
from kreps.envs.references import REFERENCE_REWARDS
from kreps.errors import ConfigurationError, EnvironmentFailure, KrepsError
from kreps.evaluation import Evaluation, evaluate, stochastic_and_greedy
from kreps.experiments.runner import cells_of, commit, run_cells, write_results
from kreps.experiments.specs import EXPERIMENTS
from kreps.learner import KREPS
from kreps.rollout import Environment
from kreps.runs import RunConfig, RunFolder
from kreps.settings import settings_of
from kreps.storage import write_atomically
from kreps.threads import blas_threads

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    help="Kernel-based, non-parametric policy search: REPS with RKHS embeddings.\n\n"
    "[bold]Start here:[/bold]  kreps train kreps/SwingUp-v0 --out runs/swing-up",
)
console = Console()

RunArgument = Annotated[Path, typer.Argument(help="Folder of the run.", show_default=False)]


# ---- commands ---------------------------------------------------------------------------------


@app.command(
    epilog="Examples:\n\n"
    "  kreps train kreps/SwingUp-v0 --iterations 20 --seed 0 --out runs/swing-up\n\n"
    "  kreps train kreps/SwingUp-v0 --recipe paper --out runs/as-printed\n\n"
    "  kreps train Pendulum-v1 --set kl_bound=0.5 --set window=60 --out runs/pendulum\n\n"
    "  kreps train my_robot.envs:Arm-v0 --periodic 0 --periodic 1 --out runs/arm"
)
def train(
    environment: Annotated[
        str, typer.Argument(help="Gymnasium name, or module:name to import the module first.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the run; must not hold one yet.")],
    iterations: Annotated[int, typer.Option(min=1, help="Policy updates to make.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same policy.")] = 0,
    recipe: Annotated[str, typer.Option(help="default, or paper: the printed method.")] = "default",
    set_: Annotated[
        list[str],
        typer.Option("--set", metavar="NAME=VALUE", help="Change one setting; may be repeated."),
    ] = [],  # noqa: B006 (typer reads the default)
    periodic: Annotated[
        list[int],
        typer.Option(help="An observation coordinate that is an angle; may be repeated."),
    ] = [],  # noqa: B006
    report: Annotated[bool, typer.Option(help="Evaluate and draw pictures at the end.")] = True,
) -> None:
    """Learn a policy; show how it goes; leave a run folder with policy and pictures.

    Ctrl-C stops at any time: what was learnt is on disk, and [bold]kreps resume[/bold] goes on.
    """
    config = RunConfig(
        environment=environment,
        iterations=iterations,
        seed=seed,
        recipe=recipe,
        settings=dict(_setting(text) for text in set_),
        periodic=periodic or None,
    )
    env = _make(environment)
    learner = _learner(config, env)  # settings are checked before a folder is made
    folder = RunFolder(out)
    folder.create(config)
    _learn(folder, learner, iterations, report)


@app.command(
    epilog="Examples:\n\n"
    "  kreps resume runs/swing-up\n\n"
    "  kreps resume runs/swing-up --iterations 40"
)
def resume(
    run: RunArgument,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Updates in all; as first asked for if not given.")
    ] = None,
    report: Annotated[bool, typer.Option(help="Evaluate and draw pictures at the end.")] = True,
) -> None:
    """Go on with a run exactly where it stopped, as if it never had."""
    folder = RunFolder(run)
    config = folder.config()
    env = _make(config.environment)
    if folder.checkpoint_file.exists():
        learner = KREPS.resume(folder.checkpoint_file, env)
    else:  # stopped before the first update
        learner = _learner(config, env)
    if iterations is not None:  # kept, so that the next interruption knows the new target too
        config = replace(config, iterations=iterations)
        folder.write_config(config)
    done = learner.state.iteration
    say(f"{run}: {done} updates made, {max(config.iterations - done, 0)} to go")
    _learn(folder, learner, config.iterations, report)


@app.command(
    name="evaluate",
    epilog="Example:\n\n  kreps evaluate runs/swing-up --episodes 200 --steps 400",
)
def evaluate_(
    run: RunArgument,
    episodes: Annotated[int, typer.Option(min=2, help="Roll-outs per policy.")] = 200,
    steps: Annotated[int, typer.Option(min=1, help="Steps of each, without restarts.")] = 400,
    seed: Annotated[int, typer.Option(min=0, help="Of the evaluation's random numbers.")] = 0,
) -> None:
    """Average reward per step of the learnt policy, with and without its exploration noise."""
    folder = RunFolder(run)
    learner = _learnt(folder)
    _evaluate(folder, learner, episodes, steps, seed)


@app.command(epilog="Example:\n\n  kreps plot runs/swing-up")
def plot(run: RunArgument) -> None:
    """Draw the learning curve and, for two-dimensional states, maps of policy and V."""
    folder = RunFolder(run)
    for path in _plot(folder, _learnt(folder)):
        say(f"drew {path}")


@app.command(
    epilog="Examples:\n\n"
    "  kreps video runs/swing-up\n\n"
    "  kreps video runs/swing-up --steps 200 --stochastic --out swing-up.gif"
)
def video(
    run: RunArgument,
    steps: Annotated[int, typer.Option(min=1, help="Length of the roll-out.")] = 120,
    stochastic: Annotated[bool, typer.Option(help="With exploration noise.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the roll-out.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="A .gif file; video.gif in the run if not given.")
    ] = None,
) -> None:
    """Film the learnt policy in its environment."""
    folder = RunFolder(run)
    say(f"filmed {_film(folder, _learnt(folder), steps, stochastic, seed, out)}")


@app.command(
    epilog="Examples:\n\n"
    "  kreps reproduce swing-up --trials 10 --workers 2\n\n"
    "  kreps reproduce swing-up --trials 2 --iterations 5 --out /tmp/small"
)
def reproduce(
    experiment: Annotated[str, typer.Argument(help=f"One of: {', '.join(EXPERIMENTS)}.")],
    trials: Annotated[int, typer.Option(min=1, help="Seeds 0 to TRIALS - 1.")] = 10,
    workers: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = 2,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Policy updates; the experiment's own if not given.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for results.")] = Path("results"),
) -> None:
    """Repeat a comparison over many seeds and draw its figure.

    Each cell (method x seed) is kept when it is done: stop at any time and call it again.
    """
    from kreps import plotting

    if experiment not in EXPERIMENTS:
        raise ConfigurationError(
            f"experiment {experiment!r} is unknown; choose one of {', '.join(EXPERIMENTS)}"
        )
    spec = EXPERIMENTS[experiment]
    command = f"kreps reproduce {experiment} --trials {trials}"
    if iterations is not None:
        command += f" --iterations {iterations}"
    cells = cells_of(spec, trials, iterations)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as executor:
        rows = run_cells(cells, executor, out / "cells" / experiment)
    summary = write_results(out, experiment, command, spec, rows)
    figure = plotting.comparison(
        rows,
        REFERENCE_REWARDS.get(spec.environment, {}),
        f"{spec.environment}: every seed",
        f"{command}   (commit {commit()})",
    )
    table = Table(title=f"{experiment}: average reward per step after the last update")
    for heading in ("method", "stochastic", "worst seed", "greedy", "worst seed"):
        table.add_column(heading)
    for method, entry in summary.items():
        columns = [
            text
            for name in ("stochastic", "greedy")
            for text in (
                f"{entry[name]['mean']:.2f} ± {entry[name]['two_standard_errors']:.2f}",
                f"{entry[name]['worst']:.2f}",
            )
        ]
        table.add_row(method, *columns)
    console.print(table)
    say(f"Results:   {out / experiment}.csv, {out / experiment}.json")
    say(f"Figure:    {plotting.save(figure, out / f'{experiment}.png')}")


def main() -> None:
    """Entry point: errors of the library come out as one line, not as a traceback."""
    try:
        sys.exit(app(standalone_mode=False))  # a command's typer.Exit comes back as its code
    except KrepsError as error:
        complaint = Text.assemble(("error: ", "bold red"), str(error))
        Console(stderr=True).print(complaint, soft_wrap=True)
        sys.exit(2)
    except Exception as error:
        if hasattr(error, "show"):  # a usage error of the command line
            error.show()
            sys.exit(2)
        raise


# ---- parts ------------------------------------------------------------------------------------


def say(message: str) -> None:
    """Plain words: no markup, as paths may hold brackets; no line breaks, as they may be long."""
    console.print(message, markup=False, highlight=False, soft_wrap=True)


def _setting(text: str) -> tuple[str, Any]:
    """``name=value``; the value is read as JSON where it can be."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ConfigurationError(f"--set {text!r} is not NAME=VALUE, such as kl_bound=0.5")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def _make(environment: str, **options: Any) -> Environment:
    try:
        return gym.make(environment, **options)
    except Exception as error:  # whatever a foreign environment raises
        raise ConfigurationError(
            f"cannot make the environment {environment!r}: {error}; check its name, "
            "or write module:name to have its module imported first"
        ) from error


def _learner(config: RunConfig, env: Environment) -> KREPS:
    settings_of(config.recipe, **config.settings)  # complains of anything that is no setting
    return KREPS(
        env,
        seed=config.seed,
        recipe=config.recipe,
        periodic=config.periodic,
        **config.settings,
    )


def _learnt(folder: RunFolder) -> KREPS:
    """The learner of a run with at least one update, in its environment."""
    config = folder.config()
    if not folder.checkpoint_file.exists():
        raise ConfigurationError(
            f"{folder.path} has no checkpoint yet; make the first update with "
            f"`kreps resume {folder.path}`"
        )
    return KREPS.resume(folder.checkpoint_file, _make(config.environment))


def _learn(folder: RunFolder, learner: KREPS, target: int, report: bool) -> None:
    left = target - learner.state.iteration
    folder.rows()  # complains now, not after the first update, if they are damaged
    try:
        if left > 0:
            learner.learn(left, callback=folder)
    except KeyboardInterrupt:
        say(
            f"\nstopped after {learner.state.iteration} of {target} updates; "
            f"go on with: kreps resume {folder.path}"
        )
        raise typer.Exit(130) from None
    except EnvironmentFailure:
        say(f"once it is mended, go on with: kreps resume {folder.path}")
        raise
    if report:
        _report(folder, learner)
    else:
        say(f"policy: {folder.policy_file}")


def _report(folder: RunFolder, learner: KREPS) -> None:
    evaluation = _evaluate(folder, learner, episodes=200, steps=400, seed=0)
    pictures = _plot(folder, learner)
    try:
        pictures.append(_film(folder, learner, 120, False, 0, None))
    except (ConfigurationError, EnvironmentFailure) as error:
        say(f"no film: {error}")
    state = learner.state
    greedy = evaluation["greedy"].mean
    say(
        f"\n{state.iteration} updates from {state.rollouts} roll-outs "
        f"({state.steps} environment steps). The learnt policy earns {greedy:.4g} per step "
        f"without noise and {evaluation['stochastic'].mean:.4g} with it."
        + _in_words(folder.config().environment, greedy)
    )
    say(f"Policy:    {folder.policy_file}  (kreps.load_policy reads it)")
    say(f"Numbers:   {folder.progress_file}, {folder.evaluation_file}")
    for path in pictures:
        say(f"Picture:   {path}")
    say(f"Go on:     kreps resume {folder.path} --iterations {2 * state.iteration}")


def _in_words(environment: str, reward: float) -> str:
    """How the reward stands to the task's reference values."""
    references = REFERENCE_REWARDS.get(environment)
    if not references:
        return ""
    (best_name, best), *others = references.items()
    worst_name, worst = others[-1]
    way = (reward - worst) / (best - worst)
    text = (
        f" That is {way:.0%} of the way from {worst_name} ({worst:g}) "
        f"to the {best_name} ({best:g})."
    )
    for name, value in others[:-1]:
        if abs(reward - value) < 0.05 * abs(best - worst):
            text += f" It is near {name} ({value:g}): the run is probably stuck there."
    return text


def _evaluate(
    folder: RunFolder, learner: KREPS, episodes: int, steps: int, seed: int
) -> dict[str, Evaluation]:
    assert learner.env is not None and learner.state.policy is not None
    found = {}
    with console.status("evaluating ..."), blas_threads(1):
        for name, policy in stochastic_and_greedy(learner.state.policy).items():
            found[name] = evaluate(
                learner.env,
                learner.task,
                policy,
                restart_probability=learner.settings.restart_probability,
                episodes=episodes,
                steps=steps,
                seed=seed,
            )
    table = Table(title=f"Average reward per step, {episodes} roll-outs of up to {steps} steps")
    for heading in ("policy", "mean", "± 2 s.e."):
        table.add_column(heading)
    for name, result in found.items():
        table.add_row(name, f"{result.mean:.4f}", f"{2 * result.standard_error:.4f}")
    console.print(table)
    content = {
        "iteration": learner.state.iteration,
        "environment_steps": learner.state.steps,
        "seed": seed,
        **{name: asdict(result) for name, result in found.items()},
    }
    write_atomically(folder.evaluation_file, (json.dumps(content, indent=2) + "\n").encode())
    return found


def _labels(env: Environment, task: TaskSpec) -> tuple[list[str], list[str]]:
    metadata = env.metadata or {}
    observations = metadata.get("observation_labels") or [
        f"observation {i}" for i in range(task.observation_size)
    ]
    actions = metadata.get("action_labels") or [f"action {i}" for i in range(task.action_size)]
    return list(observations), list(actions)


def _plot(folder: RunFolder, learner: KREPS) -> list[Path]:
    from kreps import plotting

    assert learner.env is not None
    environment = folder.config().environment
    rows = folder.rows()
    if not rows:
        raise ConfigurationError(f"{folder.progress_file} holds no iteration to draw")
    evaluation = folder.evaluation(learner.state.iteration)
    with console.status("drawing ..."):
        curve = plotting.learning_curve(
            rows, REFERENCE_REWARDS.get(environment, {}), evaluation, environment
        )
        drawn = [plotting.save(curve, folder.path / "learning_curve.png")]
        if learner.task.observation_size == 2:
            maps = plotting.policy_maps(
                learner.state, learner.task, *_labels(learner.env, learner.task)
            )
            drawn.append(plotting.save(maps, folder.path / "policy_maps.png"))
    return drawn


def _film(
    folder: RunFolder, learner: KREPS, steps: int, stochastic: bool, seed: int, out: Path | None
) -> Path:
    from kreps import plotting

    env = _make(folder.config().environment, render_mode="rgb_array")
    policy = Policy(learner.policy.process, seed)
    frames, observations, actions = [], [], []
    with console.status("filming ..."):
        try:
            observation, _ = env.reset(seed=seed)
            for _ in range(steps):
                action, _ = policy.predict(observation.ravel(), deterministic=not stochastic)
                frames.append(env.render())
                observations.append(observation.ravel())
                actions.append(action)
                space = env.action_space
                observation, _, terminated, truncated, _ = env.step(
                    action.astype(space.dtype).reshape(space.shape or ())
                )
                if terminated or truncated:
                    break
        except Exception as error:  # whatever a foreign environment raises
            raise EnvironmentFailure(
                f"the environment cannot be filmed, it raised {type(error).__name__}: {error}"
            ) from error
        return plotting.film(
            frames,
            observations=np.array(observations),
            actions=np.array(actions),
            state=learner.state,
            task=learner.task,
            labels=_labels(env, learner.task)[0],
            action_labels=_labels(env, learner.task)[1],
            fps=float(env.metadata.get("render_fps", 20)),
            path=out or folder.path / "video.gif",
        )


if __name__ == "__main__":
    main()
