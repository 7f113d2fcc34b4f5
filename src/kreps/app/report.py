"""The end of a run: evaluate the policy, draw its pictures, and say in words what was reached."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table

from kreps.algorithms.dual import Outcome
from kreps.app.diagnosis import Finding, diagnose, recorded
from kreps.app.run_folder import RunFolder
from kreps.data.task import TaskSpec
from kreps.envs.references import REFERENCE_RESTART_PROBABILITY, REFERENCE_REWARDS
from kreps.errors import ConfigurationError, EnvironmentFailure
from kreps.kernels.threads import blas_threads
from kreps.learning.environment import Environment, batch_model_of
from kreps.learning.evaluate import EPISODES, STEPS, Evaluation, evaluate, stochastic_and_greedy
from kreps.learning.methods import KREPS
from kreps.learning.policy import Policy
from kreps.learning.storage import write_atomically
from kreps.settings import LearnerSettings

console = Console()
MOST_FINDINGS = 3
"""Findings that the end of a run tells; `kreps diagnose` tells all."""


def say(message: str) -> None:
    """Plain words: no markup, as paths may hold brackets; no line breaks, as they may be long."""
    console.print(message, markup=False, highlight=False, soft_wrap=True)


def make_environment(environment: str, **options: Any) -> Environment:
    try:
        return gym.make(environment, **options)
    except Exception as error:  # whatever a foreign environment raises
        raise ConfigurationError(
            f"cannot make the environment {environment!r}: {error}; check its name, "
            "or write module:name to have its module imported first"
        ) from error


def report_run(folder: RunFolder, learner: KREPS) -> None:
    assert learner.env is not None
    if batch_model_of(learner.env) is None:  # steps may be slow, or those of a robot
        episodes, steps = 10, 200
        say(f"a short evaluation; `kreps evaluate {folder.path}` makes a full one")
    else:
        episodes, steps = EPISODES, STEPS
    evaluation = evaluate_run(folder, learner, episodes, steps, seed=0)
    pictures = plot_run(folder, learner)
    try:
        pictures.append(film_run(folder, learner, 120, False, 0, None))
    except (ConfigurationError, EnvironmentFailure) as error:
        say(f"no film: {error}")
    state = learner.state
    greedy = evaluation["greedy"].mean
    say(
        f"\n{state.iteration} updates from {state.rollouts} roll-outs "
        f"({state.steps} environment steps). The learnt policy earns {greedy:.4g} per step "
        f"without noise and {evaluation['stochastic'].mean:.4g} with it."
        + _in_words(_references(folder), greedy)
    )
    last = folder.rows()[-1]
    say(
        f"Last update {Outcome[last['outcome']]} (KL {float(last['kl']):.3f} of at most "
        f"{float(last['kl_bound']):g} nats, duality gap {float(last['gap']):.0e})."
    )
    _say_limits(folder)
    say(f"Policy:    {folder.policy_file}  (kreps.load_policy reads it)")
    say(f"Numbers:   {folder.progress_file}, {folder.evaluation_file}")
    for path in pictures:
        say(f"Picture:   {path}")
    say(f"Go on:     kreps resume {folder.path} --iterations {2 * state.iteration}")


def _say_limits(folder: RunFolder) -> None:
    """The gravest findings, with what to try."""
    findings = [f for f in diagnosis_of(folder) if f.severity != "fine"]
    for finding in findings[:MOST_FINDINGS]:
        say_finding(folder, finding)
    if findings:
        say(f"All of it on one page: kreps diagnose {folder.path}")
    else:
        say(f"Nothing stands out that holds it back (kreps diagnose {folder.path}).")


def say_finding(folder: RunFolder, finding: Finding) -> None:
    """In words; commands with the run's own folder."""
    say(f"{finding.severity.capitalize() + ':':<11}{finding.name}. {finding.sentence}")
    if finding.remedy:
        say(f"{'':<11}Try: {finding.remedy.replace('RUN', str(folder.path))}")


def say_diagnosis(folder: RunFolder) -> list[Finding]:
    """All findings, and what could not be judged."""
    findings = diagnosis_of(folder)
    for finding in findings:
        say_finding(folder, finding)
    if not recorded(_rows(folder)):
        say(
            "Not judged: what the version that made this run did not record (model, noise, clipped "
            "actions, cap of the basis); updates made with this one do."
        )
    return findings


def _rows(folder: RunFolder) -> list[dict[str, str]]:
    rows = folder.rows()
    if not rows:
        raise ConfigurationError(
            f"{folder.progress_file} holds no iteration yet; make the next update with "
            f"`kreps resume {folder.path}`"
        )
    return rows


def diagnosis_of(folder: RunFolder) -> list[Finding]:
    """What limits a run, from its files alone: no environment is made."""
    rows = _rows(folder)
    return diagnose(rows, folder.evaluation(int(rows[-1]["iteration"])), _references(folder))


def draw_diagnosis(folder: RunFolder, findings: list[Finding], path: Path) -> Path:
    from kreps import plotting
    from kreps.app import diagnosis_page

    page = diagnosis_page.page(
        _rows(folder),
        findings,
        _references(folder),
        f"{folder.config().environment}, {folder.path}",
    )
    return plotting.save(page, path)


def _references(folder: RunFolder) -> dict[str, float]:
    """The task's reference values, where they are of the process that was learnt on."""
    config = folder.config()
    # not all settings: those of a run of an earlier version may be none of this one
    default = LearnerSettings.restart_probability
    if config.settings.get("restart_probability", default) != REFERENCE_RESTART_PROBABILITY:
        return {}
    return REFERENCE_REWARDS.get(config.environment, {})


def _in_words(references: dict[str, float], reward: float) -> str:
    """How the reward stands to the task's reference values."""
    if not references:
        return ""
    (best_name, best), *others = references.items()
    worst_name, worst = others[-1]
    way = (reward - worst) / (best - worst)
    return (
        f" That is {way:.0%} of the way from {worst_name} ({worst:g}) "
        f"to the {best_name} ({best:g})."
    )


def evaluate_run(
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


def plot_run(folder: RunFolder, learner: KREPS) -> list[Path]:
    from kreps import plotting
    from kreps.app import plots

    assert learner.env is not None
    rows = folder.rows()
    if not rows:
        raise ConfigurationError(f"{folder.progress_file} holds no iteration to draw")
    evaluation = folder.evaluation(learner.state.iteration)
    with console.status("drawing ..."):
        curve = plots.learning_curve(
            rows, _references(folder), evaluation, folder.config().environment
        )
        drawn = [plotting.save(curve, folder.path / "learning_curve.png")]
        if learner.task.observation_size == 2:
            maps = plots.policy_maps(
                learner.state, learner.task, *_labels(learner.env, learner.task)
            )
            drawn.append(plotting.save(maps, folder.path / "policy_maps.png"))
    return drawn


def film_run(
    folder: RunFolder, learner: KREPS, steps: int, stochastic: bool, seed: int, out: Path | None
) -> Path:
    from kreps.app import plots

    path = out or folder.path / "video.gif"
    plots.check_film_name(path)
    env = make_environment(folder.config().environment, render_mode="rgb_array")
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
        finally:
            env.close()
        return plots.film(
            frames,
            observations=np.array(observations),
            actions=np.array(actions),
            state=learner.state,
            task=learner.task,
            labels=_labels(env, learner.task)[0],
            action_labels=_labels(env, learner.task)[1],
            fps=float(env.metadata.get("render_fps", 20)),
            path=path,
        )
