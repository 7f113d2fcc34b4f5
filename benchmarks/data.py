"""Real data of the swing-up: what a learner has seen after some iterations."""

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
    """An update about to be made.

    Attributes:
        learner: after some iterations.
        state: what it carries.
        rollouts: what is new.
    """

    learner: KREPS
    state: LearnerState
    rollouts: Sequence[Rollout]

    def samples(self) -> int:
        window, _ = self.state.extended(self.rollouts, self.learner.task)
        return len(window.transitions)

    def run(self) -> dict[str, float]:
        """Make it from the same state each time; CPU seconds by stage."""
        self.learner.state = self.state
        return self.learner.update(self.rollouts).seconds


@cache
def next_update(iterations: int) -> Update:
    """The update of the default swing-up learner after ``iterations`` others."""
    learner = KREPS(gym.make("kreps/SwingUp-v0"), recipe="observed", seed=SEED).learn(
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
        restart_probability=learner.settings.restart_probability,
    )
    return Update(learner, learner.state, rollouts)


@dataclass(frozen=True)
class SwingUpData:
    """Transitions, and the learner that collected them."""

    learner: KREPS
    transitions: Transitions


@cache
def swing_up(n: int) -> SwingUpData:
    """The first n transitions that a default learner collects by its first policies."""
    learner = KREPS(gym.make("kreps/SwingUp-v0"), recipe="observed", seed=SEED, window=1000)
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
    """The learnt policy's hyper-parameters on m support points that all count.

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
