"""One cell of an experiment: one method on one task with one seed, learnt and evaluated."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from kreps.errors import StorageError
from kreps.experiments.specs import METHODS, TASKS
from kreps.kernels.threads import blas_threads
from kreps.learning.evaluate import evaluate, stochastic_and_greedy
from kreps.learning.learner import LEARNERS, IterationReport, Learner
from kreps.learning.progress import seconds_by_stage
from kreps.learning.storage import write_atomically
from kreps.settings import OnPolicySettings


@dataclass(frozen=True)
class Trial:
    """What one worker is asked to do; made of plain values, so that it travels between processes.

    Attributes:
        task, method: names that are shown.
        environment: Gymnasium name.
        learner: a name of `kreps.learner.LEARNERS`.
        options: of its constructor.
        iterations, seed: as it takes them.
        episodes: of the evaluations on the way, and of the last one.
        label: tells apart cells of one method with other options.
    """

    task: str
    method: str
    environment: str
    learner: str
    options: Mapping[str, Any]
    iterations: int
    seed: int
    episodes: tuple[int, int]
    label: str = ""

    @property
    def name(self) -> str:
        return f"{_slug(self.task)}/{_slug(f'{self.method} {self.label} seed {self.seed}')}"

    def description(self) -> dict[str, Any]:
        """As it is read back from a file."""
        plain: dict[str, Any] = json.loads(json.dumps({**vars(self), "options": {**self.options}}))
        return plain

    @property
    def work(self) -> str:
        """What is to be done, whatever it is called: cells that agree in it have one result."""
        names = ("task", "method", "label")
        work = {k: v for k, v in self.description().items() if k not in names}
        return json.dumps(work, sort_keys=True)

    def named(self, result: Mapping[str, Any]) -> dict[str, Any]:
        """The result of a cell of the same work as that of this one."""
        rows = [{**row, "task": self.task, "method": self.method} for row in result["rows"]]
        return {**result, "cell": self.description(), "rows": rows}


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def trial_of(
    task_name: str,
    method_name: str,
    seed: int,
    options: Mapping[str, Any],
    *,
    iterations: int | None,
    episodes: tuple[int, int],
    label: str = "",
) -> Trial:
    """The cell of a task, a method and a seed, with ``options`` beside the method's own."""
    task, method = TASKS[task_name], METHODS[method_name]
    explores = issubclass(LEARNERS[method.learner].settings_type, OnPolicySettings)
    protocol = dict(task.exploration) if explores else {"ranges": task.ranges}
    wanted = task.iterations if iterations is None else iterations
    return Trial(
        task=task_name,
        method=method_name,
        environment=task.environment,
        learner=method.learner,
        options={**protocol, **method.options, **options},
        iterations=1 if method.once else wanted,
        seed=seed,
        episodes=episodes,
        label=label,
    )


def run_cell(cell: Trial) -> dict[str, Any]:
    """Learn, and evaluate the policy after every iteration on random numbers of its own.

    Returns:
        The cell's description and one row per iteration.
    """
    env = gym.make(cell.environment)
    rows: list[dict[str, Any]] = []

    def evaluated(learner: Learner[Any], report: IterationReport) -> None:
        assert learner.state.policy is not None
        row: dict[str, Any] = {
            "task": cell.task,
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
                    episodes=cell.episodes[report.iteration == cell.iterations],
                    seed=cell.seed,
                )
            row[name] = found.mean
            row[f"{name}_standard_error"] = found.standard_error
        stages = seconds_by_stage(report)
        row["rollout_cpu_seconds"] = stages.pop("rollouts")
        row["update_cpu_seconds"] = sum(stages.values())
        row["samples"] = report.update.samples
        rows.append({**row, **report.update.numbers()})

    learner = LEARNERS[cell.learner](env, seed=cell.seed, **cell.options)
    learner.learn(cell.iterations, callback=evaluated, progress=False)
    return {"cell": cell.description(), "rows": rows}


def read_cell(cell: Trial, folder: Path) -> dict[str, Any] | None:
    """The result of this very cell if it is there and whole; None if it has to be run."""
    path = folder / f"{cell.name}.json"
    try:
        found = json.loads(path.read_text())
        same = found["cell"] == cell.description()
        whole = len(found["rows"]) == cell.iterations and isinstance(found["commit"], str)
        return found if same and whole else None
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StorageError(
            f"{path} is damaged ({error}); remove it to run the cell again"
        ) from error


def write_cell(cell: Trial, folder: Path, result: dict[str, Any]) -> None:
    path = folder / f"{cell.name}.json"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {path.parent}: {error}") from error
    write_atomically(path, (json.dumps(result) + "\n").encode())


def name_of(result: Mapping[str, Any]) -> str:
    """The name of the cell that a result is of."""
    return Trial(**result["cell"]).name


def commits_of(results: Sequence[Mapping[str, Any]]) -> str:
    """The commits at which the cells were run: one, if all went well."""
    return ", ".join(sorted({result["commit"] for result in results}))
