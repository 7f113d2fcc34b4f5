"""Exploration until the reward depends on the state, and which rollouts the window keeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.data.rewards import is_informative, reward_depends_on_state
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow

TASK = TaskSpec(2, np.array([-2.0, -1.0]), np.array([2.0, 1.0]))


def rollout(reward: Any, seed: int = 0, steps: int = 30) -> Rollout:
    """Random commands, some beyond the limits; ``reward(states, applied actions)``."""
    rng = np.random.default_rng(seed)
    states = rng.standard_normal((steps + 1, 2))
    actions = 2.0 * rng.standard_normal((steps, 2))
    return Rollout(states, actions, reward(states[:-1], TASK.clip(actions)))


def rollouts_of(rewards: list[Any], steps: int = 20) -> Rollouts:
    made = (rollout(reward, seed, steps=steps) for seed, reward in enumerate(rewards))
    return Rollouts.from_list(made)


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
def test_a_constant_less_a_cost_of_actions_does_not_depend_on_the_state(reward: Any) -> None:
    assert not reward_depends_on_state(rollouts_of([reward] * 3, steps=30), TASK)


@pytest.mark.parametrize(
    "reward",
    [
        lambda s, a: -(s[:, 0] ** 2),
        lambda s, a: -(s[:, 0] ** 2) - a[:, 0] ** 2,
        lambda s, a: -0.1 * a[:, 0] ** 2 + 100.0 * (np.arange(len(s)) == 17),  # a goal, once
        lambda s, a: 1e6 + s[:, 0],
        lambda s, a: (
            -((a[:, 0] - 0.5) ** 2)
        ),  # of actions alone, but the zero action is not the best
    ],
)
def test_other_rewards_depend_on_the_state(reward: Any) -> None:
    assert reward_depends_on_state(rollouts_of([reward] * 3, steps=30), TASK)


def test_with_too_few_samples_for_a_fit_only_a_constant_does_not_depend_on_the_state() -> None:
    # a quadratic in two actions has six terms
    assert reward_depends_on_state(rollout(lambda s, a: s[:, 0], steps=6), TASK)
    assert not reward_depends_on_state(rollout(lambda s, a: np.ones(len(s)), steps=6), TASK)


def test_differences_of_rewards_count_from_two_ten_millionths_of_the_largest() -> None:
    def reward(part: float) -> Any:
        return lambda s, a: 100.0 + 100.0 * part * (np.arange(len(s)) == 17)

    assert not reward_depends_on_state(rollout(reward(1.9e-7)), TASK)
    assert reward_depends_on_state(rollout(reward(2.2e-7)), TASK)


@pytest.mark.parametrize("name", ["kreps/SwingUp-v0", "kreps/Reaching-v0", "Pendulum-v1"])
def test_one_rollout_of_a_dense_reward_depends_on_the_state(name: str) -> None:
    learner = kreps.KREPS(gym.make(name), initial_rollouts=1, model_based=None)
    learner.learn(1, progress=False)
    assert reward_depends_on_state(learner.state.window.rollouts, learner.task)


TINY: dict[str, Any] = {"initial_rollouts": 4, "rollouts_per_iteration": 2, "window": 4}
LIGHT: dict[str, Any] = {"model_based.improvement_steps": 1, "model_based.acceptance_rollouts": 5}
SHORT: dict[str, Any] = {**TINY, **LIGHT, "restart_probability": 0.02}


@pytest.mark.parametrize("method", [kreps.KREPS, kreps.ValueIteration, kreps.NPALP])
def test_red_noise_at_the_limits_until_the_reward_depends_on_the_state(method: Any) -> None:
    learner = method(gym.make("MountainCarContinuous-v0"), seed=1, **TINY)
    assert not learner.exploring  # the first policy is that of the settings
    learner.learn(2, progress=False)
    assert learner.exploring
    second = learner.state.window.rollouts[2:]  # of the second iteration
    np.testing.assert_array_equal(np.abs(second.actions), 1.0)
    longest = max(second, key=len)
    assert np.mean(longest.actions[1:] == longest.actions[:-1]) > 0.8  # 0.5 for white noise


def test_one_rollout_that_reaches_the_goal_ends_the_exploration() -> None:
    learner = kreps.KREPS(gym.make("MountainCarContinuous-v0"), seed=1, **SHORT)
    learner.learn(1, progress=False)
    seen = learner.state.window.rollouts[0]
    rewards = np.where(np.arange(len(seen)) == len(seen) - 1, 100.0, seen.rewards)
    learner.update([Rollout(seen.observations, seen.actions, rewards, terminated=True)])
    assert not learner.exploring
    learner.learn(1, progress=False)
    actions = learner.state.window.rollouts[-2:].actions
    assert (np.abs(actions) != 1.0).any()  # as of a learnt policy, not of bang-bang noise


def test_progress_shows_exploration(capsys: pytest.CaptureFixture[str]) -> None:
    kreps.KREPS(gym.make("MountainCarContinuous-v0"), seed=1, **TINY).learn(1)
    assert "no state-dependent reward: exploring" in capsys.readouterr().out


def test_pink_noise_swings_the_rod_up_more_often_than_white_noise() -> None:
    def upright(noise: str) -> float:
        """Fraction of the states of four seeds that are near upright."""
        shares = []
        for seed in (161, 162, 163, 164):
            env = gym.make("kreps/SwingUp-v0")
            noisy = kreps.Exploration(noise)
            learner = kreps.KREPS(env, seed=seed, exploration=noisy, model_based=None)
            learner.learn(1, progress=False)
            angles = learner.state.window.rollouts.points[:, 0]
            shares.append(float(np.mean(np.abs(angles) < 0.5)))
        return float(np.mean(shares))

    assert upright("pink") > 2.0 * upright("gaussian")


def test_the_same_seed_gives_the_same_first_rollouts() -> None:
    def actions() -> np.ndarray:
        pink = kreps.Exploration("pink")
        env = gym.make("kreps/SwingUp-v0")
        learner = kreps.KREPS(env, seed=5, exploration=pink, model_based=None, **TINY)
        learner.learn(1, progress=False)
        return learner.state.window.rollouts.actions

    np.testing.assert_array_equal(actions(), actions())


# ---- what the window keeps --------------------------------------------------------------------

COST = lambda s, a: -0.1 * a[:, 0] ** 2  # noqa: E731
GOAL = lambda s, a: -0.1 * a[:, 0] ** 2 + 100.0 * (np.arange(len(s)) == 5)  # noqa: E731


def test_a_rollout_is_informative_if_it_is_long_enough_and_reaches_the_goal() -> None:
    assert is_informative(rollout(GOAL, steps=7), TASK)  # two actions have six terms
    assert not is_informative(rollout(GOAL, steps=6), TASK)
    assert not is_informative(rollout(COST, steps=20), TASK)


def test_rollouts_that_are_too_short_to_decide_do_not_count_as_uninformative() -> None:
    window = ReplayWindow(TASK, None).append(rollouts_of([GOAL] * 3))
    assert window.informative == (True, True, True) and window.all_informative
    assert not window.append([rollout(COST, steps=20)]).all_informative
    assert not window.append([rollout(COST, steps=7)]).all_informative
    for steps in (1, 6):
        longer = window.append([rollout(COST, steps=steps)])
        assert longer.informative == (True, True, True, False) and longer.all_informative
    learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=0, model_based=None)
    learner.learn(1, progress=False)
    assert learner.state.window.all_informative


def test_the_window_depends_on_the_state_with_one_reward_that_does() -> None:
    window = ReplayWindow(TASK, 6).append(rollouts_of([GOAL] + [COST] * 8))
    assert window.reward_depends_on_state
    assert not window.newest_depend_on_state
    assert window.append([rollout(GOAL)]).newest_depend_on_state
    assert not ReplayWindow(TASK, 6).newest_depend_on_state
    assert not ReplayWindow(TASK, 6).append(rollouts_of([COST] * 8)).reward_depends_on_state


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
def test_a_third_of_the_window_is_reserved_for_informative_rollouts(
    before: int, goals: list[int], kept: list[int]
) -> None:
    seen = rollouts_of([GOAL if i in goals else COST for i in range(10)])
    found = ReplayWindow(TASK, 6).append(seen[:before]).append(seen[before:])
    assert found.capacity == 6
    assert numbers(found.rollouts, seen) == kept
    assert found.informative == tuple(i in goals for i in kept)


def numbers(found: Rollouts, seen: Rollouts) -> list[int]:
    """Number in ``seen`` of each rollout, by its first observation."""
    starts = [tuple(r.observations[0]) for r in seen]
    return [starts.index(tuple(r.observations[0])) for r in found]


@pytest.mark.parametrize("capacity", [None, 20, 10])
def test_all_rollouts_are_kept_while_they_fit(capacity: int | None) -> None:
    seen = rollouts_of([COST, GOAL] * 5)
    found = ReplayWindow(TASK, capacity).append(seen[:4]).append(seen[4:])
    assert numbers(found.rollouts, seen) == list(range(10))
    assert found.informative == (False, True) * 5


@pytest.mark.parametrize(("capacity", "count"), [(None, 10), (30, 10), (12, 8), (6, 4), (2, 2)])
def test_the_newest_are_as_many_as_are_not_reserved(capacity: int | None, count: int) -> None:
    seen = rollouts_of([COST] * 10)
    window = ReplayWindow(TASK, capacity).append(seen)
    assert numbers(window.newest, seen) == list(range(10))[-count:]


def test_it_explores_again_while_only_a_reserved_rollout_reached_the_goal() -> None:
    few = SHORT | {"window": 6, "window_steps": 0}
    learner = kreps.KREPS(gym.make("MountainCarContinuous-v0"), seed=1, **few)
    learner.learn(1, progress=False)
    seen = learner.state.window.rollouts[0]
    rewards = np.where(np.arange(len(seen)) == len(seen) - 1, 100.0, seen.rewards)
    goal = Rollout(seen.observations, seen.actions, rewards, terminated=True)
    learner.update([goal])
    assert not learner.exploring
    idle = [replace(r, rewards=-0.1 * np.clip(r.actions[:, 0], -1, 1) ** 2) for r in [seen] * 4]
    learner.update(idle)
    kept = [r for r in learner.state.window.rollouts if r.terminated]
    assert len(kept) == 1 and kept[0].rewards[-1] == 100.0
    assert learner.exploring


# ---- what the data identify -------------------------------------------------------------------


class Tuning(gym.Env[Any, Any]):
    """Trials of one or a few steps in which the reward is a function of the action alone."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, reward: Any, steps: int, terminates: bool) -> None:
        self.reward, self.steps, self.terminates = reward, steps, terminates

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.left = self.steps
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.left -= 1
        end = self.left == 0
        reward = float(self.reward(float(action[0])))
        return (
            np.zeros(1, np.float32),
            reward,
            end and self.terminates,
            end and not self.terminates,
            {},
        )


