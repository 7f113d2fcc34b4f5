"""``progress.csv``: one row of numbers per iteration of a run.

eta, its floor, dual, primal and gap are in standard deviations of the reward.  ``weighted`` is the
number of samples with a weight in the last step of an update, generated ones included.  ``kl`` is
that of these weights, ``policy_kl`` the mean divergence of the fitted policy from the previous one
over sampled states, both in nats.  ``policy_noise`` is the policy's standard deviation near its
data, in units of half the action range.  The quartiles are those of the new rollouts' mean rewards
per step, each counted by its steps.  Steps and rewards per step are those of the environment; the
restart probability is that at each decision, and ``action_repeat`` the steps for which one is held.
``robot_seconds`` are the steps so far times the control period, without resets.  ``mean_return`` is
the mean sum of the rewards of a new rollout, which a random restart may have cut, ``terminated``
the share of the new rollouts that ended by a termination.  These numbers are of the acting policy's
rollouts; ``explorer_share`` is the share of the steps that the explorer made.  The errors of
dynamics, terminations and reward are those of `kreps.models.model_errors`.
"""

from __future__ import annotations

import csv
import io
import math
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from kreps.algorithms.dual import Outcome
from kreps.checks import MAX_WHOLE_NUMBER
from kreps.errors import StorageError
from kreps.learning.environment import time_limit
from kreps.learning.iteration import IterationReport
from kreps.learning.methods import KREPS
from kreps.learning.progress import seconds_by_stage
from kreps.legacy import present_columns
from kreps.settings import RKHS, Settings

STAGES = (
    "rollouts",
    "basis",
    "embedding fit",
    "embedding",
    "dual",
    "policy fit",
    "policy",
    "generated samples",
    "acceptance test",
)
"""Stages of an iteration whose CPU seconds are recorded."""

ADDED_COLUMNS = (
    "cpu_seconds_generated_samples",
    "weighted",
    "model_error",
    "clipped",
    "eta_floor",
    "policy_noise",
    "max_rank",
    "ridge",
    "exploring",
    "rejected",
    "cpu_seconds_acceptance_test",
    "reward_lower_quartile",
    "reward_upper_quartile",
    "dynamics_error",
    "worst_dynamics_error",
    "worst_coordinate",
    "termination_error",
    "reward_error",
    "mean_return",
    "terminated",
    "time_limit",
    "restart_probability",
    "action_repeat",
    "explorer_share",
    "robot_seconds",
    "policy_kl",
)
"""Columns that runs of earlier versions lack, in the order in which they were added.

A missing one is read as NaN.  Present ones may be NaN: the errors without such a model,
``max_rank`` with a fixed number of features of V, ``rejected`` without an acceptance test,
``time_limit`` of an environment that has none, ``robot_seconds`` without a known control period,
``policy_kl`` without a previous policy.
"""


def seconds_column(stage: str) -> str:
    """Column of the CPU seconds of a stage."""
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
    *(column for column in map(seconds_column, STAGES) if column not in ADDED_COLUMNS),
    *ADDED_COLUMNS,
)

TINY, HUGE = 1e-100, 1e100
COUNT, POSITIVE, NOT_NEGATIVE, SHARE = (1, MAX_WHOLE_NUMBER), (TINY, HUGE), (0, HUGE), (0, 1)

WHOLE = {
    **dict.fromkeys(("iteration", "rollouts", "steps", "samples", "support"), COUNT),
    **dict.fromkeys(("rank", "weighted", "max_rank", "time_limit", "action_repeat"), COUNT),
    **dict.fromkeys(("newton_iterations", "worst_coordinate"), (0, MAX_WHOLE_NUMBER)),
}
"""Smallest and largest value of columns of whole numbers."""

