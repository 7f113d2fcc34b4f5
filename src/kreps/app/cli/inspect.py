"""The commands that look at a run: evaluate, plot, diagnose and video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kreps.app.cli.paths import PATH
from kreps.app.cli.runs import RunArgument, learnt, require_checkpoint
from kreps.app.console import say_command
from kreps.app.evaluation import evaluate_run, say_evaluation, write_evaluation
from kreps.app.pictures import draw_diagnosis, draw_run, film_run
from kreps.app.report import say_diagnosis
from kreps.app.run_folder import RunFolder
from kreps.checks import MAX_COUNT
from kreps.learning.environment import time_limit
from kreps.learning.episodes import LONGEST_EPISODE, evaluated_steps
from kreps.learning.evaluate import EPISODES, STEPS
from kreps.learning.methods import KREPS

EVALUATE_EXAMPLES = ("kreps evaluate runs/swing-up --episodes 200 --steps 400",)
PLOT_EXAMPLES = ("kreps plot runs/swing-up",)
DIAGNOSE_EXAMPLES = (
    "kreps diagnose runs/swing-up",
    "kreps diagnose runs/swing-up --out swing-up.pdf",
)
VIDEO_EXAMPLES = (
    "kreps video runs/swing-up",
    "kreps video runs/swing-up --steps 200 --stochastic --out swing-up.gif",
)


def evaluate(
    run: RunArgument,
    episodes: Annotated[
        int, typer.Option(min=2, max=MAX_COUNT, help="Rollouts per policy.")
    ] = EPISODES,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help=f"Steps of each, without restarts; {STEPS} if not given, or a longer time limit "
            f"of the environment up to {LONGEST_EPISODE}.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the evaluation.")] = 0,
) -> None:
    """Measure the average reward per step of the policy, with and without exploration noise.

    With a time limit or terminations, the return over whole episodes too.
    """
    folder = RunFolder(run)
    with learnt(folder) as learner:
        assert learner.env is not None
        steps = steps or evaluated_steps(STEPS, time_limit(learner.env))
        found, rollouts = evaluate_run(learner, episodes, steps, seed)
    say_evaluation(found)
    write_evaluation(folder, learner, found, rollouts, seed)


def plot(run: RunArgument) -> None:
    """Draw the learning curve, the evaluated rollouts, and maps for two-dimensional states.

    The rollouts are those that [bold]kreps evaluate[/bold] recorded, so the environment does not
    move.
    """
    folder = RunFolder(run)
    with learnt(folder) as learner:
        drawn = draw_run(folder, learner)
    for path in drawn:
        say_command("drew ", str(path))


def diagnose(
    run: RunArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A .png, .pdf or .svg file; diagnosis.png in the run if not given.", **PATH
        ),
    ] = None,
) -> None:
    """Explain what limits a run and what to try, and draw it on one page.

    The findings are about the dual solver, the step, the effective sample size, the acceptance
    test, each part of the model, the basis of V, the exploration, the reward, the returns and
    lengths of episodes, and idle columns of the observation, each compared with a threshold.
    [bold]limit[/bold]: it limits the run; [bold]note[/bold]: it may or may not;
    [bold]fine[/bold]: it does not.  Only the files of the run are read, so no environment is
    needed.  After an evaluation the cost of the exploration noise and the returns are included.
    """
    from kreps import plotting  # noqa: F401  (first, as it makes Matplotlib importable)
    from kreps.app.diagnosis_page import check_page_name

    folder = RunFolder(run)
    folder.config()  # an error if this is not a run folder
    out = out or folder.path / "diagnosis.png"
    check_page_name(out)
    findings = say_diagnosis(folder)
    say_command("drew ", str(draw_diagnosis(folder, findings, out)))


def video(
    run: RunArgument,
    steps: Annotated[int, typer.Option(min=1, help="Largest length of the rollout.")] = 120,
    stochastic: Annotated[bool, typer.Option(help="With exploration noise.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the rollout.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="A .gif file; video.gif in the run if not given.", **PATH)
    ] = None,
) -> None:
    """Film the policy in its environment."""
    folder = RunFolder(run)
    require_checkpoint(folder)
    learner = KREPS.resume(folder.checkpoint_file)
    path = film_run(folder, learner, steps, stochastic=stochastic, seed=seed, out=out)
    say_command("filmed ", str(path))
