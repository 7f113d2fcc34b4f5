"""One trial of an experiment: one method on one task with one seed, learnt and evaluated."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kreps.errors import StorageError
from kreps.experiments.fingerprint import Fingerprint, recorded
from kreps.experiments.specs import METHODS, TASKS
from kreps.kernels.threads import blas_threads
from kreps.learning.environment import opened
from kreps.learning.evaluate import evaluate, stochastic_and_greedy
from kreps.learning.iteration import IterationReport
from kreps.learning.learner import Learner
from kreps.learning.methods import LEARNERS
from kreps.learning.progress import seconds_by_stage
from kreps.learning.storage import write_atomically
from kreps.presets import flat
from kreps.settings import OnPolicySettings


@dataclass(frozen=True)
class Trial:
    """The work of one worker process, in plain values that can be sent between processes.

    Attributes:
        task, method: names that figures show.
        environment: Gymnasium name.
        learner: key of `kreps.learning.learner.LEARNERS`.
        options: of the learner's constructor, plain JSON values.
        iterations: policy updates.
        seed: of the learner and of the evaluation.
        episodes: evaluation rollouts after each update but the last, and after the last one.
        label: distinguishes trials of one method with different options.
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
        """Path of the result file inside the folder of trials, without its ending."""
        return f"{_slug(self.task)}/{_slug(f'{self.method} {self.label} seed {self.seed}')}"

    def description(self) -> dict[str, Any]:
        """All fields in the form that a JSON file returns them in."""
        plain: dict[str, Any] = json.loads(json.dumps({**vars(self), "options": {**self.options}}))
        return plain

    @property
    def curve(self) -> tuple[str, str, str]:
        """What the trials of different seeds have in common."""
        return self.task, self.method, self.label

    @property
    def work(self) -> str:
        """All fields except the displayed names: trials that agree in it have the same result."""
        names = ("task", "method", "label")
        work = {k: v for k, v in self.description().items() if k not in names}
        return json.dumps(work, sort_keys=True)

    def renamed(self, result: Mapping[str, Any]) -> dict[str, Any]:
        """The result of a trial with the same work, under the names of this one."""
        rows = [{**row, "task": self.task, "method": self.method} for row in result["rows"]]
        return {**result, "trial": self.description(), "rows": rows}


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
    """The trial of a task, a method and a seed.

    Args:
        task_name, method_name: keys of `TASKS` and `METHODS`.
        seed, episodes, label: see `Trial`.
        options: replace those of the task and the method.
        iterations: policy updates; None takes the number that the task prescribes.  A method with
            ``once`` gets one.
    """
    task, method = TASKS[task_name], METHODS[method_name]
    explores = issubclass(LEARNERS[method.learner].settings_type, OnPolicySettings)
    protocol = dict(task.exploration) if explores else {"ranges": task.ranges}
    wanted = task.iterations if iterations is None else iterations
    return Trial(
        task=task_name,
        method=method_name,
        environment=task.environment,
        learner=method.learner,
        options={**protocol, **task.options, **method.options, **options},
        iterations=1 if method.once else wanted,
        seed=seed,
        episodes=episodes,
        label=label,
    )


def run_recorded(trial: Trial) -> dict[str, Any]:
    """`run_trial` with the fingerprint of the code that it called as ``code``."""
    with recorded() as code:
        result = run_trial(trial)
    return {**result, "code": code}


def run_trial(trial: Trial) -> dict[str, Any]:
    """Learn; after every iteration evaluate the policy on random numbers of its own.

    Returns:
        ``trial``: its description; ``settings``: their values, with all defaults; ``code``: empty;
        ``rows``: one per iteration.
    """
    rows: list[dict[str, Any]] = []

    def add_row(learner: Learner[Any], report: IterationReport) -> None:
        assert learner.env is not None and learner.state.policy is not None
        row: dict[str, Any] = {
            "task": trial.task,
            "method": trial.method,
            "seed": trial.seed,
            "iteration": report.iteration,
            "steps": report.steps,
            "training_reward": report.average_reward,
        }
        for name, policy in stochastic_and_greedy(learner.state.policy).items():
            with blas_threads(1):
                evaluation = evaluate(
                    learner.env,
                    learner.task,
                    policy,
                    restart_probability=learner.restart_probability,
                    episodes=trial.episodes[report.iteration == trial.iterations],
                    seed=trial.seed,
                )
            row[name] = evaluation.mean
            row[f"{name}_standard_error"] = evaluation.standard_error
        stages = seconds_by_stage(report)
        row["rollout_cpu_seconds"] = stages.pop("rollouts")
        row["update_cpu_seconds"] = sum(stages.values())
        row["samples"] = report.update.samples
        rows.append({**row, **report.update.numbers()})

    with opened(trial.environment) as env:
        learner = LEARNERS[trial.learner](env, seed=trial.seed, **trial.options)
        learner.learn(trial.iterations, callback=add_row, progress=False)
    settings = settings_of_trial(trial)
    return {"trial": trial.description(), "settings": settings, "code": {}, "rows": rows}


def settings_of_trial(trial: Trial) -> dict[str, Any]:
    """What decides the result of a trial besides the code, the seed and the iterations."""
    with opened(trial.environment) as env:
        learner = LEARNERS[trial.learner](env, **trial.options)
    values = {
        "environment": trial.environment,
        "learner": trial.learner,
        "episodes": trial.episodes,
        **flat(learner.settings),
    }
    plain: dict[str, Any] = json.loads(json.dumps(values))
    return plain


def read_trial(trial: Trial, folder: Path) -> dict[str, Any] | None:
    """The result in the folder; None if there is none, or one of other settings or iterations,
    or of before results had a fingerprint.

    Raises:
        StorageError: the file is damaged.
    """
    path = folder / f"{trial.name}.json"
    try:
        result = json.loads(path.read_text())
        same = result["trial"] == trial.description() and "code" in result
        complete = len(result["rows"]) == trial.iterations and isinstance(result["commit"], str)
        return result if same and complete else None
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StorageError(
            f"{path} is damaged ({error}); remove it to run the trial again"
        ) from error


def write_trial(trial: Trial, folder: Path, result: dict[str, Any]) -> None:
    """Write a result to the file that `read_trial` reads.

    Raises:
        StorageError: the folder cannot be made or the file not be written.
    """
    path = folder / f"{trial.name}.json"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {path.parent}: {error}") from error
    write_atomically(path, (json.dumps(result) + "\n").encode())


def name_of(result: Mapping[str, Any]) -> str:
    """The name of the trial that a result belongs to."""
    return Trial(**result["trial"]).name


def code_of(results: Sequence[Mapping[str, Any]]) -> Fingerprint:
    """The fingerprints of all trials in one."""
    return dict(sorted({k: v for result in results for k, v in result["code"].items()}.items()))


def commits_of(results: Sequence[Mapping[str, Any]]) -> str:
    """The different commits that the trials were run at, separated by commas."""
    return ", ".join(sorted({result["commit"] for result in results}))
