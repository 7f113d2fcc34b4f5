"""The command line: train, resume, evaluate, plot, diagnose, video, export, reproduce, search."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

import kreps
from kreps.app.report import (
    draw_diagnosis,
    evaluate_run,
    film_run,
    make_environment,
    plot_run,
    report_run,
    say,
    say_diagnosis,
)
from kreps.app.run_folder import RunConfig, RunFolder
from kreps.errors import ConfigurationError, EnvironmentFailure, KrepsError
from kreps.experiments.claims import write_claims
from kreps.experiments.executors import executor
from kreps.experiments.figures import draw_features, write_figure
from kreps.experiments.runner import figure_trials, run_trials
from kreps.experiments.search import CANDIDATES, search_trials, write_search
from kreps.experiments.specs import EXTRA_EXPERIMENTS, FIGURES, FIRST_SEED, PICTURES
from kreps.experiments.trials import name_of
from kreps.learning.environment import Environment
from kreps.learning.evaluate import EPISODES, STEPS
from kreps.learning.methods import KREPS
from kreps.learning.policy import load_policy, mean_difference
from kreps.presets import settings_of

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    help="Kernel-based, non-parametric policy search: REPS with RKHS embeddings.\n\n"
    "[bold]Start here:[/bold]  kreps train kreps/SwingUp-v0 --out runs/swing-up",
)

WorkersOption = Annotated[int, typer.Option(min=1, help="Processes side by side.")]
SchedulerOption = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Run on the Dask cluster of this scheduler instead."),
]
FAITHFUL = 0.02
"""Root mean square, in units of the action scale, up to which compressed policies of the swing-up
lost less than half a reward per step (benchmarks/predict.py)."""

EXPORTS = (".onnx", ".safetensors")
"""What `export` writes, by the end of the file's name."""

RunArgument = Annotated[Path, typer.Argument(help="Folder of the run.", show_default=False)]


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        say(f"kreps {kreps.__version__}")
        raise typer.Exit


# ---- commands ---------------------------------------------------------------------------------


@app.command(
    epilog="Examples:\n\n"
    "  kreps train kreps/SwingUp-v0 --iterations 20 --seed 0 --out runs/swing-up\n\n"
    "  kreps train kreps/SwingUp-v0 --preset paper --out runs/paper-like\n\n"
    "  kreps train kreps/ImageSwingUp-v0 --iterations 15 --out runs/images\n\n"
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
    preset: Annotated[
        str,
        typer.Option(
            help="default; observed: one step on the actions taken; paper: close to the printed "
            "method."
        ),
    ] = "default",
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
        preset=preset,
        settings=dict(_setting(text) for text in set_),
        periodic=periodic or None,
    )
    env = make_environment(environment)
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
    env = make_environment(config.environment)
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
    episodes: Annotated[int, typer.Option(min=2, help="Roll-outs per policy.")] = EPISODES,
    steps: Annotated[int, typer.Option(min=1, help="Steps of each, without restarts.")] = STEPS,
    seed: Annotated[int, typer.Option(min=0, help="Of the evaluation's random numbers.")] = 0,
) -> None:
    """Average reward per step of the learnt policy, with and without its exploration noise."""
    folder = RunFolder(run)
    learner = _learnt(folder)
    evaluate_run(folder, learner, episodes, steps, seed)


@app.command(epilog="Example:\n\n  kreps plot runs/swing-up")
def plot(run: RunArgument) -> None:
    """Draw the learning curve and, for two-dimensional states, maps of policy and V."""
    folder = RunFolder(run)
    for path in plot_run(folder, _learnt(folder)):
        say(f"drew {path}")


