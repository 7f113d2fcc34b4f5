"""One update of KREPS: Algorithm 1, then the model-based step, then the report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kreps.algorithms.acceptance import temperature_floor
from kreps.algorithms.dual import effective_sample_size
from kreps.algorithms.exact import ExactBatch
from kreps.algorithms.low_rank import LowRankBatch
from kreps.algorithms.model_based import (
    generates_samples,
    has_acceptance_test,
    model_based_step,
)
from kreps.algorithms.policy_divergence import expected_policy_kl
from kreps.algorithms.report import UpdateInfo
from kreps.algorithms.reps import Batch, Step, reps_step, stationarity_ridge
from kreps.algorithms.rollout_folds import RolloutFolds
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.data.compute import CHUNK_SIZE, Compute
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout
from kreps.errors import ConfigurationError
from kreps.models.history_choice import HistoryChoice, choose_history
from kreps.models.model_errors import model_errors
from kreps.policies.base import LearntPolicy
from kreps.settings import Grid, Settings


def update(
    state: LearnerState,
    samples: Sequence[Rollout] | Dataset,
    settings: Settings,
    rng: np.random.Generator,
    compute: Compute,
) -> tuple[LearnerState, UpdateInfo]:
    """One update from new rollouts and those kept, or from a data set; nothing is modified.

    Raises:
        DataError: no rollouts at all, or some of another width than the task's.
        ConfigurationError: more samples than an exact update can serve, and no low rank.
    """
    clock = Stopwatch()
    choice = history_choice(state, samples, settings, rng)
    clock.lap("history")
    if choice is not None:
        state = state.with_history(choice.chosen.delay, choice.chosen.history)
    batch = batch_of(state, samples, settings, rng, compute)
    batch.clock.seconds |= {} if choice is None else clock.seconds
    step = reps_step(batch, state, temperature_floor(has_acceptance_test(batch), settings), rng)
    reward_start, rejected, explorer = state.reward_start, None, None
    if generates_samples(batch):
        found = model_based_step(batch, step, state, rng)
        step, reward_start, rejected = found.step, found.reward_start, found.rejected
        explorer = found.explorer
    new_state = state.after(
        *batch.seen,
        window=batch.window,
        policy=state.policy if rejected else step.policy.policy,
        explorer=explorer,
        value=step.features.basis.function(batch.reward_unit * step.dual.theta),
        embedding_start=step.model.parameters,
        reward_start=reward_start,
        policy_start=step.policy.x,
    )
    return new_state, report(batch, step, state.policy, rejected, choice)


def history_choice(
    state: LearnerState,
    samples: Sequence[Rollout] | Dataset,
    settings: Settings,
    rng: np.random.Generator,
) -> HistoryChoice | None:
    """Delay and history of the states of this update, where the settings leave them open.

    They are chosen from all rollouts of the window, or from the first ones of a data set.
    """
    if settings.history != "auto":
        return None
    if isinstance(samples, Dataset):
        rollouts = samples.first(CHUNK_SIZE)
    else:
        rollouts = state.append(samples).rollouts
    return choose_history(rollouts, state.window.task, settings.delay, rng)


def batch_of(
    state: LearnerState,
    samples: Sequence[Rollout] | Dataset,
    settings: Settings,
    rng: np.random.Generator,
    compute: Compute,
) -> Batch[Any, Any]:
    """All samples exactly, or in low rank where ``settings.low_rank`` says so."""
    clock, low_rank = Stopwatch(), settings.low_rank
    if isinstance(samples, Dataset):
        if low_rank is None:
            raise ConfigurationError(
                "low_rank = None, but a data set is learnt from in chunks; set "
                "low_rank=kreps.LowRank(), or give a list of rollouts"
            )
        return LowRankBatch(state.window, samples, settings, low_rank, clock, compute, rng)
    window = state.append(samples)
    if settings.cross_validation == "rollouts":
        return RolloutFolds(window, samples, settings, clock)
    if low_rank is None or window.steps <= low_rank.above:
        return ExactBatch(window, samples, settings, clock)
    return LowRankBatch(window, samples, settings, low_rank, clock, compute, rng)


def report(
    batch: Batch[Any, Any],
    step: Step,
    previous: LearntPolicy | None,
    rejected: bool | None,
    choice: HistoryChoice | None,
) -> UpdateInfo:
    """What is only reported of an update, with the policy before it."""
    errors, actions, task = step.model.errors, batch.actions, batch.task
    beyond = (actions < task.action_low) | (actions > task.action_high)
    parameters, basis = step.model.parameters, step.features.basis
    kernel = step.kernel if isinstance(batch.settings.value, Grid) else basis.kernel
    return UpdateInfo(
        samples=batch.size,
        kl_bound=batch.settings.kl_bound,
        eta_floor=step.problem.eta_floor,
        ridge=stationarity_ridge(batch.settings, errors),
        model_error=float("nan") if errors is None else errors.relative,
        held_out=model_errors(batch.data, task, step.model.dynamics, step.reward_model),
        clipped=float(np.mean(beyond)),
        rank=step.problem.rank,
        rank_residual=basis.residual,
        dual=step.dual,
        effective_samples=effective_sample_size(step.dual.weights),
        support=step.policy.support,
        state_lengthscales=kernel.lengthscales[: len(step.kernel.factors)],
        embedding_parameters=None if parameters is None else np.exp(parameters),
        policy_parameters=np.exp(step.policy.x),
        noise=step.policy.noise,
        policy_kl=expected_policy_kl(step.policy.policy, previous, batch.data),
        rejected=rejected,
        jitter=max([step.dual.jitter, *batch.jitters]),
        history_choice=choice,
        seconds=batch.clock.seconds,
    )
