"""The policy acceptance test, and the settings of an update that depend on it."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from kreps.algorithms.acceptance import proposal_std_scale, rejects, temperature_floor
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.models.dynamics import fit_dynamics
from kreps.models.model_env import ModelEnv, ModelRollouts
from kreps.models.novelty import NoveltyBonus
from kreps.models.reward_model import RewardModel
from kreps.models.terminations import Terminations
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
        self, policies: Any, reward: Any, count: int, rng: np.random.Generator
    ) -> list[ModelRollouts]:
        assert self.exploring_starts == 0.0
        draws = rng.standard_normal(count)
        zeros = np.zeros((1, count))
        return [
            ModelRollouts(
                zeros + policy.mean * (1.0 + policy.risk * draws) + 100.0 * draws,
                zeros + policy.similarity,
                zeros > 0.0,
            )
            for policy in policies
        ]


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


def acceptance(
    new: Any, previous: Any, rollouts: int = 100, seed: int = 0, **changes: Any
) -> bool | None:
    env = learnt_env()
    env = ModelOfReturns(**{field.name: getattr(env, field.name) for field in fields(env)})
    world = world_of(env, np.array([-1000.0, 0.0]), lambda inputs: inputs[:, :1])
    return rejects(new, previous, replace(world, **changes), rollouts, np.random.default_rng(seed))


def test_a_policy_with_a_smaller_return_is_rejected() -> None:
    # the common random number is two hundred times as large as the difference
    assert acceptance(Policy(1.0), Policy(1.5)) is True
    assert acceptance(Policy(1.5), Policy(1.0)) is False
    assert acceptance(Policy(1.0), Policy(1.0)) is False


def test_a_difference_within_one_standard_error_is_accepted() -> None:
    rejected = [acceptance(Policy(1.0, 8.0), Policy(1.02), seed=seed) for seed in range(200)]
    # the difference is 0.025 standard errors, so about one in six is rejected
    assert np.mean(np.array(rejected, dtype=float)) == pytest.approx(0.165, abs=0.08)


def test_a_policy_that_leaves_the_explored_region_is_rejected() -> None:
    assert acceptance(Policy(2.0, similarity=0.5), Policy(1.0)) is True
    # similarities are relative to the typical one of the previous policy
    assert acceptance(Policy(2.0, similarity=1e-3), Policy(1.0, similarity=1e-3)) is False
    assert acceptance(Policy(2.0, similarity=0.0), Policy(1.0, similarity=0.0)) is False


def test_where_episodes_terminate_a_policy_may_leave_the_explored_region() -> None:
    # living longer leads to new states, for which a policy must not be rejected
    env = learnt_env()
    ends = Terminations(lambda successors: np.zeros((len(successors), 1)), np.zeros(120), 0.0)
    env = replace(env, dynamics=replace(env.dynamics, terminations=ends))
    env = ModelOfReturns(**{field.name: getattr(env, field.name) for field in fields(env)})
    assert acceptance(Policy(2.0, similarity=0.5), Policy(1.0), model_env=env) is False
    assert acceptance(Policy(1.0, similarity=0.5), Policy(2.0), model_env=env) is True


def test_with_an_exploration_bonus_an_unexplored_region_pays_the_optimistic_reward() -> None:
    bonus = NoveltyBonus(optimistic_reward=100.0, average_reward=0.0, known_radius=0.1)
    assert acceptance(Policy(0.5, similarity=0.5), Policy(1.0), bonus=bonus) is False
    assert acceptance(Policy(0.5), Policy(1.0), bonus=bonus) is True  # an explored region


def test_there_is_no_test_without_a_previous_policy_a_model_or_rollouts() -> None:
    assert acceptance(Policy(1.0), None) is None
    assert acceptance(Policy(1.0), Policy(1.5), model_env=None) is None
    assert acceptance(Policy(1.0), Policy(1.5), rollouts=0) is None


class Push:
    def __init__(self, force: float) -> None:
        self.force = force

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return np.full((len(states), 1), self.force)


@pytest.mark.parametrize("seed", range(5))
def test_a_learnt_model_rejects_the_worse_of_two_policies(seed: int) -> None:
    env = learnt_env()
    rewards = env.data.rewards
    world = world_of(env, rewards, lambda x: 0.9 * x[:, 1:2] + 0.4 * x[:, 2:] - rewards.mean())
    rng = np.random.default_rng(seed)
    assert rejects(Push(-0.15), Push(0.15), world, 20, rng) is True
    assert rejects(Push(0.15), Push(-0.15), world, 20, rng) is False
