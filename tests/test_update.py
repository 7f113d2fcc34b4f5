"""The report of an update: ridge, model error and clipped actions; and which update is made."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.algorithms.report import UpdateInfo
from kreps.algorithms.reps import stationarity_ridge
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.algorithms.update import update
from kreps.data.compute import Compute
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.kernels.regression import KernelEmbedding, LeaveOneOut
from kreps.models.dynamics import DeltaStateTargets
from kreps.models.transition import state_actions, state_kernel
from kreps.presets import settings_of
from kreps.settings import LowRank

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]))

exact_and_low_rank = pytest.mark.parametrize(
    "low_rank", [None, LowRank(above=0)], ids=["exact", "low rank"]
)


def pushes(rollouts: int = 8, steps: int = 15, seed: int = 0) -> list[Rollout]:
    """A mass with friction on a line, pushed at random, often beyond the limits."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(rollouts):
        states = [np.array([rng.normal(), 0.0])]
        actions = rng.normal(0.0, 2.0, size=(steps, 1))
        for force in TASK.clip(actions)[:, 0]:
            velocity = 0.9 * states[-1][1] + 0.3 * force + 0.05 * rng.normal()
            states.append(np.array([states[-1][0] + 0.3 * velocity, velocity]))
        observations = np.array(states)
        rewards = -(observations[:-1, 0] ** 2) - 0.1 * observations[:-1, 1] ** 2
        rewards -= 0.01 * TASK.clip(actions)[:, 0] ** 2
        found.append(Rollout(observations, actions, rewards))
    return found


def updated(given: list[Rollout], **settings: Any) -> tuple[kreps.KREPS, UpdateInfo]:
    learner = kreps.KREPS(TASK, **settings)
    info = learner.update(given)
    assert isinstance(info, UpdateInfo)
    return learner, info


# ---- the ridge --------------------------------------------------------------------------------


def errors_of_refits(model: KernelEmbedding, targets: FloatArray) -> FloatArray:
    """Each target less its prediction by a model of all other samples."""
    errors = []
    for i in range(len(targets)):
        rest = np.arange(len(targets)) != i
        refit = KernelEmbedding.fit(model.kernel, model.inputs[rest], model.regulariser)
        errors.append(targets[i] - refit.strengths(model.inputs[i : i + 1])[:, 0] @ targets[rest])
    return np.array(errors)


@pytest.mark.parametrize("model", ["dynamics", "change"])
def test_the_ridge_is_the_mean_squared_error_of_refits_without_each_sample(model: str) -> None:
    rollouts = pushes(6, 12)
    _, info = updated(rollouts, model=model)
    data = Transitions.from_rollouts(rollouts)
    kernel = state_kernel(data, TASK, np.random.default_rng(0))
    kernel = kernel.with_lengthscales(info.state_lengthscales)
    basis, features = RKHSBasis.fit(kernel, data.points, tolerance=1e-6, max_rank=400)
    targets = features[data.successor] - features[data.state]
    assert info.embedding_parameters is not None
    *lengthscales, regulariser = info.embedding_parameters
    factors = (*kernel.factors, SquaredExponential((2,)))
    embedding = KernelEmbedding.fit(
        Kernel(factors, np.array(lengthscales)), state_actions(data, TASK), regulariser
    )
    if model == "change":
        errors = errors_of_refits(embedding, targets)
    else:
        delta_targets = DeltaStateTargets.fit(data, TASK)
        residuals = errors_of_refits(embedding, delta_targets.targets(data, TASK))
        predicted = data.points[data.successor] - delta_targets.changes(residuals)
        errors = features[data.successor] - basis.features(predicted)
    assert info.ridge == pytest.approx(np.mean(np.sum(errors**2, axis=1)), rel=1e-6)
    assert info.ridge > 5e-3
    relative = np.sqrt(np.sum(errors**2) / np.sum(targets**2))
    assert info.model_error == pytest.approx(relative, rel=1e-6)


@pytest.mark.parametrize("ridge", [0.01, 3.0])
def test_a_given_ridge_is_used(ridge: float) -> None:
    _, info = updated(pushes(4), ridge=ridge)
    assert info.ridge == ridge
    rng = np.random.default_rng(8)
    errors = LeaveOneOut(rng.normal(size=(9, 3)), rng.normal(size=(9, 3)))
    assert stationarity_ridge(settings_of(ridge=ridge), errors) == ridge
    assert stationarity_ridge(settings_of(), errors) == pytest.approx(errors.mean_square)
    assert stationarity_ridge(settings_of("single_step"), None) == 0.1


