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
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.learning.collect import collect
from kreps.models.model_env import ModelRollouts
from kreps.models.novelty import MAX_RADIUS, NoveltyBonus, novelty_bonus, novelty_radius
from kreps.models.reward_model import RewardModel
from kreps.models.world_model import WorldModel
from kreps.policies.base import StochasticPolicy

TASK = TaskSpec(2, np.array([-1.0]), np.array([1.0]))
KERNEL = Kernel(TASK.state_factors, np.array([0.5, 2.0]))

LIMIT = 2.0 * MAX_RADIUS
"""Largest radius with this kernel, which has two factors."""


def rollouts(count: int, seed: int = 0, spread: float = 0.2) -> list[Rollout]:
    """Random states, near enough to each other for a radius below its limit."""
    rng = np.random.default_rng(seed)
    return [
        Rollout(spread * rng.standard_normal((n + 1, 2)), np.zeros((n, 1)), rng.standard_normal(n))
        for n in rng.integers(3, 9, count)
    ]


def model_env(data: Transitions | list[Rollout]) -> Any:
    """Only the samples and the kernel, from which the radius follows."""
    data = data if isinstance(data, Transitions) else Transitions.from_rollouts(data)
    return SimpleNamespace(data=data, kernel=KERNEL)


def half_squared_distance(a: FloatArray, b: FloatArray) -> float:
    return 0.5 * float(np.sum(((a - b) / KERNEL.lengthscales) ** 2))


# ---- the radius -------------------------------------------------------------------------------


def test_most_samples_have_one_of_another_rollout_within_the_radius() -> None:
    made = rollouts(6)
    nearest = [
        min(half_squared_distance(s, t) for o in made if o is not r for t in o.observations[:-1])
        for r in made
        for s in r.observations[:-1]
    ]
    env = model_env(made)
    found = novelty_radius(env)
    assert found is not None and found < LIMIT
    similarity = np.exp(-np.array(nearest))
    assert found == pytest.approx(-np.log(np.quantile(similarity, 0.1)), rel=1e-9)
    assert np.mean(np.array(nearest) <= found) == pytest.approx(0.9, abs=0.03)


def test_the_radius_has_an_upper_limit_per_factor_of_the_kernel() -> None:
    made = rollouts(6, spread=2.0)
    assert novelty_radius(model_env(made)) == LIMIT
    # one factor for both coordinates, and a factor for each of three
    env: Any = SimpleNamespace(
        data=model_env(made).data, kernel=Kernel((SquaredExponential((0, 1)),), np.array([0.1]))
    )
    assert novelty_radius(env) == 0.06
    states = np.random.default_rng(0).normal(size=(10, 3))
    apart = [Rollout(100.0 * s + np.zeros((4, 3)), np.zeros((3, 1)), np.zeros(3)) for s in states]
    kernel = Kernel(TaskSpec(3, np.array([-1.0]), np.array([1.0])).state_factors, np.ones(3))
    env = SimpleNamespace(data=Transitions.from_rollouts(apart), kernel=kernel)
    assert novelty_radius(env) == pytest.approx(0.18)


def test_one_far_rollout_does_not_make_every_state_explored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # two rollouts near the start, and a third one that goes far away
    near = rollouts(2, spread=0.01)
    away = np.stack([np.linspace(0.0, 4.0, 8), np.linspace(0.0, 4.0, 8)], axis=1)
    far = Rollout(away, np.zeros((7, 1)), np.zeros(7))
    env = model_env([*near, far])
    found = novelty_radius(env)
    assert found == LIMIT
    similarity = env.kernel.gram(np.array([[-2.0, -2.0], [0.0, 0.0]]), env.data.states)
    novelty = NoveltyBonus(1.0, 0.0, found).novelty(similarity.max(axis=1))
    assert novelty[0] > 0.99 and novelty[1] == 0.0
    # without the limit, a state on the other side of the start would count as explored
    monkeypatch.setattr("kreps.models.novelty.MAX_RADIUS", np.inf)
    unlimited = novelty_radius(env)
    assert unlimited is not None
    novelty = NoveltyBonus(1.0, 0.0, unlimited).novelty(similarity.max(axis=1))
    assert novelty.tolist() == [0.0, 0.0]


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
    assert novelty_bonus(env, np.arange(3.0), np.ones(3) / 3, initial=0.1, rollouts=0.0) is None


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


