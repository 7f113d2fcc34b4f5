"""A run folder: what was asked for, how it went, and everything needed to go on.

``config.json`` says what was asked for; after each iteration ``progress.csv``,
``policy.safetensors`` and then ``checkpoint.safetensors`` are replaced, each atomically.  The
checkpoint is what counts: the others are never behind it, and rows ahead of it are dropped on
resuming.  In ``progress.csv`` eta, its floor, dual, primal and gap are in standard deviations of
the reward; ``weighted`` are the samples that the last step gave weights to, imagined ones too;
``policy_noise`` is the policy's near its data, in units of half the action range.
"""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kreps.algorithms.dual import Outcome
from kreps.errors import ConfigurationError, StorageError
from kreps.learning.learner import IterationReport
from kreps.learning.methods import KREPS
from kreps.learning.progress import seconds_by_stage
from kreps.learning.storage import save_policy, write_atomically
from kreps.settings import RKHS, Settings
from kreps.versions import versions

STAGES = (
    "rollouts",
    "basis",
    "embedding fit",
    "embedding",
    "dual",
    "policy fit",
    "policy",
    "imagined step",
    "judgement",
)
NEWER = (
    "cpu_seconds_imagined_step",
    "weighted",
    "model_error",
    "clipped",
    "eta_floor",
    "policy_noise",
    "max_rank",
    "ridge",
    "exploring",
    "refused",
    "cpu_seconds_judgement",
)
"""Columns that runs of earlier versions have not.  There they are NaN, as is the error where there
is no model, and the cap where the features of V are of a fixed number."""


def seconds_column(stage: str) -> str:
    """Of the CPU seconds of a stage."""
    return f"cpu_seconds_{stage.replace(' ', '_')}"


COLUMNS = (
    "iteration",
    "rollouts",
    "steps",
    "average_reward",
    "kl",
    "kl_bound",
    "eta",
    "effective_samples",
    "samples",
    "rank",
    "rank_residual",
    "support",
    "dual",
    "primal",
    "gap",
    "decrement",
    "stationarity",
    "newton_iterations",
    "outcome",
    "jitter",
    *(column for column in map(seconds_column, STAGES) if column not in NEWER),
    *NEWER,
)


@dataclass(frozen=True)
class RunConfig:
    """What a run was asked to do; enough to make its environment again.

    Attributes:
        environment: Gymnasium name.
        iterations: updates to make in all.
        seed, preset, settings: as given to `KREPS`; ``settings`` holds only what was changed.
        periodic: as given to `KREPS`.
    """

    environment: str
    iterations: int
    seed: int
    preset: str
    settings: dict[str, Any]
    periodic: list[int] | None


