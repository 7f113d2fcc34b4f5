"""Comparison of policies by rollouts in the model, and the policy acceptance test.

A one-step update can exploit errors of V and of the model together.  Long model rollouts do not
use V, so policies are compared by them, with common random numbers.  Of the policies of an update
the best one is kept; the previous policy acts again where it is better by more than one standard
error, and where episodes end, if it is no worse or earned more (`kreps.algorithms.real_returns`).

Rewards are used as predicted, also in states that are unlike any sample: a reward of an unknown
state that is too high is corrected by the rollouts that it attracts, and one that is shrunk towards
bad rewards keeps policies near the samples (research record 23).  The explorer gets the exploration
bonus there instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kreps.algorithms.dual import MIN_ETA
from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import ModelEnv, average_reward
from kreps.models.world_model import WorldModel
from kreps.policies.base import StochasticPolicy
from kreps.settings import ModelBased, Settings

ETA_FLOOR_WITH_ACCEPTANCE_TEST = 0.01
ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST = 0.05
"""Smallest temperatures where ``eta_floor`` is None, in standard deviations of the reward.  Where a
task begins with large costs, these make up the standard deviation, and the cost of holding a goal
badly, about a hundredth of it per step, is not resolved at the higher floor.  Without an acceptance
test the lower one lets the update exploit errors of the model."""


@dataclass(frozen=True)
class ModelComparison:
    """Comparison of policies by rollouts in the model, with common random numbers.

    The standard error of a difference is that of start states and noise; it does not contain errors
    of the model.

    Attributes:
        world: the learnt model.
        rollouts: number of rollouts of each policy.
        seed: of starts and noise, which are the same for all policies.
        has_ends: whether any episode of the task has terminated, also if the window has no such
            rollout any more.
    """

    world: WorldModel
    rollouts: int
    seed: int
    has_ends: bool = False

    def returns(self, policy: StochasticPolicy, copies: int = 1) -> FloatArray:
        """Average reward per step (copies * rollouts,) from each start, standardised.

        Args:
            policy: with its exploration noise.
            copies: how often each rollout is made (`ModelEnv.evaluate`).
        """
        world, model_env = self.world, self.from_starts
        rng = np.random.default_rng(self.seed)
        each = model_env.evaluate(policy, world.reward_model, self.rollouts, rng, copies)
        bonus = world.bonus
        rewards = each.rewards if bonus is None else bonus.optimistic_rewards(each)
        return average_reward(rewards, model_env.restart_probability)

    @cached_property
    def from_starts(self) -> ModelEnv:
        """The model whose rollouts all begin in start states, with what it computes only once."""
        assert self.world.model_env is not None
        return replace(self.world.model_env, exploring_starts=0.0)


def standard_error(gain: FloatArray) -> float:
    """Of the mean of differences (n,)."""
    return float(gain.std(ddof=1) / np.sqrt(len(gain)))


def is_worse(gain: FloatArray) -> bool:
    """Whether the mean of the differences (n,) is below zero by more than its standard error."""
    return not gain.mean() >= -standard_error(gain)


def is_rejected(gain: FloatArray, has_ends: bool) -> bool:
    """Whether the new policy is worse than the previous one.

    Where episodes end, whether it is no better: policies that keep all episodes going have equal
    returns in the model, and one that has stood the test in truth is not given up for another.

    Args:
        gain: (rollouts,) returns of the new policy relative to the previous one.
        has_ends: whether episodes end.
    """
    return not gain.mean() > 0.0 if has_ends else is_worse(gain)


def compare_in_model(
    world: WorldModel, rollouts: int, seed: int, has_ends: bool = False
) -> ModelComparison | None:
    """The comparison of an update; None where there is none.

    Args:
        world, seed, has_ends: as of `ModelComparison`.
        rollouts: per policy; 0 for no comparison.
    """
    if world.model_env is None or not rollouts:
        return None
    return ModelComparison(world, rollouts, seed, has_ends)


def temperature_floor(tested: bool, settings: Settings) -> float:
    """Smallest eta of the dual, in standard deviations of the reward: as set, or by default.

    Args:
        tested: whether the new policy has to pass the acceptance test.
        settings: ``eta_floor``.
    """
    floor = settings.eta_floor
    if floor is None:
        floor = ETA_FLOOR_WITH_ACCEPTANCE_TEST if tested else ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST
    return max(floor, MIN_ETA)


def proposal_std_scale(tested: bool, model_based: ModelBased) -> float:
    """Factor by which the policy's standard deviation is inflated when actions are generated.

    The policy fitted to them is deflated by the same factor and soon explores little, so it is 1
    where there is no acceptance test.
    """
    return model_based.proposal_std_scale if tested else 1.0
