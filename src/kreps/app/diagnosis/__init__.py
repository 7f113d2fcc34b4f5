"""What limits a run, in words and with a remedy: from the files of a run to findings.

One short function per cause.  Each compares the median of the latest iterations, or the trend
over the last half of them, with a threshold, and reports what is fine as well as what is not.  The
thresholds are in `thresholds`, their reasons in ``docs/diagnosis.md``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

from kreps.app.diagnosis.columns import Row
from kreps.app.diagnosis.delay import delay_or_hidden_state
from kreps.app.diagnosis.episodes import episodes, rollout_length
from kreps.app.diagnosis.exploration import clipped_actions, exploration_noise
from kreps.app.diagnosis.finding import Finding, Severity
from kreps.app.diagnosis.model import (
    basis_of_value,
    dynamics,
    reward_model,
    terminations,
    transition_model,
)
from kreps.app.diagnosis.reward import goal, local_optimum, near_best, progress
from kreps.app.diagnosis.samples import action_cost, idle_columns
from kreps.app.diagnosis.update import acceptance_test, dual_solver, effective_samples, kl_bound
from kreps.data.rollouts import Rollouts
from kreps.data.window import ReplayWindow

__all__ = ["Finding", "Row", "Severity", "diagnose"]


def diagnose(
    rows: Sequence[Row],
    evaluation: Mapping[str, Any] | None = None,
    references: Mapping[str, float] | None = None,
    window: ReplayWindow | None = None,
    greedy: Rollouts | None = None,
) -> list[Finding]:
    """All findings about a run, the most severe first.

    Causes whose numbers were not recorded are left out, as is the model's where there is none.

    Args:
        rows: of ``progress.csv``, at least one.
        evaluation: of ``evaluation.json``, of the policy of the last row.
        references: reference rewards of the task by name, from best to worst.
        window: the samples of the last update.
        greedy: evaluated rollouts of the greedy policy of the last row.
    """
    references = references or {}
    found = [
        dual_solver(rows),
        goal(rows, evaluation),
        local_optimum(rows, evaluation, references),
        progress(rows, evaluation, references),
        kl_bound(rows),
        effective_samples(rows),
        acceptance_test(rows),
        episodes(rows, evaluation),
        rollout_length(rows, greedy),
        action_cost(window),
        transition_model(rows),
        dynamics(rows),
        terminations(rows),
        reward_model(rows, near_best(rows, evaluation, references)),
        delay_or_hidden_state(window),
        idle_columns(window),
        basis_of_value(rows),
        exploration_noise(rows, evaluation),
        clipped_actions(rows),
    ]
    order = get_args(Severity)
    return sorted((f for f in found if f is not None), key=lambda f: order.index(f.severity))