@app.command(
    epilog="Examples:\n\n"
    "  kreps diagnose runs/swing-up\n\n"
    "  kreps diagnose runs/swing-up --out swing-up.pdf"
)
def diagnose(
    run: RunArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A .png, .pdf or .svg file; diagnosis.png in the run if not given.",
        ),
    ] = None,
) -> None:
    """Say in words what limits a run and what to try, and draw it on one page.

    It looks at the transition model, the step, the effective samples, the basis of V, the
    exploration and the reward, each against a threshold. [bold]limit[/bold]: it holds the run
    back; [bold]note[/bold]: worth knowing; [bold]fine[/bold]: not the cause. Only the run's files
    are read, so no environment is needed; evaluate first, and the cost of the noise is told too.
    """
    from kreps.app.diagnosis_page import check_page_name

    folder = RunFolder(run)
    folder.config()  # complains of a folder that is no run
    out = out or folder.path / "diagnosis.png"
    check_page_name(out)
    findings = say_diagnosis(folder)
    say(f"drew {draw_diagnosis(folder, findings, out)}")


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
    say(f"filmed {film_run(folder, _learnt(folder), steps, stochastic, seed, out)}")


@app.command(
    epilog="Examples:\n\n"
    "  kreps export runs/swing-up --out policy.onnx\n\n"
    "  kreps export runs/swing-up --centres 50 --dtype float32 --out policy.onnx\n\n"
    "  kreps export runs/swing-up/policy.safetensors --centres 50 --out small.safetensors"
)
def export(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="RUN_OR_POLICY",
            help="Folder of the run, or a policy's .safetensors file.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="An .onnx file, or a .safetensors file for kreps.load_policy.")
    ],
    centres: Annotated[
        int | None,
        typer.Option(min=1, help="Compress to at most so many support points; all if not given."),
    ] = None,
    dtype: Annotated[
        str, typer.Option(help="float64 or float32, of a model's input and outputs.")
    ] = "float64",
) -> None:
    """Write the learnt policy for a controller: as an ONNX model, or compressed.

    A model needs no Python on the robot. Its input is [bold]observation[/bold] (batch, ds), its
    outputs are [bold]action[/bold] (batch, da), without exploration and within the limits, and
    [bold]standard_deviation[/bold] (batch, da). Writing it needs: pip install 'kreps\\[onnx]'.
    """
    if out.suffix not in EXPORTS:
        raise ConfigurationError(
            f"--out {out} is no name for a policy; end it in {' or '.join(EXPORTS)}"
        )
    file = _policy_file(source)
    policy = load_policy(file)
    if centres is not None:
        exact, policy = policy, policy.compressed(centres)
        if policy is not exact:
            off = mean_difference(exact, policy)
            say(f"compressed: at its samples the action is off by {off:.2g} of its scale (rms)")
            if off > FAITHFUL:
                say(
                    f"that is more than {FAITHFUL:g}: take more centres, or evaluate it before "
                    "its use"
                )
    if out.suffix == ".onnx":
        arithmetic = policy.export_onnx(out, dtype)
        how = f"a model with {arithmetic} arithmetic"
        if dtype == "float32" != arithmetic:
            how += " (float32 is too coarse for so many centres; --centres 50 mends that)"
    else:
        if dtype != "float64":
            raise ConfigurationError(
                f"--dtype {dtype}, but .safetensors files of kreps hold float64 only; leave it "
                "out, or write an .onnx file"
            )
        if out.resolve() == file.resolve():
            raise ConfigurationError(
                f"--out {out} is the file that is read; the exact policy would be lost, so choose "
                "another name"
            )
        policy.save(out)
        how = "a policy for kreps.load_policy"
    say(f"wrote {out}: {how}, {out.stat().st_size / 1e3:.0f} kB")


