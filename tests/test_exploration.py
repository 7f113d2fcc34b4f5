"""Exploration until the reward depends on the state, and which rollouts are remembered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.data.rewards import all_rollouts_informative, is_informative, reward_depends_on_state
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow, append, newest

TASK = TaskSpec(2, np.array([-2.0, -1.0]), np.array([2.0, 1.0]))


def rollout(reward: Any, seed: int = 0, steps: int = 30) -> Rollout:
    """Random commands, some beyond the limits; ``reward(states, applied actions)``."""
    rng = np.random.default_rng(seed)
    states = rng.standard_normal((steps + 1, 2))
    actions = 2.0 * rng.standard_normal((steps, 2))
    return Rollout(states, actions, reward(states[:-1], TASK.clip(actions)))


@pytest.mark.parametrize(
    "reward",
    [
        lambda s, a: np.zeros(len(s)),
        lambda s, a: np.full(len(s), -1.0),
        lambda s, a: -0.1 * a[:, 0] ** 2,
        lambda s, a: 3.0 - a[:, 0] ** 2 - 0.2 * (a[:, 1] - a[:, 0]) ** 2,
        lambda s, a: (-0.1 * a[:, 0] ** 2).astype(np.float32),
    ],
)
def test_constants_and_prices_of_actions_tell_nothing(reward: Any) -> None:
    assert not reward_depends_on_state([rollout(reward, seed) for seed in range(3)], TASK)


@pytest.mark.parametrize(
    "reward",
    [
        lambda s, a: -(s[:, 0] ** 2),
        lambda s, a: -(s[:, 0] ** 2) - a[:, 0] ** 2,
        lambda s, a: -0.1 * a[:, 0] ** 2 + 100.0 * (np.arange(len(s)) == 17),  # a goal, once
        lambda s, a: 1e6 + s[:, 0],
        lambda s, a: -((a[:, 0] - 0.5) ** 2),  # of actions alone, but to do nothing is not best
    ],
)
def test_what_depends_on_states_tells(reward: Any) -> None:
    assert reward_depends_on_state([rollout(reward, seed) for seed in range(3)], TASK)


def test_with_fewer_samples_than_terms_anything_but_a_constant_tells() -> None:
    def of(reward: Any) -> Rollout:
        return rollout(reward, steps=6)  # two actions have six terms

    assert reward_depends_on_state([of(lambda s, a: s[:, 0])], TASK)
    assert not reward_depends_on_state([of(lambda s, a: np.ones(len(s)))], TASK)


@pytest.mark.parametrize("name", ["kreps/SwingUp-v0", "kreps/Reaching-v0", "Pendulum-v1"])
def test_one_roll_out_of_a_dense_reward_tells(name: str) -> None:
    learner = kreps.KREPS(gym.make(name), initial_rollouts=1, rollouts_per_iteration=1)
    learner.learn(1, progress=False)
    assert reward_depends_on_state(learner.state.window.rollouts, learner.task)


TINY: dict[str, Any] = {"initial_rollouts": 4, "rollouts_per_iteration": 2, "window": 4}


@pytest.mark.parametrize("method", [kreps.KREPS, kreps.ValueIteration, kreps.NPALP])
def test_slow_noise_at_the_limits_until_the_reward_tells(method: Any) -> None:
    learner = method(gym.make("MountainCarContinuous-v0"), seed=1, **TINY)
    assert not learner.exploring  # its first policy is its own
    learner.learn(2, progress=False)
    assert learner.exploring
    newest = learner.state.window.rollouts[2:]  # of the second iteration
    np.testing.assert_array_equal(np.abs(np.concatenate([r.actions for r in newest])), 1.0)
    longest = max(newest, key=len)
    assert np.mean(longest.actions[1:] == longest.actions[:-1]) > 0.8  # white noise: one half


def test_a_goal_seen_once_is_learnt_from() -> None:
    learner = kreps.KREPS(gym.make("MountainCarContinuous-v0"), seed=1, **TINY)
    learner.learn(1, progress=False)
    seen = learner.state.window.rollouts[0]
    rewards = np.where(np.arange(len(seen)) == len(seen) - 1, 100.0, seen.rewards)
    learner.update([Rollout(seen.observations, seen.actions, rewards, terminated=True)])
    assert not learner.exploring
    learner.learn(1, progress=False)
    actions = np.concatenate([r.actions for r in learner.state.window.rollouts[-2:]])
    assert (np.abs(actions) != 1.0).any()  # it is the policy that acts


def test_the_progress_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    kreps.KREPS(gym.make("MountainCarContinuous-v0"), seed=1, **TINY).learn(1)
    assert "no reward tells of the states: exploring" in capsys.readouterr().out


def test_pink_noise_brings_the_rod_nearer_to_the_top_than_white_noise() -> None:
    def at_the_top(exploration: str) -> float:
        """Share of the states of four seeds that are near upright."""
        shares = []
        for seed in (161, 162, 163, 164):
            env = gym.make("kreps/SwingUp-v0")
            learner = kreps.KREPS(env, seed=seed, exploration=exploration)
            learner.learn(1, progress=False)
            angles = [r.observations[:, 0] for r in learner.state.window.rollouts]
            shares.append(float(np.mean(np.abs(np.concatenate(angles)) < 0.5)))
        return float(np.mean(shares))

    assert at_the_top("pink") > 2.0 * at_the_top("gaussian")


def test_first_roll_outs_are_as_the_seed_says() -> None:
    def actions() -> np.ndarray:
        learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=5, exploration="pink", **TINY)
        learner.learn(1, progress=False)
        return np.concatenate([r.actions for r in learner.state.window.rollouts])

    np.testing.assert_array_equal(actions(), actions())


# ---- what is remembered -----------------------------------------------------------------------

PRICE = lambda s, a: -0.1 * a[:, 0] ** 2  # noqa: E731
GOAL = lambda s, a: -0.1 * a[:, 0] ** 2 + 100.0 * (np.arange(len(s)) == 5)  # noqa: E731


def of_rewards(rewards: list[Any], steps: int = 20) -> list[Rollout]:
    return [rollout(reward, seed, steps=steps) for seed, reward in enumerate(rewards)]


def test_one_roll_out_tells_if_it_is_long_enough() -> None:
    assert is_informative(rollout(GOAL, steps=7), TASK)  # two actions have six terms
    assert not is_informative(rollout(GOAL, steps=6), TASK)
    assert not is_informative(rollout(PRICE, steps=20), TASK)


def test_a_roll_out_that_tells_nothing_is_noticed_unless_it_is_too_short_to_know() -> None:
    telling = [rollout(GOAL, seed, steps=20) for seed in range(3)]
    assert all_rollouts_informative(telling, TASK)
    assert not all_rollouts_informative([*telling, rollout(PRICE, steps=20)], TASK)
    for steps in (1, 6):
        assert all_rollouts_informative([*telling, rollout(PRICE, steps=steps)], TASK)
    learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=0)
    learner.learn(1, progress=False)
    assert all_rollouts_informative(learner.state.window.rollouts, learner.task)


@pytest.mark.parametrize(
    ("goals", "kept"),
    [
        ([], [4, 5, 6, 7, 8, 9]),  # the latest
        ([0], [0, 5, 6, 7, 8, 9]),
        ([0, 1, 3], [1, 3, 6, 7, 8, 9]),  # a third of the window, no more
        ([0, 8], [0, 5, 6, 7, 8, 9]),
        ([0, 5, 7], [4, 5, 6, 7, 8, 9]),
        (list(range(10)), [4, 5, 6, 7, 8, 9]),
    ],
)
@pytest.mark.parametrize("before", [0, 3, 6])
def test_a_third_of_the_window_is_for_those_that_tell(
    before: int, goals: list[int], kept: list[int]
) -> None:
    seen = of_rewards([GOAL if i in goals else PRICE for i in range(10)])
    window = ReplayWindow(6, tuple(seen[:before]))
    found = append(window, seen[before:], TASK)
    assert found.capacity == 6
    assert [next(i for i, r in enumerate(seen) if r is one) for one in found.rollouts] == kept


@pytest.mark.parametrize("capacity", [None, 20, 10])
def test_what_there_is_room_for_is_kept(capacity: int | None) -> None:
    seen = of_rewards([PRICE, GOAL] * 5)
    found = append(ReplayWindow(capacity, tuple(seen[:4])), seen[4:], TASK)
    assert found == ReplayWindow(capacity, tuple(seen))


@pytest.mark.parametrize(("capacity", "count"), [(None, 10), (30, 10), (12, 8), (6, 4), (2, 2)])
def test_the_latest_are_those_in_no_reserved_place(capacity: int | None, count: int) -> None:
    seen = of_rewards([PRICE] * 10)
    window = append(ReplayWindow(capacity), seen, TASK)
    assert tuple(newest(window)) == tuple(seen[-count:])


def test_it_explores_again_though_a_goal_is_remembered() -> None:
    learner = kreps.KREPS(gym.make("MountainCarContinuous-v0"), seed=1, **TINY | {"window": 6})
    learner.learn(1, progress=False)
    seen = learner.state.window.rollouts[0]
    rewards = np.where(np.arange(len(seen)) == len(seen) - 1, 100.0, seen.rewards)
    goal = Rollout(seen.observations, seen.actions, rewards, terminated=True)
    learner.update([goal])
    assert not learner.exploring
    idle = [replace(r, rewards=-0.1 * np.clip(r.actions[:, 0], -1, 1) ** 2) for r in [seen] * 4]
    learner.update(idle)
    assert goal in learner.state.window.rollouts and learner.exploring
