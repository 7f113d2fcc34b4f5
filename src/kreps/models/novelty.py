"""An exploration bonus for states that are unlike any sample, as in R-max.

A policy that holds the best state it has seen collects no other data, so a local optimum would be
kept for ever.  In R-max (Brafman and Tennenholtz 2002) an unexplored region is an absorbing state
that pays an optimistic reward until the restart.  Its total value is added to the reward of the
action that leads there.

A state counts as explored if it is within the novelty radius of a sample: nearly all samples have a
sample of another rollout within that radius.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import ModelEnv, ModelRollouts

DECAY, DECAY_ROLLOUTS, FULL_ROLLOUTS = 0.35, 10.0, 30.0
"""The bonus is as set after data of `FULL_ROLLOUTS` mean rollouts, and falls to `DECAY` of itself
with the data of each further `DECAY_ROLLOUTS`: a region that is still unexplored then has not been
visited despite its bonus.  With fewer data it is larger by the same rule, up to all of the way to
the optimistic reward (R-max)."""

MIN_STRENGTH = 0.005
"""A smaller bonus is left out."""

MAX_REWARD_SD = 2.0
"""Largest optimistic reward, in standard deviations above the mean reward: where the best reward is
a goal that is seldom reached, an unexplored region need not hold another one."""

KNOWN_SHARE = 0.9
"""Share of the samples that lie within the novelty radius of a sample of another rollout."""

MAX_RADIUS = 0.06
"""Largest novelty radius per factor of the kernel.  Two random samples are about half a unit per
factor apart.  With few rollouts, one that went far is alone in its region, and without this limit
would make every state count as explored."""

MIN_RADIUS = 1e-12
"""Smallest novelty radius: states that are equal up to rounding are explored."""

BLOCK_SIZE = 3_000
"""Samples compared with all others at once, which bounds the memory."""

_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class NoveltyBonus:
    """The exploration bonus of one update.

    Attributes:
        optimistic_reward: per step in an unexplored region, until the restart, standardised.
        average_reward: per step, of the samples with the weights of the update, standardised.
        known_radius: half the squared distance, in lengthscales, up to which a state is explored.
    """

    optimistic_reward: float
    average_reward: float
    known_radius: float

    def novelty(self, similarity: FloatArray) -> FloatArray:
        """Novelty of states, from 0 within the radius to 1 far away.

        Args:
            similarity: of the states to their nearest sample, the kernel's value, of any shape.
        """
        distance = -np.log(np.maximum(similarity, _TINY))
        return -np.expm1(-np.maximum(distance - self.known_radius, 0.0) / self.known_radius)

    def exploration_bonus(self, restart_probability: float) -> float:
        """Total value of reaching an unexplored region, relative to the average reward.

        ``sum_k (1 - p)^k (optimistic_reward - average_reward)`` over the steps k >= 1 to the
        restart.
        """
        steps = (1.0 - restart_probability) / restart_probability
        return steps * (self.optimistic_reward - self.average_reward)

    def optimistic_rewards(self, rollouts: ModelRollouts) -> FloatArray:
        """Rewards (steps, count) of model rollouts if unexplored regions are absorbing.

        Novelty is in [0, 1], and so is the share of a rollout that has been absorbed.  After a
        termination nothing more is absorbed.
        """
        explored = np.ones(rollouts.rewards.shape[1])
        rewards = np.empty_like(rollouts.rewards)
        for t, novelty in enumerate(self.novelty(rollouts.similarity)):
            explored = explored * (1.0 - np.where(rollouts.ended[t], 0.0, novelty))
            optimistic = self.optimistic_reward
            rewards[t] = optimistic + explored * (rollouts.rewards[t] - optimistic)
        return rewards


def novelty_bonus(
    model_env: ModelEnv | None,
    rewards: FloatArray,
    weights: FloatArray,
    initial: float,
    rollouts: float,
) -> NoveltyBonus | None:
    """The exploration bonus of one update; None where there is none.

    Args:
        model_env: of the samples; None if the model cannot be rolled out.
        rewards: (n,) of the samples, standardised.
        weights: (n,) of the first step, which sum to one.
        initial: bonus after `FULL_ROLLOUTS` rollouts, as a share of the way from the average reward
            to the best one.
        rollouts: samples seen so far, in mean lengths of a rollout.
    """
    decayed = DECAY ** ((rollouts - FULL_ROLLOUTS) / DECAY_ROLLOUTS)
    strength = min(initial * decayed, max(1.0, initial))
    if model_env is None or strength < MIN_STRENGTH:
        return None
    radius = novelty_radius(model_env)
    if radius is None:
        return None
    average = float(weights @ rewards)
    best = min(float(rewards.max()), float(rewards.mean()) + MAX_REWARD_SD * float(rewards.std()))
    return NoveltyBonus(average + strength * max(best - average, 0.0), average, radius)


def novelty_radius(model_env: ModelEnv, block_size: int = BLOCK_SIZE) -> float | None:
    """Half the squared distance, in lengthscales, within which most samples have another rollout's.

    Samples of the same rollout do not count, as they are near in any case.

    Args:
        model_env: of the samples.
        block_size: samples compared with all others at once.

    Returns:
        None if all samples are of one rollout.
    """
    states, rollout = model_env.data.states, model_env.data.rollout
    if rollout[0] == rollout[-1]:
        return None
    nearest = []
    for i in range(0, len(states), block_size):
        similarity = model_env.kernel.gram(states[i : i + block_size], states)
        similarity[rollout[i : i + block_size, None] == rollout] = 0.0
        nearest.append(similarity.max(axis=1))
    at_radius = np.quantile(np.concatenate(nearest), 1.0 - KNOWN_SHARE)
    largest = MAX_RADIUS * len(model_env.kernel.lengthscales)
    return min(max(-float(np.log(max(at_radius, _TINY))), MIN_RADIUS), largest)