class RunFolder:
    """The files of one run."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config_file = self.path / "config.json"
        self.progress_file = self.path / "progress.csv"
        self.checkpoint_file = self.path / "checkpoint.safetensors"
        self.policy_file = self.path / "policy.safetensors"
        self.evaluation_file = self.path / "evaluation.json"

    def write_config(self, config: RunConfig) -> None:
        content = {**vars(config), "versions": versions()}
        write_atomically(self.config_file, (json.dumps(content, indent=2) + "\n").encode())

    def create(self, config: RunConfig) -> None:
        """Start a run here.

        Raises:
            ConfigurationError: there is one already.
        """
        if self.config_file.exists():
            raise ConfigurationError(
                f"{self.path} holds a run already; go on with `kreps resume {self.path}`, "
                "remove it, or choose another folder"
            )
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot make the folder {self.path}: {error}") from error
        self.write_config(config)

    def config(self) -> RunConfig:
        """Raises `StorageError` if this is not a run folder."""
        try:
            content = json.loads(self.config_file.read_text())
            content.pop("versions", None)
            config = RunConfig(**content)
            types = {"environment": str, "iterations": int, "seed": int, "settings": dict}
            for name, kind in types.items():
                if not isinstance(getattr(config, name), kind):
                    raise TypeError(f"{name} is not a {kind.__name__}")
            if not isinstance(config.periodic, list | None):
                raise TypeError("periodic is not a list")
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise StorageError(
                f"{self.path} is not a run folder with an intact config.json ({error}); "
                "start a run with `kreps train`"
            ) from error
        return config

    def rows(self) -> list[dict[str, str]]:
        """What ``progress.csv`` holds, a dictionary a row; empty if there is no such file.

        Rows of earlier versions have "nan" in the columns that are `NEWER`.

        Raises:
            StorageError: it is not what a run writes.
        """
        try:
            with open(self.progress_file, newline="") as file:
                reader = csv.DictReader(file)
                rows = list(reader)
                columns = tuple(reader.fieldnames or ())
                if len(columns) >= len(COLUMNS) - len(NEWER) and columns == COLUMNS[: len(columns)]:
                    missing = dict.fromkeys(COLUMNS[len(columns) :], "nan")
                    rows = [{**row, **missing} for row in rows]
                else:
                    raise ValueError("its columns are not those of a run")
                for row in rows:
                    if row["outcome"] not in Outcome.__members__:
                        raise ValueError(f"it has an unknown outcome {row['outcome']!r:.40}")
                    values = {name: float(row[name]) for name in COLUMNS if name != "outcome"}
                    if not all(
                        math.isfinite(value) or (name in NEWER and math.isnan(value))
                        for name, value in values.items()
                    ):
                        raise ValueError("it holds NaN or infinities")
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError, csv.Error) as error:
            raise StorageError(
                f"{self.progress_file} is damaged ({error}); remove it to go on without the rows "
                "of the past, the checkpoint has all that the learner needs"
            ) from error
        return rows

    def evaluation(self, iteration: int) -> dict[str, Any] | None:
        """What ``evaluation.json`` holds, None if there is none of the policy of ``iteration``.

        Raises:
            StorageError: it is not what an evaluation writes.
        """
        try:
            content = json.loads(self.evaluation_file.read_text())
            for name in ("stochastic", "greedy"):
                if not math.isfinite(content[name]["mean"]):
                    raise ValueError("it holds NaN or infinities")
            return content if content["iteration"] == iteration else None
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise StorageError(
                f"{self.evaluation_file} is damaged ({error}); remove it, or evaluate again"
            ) from error

    def __call__(self, learner: KREPS, report: IterationReport) -> None:
        """As a callback of `KREPS.learn`: keep what was learnt."""
        before = [row for row in self.rows() if int(row["iteration"]) < report.iteration]
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", extrasaction="ignore")
        writer.writeheader()
        writer.writerows([*before, progress_row(learner, report)])
        write_atomically(self.progress_file, text.getvalue().encode())
        assert learner.state.policy is not None
        save_policy(learner.state.policy, self.policy_file)
        learner.save(self.checkpoint_file)


def rank_cap(settings: Settings) -> float:
    """Most features of V; NaN where their number is fixed: those of a grid, or Fourier features."""
    return settings.value.max_rank if isinstance(settings.value, RKHS) else math.nan


def progress_row(learner: KREPS, report: IterationReport) -> dict[str, Any]:
    """One row of ``progress.csv``."""
    info, dual = report.update, report.update.dual
    seconds = seconds_by_stage(report)
    return {
        "iteration": report.iteration,
        "rollouts": report.rollouts,
        "steps": report.steps,
        "average_reward": report.average_reward,
        "kl": dual.kl,
        "kl_bound": learner.settings.kl_bound,
        "eta": dual.eta,
        "effective_samples": info.effective_samples,
        "samples": info.samples,
        "rank": info.rank,
        "rank_residual": info.rank_residual,
        "support": info.support,
        "dual": dual.dual,
        "primal": dual.primal,
        "gap": dual.gap,
        "decrement": dual.decrement,
        "stationarity": dual.stationarity,
        "newton_iterations": dual.iterations,
        "outcome": dual.outcome.name,
        "jitter": info.jitter,
        "weighted": len(dual.weights),
        "model_error": info.model_error,
        "clipped": info.clipped,
        "eta_floor": info.eta_floor,
        "policy_noise": math.sqrt(info.noise),
        "max_rank": rank_cap(learner.settings),
        "ridge": info.ridge,
        "exploring": float(learner.exploring),
        "refused": math.nan if info.rejected is None else float(info.rejected),
        **{seconds_column(stage): round(seconds.get(stage, 0.0), 5) for stage in STAGES},
    }
