"""One update of a learner: Algorithm 1, then the model-based step, then the report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kreps.algorithms.acceptance import least_temperature
from kreps.algorithms.dual import effective_sample_size
from kreps.algorithms.exact import ExactBatch
from kreps.algorithms.low_rank import LowRankBatch
from kreps.algorithms.model_based import can_simulate, generates_samples, model_based_step
from kreps.algorithms.report import UpdateInfo
from kreps.algorithms.reps import Batch, Step, reps_step, stationarity_ridge
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.data.compute import Compute
from kreps.data.dataset import Dataset
from kreps.data.rollout import Rollout
from kreps.data.task import TaskSpec
from kreps.settings import Settings

EXACT_LIMIT = 3_000


def update(
    state: LearnerState,
    rollouts: Sequence[Rollout] | Dataset,
    task: TaskSpec,
    settings: Settings,
    rng: np.random.Generator,
    compute: Compute,
) -> tuple[LearnerState, UpdateInfo]:
    """One update from new roll-outs and those kept, or from a data set; nothing is modified."""
    batch = batch_of(state, rollouts, task, settings, rng, compute)
    judged = can_simulate(batch) and settings.judging_rollouts > 0
    step = reps_step(batch, state, least_temperature(judged, settings), rng)
    reward_start, refused = state.reward_start, None
    if generates_samples(batch):
        step, reward_start, refused = model_based_step(batch, step, state, rng)
    learnt = state.after_data(
        *batch.seen,
        window=batch.window,
        policy=state.policy if refused else step.policy.policy,
        value=step.features.basis.function(batch.reward_unit * step.dual.theta),
        embedding_start=step.model.parameters,
        reward_start=reward_start,
        policy_start=step.policy.x,
    )
    return learnt, report(batch, step, refused)


def batch_of(
    state: LearnerState,
    rollouts: Sequence[Rollout] | Dataset,
    task: TaskSpec,
    settings: Settings,
    rng: np.random.Generator,
    compute: Compute,
) -> Batch:
    """All samples exactly, or any number of them in low rank: what the settings ask for."""
    clock = Stopwatch()
    exact = settings.approximation == "exact"
    if settings.approximation == "auto" and not isinstance(rollouts, Dataset):
        window = state.extended_window(rollouts, task)
        exact = sum(map(len, window.rollouts)) <= EXACT_LIMIT
    if exact:
        return ExactBatch(state, rollouts, task, settings, clock)
    return LowRankBatch(state, rollouts, task, settings, clock, compute, rng)


def report(batch: Batch, step: Step, refused: bool | None) -> UpdateInfo:
    """What is only told of an update."""
    errors, settings, actions = step.model.errors, batch.settings, batch.actions
    beyond = (actions < batch.task.action_low) | (actions > batch.task.action_high)
    return UpdateInfo(
        samples=batch.size,
        kl_bound=settings.kl_bound,
        eta_floor=step.problem.eta_floor,
        ridge=stationarity_ridge(settings, errors),
        model_error=float("nan") if errors is None else errors.relative,
        clipped=float(np.mean(beyond)),
        rank=step.problem.rank,
        rank_residual=step.features.basis.residual,
        dual=step.dual,
        effective_samples=effective_sample_size(step.dual.weights),
        support=step.policy.support,
        state_lengthscales=step.kernel.lengthscales,
        embedding_parameters=None
        if step.model.parameters is None
        else np.exp(step.model.parameters),
        policy_parameters=np.exp(step.policy.x),
        noise=step.policy.policy.noise,
        refused=refused,
        jitter=max(step.dual.jitter, *batch.jitters),
        seconds=batch.clock.seconds,
    )