def strength(initial: float, rollouts_seen: float) -> float:
    """Of the bonus, as a share of the way from the average reward to the best one; 0 for none."""
    env, rewards, weights = model_env(rollouts(5)), np.arange(9.0), np.eye(9)[2]
    bonus = novelty_bonus(env, rewards, weights, initial, rollouts_seen)
    if bonus is None:
        return 0.0
    assert bonus.average_reward == 2.0
    return (bonus.optimistic_reward - 2.0) / (8.0 - 2.0)


def test_the_bonus_is_as_set_after_thirty_rollouts_and_larger_before() -> None:
    assert strength(0.1, 30.0) == pytest.approx(0.1)
    assert strength(0.1, 40.0) == pytest.approx(0.035)
    assert strength(0.1, 20.0) == pytest.approx(0.1 / 0.35)
    assert strength(0.1, 35.0) == pytest.approx(0.1 * 0.35**0.5)  # not in steps of ten
    # R-max while there are few data
    assert strength(0.1, 3.0) == strength(0.1, 0.0) == pytest.approx(1.0)
    # a bonus beyond the best reward does not grow further
    assert strength(2.0, 3.0) == strength(2.0, 30.0) == pytest.approx(2.0)
    assert strength(2.0, 40.0) == pytest.approx(0.7)


def test_the_bonus_decays_with_the_data_until_it_is_left_out() -> None:
    found = [strength(0.5, 30.0 + 10.0 * tens) for tens in range(6)]
    np.testing.assert_allclose(found[:5], 0.5 * 0.35 ** np.arange(5))
    assert found[4] >= 0.005 > 0.35 * found[4]
    assert found[5] == strength(0.5, 1e6) == 0.0


@pytest.mark.parametrize("rollouts_seen", [0.0, 30.0])
def test_there_is_no_bonus_without_a_model_or_if_it_is_switched_off(rollouts_seen: float) -> None:
    rewards, weights = np.arange(9.0), np.eye(9)[2]
    assert novelty_bonus(None, rewards, weights, 0.5, rollouts_seen) is None
    assert strength(0.0, rollouts_seen) == 0.0


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

    env: Any = SimpleNamespace(
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


def swing_up(bonus: float) -> kreps.KREPS:
    """After the first update, from three mean rollouts of white noise."""
    settings: dict[str, Any] = {
        "exploration": kreps.Exploration("gaussian"),
        "model_based.exploration_bonus": bonus,
        "model_based.improvement_steps": 3,
    }
    learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=248, **settings)
    return learner.learn(1, progress=False)


def angle_of_the_highest_eighth(learner: kreps.KREPS, policy: StochasticPolicy | None) -> float:
    """The angle from the top within which an eighth of the states of a policy's rollouts are."""
    assert policy is not None and learner.env is not None
    made = collect(
        learner.env, learner.task, policy, 10, seed=0, iteration=1, restart_probability=0.02
    )
    angles = np.abs(np.concatenate([rollout.observations[:, 0] for rollout in made]))
    return float(np.quantile(angles, 0.125))


def test_with_a_bonus_an_explorer_reaches_what_white_noise_did_not() -> None:
    learner = swing_up(0.1)
    seen = np.concatenate([r.observations[:, 0] for r in learner.state.window.rollouts])
    assert np.abs(seen).min() > 1.4  # white noise does not reach the top
    # the acting policy holds the local optimum, as it has no bonus
    assert angle_of_the_highest_eighth(learner, learner.state.policy) > 1.5
    assert angle_of_the_highest_eighth(learner, learner.state.explorer) < 1.0


def test_without_a_bonus_there_is_no_explorer() -> None:
    learner = swing_up(0.0)
    assert learner.state.policy is not None and learner.state.explorer is None
