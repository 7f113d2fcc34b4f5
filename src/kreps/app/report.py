"""What a run prints: its findings, and a summary at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from kreps.algorithms.dual import Outcome
from kreps.app.console import say
from kreps.app.diagnosis import Finding, diagnose
from kreps.app.diagnosis.columns import all_recorded
from kreps.app.environments import references_of
from kreps.app.evaluation import evaluate_run
from kreps.app.pictures import draw_run, film_run
from kreps.app.run_folder import RunFolder
from kreps.errors import ConfigurationError, EnvironmentFailure
from kreps.learning.environment import batch_model_of
from kreps.learning.evaluate import EPISODES, STEPS, Evaluation
from kreps.learning.methods import KREPS

SHORT_EVALUATION = 10, 200
"""Episodes and steps where the environment has no batch model and its steps may be slow."""

SHOWN_FINDINGS = 3
"""Findings printed at the end of a run; `kreps diagnose` prints all."""


def evaluate_at_end(folder: RunFolder, learner: KREPS) -> dict[str, Evaluation]:
    """Evaluate the policy at the end of its training, in the environment it was learnt in."""
    assert learner.env is not None
    episodes, steps = EPISODES, STEPS
    if batch_model_of(learner.env) is None:
        episodes, steps = SHORT_EVALUATION
        say(f"a short evaluation; `kreps evaluate {folder.path}` makes a full one")
    return evaluate_run(folder, learner, episodes, steps, seed=0)


def report_run(folder: RunFolder, learner: KREPS, evaluation: Mapping[str, Evaluation]) -> None:
    """Draw the pictures, and print a summary with the main findings.

    Args:
        folder: of the run.
        learner: its environment should be closed already, as another one is made for the film.
        evaluation: of its policy.
    """
    pictures = draw_run(folder, learner)
    try:
        pictures.append(film_run(folder, learner))
    except (ConfigurationError, EnvironmentFailure) as error:
        say(f"no film: {error}")
    _say_summary(folder, learner, evaluation)
    say_main_findings(folder)
    _say_files(folder, pictures)
    say(f"Continue:  kreps resume {folder.path} --iterations {2 * learner.state.iteration}")


def _say_summary(folder: RunFolder, learner: KREPS, evaluation: Mapping[str, Evaluation]) -> None:
    state, greedy = learner.state, evaluation["greedy"].mean
    say(
        f"\n{state.iteration} updates from {state.rollouts} rollouts "
        f"({state.steps} environment steps). The learnt policy earns {greedy:.4g} per step "
        f"without noise and {evaluation['stochastic'].mean:.4g} with it."
        + compared(greedy, references_of(folder.config()))
    )
    last = folder.rows()[-1]
    say(
        f"Last update {Outcome[last['outcome']]} (KL {float(last['kl']):.3f} of at most "
        f"{float(last['kl_bound']):g} nats, duality gap {float(last['gap']):.0e})."
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


def _say_files(folder: RunFolder, pictures: Sequence[Path]) -> None:
    say(f"Policy:    {folder.policy_file}  (kreps.load_policy reads it)")
    say(f"Numbers:   {folder.progress_file}, {folder.evaluation_file}")
    for path in pictures:
        say(f"Picture:   {path}")


# ---- findings ---------------------------------------------------------------------------------


def diagnosis_of(folder: RunFolder) -> list[Finding]:
    """The findings about a run, from its files alone, with its folder in their commands.

    Raises:
        ConfigurationError: the run has no iteration yet.
    """
    rows = folder.recorded_rows()
    evaluation = folder.evaluation(int(rows[-1]["iteration"]))
    found = diagnose(rows, evaluation, references_of(folder.config()))
    return [replace(f, remedy=f.remedy.replace("RUN", str(folder.path))) for f in found]


def say_finding(finding: Finding) -> None:
    """Print a finding and its remedy."""
    say(f"{finding.severity.capitalize() + ':':<11}{finding.name}. {finding.sentence}")
    if finding.remedy:
        say(f"{'':<11}Try: {finding.remedy}")


def say_main_findings(folder: RunFolder) -> None:
    """Print the most severe findings that are not fine."""
    findings = [f for f in diagnosis_of(folder) if f.severity != "fine"]
    for finding in findings[:SHOWN_FINDINGS]:
        say_finding(finding)
    if findings:
        say(f"All findings on one page: kreps diagnose {folder.path}")
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