@app.command(
    epilog="Examples:\n\n"
    "  kreps reproduce figure-1b --trials 10 --workers 2\n\n"
    "  kreps reproduce all\n\n"
    "  kreps reproduce figure-1a --trials 2 --iterations 3 --out small\n\n"
    "  kreps reproduce figure-1b --scheduler tcp://head-node:8786"
)
def reproduce(
    figure: Annotated[
        str,
        typer.Argument(
            help=f"One of: {', '.join((*FIGURES, *PICTURES, 'all'))} (these); beyond the paper: "
            f"{', '.join(EXTRA_EXPERIMENTS)}."
        ),
    ],
    trials: Annotated[
        int,
        typer.Option(
            min=1,
            help=f"Seeds: from 0, or from {max(FIRST_SEED.values())} where fresh ones confirm.",
        ),
    ] = 10,
    workers: WorkersOption = 2,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Policy updates; the task's own if not given.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for results.")] = Path("results"),
    scheduler: SchedulerOption = None,
) -> None:
    """Repeat a figure of the paper over many seeds, draw it and test the paper's claims.

    Each trial (method x task x seed) is kept when it is done: stop at any time and call it again.
    Figures share trials, so [bold]all[/bold] costs less than its parts.
    """
    known = (*FIGURES, *PICTURES, "all", *EXTRA_EXPERIMENTS)
    if figure not in known:
        raise ConfigurationError(f"figure {figure!r} is unknown; choose one of {', '.join(known)}")
    wanted = (*FIGURES, *PICTURES) if figure == "all" else (figure,)
    command = f"kreps reproduce {figure} --trials {trials}"
    if iterations is not None:
        command += f" --iterations {iterations}"
    of_figures = {
        name: figure_trials(name, trials, iterations) for name in wanted if name not in PICTURES
    }
    results = []
    if of_figures:
        with executor(workers, scheduler) as pool:
            every_trial = [trial for of_figure in of_figures.values() for trial in of_figure]
            results = run_trials(every_trial, pool, out / "trials")
    for name in wanted:
        if name not in PICTURES:
            mine = {trial.name for trial in of_figures[name]}
            chosen = [result for result in results if name_of(result) in mine]
            for path in write_figure(out, name, command, chosen):
                say(f"wrote {path}")
        else:
            say(f"drew {draw_features(out / f'{name}.png')}")
    for path in write_claims(out):
        say(f"wrote {path}")


@app.command(epilog="Examples:\n\n  kreps search --workers 2\n\n  kreps search reaching --out try")
def search(
    tasks: Annotated[
        list[str] | None, typer.Argument(help=f"Some of: {', '.join(CANDIDATES)}; all if none.")
    ] = None,
    workers: WorkersOption = 2,
    out: Annotated[Path, typer.Option(help="Folder for results.")] = Path("results"),
    scheduler: SchedulerOption = None,
) -> None:
    """Search the parameters of every compared method: as many candidates for each, same seeds.

    The outcome is OUT/search.json.  Figures use the one in src/kreps/experiments: copy it there.
    """
    unknown = [task for task in tasks or () if task not in CANDIDATES]
    if unknown:
        raise ConfigurationError(
            f"task {unknown[0]!r} is unknown; choose some of {', '.join(CANDIDATES)}"
        )
    trials = [
        trial
        for task in tasks or CANDIDATES
        for method in CANDIDATES[task]
        for of_candidate in search_trials(task, method)
        for trial in of_candidate
    ]
    with executor(workers, scheduler) as pool:
        results = run_trials(trials, pool, out / "trials" / "search")
    command = " ".join(["kreps search", *(tasks or ())])
    say(f"wrote {write_search(out / 'search.json', command, tasks or list(CANDIDATES), results)}")


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


def _setting(text: str) -> tuple[str, Any]:
    """``name=value``; the value is read as JSON where it can be, and None as in Python."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ConfigurationError(f"--set {text!r} is not NAME=VALUE, such as kl_bound=0.5")
    if value == "None":
        return name, None
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def _learner(config: RunConfig, env: Environment) -> KREPS:
    settings_of(config.preset, **config.settings)  # complains of anything that is no setting
    return KREPS(
        env,
        seed=config.seed,
        preset=config.preset,
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
    return KREPS.resume(folder.checkpoint_file, make_environment(config.environment))


def _policy_file(source: Path) -> Path:
    """The policy of a run folder; any other path is that of a policy."""
    if not source.is_dir():
        return source
    folder = RunFolder(source)
    folder.config()  # complains of a folder that is no run
    if not folder.policy_file.exists():
        raise ConfigurationError(
            f"{source} has no policy yet; make the first update with `kreps resume {source}`"
        )
    return folder.policy_file


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
        report_run(folder, learner)
    else:
        say(f"policy: {folder.policy_file}")


if __name__ == "__main__":
    main()
