"""Evaluation of a run's policy, with and without its exploration noise."""

from __future__ import annotations

import json
from dataclasses import asdict

from rich.table import Table

from kreps.app.console import console
from kreps.app.run_folder import RunFolder
from kreps.kernels.threads import blas_threads
from kreps.learning.evaluate import Evaluation, evaluate, stochastic_and_greedy
from kreps.learning.methods import KREPS
from kreps.learning.storage import write_atomically


def evaluate_run(
    folder: RunFolder, learner: KREPS, episodes: int, steps: int, seed: int
) -> dict[str, Evaluation]:
    """Average reward per step of the stochastic and the greedy policy.

    The result is printed as a table and written to ``evaluation.json``.

    Args:
        folder: of the run.
        learner: with an environment and at least one update.
        episodes: rollouts per policy.
        steps: largest length of each, without restarts.
        seed: of the evaluation.
    """
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
    table = Table(title=f"Average reward per step, {episodes} rollouts of up to {steps} steps")
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
