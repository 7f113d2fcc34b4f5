"""Comparison of policies in the model, and the settings that depend on the acceptance test."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from kreps.algorithms.acceptance import (
    ModelComparison,
    compare_in_model,
    is_rejected,
    proposal_std_scale,
    standard_error,
    temperature_floor,
)
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.models.dynamics import fit_dynamics
from kreps.models.model_env import ModelEnv, ModelRollouts
from kreps.models.novelty import NoveltyBonus
from kreps.models.reward_model import RewardModel
from kreps.models.transition import state_kernel
from kreps.models.world_model import WorldModel
from kreps.presets import settings_of
from kreps.settings import ModelBased

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]), periodic=(0,))
"""An angle and a speed."""


# ---- settings ---------------------------------------------------------------------------------


def test_the_temperature_floor_is_lower_with_an_acceptance_test() -> None:
    assert temperature_floor(True, settings_of()) == 0.01
    assert temperature_floor(False, settings_of()) == 0.05


@pytest.mark.parametrize("tested", [True, False])
@pytest.mark.parametrize(("eta_floor", "floor"), [(0.3, 0.3), (0.0, 1e-6), (1e-9, 1e-6)])
def test_a_given_temperature_floor_is_used_with_and_without_a_test(
    tested: bool, eta_floor: float, floor: float
) -> None:
    assert temperature_floor(tested, settings_of(eta_floor=eta_floor)) == floor


def test_proposals_are_inflated_only_with_an_acceptance_test() -> None:
    model_based = ModelBased(proposal_std_scale=1.7)
    assert proposal_std_scale(True, model_based) == 1.7
    assert proposal_std_scale(False, model_based) == 1.0


# ---- the test ---------------------------------------------------------------------------------


class Policy:
    """Earns ``mean`` per step, times 1 + ``risk`` times a random number per rollout.

    Attributes:
        similarity: of all its states to their nearest sample.
    """

    def __init__(self, mean: float, risk: float = 0.0, similarity: float = 1.0) -> None:
        self.mean, self.risk, self.similarity = mean, risk, similarity

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        raise AssertionError("the model below does not need the actions")


class ModelOfReturns(ModelEnv):
    """Rollouts of one step with the returns of `Policy`, which share a large random number."""

    def evaluate(
        self, policy: Any, reward: Any, count: int, rng: np.random.Generator, copies: int = 1
    ) -> ModelRollouts:
        assert self.exploring_starts == 0.0 and copies == 1
        draws = rng.standard_normal(count)
        zeros = np.zeros((1, count))
        return ModelRollouts(
            rewards=zeros + policy.mean * (1.0 + policy.risk * draws) + 100.0 * draws,
            similarity=zeros + policy.similarity,
            ended=zeros > 0.0,
        )


def wheel(rollouts: int = 6, steps: int = 20) -> list[Rollout]:
    """A wheel that is pushed at random; the reward is its speed after the step."""
    rng, found = np.random.default_rng(0), []
    for number in range(rollouts):
        states = [np.array([[3.0, 0.0], [-3.0, 0.5]][number % 2])]
        actions = rng.normal(0.0, 1.5, size=(steps, 1))
        for push in TASK.clip(actions)[:, 0]:
            speed = 0.9 * states[-1][1] + 0.2 * push + 0.02 * rng.normal()
            states.append(np.array([states[-1][0] + 0.3 * speed, speed]))
        observations = np.array(states)
        found.append(Rollout(observations, actions, observations[1:, 1]))
    return found


@cache
def learnt_env() -> ModelEnv:
    data, rng = Transitions.from_rollouts(wheel()), np.random.default_rng(0)
    kernel = state_kernel(data, TASK, rng)
    dynamics, *_ = fit_dynamics(data, kernel, TASK, None, rng)
    return ModelEnv(dynamics, data, kernel, TASK, 0.02, 0.5, 20, 0.0)


def world_of(model_env: ModelEnv, rewards: FloatArray, reward_model: Any) -> WorldModel:
    return WorldModel(
        task=TASK,
        states=np.zeros((2, 2)),
        features=np.zeros((2, 1)),
        phi=lambda states: states,
        restart=np.zeros(1),
        expected_features=lambda rows, inputs: inputs,
        dynamics=model_env.dynamics,
        terminations=None,
        reward_model=RewardModel(
            reward_model, float(rewards.mean()), 0.0, float(rewards.min()), float(rewards.max())
        ),
        model_env=model_env,
        bonus=None,
    )


def comparison_of(rollouts: int = 100, seed: int = 0, **changes: Any) -> ModelComparison | None:
    env = learnt_env()
    env = ModelOfReturns(**{field.name: getattr(env, field.name) for field in fields(env)})
    world = world_of(env, np.array([-1000.0, 0.0]), lambda inputs: inputs[:, :1] - 500.0)
    return compare_in_model(replace(world, **changes), rollouts, seed)


def rejects(comparison: ModelComparison | None, new: Any, previous: Any) -> bool:
    """Whether the new policy is worse by more than one standard error."""
    assert comparison is not None
    gain = comparison.returns(new) - comparison.returns(previous)
    return bool(gain.mean() < -standard_error(gain))


def acceptance(new: Any, previous: Any, **changes: Any) -> bool:
    return rejects(comparison_of(**changes), new, previous)


def test_the_standard_error_is_that_of_the_mean_of_differences() -> None:
    # deviations of -3, -1, 1 and 3: a variance of 20 / 3
    assert standard_error(np.array([1.0, 3.0, 5.0, 7.0])) == pytest.approx(
        np.sqrt(20.0 / 3.0 / 4.0)
    )
    assert standard_error(np.full(5, 2.5)) == 0.0


def test_a_policy_with_a_smaller_return_is_rejected() -> None:
    # the common random number is two hundred times as large as the difference
    assert acceptance(Policy(1.0), Policy(1.5)) is True
    assert acceptance(Policy(1.5), Policy(1.0)) is False
    assert acceptance(Policy(1.0), Policy(1.0)) is False


def test_a_difference_within_one_standard_error_is_accepted() -> None:
    rejected = [acceptance(Policy(1.0, 8.0), Policy(1.02), seed=seed) for seed in range(200)]
    # the difference is 0.025 standard errors, so about one in six is rejected
    assert np.mean(np.array(rejected, dtype=float)) == pytest.approx(0.165, abs=0.08)


def test_a_policy_may_leave_the_explored_region() -> None:
    # what is predicted there may be wrong, but then the rollouts of the policy say so
    assert acceptance(Policy(2.0, similarity=0.0), Policy(1.0)) is False
    assert acceptance(Policy(1.0, similarity=0.0), Policy(2.0)) is True


def test_with_an_exploration_bonus_an_unexplored_region_pays_the_optimistic_reward() -> None:
    bonus = NoveltyBonus(optimistic_reward=100.0, average_reward=0.0, known_radius=0.1)
    assert acceptance(Policy(0.5, similarity=0.5), Policy(1.0), bonus=bonus) is False
    assert acceptance(Policy(0.5), Policy(1.0), bonus=bonus) is True  # an explored region


def test_there_is_no_comparison_without_a_model_or_rollouts() -> None:
    assert comparison_of(model_env=None) is None
    assert comparison_of(rollouts=0) is None


# ---- in a learnt model ------------------------------------------------------------------------


class Push:
    """A force, with some noise."""

    def __init__(self, force: float, noise: float = 0.0) -> None:
        self.force, self.noise = force, noise

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.force + self.noise * noise


def comparison_in_learnt_model(rollouts: int, seed: int) -> ModelComparison | None:
    env = learnt_env()
    rewards = env.data.rewards
    world = world_of(env, rewards, lambda x: 0.9 * x[:, 1:2] + 0.4 * x[:, 2:] - rewards.mean())
    return compare_in_model(world, rollouts, seed)


@pytest.mark.parametrize("seed", range(5))
def test_a_learnt_model_rejects_the_worse_of_two_policies(seed: int) -> None:
    comparison = comparison_in_learnt_model(20, seed)
    assert rejects(comparison, Push(-0.15), Push(0.15)) is True
    assert rejects(comparison, Push(0.15), Push(-0.15)) is False


def test_all_policies_of_a_comparison_have_the_same_random_numbers() -> None:
    comparison, other = comparison_in_learnt_model(20, 0), comparison_in_learnt_model(20, 1)
    assert comparison is not None and other is not None
    returns = comparison.returns(Push(0.1, 0.5))
    assert returns.shape == (20,) and len(np.unique(returns)) == 20
    little_more = comparison.returns(Push(0.11, 0.5))
    np.testing.assert_array_equal(comparison.returns(Push(0.1, 0.5)), returns)
    # the difference of two policies varies much less than the returns of one
    gain = little_more - returns
    assert gain.mean() > 0.0 and gain.std() < 0.2 * returns.std()
    assert not np.allclose(other.returns(Push(0.1, 0.5)), returns)


def test_where_episodes_end_a_policy_that_is_no_better_is_rejected() -> None:
    worse, equal, better = np.array([-0.1, 0.09]), np.zeros(2), np.array([-0.09, 0.1])
    assert [is_rejected(gain, True) for gain in (worse, equal, better)] == [True, True, False]
    # elsewhere one that is worse by less than a standard error, 0.095, is not
    assert [is_rejected(gain, False) for gain in (worse, equal, better)] == [False] * 3
    assert is_rejected(worse - 0.1, False)
