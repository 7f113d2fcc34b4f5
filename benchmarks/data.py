"""Data of the swing-up: the samples of a learner after some iterations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import gymnasium as gym
import numpy as np

from kreps import KREPS, Rollout
from kreps.algorithms.state import LearnerState
from kreps.data.rollouts import Transitions
from kreps.kernels.threads import blas_threads
from kreps.learning.collect import collect
from kreps.policies.cost_sensitive_gp import CostSensitiveGP

SEED = 100


@dataclass(frozen=True)
class Update:
    """The state before an update, and its new rollouts.

    Attributes:
        learner: after some iterations.
        state: of the learner.
        rollouts: new ones.
    """

    learner: KREPS
    state: LearnerState
    rollouts: Sequence[Rollout]

    def samples(self) -> int:
        """Number of samples that the update learns from."""
        return self.state.append(self.rollouts).steps

    def run(self) -> dict[str, float]:
        """Make the update, from the same state in each call; CPU seconds by stage."""
        self.learner.state = self.state
        return self.learner.update(self.rollouts).seconds


@cache
def next_update(iterations: int) -> Update:
    """The update of a single-step learner of the swing-up after ``iterations`` others."""
    learner = KREPS(gym.make("kreps/SwingUp-v0"), preset="single_step", seed=SEED).learn(
        iterations, progress=False
    )
    assert learner.env is not None and learner.state.policy is not None
    rollouts = collect(
        learner.env,
        learner.task,
        learner.state.policy,
        learner.settings.rollouts_per_iteration,
        seed=SEED,
        iteration=iterations,
        restart_probability=learner.restart_probability,
    )
    return Update(learner, learner.state, rollouts)


@dataclass(frozen=True)
class SwingUpData:
    """Transitions and the learner that collected them."""

    learner: KREPS
    transitions: Transitions


@cache
def swing_up(n: int) -> SwingUpData:
    """The first n transitions that a single-step learner collects."""
    learner = KREPS(gym.make("kreps/SwingUp-v0"), preset="single_step", seed=SEED, window=1000)
    kept: list[Rollout] = []
    assert learner.env is not None
    learner.learn(3, progress=False)
    left = n
    for rollout in learner.state.window.rollouts:
        steps = min(len(rollout), left)
        if steps == 0:
            break
        kept.append(
            Rollout(
                rollout.observations[: steps + 1],
                rollout.actions[:steps],
                rollout.rewards[:steps],
            )
        )
        left -= steps
    assert left == 0
    return SwingUpData(learner, Transitions.from_rollouts(kept))


@cache
def policy_with_support(m: int, stretch: float = 1.0) -> CostSensitiveGP:
    """A policy with learnt hyper-parameters and m support points of non-negligible weight.

    Args:
        m: support points.
        stretch: multiplies the lengthscales.
    """
    data = swing_up(m)
    learnt = data.learner.state.policy
    assert isinstance(learnt, CostSensitiveGP)
    transitions = data.transitions
    with blas_threads(1):
        return CostSensitiveGP(
            learnt.task,
            learnt.kernel.with_lengthscales(stretch * learnt.kernel.lengthscales),
            transitions.states,
            learnt.task.scaled(transitions.actions),
            np.random.default_rng(0).uniform(0.05, 5.0, m),
            learnt.signal,
            learnt.noise,
        )
