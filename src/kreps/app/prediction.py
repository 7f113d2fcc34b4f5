"""What the transition model of a run predicts of its policy."""

from __future__ import annotations

import numpy as np

from kreps.data.history import first_lags, states_of
from kreps.data.rollouts import Transitions
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray
from kreps.kernels.threads import blas_threads
from kreps.learning.evaluate import Greedy
from kreps.learning.methods import KREPS
from kreps.models.dynamics import fit_dynamics
from kreps.models.model_env import ModelEnv, supports_model_rollouts
from kreps.models.transition import state_kernel
from kreps.seeding import Purpose, generator

MAX_SAMPLES = 1500
"""Largest number of steps that the model is fitted to, as the cost is cubic in it."""

PREDICTIONS = 50
"""Rollouts in the model from one start state."""


def predicted_states(learner: KREPS, start: FloatArray, steps: int) -> FloatArray | None:
    """States (steps + 1, `PREDICTIONS`, ds) of the greedy policy in the model, NaN after an end.

    The model is not stored with a run, so it is fitted again as in the last update.

    Args:
        learner: with at least one update.
        start: (do,) first observation.
        steps: of each rollout.

    Returns:
        None if the model predicts no states: with another ``model`` than ``"dynamics"``, of images,
        or with too few samples.
    """
    data = newest_transitions(learner.state.window)
    if learner.settings.model != "dynamics" or not supports_model_rollouts(data, learner.task):
        return None
    assert learner.state.policy is not None
    rng = generator(learner.seed, Purpose.PREDICTION, learner.state.iteration)
    with blas_threads(learner.threads):
        kernel = state_kernel(data, learner.task, rng)
        dynamics, _, _ = fit_dynamics(
            data, kernel, learner.task, learner.state.embedding_start, rng
        )
        probability = learner.restart_probability
        model = ModelEnv(dynamics, data, kernel, learner.task, probability, 0.0, steps, 0.0)
        first = states_of(start[None], first_lags(start[None], learner.task), learner.task)
        starts = np.tile(first, (PREDICTIONS, 1))
        return model.trajectories(Greedy(learner.state.policy), starts, steps, rng)


def newest_transitions(window: ReplayWindow) -> Transitions:
    """The steps of the newest rollouts, at most `MAX_SAMPLES` but at least one rollout."""
    steps = np.cumsum(window.rollouts.lengths[::-1])
    count = max(1, int(np.searchsorted(steps, MAX_SAMPLES, side="right")))
    return window.states[len(steps) - count :].transitions