def test_a_model_without_error_has_the_smallest_ridge() -> None:
    errors = LeaveOneOut(np.ones((4, 2)), np.zeros((4, 2)))
    assert stationarity_ridge(settings_of(), errors) == 1e-3
    still = [replace(r, observations=np.full_like(r.observations, 0.3)) for r in pushes(3)]
    learner, info = updated(still)
    assert info.ridge == 1e-3
    assert info.model_error == 0.0  # there is no change to predict
    assert np.isfinite(learner.policy.predict([0.3, 0.3], deterministic=True)[0]).all()


@exact_and_low_rank
def test_without_a_model_the_error_is_nan(low_rank: LowRank | None) -> None:
    _, info = updated(pushes(4), preset="single_step", model="sample", low_rank=low_rank)
    assert np.isnan(info.model_error)
    assert info.ridge == 0.1
    assert info.embedding_parameters is None


# ---- clipped actions --------------------------------------------------------------------------


@exact_and_low_rank
def test_clipped_is_the_share_of_action_coordinates_beyond_the_limits(
    low_rank: LowRank | None,
) -> None:
    task = TaskSpec(1, np.array([-1.0, 0.0]), np.array([1.0, 4.0]))
    actions = np.array([[0.0, 2.0], [-1.0, 4.0], [1.5, 3.0], [-2.0, -0.1]])  # limits are within
    observations = np.arange(5.0)[:, None]
    state = LearnerState(ReplayWindow(task, None))
    settings = settings_of("single_step", low_rank=low_rank)
    rollouts = [Rollout(observations, actions, np.arange(4.0))]
    _, info = update(state, rollouts, settings, np.random.default_rng(0), Compute())
    assert info.clipped == 3.0 / 8.0


@exact_and_low_rank
def test_clipped_is_of_the_new_rollouts_or_of_all_if_there_are_none(
    low_rank: LowRank | None,
) -> None:
    within = [replace(r, actions=0.1 * r.actions) for r in pushes(4)]
    beyond = [replace(r, actions=np.sign(r.actions) * 9.0) for r in pushes(2, seed=1)]
    learner, info = updated(within, low_rank=low_rank)
    assert info.clipped < 0.05
    assert learner.update(beyond).clipped == 1.0  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    _, again = update(learner.state, [], learner.settings, rng, Compute())
    kept = np.concatenate([r.actions for r in learner.state.window.rollouts])
    assert again.clipped == np.mean(np.abs(kept) > 2.0)
    assert 0.3 < again.clipped < 0.5


@exact_and_low_rank
def test_clipped_includes_new_rollouts_that_the_window_does_not_keep(
    low_rank: LowRank | None,
) -> None:
    beyond = [replace(r, actions=np.sign(r.actions) * 9.0) for r in pushes(2, seed=1)]
    within = [replace(r, actions=0.1 * r.actions) for r in pushes(2)]
    _, info = updated([*beyond, *within], low_rank=low_rank, window=2, window_steps=0)
    assert info.samples == 30
    assert 0.5 <= info.clipped < 0.6


# ---- which update is made ---------------------------------------------------------------------


@pytest.mark.parametrize(("above", "support_is_exact"), [(120, True), (119, False)])
def test_an_update_is_exact_up_to_the_limit(above: int, support_is_exact: bool) -> None:
    settings = settings_of("single_step", low_rank=LowRank(above=above, rank=7))
    state = LearnerState(ReplayWindow(TASK, 30))
    state, _ = update(state, pushes(4), settings, np.random.default_rng(0), Compute())
    rollouts = pushes(4, seed=1)  # the window counts too
    _, info = update(state, rollouts, settings, np.random.default_rng(0), Compute())
    assert info.samples == 120
    assert (info.support > 7) == support_is_exact


def test_an_exact_update_from_a_data_set_is_an_error() -> None:
    learner, _ = updated(pushes(4), low_rank=None)
    with pytest.raises(ConfigurationError, match=r"low_rank = None.*set low_rank=kreps\.LowRank"):
        learner.update(Dataset.from_rollouts(pushes(4)))
    assert learner.state.iteration == 1


def test_an_update_from_a_data_set_is_of_low_rank_whatever_its_size() -> None:
    settings = settings_of("single_step", low_rank=LowRank(above=10**6, rank=7))
    state = LearnerState(ReplayWindow(TASK, 30))
    data = Dataset.from_rollouts(pushes(4))
    after, info = update(state, data, settings, np.random.default_rng(0), Compute())
    assert info.support <= 7
    assert len(after.window.rollouts) == 0
    assert (after.iteration, after.rollouts, after.steps) == (1, 4, 60)


def test_a_stage_that_runs_twice_reports_the_sum_of_both(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([1.0, 3.0, 4.0, 9.0])
    monkeypatch.setattr("time.process_time", lambda: next(times))
    clock = Stopwatch()
    for stage in ("policy", "dual", "policy"):
        clock.lap(stage)
    assert clock.seconds == {"policy": 7.0, "dual": 1.0}
