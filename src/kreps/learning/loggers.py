"""Callbacks that write the numbers of each iteration for tools that show them.

All write what `scalars` returns, over the number of environment steps.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from kreps.errors import ConfigurationError
from kreps.learning.callbacks import EvalCallback
from kreps.learning.iteration import IterationReport
from kreps.learning.learner import Learner
from kreps.learning.progress import seconds_by_stage
from kreps.presets import flat


def scalars(report: IterationReport, evaluation: EvalCallback | None = None) -> dict[str, float]:
    """The finite numbers of an iteration by name, such as ``"rollout/average_reward"``.

    Args:
        report: of the iteration.
        evaluation: adds ``"eval/mean_reward"`` and its standard error after an evaluation.
    """
    update = {name: v for name, v in vars(report.update).items() if isinstance(v, int | float)}
    update |= report.update.numbers()
    found: dict[str, float] = {
        "rollout/average_reward": report.average_reward,
        "rollout/mean_return": report.mean_return,
        "rollout/terminated": report.terminated,
        "rollout/explorer_share": report.explorer_share,
        "time/iterations": report.iteration,
        "time/rollouts": report.rollouts,
        **{f"update/{name}": value for name, value in update.items()},
        **{f"cpu_seconds/{stage}": value for stage, value in seconds_by_stage(report).items()},
    }
    measured = None if evaluation is None else evaluation.at(report)
    if measured is not None:
        found["eval/mean_reward"] = measured.mean
        found["eval/standard_error"] = measured.standard_error
    return {name: float(value) for name, value in found.items() if math.isfinite(value)}


def configuration(learner: Learner[Any]) -> dict[str, Any]:
    """Method, seed and settings of a learner by their flat names, as plain values."""
    return {"method": learner.method, "seed": learner.seed, **flat(learner.settings)}


class TensorBoard:
    """Writes event files for TensorBoard (``pip install 'kreps[tensorboard]'``).

    Args:
        folder: for the event files, as given to ``tensorboard --logdir``.
        evaluation: a callback before this one, whose results are written too.

    Raises:
        ConfigurationError: TensorBoard is not installed.
    """

    def __init__(self, folder: str | Path, evaluation: EvalCallback | None = None) -> None:
        try:
            from tensorboard.summary import Writer
        except ImportError as error:
            raise ConfigurationError(
                "event files need TensorBoard, which is not installed: "
                "pip install 'kreps[tensorboard]'"
            ) from error
        self._writer = Writer(str(folder))
        self.evaluation = evaluation

    def __call__(self, learner: Learner[Any], report: IterationReport) -> None:
        for name, value in scalars(report, self.evaluation).items():
            self._writer.add_scalar(name, value, report.steps)
        self._writer.flush()


class WandB:
    """Logs to a run of Weights & Biases (``pip install 'kreps[wandb]'``).

    Args:
        run: of ``wandb.init(...)``, which has project, name and mode.
        evaluation: a callback before this one, whose results are logged too.
    """

    def __init__(self, run: Any, evaluation: EvalCallback | None = None) -> None:
        self.run, self.evaluation = run, evaluation

    def __call__(self, learner: Learner[Any], report: IterationReport) -> None:
        self.run.config.update(configuration(learner), allow_val_change=True)
        self.run.log(scalars(report, self.evaluation), step=report.steps)


class MLflow:
    """Logs to a run of MLflow (``pip install 'kreps[mlflow]'``).

    Args:
        run: of ``mlflow.start_run(...)``.
        evaluation: a callback before this one, whose results are logged too.
    """

    def __init__(self, run: Any, evaluation: EvalCallback | None = None) -> None:
        self.run, self.evaluation = run, evaluation
        self._has_parameters = False

    def __call__(self, learner: Learner[Any], report: IterationReport) -> None:
        import mlflow

        identifier = self.run.info.run_id
        if not self._has_parameters:  # MLflow takes them once
            mlflow.log_params(configuration(learner), run_id=identifier)
            self._has_parameters = True
        mlflow.log_metrics(scalars(report, self.evaluation), report.steps, run_id=identifier)
