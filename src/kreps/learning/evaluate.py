"""Evaluation of a policy: its average reward per step of the process with random restarts.

Simulated rollouts have no restarts.  Their step t counts with weight ``gamma^t``,
``gamma = 1 - p``, the probability that there was no restart before it.  That has less variance than
simulating restarts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, default_errstate
from kreps.learning.collect import simulate
from kreps.learning.episodes import EpisodicReturn
from kreps.learning.planning import longest_rollout
from kreps.learning.wrappers import Environment, without_restarts
from kreps.policies.base import LearntPolicy, StochasticPolicy
from kreps.policies.exploration import WHITE, noise_rows
from kreps.seeding import Purpose, generator, integer_seed

EPISODES = 200
"""Rollouts of a full evaluation."""

STEPS = 400
"""Steps of each rollout in a full evaluation: 400 have all but 3e-4 of the weight at p = 0.02."""


@dataclass(frozen=True)
class Greedy:
    """A policy without its exploration noise."""

    policy: LearntPolicy

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.policy.greedy(states)


@dataclass(frozen=True)
class Evaluation:
    """Average reward per step of the environment.

    Attributes:
        mean: estimated from all rollouts.
        standard_error: of the mean; 0 if there is only one rollout.
        episodes: number of rollouts.
        steps: largest number of steps of a rollout.
        episodic: undiscounted return of the same rollouts; None if the task ends no episode, or if
            it was not asked for.
    """

    mean: float
    standard_error: float
    episodes: int
    steps: int
    episodic: EpisodicReturn | None = None


def evaluation_rollouts(
    env: Environment,
    task: TaskSpec,
    policy: StochasticPolicy,
    *,
    episodes: int,
    steps: int,
    seed: int,
) -> Rollouts:
    """Rollouts without restarts, with the same random numbers for every policy of a seed.

    Args:
        env: its random restarts, if it has any, are left out.
        task: of the environment; each action is held for its ``action_repeat``.
        policy: that acts.
        episodes: number of rollouts.
        steps: of the environment in each rollout, unless the task ends before.
        seed: of all random numbers.
    """
    inside, _ = without_restarts(env)
    decisions = ceil(steps / task.action_repeat)
    return simulate(
        inside,
        task,
        policy,
        [integer_seed(seed, Purpose.EVALUATION_ENVIRONMENT, j) for j in range(episodes)],
        [
            noise_rows(
                WHITE, decisions, task.action_size, generator(seed, Purpose.EVALUATION_POLICY, j)
            )
            for j in range(episodes)
        ],
        longest=longest_rollout([decisions] * episodes, task),
    )


@default_errstate()
def discounted_average(
    rollouts: Sequence[Rollout], restart_probability: float, action_repeat: int = 1
) -> Evaluation:
    """The sum of all rewards weighted by ``gamma^t``, divided by the sum of all weights.

    This is the average reward per step of the restarting process.  After a termination there is no
    reward until the restart: these steps have the weights ``gamma^T + gamma^(T+1) + ...``, which
    sum to ``gamma^T / (1 - gamma)``.  The mean is the ratio of two sums over rollouts; its standard
    error is that of the delta method.

    Args:
        rollouts: without restarts.
        restart_probability: p, at each decision.
        action_repeat: steps of the environment for each decision, by which the average is divided.
    """
    count = len(rollouts)
    weights = [(1.0 - restart_probability) ** np.arange(len(rollout)) for rollout in rollouts]
    after_end = [(1.0 - restart_probability) ** len(r) / restart_probability for r in rollouts]
    ended = np.array([rollout.terminated for rollout in rollouts])
    lengths = np.array([w.sum() for w in weights]) + np.where(ended, after_end, 0.0)
    gains = np.array([w @ rollout.rewards for w, rollout in zip(weights, rollouts, strict=True)])
    mean = float(gains.sum() / lengths.sum())
    scatter = (gains - mean * lengths) / lengths.mean()
    error = float(scatter.std(ddof=1) / np.sqrt(count)) if count > 1 else 0.0
    longest = action_repeat * max(len(rollout) for rollout in rollouts)
    return Evaluation(mean / action_repeat, error / action_repeat, count, longest)


def stochastic_and_greedy(policy: LearntPolicy) -> dict[str, StochasticPolicy]:
    """The two policies that are evaluated for every learnt one: with and without exploration."""
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
    """Average reward per step of a policy, from rollouts without restarts.

    Args:
        env: its random restarts, if it has any, are left out.
        task: of the environment; each action is held for its ``action_repeat``.
        policy: that acts.
        restart_probability: p of the process.
        episodes: number of rollouts.
        steps: of the environment in each rollout, unless the task ends before.
        seed: of all random numbers.
    """
    rollouts = evaluation_rollouts(env, task, policy, episodes=episodes, steps=steps, seed=seed)
    return discounted_average(rollouts, restart_probability, task.action_repeat)
