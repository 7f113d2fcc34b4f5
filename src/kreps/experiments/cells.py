"""One cell of an experiment: one method on one task with one seed, learnt and evaluated."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from kreps.errors import StorageError
from kreps.evaluation import evaluate, stochastic_and_greedy
from kreps.learner import KREPS, IterationReport
from kreps.progress import seconds_by_stage
from kreps.storage import write_atomically
from kreps.threads import blas_threads


@dataclass(frozen=True)
class Cell:
    """What one worker is asked to do; made of plain values, so that it travels between processes.

    Attributes:
        method: name that is shown.
        recipe, settings: as `kreps.KREPS` takes them.
        environment, iterations, seed: likewise.
    """

    method: str
    recipe: str
    settings: Mapping[str, Any]
    environment: str
    iterations: int
    seed: int

    @property
    def name(self) -> str:
        return f"{re.sub(r'[^a-z0-9]+', '-', self.method.lower()).strip('-')}-seed-{self.seed}"

    def description(self) -> dict[str, Any]:
        return {**vars(self), "settings": dict(self.settings)}


def run_cell(cell: Cell) -> dict[str, Any]:
    """Learn, and evaluate the policy after every iteration on random numbers of its own.

    Returns:
        The cell's description and one row per iteration.
    """
    env = gym.make(cell.environment)
    rows: list[dict[str, Any]] = []

    def evaluated(learner: KREPS, report: IterationReport) -> None:
        assert learner.state.policy is not None
        row: dict[str, Any] = {
            "method": cell.method,
            "seed": cell.seed,
            "iteration": report.iteration,
            "steps": report.steps,
            "training_reward": report.average_reward,
        }
        for name, policy in stochastic_and_greedy(learner.state.policy).items():
            with blas_threads(1):
                found = evaluate(
                    env,
                    learner.task,
                    policy,
                    restart_probability=learner.settings.restart_probability,
                    seed=cell.seed,
                )
            row[name] = found.mean
            row[f"{name}_standard_error"] = found.standard_error
        stages = seconds_by_stage(report)
        row["rollout_cpu_seconds"] = stages.pop("rollouts")
        row["update_cpu_seconds"] = sum(stages.values())
        row["kl"] = report.update.dual.kl
        row["eta"] = report.update.dual.eta
        row["gap"] = report.update.dual.gap
        row["effective_samples"] = report.update.effective_samples
        row["samples"] = report.update.samples
        rows.append(row)

    learner = KREPS(env, seed=cell.seed, recipe=cell.recipe, **cell.settings)
    learner.learn(cell.iterations, callback=evaluated, progress=False)
    return {"cell": cell.description(), "rows": rows}


def read_cell(cell: Cell, folder: Path) -> dict[str, Any] | None:
    """The result of this very cell if it is there and whole; None if it has to be run."""
    path = folder / f"{cell.name}.json"
    try:
        found = json.loads(path.read_text())
        same = found["cell"] == json.loads(json.dumps(cell.description()))
        whole = len(found["rows"]) == cell.iterations and isinstance(found["commit"], str)
        return found if same and whole else None
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StorageError(
            f"{path} is damaged ({error}); remove it to run the cell again"
        ) from error


def write_cell(cell: Cell, folder: Path, result: dict[str, Any]) -> None:
    write_atomically(folder / f"{cell.name}.json", (json.dumps(result) + "\n").encode())
