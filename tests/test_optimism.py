"""What is not known is thought to be good, and what is known is not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.algorithms.generated import generate
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.models.model_env import ModelRollouts
from kreps.models.novelty import (
    DECAY,
    MAX_REWARD_SD,
    MIN_STRENGTH,
    NoveltyBonus,
    novelty_bonus,
    novelty_radius,
)
from kreps.models.world_model import WorldModel

TASK = TaskSpec(2, np.array([-1.0]), np.array([1.0]))
KERNEL = Kernel(TASK.state_factors, np.array([0.5, 2.0]))


def rollouts(count: int, seed: int = 0) -> list[Rollout]:
    rng = np.random.default_rng(seed)
    return [
        Rollout(rng.standard_normal((n + 1, 2)), np.zeros((n, 1)), rng.standard_normal(n))
        for n in rng.integers(3, 9, count)
    ]


def model_env(data: Transitions) -> Any:
    return SimpleNamespace(data=data, kernel=KERNEL)


def half_squared_distance(a: np.ndarray, b: np.ndarray) -> float:
    return 0.5 * float(np.sum(((a - b) / KERNEL.lengthscales) ** 2))


def test_nearly_all_samples_have_one_of_another_rollout_within_the_known_distance() -> None:
    made = rollouts(6)
    nearest = [
        min(half_squared_distance(s, t) for o in made if o is not r for t in o.observations[:-1])
        for r in made
        for s in r.observations[:-1]
    ]
    similarity = np.exp(-np.array(nearest))
    found = novelty_radius(model_env(Transitions.from_rollouts(made)))
    assert found == pytest.approx(-np.log(np.quantile(similarity, 0.1)), rel=1e-9)
    assert np.mean(np.array(nearest) <= found) == pytest.approx(0.9, abs=0.03)


def test_samples_that_are_drawn_keep_their_rollouts() -> None:
    made = rollouts(40)
    whole = Transitions.from_rollouts(made)
    chosen = np.arange(0, len(whole), 3)
    sample = whole.rows(chosen)
    similarity = KERNEL.gram(sample.states, sample.states)
    similarity[whole.rollout[chosen, None] == whole.rollout[chosen]] = 0.0
    wanted = -np.log(np.quantile(similarity.max(axis=1), 0.1))
    assert novelty_radius(model_env(sample)) == pytest.approx(wanted, rel=1e-12)
    # the same roll-outs, drawn from chunk by chunk
    first = Transitions.from_rollouts(made[:20])
    chunks = first, Transitions.from_rollouts(made[20:])
    parts = [
        chunk.rows(chosen[(chosen >= i) & (chosen < i + len(chunk))] - i)
        for chunk, i in zip(chunks, (0, len(first)), strict=True)
    ]
    assert all(len(part) for part in parts)
    assert novelty_radius(model_env(Transitions.concat(parts))) == pytest.approx(wanted, rel=1e-12)
    assert novelty_radius(model_env(Transitions.concat(chunks))) == novelty_radius(model_env(whole))


def test_in_panels_it_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    data = model_env(Transitions.from_rollouts(rollouts(9)))
    whole = novelty_radius(data)
    monkeypatch.setattr("kreps.algorithms.optimism.BLOCK", 7)
    assert novelty_radius(data) == pytest.approx(whole, rel=1e-9)


def outlook_of(bonus: NoveltyBonus | None, model_env: Any) -> WorldModel:
    """Of two features, where the model says that nothing moves and nothing is earned."""
    return WorldModel(
        states=np.zeros((2, 2)),
        features=np.zeros((2, 2)),
        phi=lambda states: states,
        restart=np.array([3.0, -1.0]),
        rewards=np.array([-3.0, 0.0]),
        expected_features_at=lambda rows, inputs: inputs[:, :2],
        reward=lambda given: np.zeros((len(given), 1)),
        model_env=model_env,
        bonus=bonus,
    )


def test_where_an_action_leads_is_unknown_but_not_beyond_a_real_end() -> None:
    alike, ends = np.array([1.0, 0.0, 0.0, 0.0]), np.array([[0.0], [0.0], [1.0], [0.25]])
    inputs = np.ones((4, 3))
    process = SimpleNamespace(
        dynamics=SimpleNamespace(predicted=lambda given: (given[:, :2] + 1.0, ends)),
        nearest=lambda states: (None, np.where((states == 2.0).all(axis=1), alike, np.nan)),
    )
    world = outlook_of(
        NoveltyBonus(optimistic_reward=0.0, average_reward_=-2.0, known_radius=0.5), process
    )
    np.testing.assert_allclose(world.novelty(inputs), [0.0, 1.0, 0.0, 0.75])
    for blind in (replace(world, model_env=None), replace(world, bonus=None)):
        np.testing.assert_array_equal(blind.novelty(inputs), np.zeros(4))


def test_to_the_update_the_unknown_is_earned_at_once_and_followed_by_a_restart() -> None:
    class Halfway:
        """A simulator of which every second imagined action leads to the unknown."""

        dynamics = SimpleNamespace(predicted=lambda inputs: (inputs[:, :2], np.zeros((4, 1))))

        def nearest(self, states: FloatArray) -> tuple[None, FloatArray]:
            return None, np.array([1.0, 0.0, 1.0, 0.0])

    class Still:
        def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
            return np.zeros((len(states), 1))

    settings = kreps.Settings(from_generated=2, imagined_rollouts=0.0)
    weights = np.array([0.5, 0.5])
    sober, hopeful = (
        generate(
            outlook_of(bonus, Halfway()),
            weights,
            Still(),
            TASK,
            settings,
            0.1,
            np.random.default_rng(0),
        ).problem
        for bonus in (
            None,
            NoveltyBonus(optimistic_reward=1.0, average_reward_=-1.0, known_radius=0.5),
        )
    )
    p = settings.restart_probability
    gained = hopeful.rewards - hopeful.rewards.min()
    np.testing.assert_allclose(gained, [0.0, 2.0 * (1.0 - p) / p] * 2)
    assert hopeful.rewards.max() == 0.0 and not sober.rewards.any()
    np.testing.assert_array_equal(hopeful.differences[::2], sober.differences[::2])
    # own features are zero, so that this is a restart for certain
    np.testing.assert_allclose(hopeful.differences[1::2], [[3.0, -1.0]] * 2)


def test_one_rollout_says_nothing_of_what_is_known() -> None:
    alone = model_env(Transitions.from_rollouts(rollouts(1)))
    assert novelty_radius(alone) is None
    assert novelty_bonus(alone, np.arange(3.0), np.ones(3) / 3, 0, kreps.Settings()) is None


def test_equal_states_leave_an_edge_above_zero() -> None:
    same = [Rollout(np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(3))] * 3
    found = novelty_radius(model_env(Transitions.from_rollouts(same)))
    assert found is not None and found > 0.0
    novelty = NoveltyBonus(1.0, 0.0, found).novelty(np.array([1.0, 0.99, 0.0]))
    np.testing.assert_array_equal(novelty, [0.0, 1.0, 1.0])


def test_what_is_far_from_any_sample_is_unknown_and_what_is_near_is_not() -> None:
    far = np.array([[0.0, 0.5, 0.6, 1.0], [2.0, 50.0, 1e4, 0.4]])
    found = NoveltyBonus(optimistic_reward=1.0, average_reward_=0.0, known_radius=0.5).novelty(
        np.exp(-far)
    )
    wanted = 1.0 - np.exp(-np.maximum(far - 0.5, 0.0) / 0.5)
    np.testing.assert_allclose(found, wanted, atol=1e-14)
    assert found[0, :2].tolist() == [0.0, 0.0] and found[1, 2] == 1.0


def test_the_surplus_is_that_of_all_steps_until_the_restart() -> None:
    bonus = NoveltyBonus(optimistic_reward=-0.5, average_reward_=-2.0, known_radius=0.5)
    steps = 0.9 ** np.arange(1, 2000)  # beginning with the one after the action
    assert bonus.exploration_bonus(0.1) == pytest.approx(1.5 * steps.sum(), rel=1e-12)


def test_who_has_found_the_unknown_stays_there() -> None:
    bonus = NoveltyBonus(optimistic_reward=7.0, average_reward_=0.0, known_radius=0.5)
    known, novelty, half = 1.0, 0.0, np.exp(-0.5 * (1.0 + np.log(2.0)))
    similarity = np.array([[known, known], [known, half], [novelty, known], [known, known]])
    rewards = np.arange(8.0).reshape(4, 2)
    never = np.zeros((4, 2), dtype=bool)
    found = bonus.optimistic_rewards(ModelRollouts(rewards, similarity, never))
    still = (7.0 + 7.0) / 2
    wanted = [[0.0, 1.0], [2.0, (3.0 + 7.0) / 2], [7.0, (5.0 + 7.0) / 2], [7.0, still]]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    # after a real end it begins anew
    terminated = never.copy()
    terminated[2] = True
    found = bonus.optimistic_rewards(ModelRollouts(rewards, similarity, terminated))
    np.testing.assert_allclose(found, [*wanted[:3], [6.0, 7.0]], rtol=1e-12)


def test_optimism_falls_at_each_update_and_ends() -> None:
    data = model_env(Transitions.from_rollouts(rollouts(5)))
    settings = kreps.Settings(bonus=0.5)
    rewards, weights = np.arange(9.0), np.eye(9)[2]
    optimistic_reward = []
    while (
        bonus := novelty_bonus(data, rewards, weights, len(optimistic_reward), settings)
    ) is not None:
        assert bonus.average_reward_ == 2.0
        optimistic_reward.append(bonus.optimistic_reward)
    best = rewards.max()
    strengths = (np.array(optimistic_reward) - 2.0) / (best - 2.0)
    np.testing.assert_allclose(strengths, 0.5 * DECAY ** np.arange(len(optimistic_reward)))
    assert strengths[-1] >= MIN_STRENGTH > DECAY * strengths[-1]
    assert novelty_bonus(None, rewards, weights, 0, settings) is None
    assert novelty_bonus(data, rewards, weights, 0, replace(settings, bonus=0.0)) is None


def test_who_earns_the_best_hopes_for_no_less() -> None:
    data = model_env(Transitions.from_rollouts(rollouts(5)))
    rewards, weights = np.array([0.0] * 99 + [100.0]), np.eye(100)[-1]
    bonus = novelty_bonus(data, rewards, weights, 0, kreps.Settings())
    assert bonus is not None and bonus.optimistic_reward == bonus.average_reward_ == 100.0


def test_a_seldom_goal_is_not_hoped_for_everywhere() -> None:
    data = model_env(Transitions.from_rollouts(rollouts(5)))
    often, seldom = np.array([0.0, 1.0] * 50), np.array([0.0] * 99 + [100.0])
    settings, weights = kreps.Settings(bonus=1.0), np.full(100, 0.01)
    hopes = [novelty_bonus(data, rewards, weights, 0, settings) for rewards in (often, seldom)]
    assert [bonus.optimistic_reward for bonus in hopes if bonus is not None] == [
        1.0,
        pytest.approx(seldom.mean() + MAX_REWARD_SD * seldom.std()),
    ]


def visited_height(bonus: float) -> float:
    """The angle from the top that an eighth of the second batch's states are within."""
    learner = kreps.KREPS(
        gym.make("kreps/SwingUp-v0"), seed=248, exploration="gaussian", bonus=bonus
    )
    learner.learn(2, progress=False)
    newest = learner.state.window.rollouts[-10:]
    angles = np.abs(np.concatenate([rollout.observations[:, 0] for rollout in newest]))
    return float(np.quantile(angles, 0.125))


def test_an_optimist_goes_where_it_has_not_been() -> None:
    # white noise showed nothing of the height, and what was learnt of that holds the lean
    assert visited_height(0.0) > 1.6
    assert visited_height(kreps.Settings().bonus) < 1.4
