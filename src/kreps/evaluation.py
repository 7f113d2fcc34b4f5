"""How good a policy is: the average reward per step of the restarting chain, with little variance.

Roll-outs without restarts are weighted by ``gamma^t``, ``gamma = 1 - p``: a step of the restarting
chain is step t of its roll-out with that probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kreps.arrays import FloatArray
from kreps.data import Rollout, TaskSpec
from kreps.policies import CostSensitiveGP, StochasticPolicy
from kreps.rollout import Environment, simulate, without_restarts
from kreps.seeding import Purpose, generator, integer_seed


@dataclass(frozen=True)
class Greedy:
    """The mean of a policy as a policy of its own."""

    policy: CostSensitiveGP

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.policy.mean(states)


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
) -> list[Rollout]:
    """Roll-outs without restarts; the same seed gives every policy the same random numbers."""
    inside, _ = without_restarts(env)
    return simulate(
        inside,
        task,
        policy,
        [integer_seed(seed, Purpose.EVALUATION_ENVIRONMENT, j) for j in range(episodes)],
        [generator(seed, Purpose.EVALUATION_POLICY, j) for j in range(episodes)],
        [steps] * episodes,
    )


def discounted_average(rollouts: Sequence[Rollout], restart_probability: float) -> Evaluation:
    """Weigh the rewards of each roll-out by ``gamma^t``, normalised by the sum of the weights.

    A roll-out that really ends is followed by a restart: its weights stop there.
    """
    averages = []
    for rollout in rollouts:
        weights = (1.0 - restart_probability) ** np.arange(len(rollout))
        averages.append(weights @ rollout.rewards / weights.sum())
    values = np.array(averages)
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
    return Evaluation(
        float(values.mean()), error, len(values), max(len(rollout) for rollout in rollouts)
    )


def stochastic_and_greedy(policy: CostSensitiveGP) -> dict[str, StochasticPolicy]:
    """The two ways in which every learnt policy is judged, by name."""
    return {"stochastic": policy, "greedy": Greedy(policy)}


def evaluate(
    env: Environment,
    task: TaskSpec,
    policy: StochasticPolicy,
    *,
    restart_probability: float,
    episodes: int = 200,
    steps: int = 400,
    seed: int = 0,
) -> Evaluation:
    """Evaluate a policy by ``episodes`` roll-outs of ``steps`` steps each."""
    rollouts = evaluation_rollouts(env, task, policy, episodes=episodes, steps=steps, seed=seed)
    return discounted_average(rollouts, restart_probability)
