"""The policy acceptance test: a new policy must not be worse than the previous one in the model.

A one-step update can exploit errors of V and of the model together.  Long model rollouts do not
use V, so the new and the previous policy are compared by them, with common random numbers.  The
previous policy acts again where the new one is worse.

Far from the samples the model predicts an average reward, which late in learning is a good one.
So rewards of states that are unlike any sample are shrunk towards the smallest one observed.  While
there is an exploration bonus, these states get that bonus instead.  Rewards are not shrunk where
episodes terminate: a policy that avoids the termination for longer visits new states, and would be
rejected for it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kreps.algorithms.dual import MIN_ETA
from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import ModelRollouts, average_reward
from kreps.models.world_model import WorldModel
from kreps.policies.base import StochasticPolicy
from kreps.settings import ModelBased, Settings

ETA_FLOOR_WITH_ACCEPTANCE_TEST = 0.01
ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST = 0.05
"""Smallest temperatures where ``eta_floor`` is None, in standard deviations of the reward.  Where a
task begins with large costs, these make up the standard deviation, and the cost of holding a goal
badly, about a hundredth of it per step, is not resolved at the higher floor.  Without an acceptance
test the lower one lets the update exploit errors of the model."""


def rejects(
    new: StochasticPolicy,
    previous: StochasticPolicy | None,
    world: WorldModel,
    rollouts: int,
    rng: np.random.Generator,
) -> bool | None:
    """Whether the new policy earns less than the previous one by more than one standard error.

    The standard error is that of start states and noise; it does not contain errors of the model.

    Args:
        new, previous: both with their exploration noise; None before the first update.
        world: the learnt model.
        rollouts: model rollouts per policy; 0 for no test.
        rng: of the rollouts.

    Returns:
        None where there is no test.
    """
    if previous is None or world.model_env is None or not rollouts:
        return None
    model_env = replace(world.model_env, exploring_starts=0.0)
    of_new, of_previous = model_env.evaluate((new, previous), world.reward_model, rollouts, rng)
    can_terminate = model_env.dynamics.terminations is not None
    typical = max(float(np.median(of_previous.similarity)), np.finfo(np.float64).tiny)

    def returns(each: ModelRollouts) -> FloatArray:
        if world.bonus is None and can_terminate:
            rewards = each.rewards
        elif world.bonus is None:
            rewards = each.pessimistic_rewards(world.reward_model.smallest, typical)
        else:
            rewards = world.bonus.optimistic_rewards(each)
        return average_reward(rewards, model_env.restart_probability)

    gain = returns(of_new) - returns(of_previous)
    return bool(gain.mean() < -gain.std(ddof=1) / np.sqrt(rollouts))


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
