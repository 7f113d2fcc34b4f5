"""The exploration bonus for states that are unlike any sample."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.models.model_env import ModelRollouts
from kreps.models.novelty import NoveltyBonus, novelty_bonus, novelty_radius
from kreps.models.reward_model import RewardModel
from kreps.models.world_model import WorldModel

TASK = TaskSpec(2, np.array([-1.0]), np.array([1.0]))
KERNEL = Kernel(TASK.state_factors, np.array([0.5, 2.0]))


def rollouts(count: int, seed: int = 0) -> list[Rollout]:
    rng = np.random.default_rng(seed)
    return [
        Rollout(rng.standard_normal((n + 1, 2)), np.zeros((n, 1)), rng.standard_normal(n))
        for n in rng.integers(3, 9, count)
    ]


def model_env(data: Transitions | list[Rollout]) -> Any:
    """Only the samples and the kernel, from which the radius follows."""
    data = data if isinstance(data, Transitions) else Transitions.from_rollouts(data)
    return SimpleNamespace(data=data, kernel=KERNEL)


def half_squared_distance(a: FloatArray, b: FloatArray) -> float:
    return 0.5 * float(np.sum(((a - b) / KERNEL.lengthscales) ** 2))


# ---- the radius -------------------------------------------------------------------------------


def test_nine_in_ten_samples_have_one_of_another_rollout_within_the_radius() -> None:
    made = rollouts(6)
    nearest = [
        min(half_squared_distance(s, t) for o in made if o is not r for t in o.observations[:-1])
        for r in made
        for s in r.observations[:-1]
    ]
    found = novelty_radius(model_env(made))
    similarity = np.exp(-np.array(nearest))
    assert found == pytest.approx(-np.log(np.quantile(similarity, 0.1)), rel=1e-9)
    assert np.mean(np.array(nearest) <= found) == pytest.approx(0.9, abs=0.03)


def test_a_subsample_keeps_its_rollout_numbers() -> None:
    made = rollouts(40)
    whole = Transitions.from_rollouts(made)
    chosen = np.arange(0, len(whole), 3)
    sample = whole.rows(chosen)
    similarity = KERNEL.gram(sample.states, sample.states)
    similarity[whole.rollout[chosen, None] == whole.rollout[chosen]] = 0.0
    wanted = -np.log(np.quantile(similarity.max(axis=1), 0.1))
    assert novelty_radius(model_env(sample)) == pytest.approx(wanted, rel=1e-12)
    # the same rows, taken from two chunks
    first = Transitions.from_rollouts(made[:20])
    chunks = first, Transitions.from_rollouts(made[20:])
    parts = [
        chunk.rows(chosen[(chosen >= i) & (chosen < i + len(chunk))] - i)
        for chunk, i in zip(chunks, (0, len(first)), strict=True)
    ]
    assert all(len(part) for part in parts)
    assert novelty_radius(model_env(Transitions.concat(parts))) == pytest.approx(wanted, rel=1e-12)
    assert novelty_radius(model_env(Transitions.concat(chunks))) == novelty_radius(model_env(whole))


def test_the_radius_does_not_depend_on_the_size_of_the_blocks() -> None:
    env = model_env(rollouts(9))
    assert novelty_radius(env, block_size=7) == pytest.approx(novelty_radius(env), rel=1e-9)


def test_one_rollout_alone_gives_no_radius_and_no_bonus() -> None:
    env = model_env(rollouts(1))
    assert novelty_radius(env) is None
    assert novelty_bonus(env, np.arange(3.0), np.ones(3) / 3, initial=0.1, updates=0) is None


def test_equal_states_give_a_positive_radius() -> None:
    same = [Rollout(np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(3))] * 3
    found = novelty_radius(model_env(same))
    assert found is not None and found > 0.0
    novelty = NoveltyBonus(1.0, 0.0, found).novelty(np.array([1.0, 0.99, 0.0]))
    np.testing.assert_array_equal(novelty, [0.0, 1.0, 1.0])


# ---- the bonus --------------------------------------------------------------------------------


def test_novelty_grows_from_zero_at_the_radius_to_one_far_away() -> None:
    distance = np.array([[0.0, 0.5, 0.6, 1.0], [2.0, 50.0, 1e4, 0.4]])
    bonus = NoveltyBonus(optimistic_reward=1.0, average_reward=0.0, known_radius=0.5)
    found = bonus.novelty(np.exp(-distance))
    wanted = 1.0 - np.exp(-np.maximum(distance - 0.5, 0.0) / 0.5)
    np.testing.assert_allclose(found, wanted, atol=1e-14)
    assert found[0, :2].tolist() == [0.0, 0.0] and found[1, 2] == 1.0


def test_the_bonus_is_the_excess_reward_of_all_steps_until_the_restart() -> None:
    bonus = NoveltyBonus(optimistic_reward=-0.5, average_reward=-2.0, known_radius=0.5)
    steps = 0.9 ** np.arange(1, 2000)  # from the step after the action
    assert bonus.exploration_bonus(0.1) == pytest.approx(1.5 * steps.sum(), rel=1e-12)


def test_an_unexplored_region_is_absorbing_in_model_rollouts() -> None:
    bonus = NoveltyBonus(optimistic_reward=7.0, average_reward=0.0, known_radius=0.5)
    known, unknown, half = 1.0, 0.0, np.exp(-0.5 * (1.0 + np.log(2.0)))
    similarity = np.array([[known, known], [known, half], [unknown, known], [known, known]])
    rewards = np.arange(8.0).reshape(4, 2)
    never = np.zeros((4, 2), dtype=bool)
    found = bonus.optimistic_rewards(ModelRollouts(rewards, similarity, never))
    wanted = [[0.0, 1.0], [2.0, (3.0 + 7.0) / 2], [7.0, (5.0 + 7.0) / 2], [7.0, 7.0]]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    # after a termination nothing more is absorbed; what was absorbed before stays
    ended = never.copy()
    ended[2:] = True
    found = bonus.optimistic_rewards(ModelRollouts(rewards, similarity, ended))
    np.testing.assert_allclose(found, [*wanted[:2], [4.0, 6.0], [6.0, 7.0]], rtol=1e-12)


def test_the_bonus_decays_with_each_update_until_it_is_left_out() -> None:
    env = model_env(rollouts(5))
    rewards, weights = np.arange(9.0), np.eye(9)[2]
    optimistic: list[float] = []
    while (bonus := novelty_bonus(env, rewards, weights, 0.5, len(optimistic))) is not None:
        assert bonus.average_reward == 2.0
        optimistic.append(bonus.optimistic_reward)
    strengths = (np.array(optimistic) - 2.0) / (8.0 - 2.0)
    np.testing.assert_allclose(strengths, 0.5 * 0.35 ** np.arange(5))
    assert strengths[-1] >= 0.005 > 0.35 * strengths[-1]
    assert novelty_bonus(None, rewards, weights, 0.5, 0) is None
    assert novelty_bonus(env, rewards, weights, 0.0, 0) is None


def test_the_optimistic_reward_is_never_below_the_average() -> None:
    env = model_env(rollouts(5))
    rewards, weights = np.array([0.0] * 99 + [100.0]), np.eye(100)[-1]
    bonus = novelty_bonus(env, rewards, weights, 0.1, 0)
    assert bonus is not None and bonus.optimistic_reward == bonus.average_reward == 100.0


def test_the_optimistic_reward_is_at_most_two_deviations_above_the_mean() -> None:
    env = model_env(rollouts(5))
    frequent, rare = np.array([0.0, 1.0] * 50), np.array([0.0] * 99 + [100.0])
    weights = np.full(100, 0.01)
    found = [novelty_bonus(env, rewards, weights, 1.0, 0) for rewards in (frequent, rare)]
    assert [bonus.optimistic_reward for bonus in found if bonus is not None] == [
        1.0,
        pytest.approx(rare.mean() + 2.0 * rare.std()),
    ]


# ---- in a model -------------------------------------------------------------------------------


def world_of(
    model_env: Any, reward_model: Any = None, rewards: Any = (-3.0, -1.0, 0.0)
) -> WorldModel:
    return WorldModel(
        task=TASK,
        states=np.zeros((2, 2)),
        features=np.zeros((2, 2)),
        phi=lambda states: states,
        restart=np.array([3.0, -1.0]),
        expected_features=lambda rows, inputs: inputs[:, :2],
        dynamics=None if model_env is None else model_env.dynamics,
        terminations=None,
        reward_model=RewardModel(lambda inputs: inputs[:, :1], 0.0, 0.0, -3.0, 0.0),
        model_env=model_env,
        bonus=NoveltyBonus(optimistic_reward=0.0, average_reward=-2.0, known_radius=0.5),
    )


def test_novelty_is_that_of_the_successor_unless_the_task_terminates() -> None:
    similarity = np.array([1.0, 0.0, 0.0, 0.0])
    termination = np.array([0.0, 0.0, 1.0, 0.25])
    inputs = np.ones((4, 3))

    def nearest(states: FloatArray) -> tuple[None, FloatArray]:
        np.testing.assert_array_equal(states, np.full((4, 2), 2.0))
        return None, similarity

    env = SimpleNamespace(
        dynamics=SimpleNamespace(
            predict=lambda inputs: (inputs[:, :2] + 1.0, termination), terminations=object()
        ),
        nearest=nearest,
    )
    world = world_of(env)
    found, novelty = world.terminations_and_novelty(inputs)
    np.testing.assert_array_equal(found, termination)
    np.testing.assert_allclose(novelty, [0.0, 1.0, 0.0, 0.75])
    for without in (replace(world, model_env=None), replace(world, bonus=None)):
        found, novelty = without.terminations_and_novelty(inputs)
        np.testing.assert_array_equal(found, termination)
        np.testing.assert_array_equal(novelty, np.zeros(4))
    # an embedding predicts no successors, but terminations of actions
    embedded = replace(world, dynamics=None, terminations=lambda inputs: 0.5 * inputs[:, 0])
    found, novelty = embedded.terminations_and_novelty(inputs)
    np.testing.assert_array_equal(found, np.full(4, 0.5))
    np.testing.assert_array_equal(novelty, np.zeros(4))


def test_expected_rewards_are_the_mean_plus_the_model_clipped_to_the_observed_range() -> None:
    inputs = np.random.default_rng(0).normal(size=(50, 3))
    model = RewardModel(lambda inputs: 2.0 * inputs[:, :1], -4.0 / 3.0, 0.8, -3.0, 0.0)
    predicted = -4.0 / 3.0 + 2.0 * inputs[:, 0]
    found = model(inputs, np.zeros(50))
    np.testing.assert_allclose(found, np.clip(predicted, -3.0, 0.0))
    assert (found.min(), found.max()) == (-3.0, 0.0)
    # a termination adds a constant, by its probability
    probabilities = np.linspace(0.0, 1.0, 50)
    found = model(inputs, probabilities)
    np.testing.assert_allclose(found, np.clip(predicted + 0.8 * probabilities, -3.0, 0.0))


def angle_of_the_highest_eighth(bonus: float) -> float:
    """The angle from the top within which an eighth of the states of the second batch are."""
    learner = kreps.KREPS(
        gym.make("kreps/SwingUp-v0"),
        seed=248,
        exploration=kreps.Exploration("gaussian"),
        **{"model_based.exploration_bonus": bonus},
    )
    learner.learn(2, progress=False)
    newest = learner.state.window.rollouts[-10:]
    angles = np.abs(np.concatenate([rollout.observations[:, 0] for rollout in newest]))
    return float(np.quantile(angles, 0.125))


def test_with_a_bonus_a_policy_explores_what_white_noise_did_not() -> None:
    # white noise does not reach the top; without a bonus the policy holds the local optimum
    assert angle_of_the_highest_eighth(0.0) > 1.6
    assert angle_of_the_highest_eighth(0.1) < 1.4
