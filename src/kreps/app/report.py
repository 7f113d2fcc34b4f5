"""What a run prints: its findings, and a summary at its end."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from kreps.algorithms.dual import Outcome
from kreps.app.console import say, say_command
from kreps.app.diagnosis import Finding, diagnose
from kreps.app.diagnosis.columns import all_recorded
from kreps.app.environments import references_of
from kreps.app.evaluation import evaluate_run, write_evaluation
from kreps.app.pictures import draw_run, film_run
from kreps.app.run_folder import RunFolder
from kreps.errors import KrepsError
from kreps.learning.environment import batch_model_of, time_limit
from kreps.learning.episodes import EpisodicReturn, evaluated_steps
from kreps.learning.evaluate import EPISODES, STEPS, Evaluation
from kreps.learning.methods import KREPS

SHORT_EVALUATION = 10, 200
"""Episodes and steps where the environment has no batch model and its steps may be slow."""

LABEL = 11
"""Characters of the labels at the start of lines."""

SHOWN_FINDINGS = 3
"""Findings printed at the end of a run; `kreps diagnose` prints all."""


def evaluate_at_end(folder: RunFolder, learner: KREPS) -> dict[str, Evaluation]:
    """Evaluate the policy at the end of its training, in the environment it was learnt in.

    Returns:
        The evaluation of both policies; empty if it failed, which is printed.
    """
    assert learner.env is not None
    episodes, steps = EPISODES, STEPS
    if batch_model_of(learner.env) is None:
        episodes, steps = SHORT_EVALUATION
        say(f"a short evaluation; `kreps evaluate {folder.path}` makes a full one")
    steps = evaluated_steps(steps, time_limit(learner.env))
    measured = _attempt("evaluation", lambda: evaluate_run(learner, episodes, steps, seed=0))
    if measured is None:
        return {}
    _attempt("evaluation.json", lambda: write_evaluation(folder, learner, *measured, seed=0))
    return measured[0]


def report_run(folder: RunFolder, learner: KREPS, evaluation: Mapping[str, Evaluation]) -> None:
    """Print the main findings and a summary, then draw the pictures.

    The pictures come last, and none of them ends the report: code of the environment draws, which
    may fail, wait or end the program.

    Args:
        folder: of the run.
        learner: its environment should be closed already, as another one is made for the film.
        evaluation: of its policy; may be empty.
    """
    _attempt("findings", lambda: say_main_findings(folder))
    _say_summary(folder, learner, evaluation)
    say_command("Policy:    ", f"{folder.policy_file}  (kreps.load_policy reads it)")
    say_command("Numbers:   ", f"{folder.progress_file}, {folder.evaluation_file}")
    more = 2 * learner.state.iteration
    say_command("Continue:  ", f"kreps resume {folder.path} --iterations {more}")
    _attempt("pictures", lambda: _say_pictures(draw_run(folder, learner)))
    _attempt("film", lambda: _say_pictures([film_run(folder, learner)]))


Result = TypeVar("Result")


def _attempt(what: str, part: Callable[[], Result]) -> Result | None:
    """A part of the report; if it fails, that is printed, and the other parts are made."""
    try:
        return part()
    except KrepsError as error:
        say(f"no {what}: {error}")
    except (Exception, SystemExit) as error:  # whatever foreign code raises
        say(f"no {what}: {type(error).__name__}: {error}")
    return None


def _say_pictures(paths: Iterable[Path]) -> None:
    for path in paths:
        say_command("Picture:   ", str(path))


def _say_summary(folder: RunFolder, learner: KREPS, evaluation: Mapping[str, Evaluation]) -> None:
    state, rows = learner.state, folder.rows()
    seconds = learner.task.robot_seconds(state.steps)
    robot_time = "" if seconds is None else f", {seconds:.1f} s of robot time"
    text = (
        f"\n{state.iteration} updates from {state.rollouts} rollouts "
        f"({state.steps} environment steps{robot_time})."
    )
    if evaluation:
        greedy, stochastic = evaluation["greedy"], evaluation["stochastic"]
        text += (
            f" The learnt policy earns {_with_error(greedy)} per step without noise and "
            f"{_with_error(stochastic)} with it (± 2 standard errors)."
            + compared(greedy.mean, references_of(folder.config()))
            + _returns(greedy.episodic, stochastic.episodic)
        )
    elif rows:
        text += f" The last training rollouts earned {float(rows[-1]['average_reward']):.4g}."
    say(text)
    if rows:
        last = rows[-1]
        say(
            f"Last update {Outcome[last['outcome']]} (KL {float(last['kl']):.3g} of at most "
            f"{float(last['kl_bound']):g} nats, duality gap {float(last['gap']):.0e})."
        )


def _with_error(result: Evaluation | EpisodicReturn) -> str:
    return f"{result.mean:.4g} ± {2 * result.standard_error:.2g}"


def _returns(greedy: EpisodicReturn | None, stochastic: EpisodicReturn | None) -> str:
    """A sentence with the returns over whole episodes; empty where the task ends none."""
    if greedy is None or stochastic is None:
        return ""
    return (
        f" Whole episodes return {_with_error(greedy)} without noise, in {greedy.length:.4g} steps "
        f"on average, and {_with_error(stochastic)} with it, in {stochastic.length:.4g}."
    )


def compared(reward: float, references: Mapping[str, float]) -> str:
    """A sentence that compares a reward with the best and worst reference; empty without any."""
    if not references:
        return ""
    (best_name, best), *others = references.items()
    worst_name, worst = others[-1]
    way = (reward - worst) / (best - worst)
    return (
        f" That is {way:.0%} of the way from {worst_name} ({worst:g}) "
        f"to the {best_name} ({best:g})."
    )


# ---- findings ---------------------------------------------------------------------------------


def diagnosis_of(folder: RunFolder) -> list[Finding]:
    """The findings about a run, from its files alone, with its folder in their commands.

    Raises:
        ConfigurationError: the run has no iteration yet.
    """
    rows, config = folder.recorded_rows(), folder.config()
    iteration = int(rows[-1]["iteration"])
    found = diagnose(
        rows,
        folder.evaluation(iteration),
        references_of(config),
        _attempt("findings about samples", folder.window),
        _attempt("findings about episodes", lambda: folder.evaluation_rollouts(iteration)),
    )
    if config.data:  # one update, and no environment in which the run could go on
        found = [
            replace(f, remedy=re.sub(r" \(kreps resume RUN[^)]*\)", "", f.remedy))
            for f in found
            if f.name != "progress"
        ]
    return [replace(f, remedy=f.remedy.replace("RUN", str(folder.path))) for f in found]


def say_finding(finding: Finding) -> None:
    """Print a finding and its remedy."""
    label = f"{finding.severity.capitalize()}:"
    say(f"{label:<{LABEL}}{finding.name}. {finding.sentence}", indent=LABEL)
    if finding.remedy:
        say(f"{'':<{LABEL}}Try: {finding.remedy}", indent=LABEL)


def say_main_findings(folder: RunFolder) -> None:
    """Print the most severe findings that are not fine."""
    findings = [f for f in diagnosis_of(folder) if f.severity != "fine"]
    for finding in findings[:SHOWN_FINDINGS]:
        say_finding(finding)
    if findings:
        say_command("All findings on one page: ", f"kreps diagnose {folder.path}")
    else:
        say(f"No finding limits this run (kreps diagnose {folder.path}).")


def say_diagnosis(folder: RunFolder) -> list[Finding]:
    """Print all findings, and which ones are missing in a run of an earlier version."""
    findings = diagnosis_of(folder)
    for finding in findings:
        say_finding(finding)
    if not all_recorded(folder.recorded_rows()):
        say(
            "Not recorded by the version that made the last update: model error, policy noise, "
            "clipped actions, largest rank of the basis. An update with this version records them."
        )
    return findings
