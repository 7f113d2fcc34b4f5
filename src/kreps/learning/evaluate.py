"""How good a policy is: the average reward per step of the restarting chain, with little variance.

Roll-outs without restarts are weighted by ``gamma^t``, ``gamma = 1 - p``: a step of the restarting
chain is step t of its roll-out with that probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.learning.collect import simulate
from kreps.learning.environment import Environment, without_restarts
from kreps.policies.base import LearntPolicy, StochasticPolicy
from kreps.seeding import Purpose, generator, integer_seed

EPISODES = 200
STEPS = 400
"""Of a full evaluation: 400 steps hold all but 3e-4 of the weight at p = 0.02."""


@dataclass(frozen=True)
class Greedy:
    """A policy without its exploration, as a policy of its own."""

    policy: LearntPolicy

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.policy.greedy(states)


@dataclass(frozen=True)
class Evaluation:
    """Average reward per step: mean over ``episodes`` roll-outs and its standard error."""

    mean: float
    standard_error: float
    episodes: int
    steps: int


def evaluation_rollouts(
    env: Environment,
    task: TaskSpec,
    policy: StochasticPolicy,
    *,
    episodes: int,
    steps: int,
    seed: int,
) -> Rollouts:
    """Roll-outs without restarts; the same seed gives every policy the same random numbers."""
    inside, _ = without_restarts(env)
    return simulate(
        inside,
        task,
        policy,
        [integer_seed(seed, Purpose.EVALUATION_ENVIRONMENT, j) for j in range(episodes)],
        [
            generator(seed, Purpose.EVALUATION_POLICY, j).standard_normal((steps, task.action_size))
            for j in range(episodes)
        ],
    )


def discounted_average(rollouts: Sequence[Rollout], restart_probability: float) -> Evaluation:
    """All rewards weighted by ``gamma^t``, over the sum of all weights.

    A roll-out that really ends is followed by a restart: its weights stop there, so roll-outs count
    by their weight (renewal reward).  The standard error is that of a ratio (delta method).
    """
    count = len(rollouts)
    weights = [(1.0 - restart_probability) ** np.arange(len(rollout)) for rollout in rollouts]
    lengths = np.array([w.sum() for w in weights])
    gains = np.array([w @ rollout.rewards for w, rollout in zip(weights, rollouts, strict=True)])
    mean = float(gains.sum() / lengths.sum())
    scatter = (gains - mean * lengths) / lengths.mean()
    error = float(scatter.std(ddof=1) / np.sqrt(count)) if count > 1 else 0.0
    return Evaluation(mean, error, count, max(len(rollout) for rollout in rollouts))


def stochastic_and_greedy(policy: LearntPolicy) -> dict[str, StochasticPolicy]:
    """The two ways in which every learnt policy is judged, by name."""
    return {"stochastic": policy, "greedy": Greedy(policy)}


def evaluate(
    env: Environment,
    task: TaskSpec,
    policy: StochasticPolicy,
    *,
    restart_probability: float,
    episodes: int = EPISODES,
    steps: int = STEPS,
    seed: int = 0,
) -> Evaluation:
    """Evaluate a policy by ``episodes`` roll-outs of ``steps`` steps each."""
    rollouts = evaluation_rollouts(env, task, policy, episodes=episodes, steps=steps, seed=seed)
    return discounted_average(rollouts, restart_probability)
