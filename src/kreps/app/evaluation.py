"""Evaluation of a run's policy, with and without its exploration noise."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace

from rich.table import Table

from kreps.app.console import console, say
from kreps.app.run_folder import RunFolder
from kreps.data.rollouts import Rollouts
from kreps.kernels.threads import blas_threads
from kreps.learning.environment import time_limit
from kreps.learning.episodes import EpisodicReturn, episodic_return
from kreps.learning.evaluate import (
    Evaluation,
    discounted_average,
    evaluation_rollouts,
    stochastic_and_greedy,
)
from kreps.learning.methods import KREPS
from kreps.learning.storage import save_rollouts, write_atomically

STORED_ROLLOUTS, STORED_NUMBERS = 10, 500_000
"""Largest number of rollouts of the greedy policy that are stored, and of numbers in them."""


def evaluate_run(
    learner: KREPS, episodes: int, steps: int, seed: int
) -> tuple[dict[str, Evaluation], Rollouts]:
    """Average reward per step of the stochastic and the greedy policy, and return per episode.

    Args:
        learner: with an environment and at least one update.
        episodes: rollouts per policy.
        steps: largest length of each, without restarts.
        seed: of the evaluation.

    Returns:
        The evaluation by policy, and the rollouts of the greedy policy.
    """
    assert learner.env is not None and learner.state.policy is not None
    found, limit = {}, time_limit(learner.env)
    with console().status("evaluating ..."), blas_threads(1):
        for name, policy in stochastic_and_greedy(learner.state.policy).items():
            rollouts = evaluation_rollouts(
                learner.env, learner.task, policy, episodes=episodes, steps=steps, seed=seed
            )
            repeat = learner.task.action_repeat
            average = discounted_average(rollouts, learner.restart_probability, repeat)
            episodic = episodic_return(rollouts, steps, limit, repeat)
            found[name] = replace(average, episodic=episodic)
    return found, rollouts  # of the greedy policy, the last one


def say_evaluation(found: Mapping[str, Evaluation]) -> None:
    """Print an evaluation as a table, with the returns where the task ends episodes."""
    first = next(iter(found.values()))
    say(f"Average reward per step, {first.episodes} rollouts of up to {first.steps} steps:")
    table = Table()
    headings = ["policy", "mean", "2 s.e."]
    episodic = [result.episodic for result in found.values() if result.episodic is not None]
    if episodic:
        headings += ["return per episode", "2 s.e.", "steps"]
    for heading in headings:
        table.add_column(heading)
    for name, result in found.items():
        cells = [name, *_with_error(result)]
        if result.episodic is not None:
            cells += [*_with_error(result.episodic), f"{result.episodic.length:.4g}"]
        table.add_row(*cells)
    console().print(table)
    cut = max((1.0 - each.whole for each in episodic), default=0.0)
    if cut > 0.0:
        say(
            f"Up to {cut:.0%} of the episodes were cut at {first.steps} steps, and their return "
            "lacks what would have followed; --steps follows them longer."
        )


def _with_error(result: Evaluation | EpisodicReturn) -> tuple[str, str]:
    return f"{result.mean:.5g}", f"{2 * result.standard_error:.2g}"


def write_evaluation(
    folder: RunFolder,
    learner: KREPS,
    found: Mapping[str, Evaluation],
    rollouts: Rollouts,
    seed: int,
) -> None:
    """Write an evaluation of the learner's policy.

    It is written to ``evaluation.json``, and the first rollouts of the greedy policy to
    ``evaluation_rollouts.safetensors``.
    """
    content = {
        "iteration": learner.state.iteration,
        "environment_steps": learner.state.steps,
        "seed": seed,
        **{name: asdict(result) for name, result in found.items()},
    }
    folder.remove_evaluation_rollouts()  # never those of another policy beside this evaluation
    write_atomically(folder.evaluation_file, (json.dumps(content, indent=2) + "\n").encode())
    save_rollouts(_stored(rollouts), folder.rollouts_file)


def _stored(rollouts: Rollouts) -> Rollouts:
    """The first rollouts, fewer where an observation has many numbers, but at least one."""
    numbers = rollouts.points.shape[1] + rollouts.actions.shape[1] + 1
    fitting = STORED_NUMBERS // (numbers * int(rollouts.lengths.max()))
    return rollouts[: max(1, min(STORED_ROLLOUTS, fitting))]
