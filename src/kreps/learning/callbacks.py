"""Callbacks of `Learner.learn`, with the names that they have in Stable-Baselines3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kreps.errors import ConfigurationError, StorageError
from kreps.kernels.threads import blas_threads
from kreps.learning.evaluate import STEPS, Evaluation, Greedy, evaluate
from kreps.learning.iteration import IterationReport
from kreps.learning.learner import Learner, whole_number
from kreps.learning.wrappers import Environment


class Checkpoint:
    """Keeps checkpoints of some iterations, from which `kreps.KREPS.resume` continues.

    Args:
        folder: for the files, which are named by the iteration, as ``000010.safetensors``.  It is
            made unless it is there.
        every: iterations from one checkpoint to the next.

    Raises:
        ConfigurationError: ``every`` is no whole number >= 1.
    """

    def __init__(self, folder: str | Path, every: int = 1) -> None:
        self.folder, self.every = Path(folder), _period(every)

    def __call__(self, learner: Learner[Any], report: IterationReport) -> None:
        if report.iteration % self.every:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot make the folder {self.folder}: {error}") from error
        learner.save(self.folder / f"{report.iteration:06}.safetensors")


class EvalCallback:
    """Evaluates the policy in rollouts that are not learnt from, and keeps the best policy.

    All policies are evaluated with the same random numbers.  What is learnt does not depend on it.

    Args:
        env: to evaluate in; None takes the learner's.  On a robot each evaluation takes robot time,
            which is not counted among the steps of the learner.
        every: iterations from one evaluation to the next.
        episodes: rollouts of an evaluation.
        steps: of the environment in each rollout, unless the task ends before.
        deterministic: whether to evaluate without exploration noise.
        best: file for the best policy so far, which `kreps.load_policy` reads; None writes none.
        seed: of the rollouts.

    Attributes:
        evaluations: environment steps of the learner and result of each evaluation, in order.  The
            result is the average reward per step (`kreps.learning.evaluate.Evaluation`).
        best_mean_reward: its largest mean so far.

    Raises:
        ConfigurationError: a number is no whole number >= 1.
    """

    def __init__(
        self,
        env: Environment | None = None,
        *,
        every: int = 1,
        episodes: int = 20,
        steps: int = STEPS,
        deterministic: bool = True,
        best: str | Path | None = None,
        seed: int = 0,
    ) -> None:
        self.env, self.best = env, best
        self.every = _period(every)
        self.episodes, self.steps = _period(episodes, "episodes"), _period(steps, "steps")
        self.deterministic, self.seed = deterministic, whole_number("seed", seed)
        self.evaluations: list[tuple[int, Evaluation]] = []
        self.best_mean_reward = -np.inf

    def __call__(self, learner: Learner[Any], report: IterationReport) -> None:
        if report.iteration % self.every:
            return
        env, policy = self.env or learner.env, learner.policy
        assert env is not None  # it was learnt in
        with blas_threads(1):
            found = evaluate(
                env,
                learner.task,
                Greedy(policy.process) if self.deterministic else policy.process,
                restart_probability=learner.restart_probability,
                episodes=self.episodes,
                steps=self.steps,
                seed=self.seed,
            )
        self.evaluations.append((report.steps, found))
        if found.mean > self.best_mean_reward:
            self.best_mean_reward = found.mean
            if self.best is not None:
                policy.save(self.best)

    def at(self, report: IterationReport) -> Evaluation | None:
        """The evaluation after this iteration; None if there was none."""
        return dict(self.evaluations).get(report.steps)


class StopOnReward:
    """Ends learning once the average reward per step has reached a threshold.

    Args:
        reward: the threshold, per step of the environment.
        evaluation: a callback before this one, whose result counts; None takes the new rollouts of
            each iteration, which have exploration noise.
    """

    def __init__(self, reward: float, evaluation: EvalCallback | None = None) -> None:
        self.reward, self.evaluation = reward, evaluation

    def __call__(self, learner: Learner[Any], report: IterationReport) -> bool:
        """False if the threshold is reached."""
        if self.evaluation is None:
            return report.average_reward < self.reward
        found = self.evaluation.at(report)
        return found is None or found.mean < self.reward


def _period(value: int, name: str = "every") -> int:
    if whole_number(name, value) < 1:
        raise ConfigurationError(f"{name} = {value}, but it must be at least 1")
    return int(value)