RANGES = {
    **WHOLE,
    **dict.fromkeys(("kl_bound", "eta", "effective_samples", "ridge"), POSITIVE),
    **dict.fromkeys(("jitter", "eta_floor", "policy_noise", "model_error"), NOT_NEGATIVE),
    **dict.fromkeys(("dynamics_error", "worst_dynamics_error"), NOT_NEGATIVE),
    **dict.fromkeys(("termination_error", "reward_error", "robot_seconds"), NOT_NEGATIVE),
    "policy_kl": NOT_NEGATIVE,
    **dict.fromkeys(map(seconds_column, STAGES), NOT_NEGATIVE),
    **dict.fromkeys(("clipped", "exploring", "rejected", "terminated", "explorer_share"), SHARE),
    "restart_probability": SHARE,
}
"""Smallest and largest value of columns whose numbers cannot be anything up to 1e100."""


def read_progress(path: Path) -> list[dict[str, str]]:
    """The rows by column; empty if there is no such file.

    Columns of earlier versions have their present names, and "nan" where they are missing.

    Raises:
        StorageError: it is not what a run writes.
    """
    try:
        with open(path, newline="") as file:
            reader = csv.reader(file)
            columns = present_columns(next(reader, []))
            _check_columns(columns)
            rows = [_checked_row(columns, values) for values in reader if values]
        numbers = [int(row["iteration"]) for row in rows]
        if any(later <= earlier for earlier, later in pairwise(numbers)):
            raise ValueError("its iterations do not ascend")
        return rows
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise StorageError(
            f"{path} is damaged ({error}); remove it to continue without the earlier rows, the "
            "checkpoint has everything that the learner needs"
        ) from error


def _check_columns(columns: Sequence[str]) -> None:
    first = len(COLUMNS) - len(ADDED_COLUMNS)
    if len(columns) < first or tuple(columns) != COLUMNS[: len(columns)]:
        raise ValueError("its columns are not those of a run")


def _checked_row(columns: Sequence[str], values: Sequence[str]) -> dict[str, str]:
    row = dict.fromkeys(COLUMNS, "nan") | dict(zip(columns, values, strict=True))
    if row["outcome"] not in Outcome.__members__:
        raise ValueError(f"it has an unknown outcome {row['outcome']!r:.40}")
    for name in COLUMNS:
        if name != "outcome":
            _check_number(name, row[name])
    return row


def _check_number(name: str, text: str) -> None:
    if name in ADDED_COLUMNS and math.isnan(float(text)):
        return
    value = int(text) if name in WHOLE else float(text)
    low, high = RANGES.get(name, (-HUGE, HUGE))
    if not low <= value <= high:  # nor NaN
        raise ValueError(f"{name} = {text:.40}, but it must be between {low:g} and {high:g}")


def progress_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as the content of a file."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def max_rank(settings: Settings) -> float:
    """Largest number of features of V; NaN where their number is fixed, as on a grid."""
    return settings.value.max_rank if isinstance(settings.value, RKHS) else math.nan


def episode_limit(learner: KREPS) -> float:
    """Steps after which the environment truncates an episode; NaN where it does not."""
    limit = sys.maxsize if learner.env is None else time_limit(learner.env)
    return math.nan if limit == sys.maxsize else limit


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def progress_row(learner: KREPS, report: IterationReport) -> dict[str, Any]:
    """The row of an iteration."""
    info, dual, errors = report.update, report.update.dual, report.update.held_out
    seconds = seconds_by_stage(report)
    lower, upper = report.reward_quartiles
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
        "max_rank": max_rank(learner.settings),
        "ridge": info.ridge,
        "exploring": float(learner.exploring),
        "explorer_share": report.explorer_share,
        "rejected": _or_nan(None if info.rejected is None else float(info.rejected)),
        "reward_lower_quartile": lower,
        "reward_upper_quartile": upper,
        "dynamics_error": errors.dynamics,
        "worst_dynamics_error": errors.worst,
        "worst_coordinate": _or_nan(errors.worst_coordinate),
        "termination_error": errors.terminations,
        "reward_error": errors.reward,
        "mean_return": report.mean_return,
        "terminated": report.terminated,
        "time_limit": episode_limit(learner),
        "restart_probability": report.restart_probability,
        "action_repeat": learner.task.action_repeat,
        "robot_seconds": round(_or_nan(learner.task.robot_seconds(report.steps)), 6),
        "policy_kl": info.policy_kl,
        **{seconds_column(stage): round(seconds.get(stage, 0.0), 5) for stage in STAGES},
    }