@pytest.mark.parametrize(
    ("reward", "best", "steps", "terminates"),
    [
        (lambda a: -((a - 0.7) ** 2), 0.7, 3, False),
        (lambda a: -((a - 0.1) ** 2), 0.1, 1, True),
        (lambda a: -abs(a + 0.3), -0.3, 1, False),
        (lambda a: np.exp(-((a - 0.2) ** 2) / 0.1), 0.2, 3, True),
    ],
)
def test_the_best_action_is_found_if_the_reward_is_of_the_action_alone(
    reward: Any, best: float, steps: int, terminates: bool
) -> None:
    env = Tuning(reward, steps, terminates)
    learner = kreps.KREPS(env, seed=0, **LIGHT).learn(20, progress=False)
    assert not learner.exploring
    action, _ = learner.predict(np.zeros(1), deterministic=True)
    assert action[0] == pytest.approx(best, abs=0.05)


@pytest.mark.parametrize("reward", [lambda a: -(a**2), lambda a: -1.0, lambda a: 0.0])
def test_in_trials_of_one_step_there_is_no_goal_to_explore_for(reward: Any) -> None:
    learner = kreps.KREPS(Tuning(reward, 1, False), seed=0, **LIGHT).learn(2, progress=False)
    assert not learner.exploring


@pytest.mark.parametrize(
    ("low", "high", "reward", "depends"),
    [
        # two actions, whose rewards are those of many costs
        (-1.0, 1.0, lambda a: -((a - 0.1) ** 2), True),
        (-1.0, 2.0, lambda a: -0.1 * a**2, True),
        # the zero action is one of the two
        (0.0, 2.0, lambda a: -0.1 * a**2, False),
        (0.0, 2.0, lambda a: 0.1 * a**2, True),
        # equal rewards tell nothing
        (-1.0, 1.0, lambda a: -0.1 * a**2, False),
    ],
)
def test_a_cost_of_actions_must_be_identified(
    low: float, high: float, reward: Any, depends: bool
) -> None:
    task = TaskSpec(1, np.array([low]), np.array([high]))
    actions = np.random.default_rng(0).choice([low, high], 40)[:, None]
    found = Rollout(np.zeros((41, 1)), actions, reward(actions[:, 0]))
    assert reward_depends_on_state(found, task) == depends
    # any third action determines it
    more = np.append(actions, [[0.5 * (low + high)]], axis=0)
    third = Rollout(np.zeros((42, 1)), more, -0.1 * more[:, 0] ** 2)
    assert not reward_depends_on_state(third, task)
