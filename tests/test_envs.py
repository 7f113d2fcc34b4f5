"""The swing-up: environment, batch model, physics, reference rewards; random restarts."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import kreps
from kreps.data.task import TaskSpec
from kreps.envs import swing_up
from kreps.envs.references import REFERENCE_REWARDS
from kreps.envs.restart import restart_length, stratified_lengths
from kreps.envs.swing_up import SwingUp, SwingUpBatch
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.learning.environment import task_of
from kreps.learning.evaluate import discounted_average, evaluation_rollouts
from kreps.policies.base import StochasticPolicy

NAME = "kreps/SwingUp-v0"
HANGING = (np.array([np.pi]), np.array([0.0]))


@dataclass(frozen=True)
class Constant:
    """The same torque in every state."""

    torque: float

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return np.full((len(states), 1), self.torque)


@dataclass(frozen=True)
class Uniform:
    """Uniformly random torque within the limits."""

    rng: np.random.Generator

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.rng.uniform(-swing_up.MAX_TORQUE, swing_up.MAX_TORQUE, (len(states), 1))


def energy(theta: FloatArray, velocity: FloatArray) -> FloatArray:
    """Kinetic and potential energy (m,) of the rod in J, zero at rest in the horizontal."""
    return 0.5 * swing_up.INERTIA * velocity**2 + swing_up.WEIGHT_TORQUE * np.cos(theta)


def average_reward(policy: StochasticPolicy, episodes: int = 200) -> float:
    env = gym.make(NAME)
    rollouts = evaluation_rollouts(env, task_of(env), policy, episodes=episodes, steps=400, seed=0)
    return discounted_average(rollouts, 0.02).mean


def lengths_of(env: gym.Env[Any, Any], action: Any, seeds: Sequence[int | None]) -> list[int]:
    """Steps of one episode per seed, which must end with a restart."""
    lengths = []
    for seed in seeds:
        env.reset(seed=seed)
        steps, truncated = 0, False
        while not truncated:
            _, _, terminated, truncated, info = env.step(action)
            steps += 1
            assert not terminated
            assert ("restart" in info) == truncated
        assert info["restart"] is True
        lengths.append(steps)
    return lengths


# ---- the Gymnasium interface ----------------------------------------------------------------


def test_gymnasium_checker_has_no_substantial_warning() -> None:
    recommendations = ("symmetric and normalized space", "value is -infinity", "value is infinity")
    env = gym.make(NAME, render_mode="rgb_array")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=False)
    others = [
        str(w.message) for w in caught if not any(t in str(w.message) for t in recommendations)
    ]
    assert others == []


def test_reset_starts_hanging_at_rest_and_step_returns_python_types() -> None:
    env = gym.make(NAME)
    observation, info = env.reset(seed=0)
    np.testing.assert_array_equal(observation, [np.pi, 0.0])
    assert info == {}
    observation, reward, terminated, truncated, _ = env.step(np.array([5.0]))
    assert observation.shape == (2,) and observation.dtype == np.float64
    assert type(reward) is float
    assert terminated is False and truncated is False


def test_returned_observations_are_not_overwritten_by_later_steps() -> None:
    env = SwingUp()
    first, _ = env.reset(seed=0)
    second = env.step(np.array([10.0]))[0]
    kept = second.copy()
    env.step(np.array([-10.0]))
    np.testing.assert_array_equal(first, [np.pi, 0.0])
    np.testing.assert_array_equal(second, kept)
    second[:] = 99.0  # nor does overwriting them change the state of the environment
    assert np.abs(env.step(np.array([0.0]))[0]).max() < 20.0


def test_metadata_marks_the_angle_and_labels_every_coordinate() -> None:
    env = gym.make(NAME)
    assert env.metadata["periodic_coordinates"] == (0,)
    assert len(env.metadata["observation_labels"]) == 2
    assert len(env.metadata["action_labels"]) == 1
    assert env.metadata["render_fps"] == 20


def test_the_rendered_picture_depends_on_the_state() -> None:
    env = gym.make(NAME, render_mode="rgb_array")
    env.reset(seed=0)
    before = np.asarray(env.render())
    assert before.shape == (240, 240, 3) and before.dtype == np.uint8
    again = np.asarray(env.render())
    np.testing.assert_array_equal(before, again)
    for _ in range(4):
        env.step(np.array([30.0]))
    after = np.asarray(env.render())
    assert (before != after).any(axis=2).sum() > 100


def test_the_picture_shows_upright_above_and_a_positive_angle_on_the_left() -> None:
    def centre_of_rod(theta: float) -> FloatArray:
        env = SwingUp(render_mode="rgb_array")
        env.reset(seed=0)
        env._states = np.array([[theta, 0.0]])
        picture = env.render().astype(int)
        rod = picture[..., 2] - picture[..., 0] > 60  # the rod is the only blue thing
        return np.argwhere(rod).mean(axis=0) - 119.5  # rows downwards, columns to the right

    row, column = centre_of_rod(0.0)
    assert row < -30 and abs(column) < 3
    row, column = centre_of_rod(np.pi / 2)
    assert abs(row) < 3 and column < -30
    assert SwingUp().render() is None


# ---- the batch model --------------------------------------------------------------------------


def test_batch_and_environment_give_the_same_trajectories_from_the_same_seeds() -> None:
    seeds, steps = [3, 14, 159], 60
    actions = np.random.default_rng(0).uniform(-45.0, 45.0, (steps, len(seeds), 1))
    model = SwingUpBatch()
    rngs = [gym.utils.seeding.np_random(seed)[0] for seed in seeds]
    batch = model.initial(rngs)
    envs = [gym.make(NAME) for _ in seeds]
    for j, (env, seed) in enumerate(zip(envs, seeds, strict=True)):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], batch[j])
    for t in range(steps):
        batch, rewards, ends = model.step(batch, actions[t], rngs)
        assert not ends.any()
        for j, env in enumerate(envs):
            observation, reward, *_ = env.step(actions[t, j])
            np.testing.assert_array_equal(observation, batch[j])
            assert reward == rewards[j]


def test_a_row_of_a_batch_does_not_depend_on_other_rows() -> None:
    model = SwingUpBatch()
    states = np.array([[np.pi, 0.0], [0.1, 2.0], [4.0, -3.0]])
    actions = np.array([[5.0], [-30.0], [100.0]])
    seeded = [np.random.default_rng(s) for s in range(3)]
    together, rewards, _ = model.step(states, actions, seeded)
    for j in range(3):
        alone, reward, _ = model.step(
            states[j : j + 1], actions[j : j + 1], [np.random.default_rng(j)]
        )
        np.testing.assert_array_equal(alone[0], together[j])
        assert reward[0] == rewards[j]


# ---- physics ----------------------------------------------------------------------------------


def test_energy_is_conserved_without_friction_noise_and_torque() -> None:
    theta, velocity = np.array([np.pi - 2.0, 0.3, 1.5]), np.array([0.0, 0.5, 9.0])
    start = energy(theta, velocity)
    for _ in range(200):  # ten seconds
        theta, velocity = swing_up.integrate(theta, velocity, np.zeros(3), friction=0.0)
    drift = np.abs(energy(theta, velocity) - start)
    assert drift.max() < 1e-3  # of about 50 J; Euler steps would lose all of it


def test_friction_lowers_the_energy_at_every_step() -> None:
    theta, velocity = np.array([0.5]), np.array([4.0])
    left = [energy(theta, velocity)[0]]
    for _ in range(60):
        theta, velocity = swing_up.integrate(theta, velocity, np.zeros(1))
        left.append(energy(theta, velocity)[0])
    assert (np.diff(left) < 0).all()


def test_the_integrator_has_order_four() -> None:
    def after_one_second(sub_steps: int) -> FloatArray:
        theta, velocity = np.array([2.0]), np.array([1.0])
        for _ in range(20):
            theta, velocity = swing_up.integrate(
                theta, velocity, np.array([7.0]), sub_steps=sub_steps
            )
        return np.concatenate([theta, velocity])

    exact = after_one_second(64)
    errors = [np.abs(after_one_second(k) - exact).max() for k in (1, 2, 4)]
    assert errors[0] / errors[1] > 12.0  # 16 for order four, 8 for order three
    assert errors[1] / errors[2] > 12.0


def test_hanging_is_a_fixed_point_and_upright_is_an_unstable_one() -> None:
    theta, velocity = HANGING
    for _ in range(100):
        theta, velocity = swing_up.integrate(theta, velocity, np.zeros(1))
    assert abs(theta[0] - np.pi) < 1e-12 and abs(velocity[0]) < 1e-12
    theta, velocity = np.array([1e-3, 0.0]), np.zeros(2)
    for _ in range(10):
        theta, velocity = swing_up.integrate(theta, velocity, np.zeros(2))
    # I theta'' = G theta - k theta': half a second of the growing solution
    ratio = swing_up.FRICTION / swing_up.INERTIA
    rate = -ratio / 2 + np.sqrt(ratio**2 / 4 + swing_up.WEIGHT_TORQUE / swing_up.INERTIA)
    assert theta[0] == pytest.approx(0.5e-3 * np.exp(0.5 * rate), rel=0.1)
    assert theta[1] == 0.0


def test_a_positive_torque_turns_counterclockwise_and_cannot_lift_the_pendulum_directly() -> None:
    theta, velocity = HANGING
    highest = np.pi
    for _ in range(400):
        theta, velocity = swing_up.integrate(theta, velocity, np.array([30.0]))
        highest = max(highest, float(theta[0]))
    assert np.pi + 0.5 < highest < 1.5 * np.pi  # it rises, but not to the horizontal
    # at rest the torque balances the weight
    assert swing_up.WEIGHT_TORQUE * np.sin(theta[0] - np.pi) == pytest.approx(30.0, rel=0.05)


def test_torque_beyond_the_limit_has_the_effect_and_cost_of_the_limit() -> None:
    model = SwingUpBatch()
    states = np.tile([2.0, -1.0], (2, 1))
    for beyond, limit in ((500.0, 30.0), (-500.0, -30.0)):
        rngs = [np.random.default_rng(0), np.random.default_rng(0)]
        successors, rewards, _ = model.step(states, np.array([[beyond], [limit]]), rngs)
        np.testing.assert_array_equal(successors[0], successors[1])
        assert rewards[0] == rewards[1]
        assert rewards[0] == pytest.approx(-10 * 2.0**2 - 0.1 - 0.001 * 30.0**2)


def test_noise_of_variance_20_is_added_to_the_clipped_torque_once_a_period() -> None:
    m = 1000
    start = np.tile([np.pi, 0.5], (m, 1))
    rng, twin = np.random.default_rng(0), np.random.default_rng(0)
    successors, rewards, _ = SwingUpBatch().step(start, np.full((m, 1), 40.0), [rng] * m)
    # one number per rollout; the torque can exceed the limit of 30, as noise is added after it
    torque = 30.0 + np.sqrt(20.0) * twin.standard_normal(m)
    theta, velocity = swing_up.integrate(start[:, 0], start[:, 1], torque)
    np.testing.assert_allclose(successors, np.stack([theta, velocity], axis=1), rtol=1e-12)
    assert rng.standard_normal() == twin.standard_normal()
    # the cost is that of the clipped command, without noise
    np.testing.assert_allclose(rewards, -10.0 * np.pi**2 - 0.1 * 0.25 - 0.001 * 900.0, rtol=1e-12)


def test_the_wrapped_angle_stays_inside_the_observation_space() -> None:
    space = SwingUp().observation_space
    assert isinstance(space, gym.spaces.Box)
    wrap = -0.5 * np.pi
    angles = np.array([0.0, np.pi, -np.pi, wrap, np.nextafter(wrap, -9), 1.5 * np.pi, 7.0, 100.0])
    wrapped = swing_up.wrap_angle(angles)
    assert (wrapped >= space.low[0]).all() and (wrapped <= space.high[0]).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)
    assert swing_up.wrap_angle(np.array([np.pi]))[0] == np.pi
    assert swing_up.wrap_angle(np.array([0.0]))[0] == 0.0


def test_reference_value_of_constant_torque_is_a_local_optimum_on_one_side_only() -> None:
    reference = REFERENCE_REWARDS[NAME]["local optimum (constant torque)"]
    assert average_reward(Constant(-30.0)) == pytest.approx(reference, abs=0.7)
    # the cost is 10 theta^2 with theta in [-pi / 2, 3 pi / 2), which is larger beyond pi than below
    assert average_reward(Constant(30.0)) < 2.0 * reference


def test_reference_value_of_zero_torque() -> None:
    reference = REFERENCE_REWARDS[NAME]["zero torque"]
    assert average_reward(Constant(0.0)) == pytest.approx(reference, abs=0.7)


def test_reference_value_of_uniformly_random_torque() -> None:
    reference = REFERENCE_REWARDS[NAME]["uniformly random torque"]
    policy = Uniform(np.random.default_rng(0))
    assert average_reward(policy, episodes=400) == pytest.approx(reference, abs=0.7)


# ---- restarts ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [NAME, "Pendulum-v1"])
def test_restarts_come_after_49_steps_on_average_in_any_environment(name: str) -> None:
    inside = gym.make(name, disable_env_checker=True).unwrapped  # without its own time limit
    env = kreps.RandomRestart(inside)
    action = np.zeros(1, dtype=np.float32)
    lengths = np.array(lengths_of(env, action, range(150)))
    assert lengths.min() >= 1
    standard_error = np.sqrt(0.98) / 0.02 / np.sqrt(len(lengths))
    assert lengths.mean() == pytest.approx(49.0, abs=3 * standard_error)


@pytest.mark.parametrize("probability", [0.02, 0.2])
def test_stratified_lengths_have_the_right_distribution_and_a_sum_that_varies_little(
    probability: float,
) -> None:
    stratified = np.array(
        [stratified_lengths(np.random.default_rng(seed), probability, 30) for seed in range(2000)]
    )
    independent = np.array(
        [restart_length(np.random.default_rng([1, i]), probability) for i in range(20_000)]
    )
    assert stratified.shape == (2000, 30) and stratified.min() >= 1
    # each length has the distribution of an independent one
    for column in (stratified[:, 0], stratified[:, 29]):
        for share in (0.1, 0.5, 0.9):
            limit = np.quantile(independent, share)
            standard_error = np.sqrt(share * (1.0 - share) / len(column))
            found, wanted = np.mean(column <= limit), np.mean(independent <= limit)
            assert found == pytest.approx(wanted, abs=4 * standard_error)
    # their sum varies much less, and their order is random
    sums = stratified.sum(axis=1)
    assert sums.mean() == pytest.approx(30 * independent.mean(), rel=0.03)
    assert sums.std() < 0.25 * np.sqrt(30) * independent.std()
    assert abs(np.corrcoef(stratified[:, 0], stratified[:, 1])[0, 1]) < 0.1


@pytest.mark.parametrize("probability", [1e-300, 1e-20, 1.0 - 1e-12])
@pytest.mark.parametrize("count", [1, 30])
def test_stratified_lengths_are_whole_numbers_for_extreme_probabilities(
    probability: float, count: int
) -> None:
    lengths = stratified_lengths(np.random.default_rng(0), probability, count)
    assert len(lengths) == count and all(type(length) is int for length in lengths)
    assert min(lengths) >= (1 if probability > 0.5 else 10**15)


@pytest.mark.parametrize("count", [10, 30])
def test_the_sum_of_stratified_lengths_has_a_standard_deviation_of_about_50(count: int) -> None:
    sums = [sum(stratified_lengths(np.random.default_rng(i), 0.02, count)) for i in range(2000)]
    assert np.mean(sums) == pytest.approx(49.0 * count, rel=0.02)
    assert np.std(sums) == pytest.approx(50.0, rel=0.1)


def test_restarts_are_reproducible_by_seed_and_continue_without_one() -> None:
    def lengths(first: int) -> list[int]:
        env = kreps.RandomRestart(SwingUp(), probability=0.1)
        return lengths_of(env, np.zeros(1), [first, None, None, None])

    assert lengths(5) == lengths(5)
    assert lengths(5) != lengths(6)
    assert len(set(lengths(5))) > 1  # a reset without a seed draws the next length


def test_a_restart_wrapper_needs_no_seed() -> None:
    env = kreps.RandomRestart(SwingUp(), probability=0.5)
    assert lengths_of(env, np.zeros(1), [None])[0] >= 1


def test_a_restart_returns_the_successor_and_does_not_change_the_environment() -> None:
    env, plain = kreps.RandomRestart(SwingUp(), probability=0.2), SwingUp()
    np.testing.assert_array_equal(env.reset(seed=1)[0], plain.reset(seed=1)[0])
    truncated, steps = False, 0
    while not truncated:
        observation, reward, _, truncated, _ = env.step(np.array([20.0]))
        expected, expected_reward, *_ = plain.step(np.array([20.0]))
        np.testing.assert_array_equal(observation, expected)
        assert reward == expected_reward
        steps += 1
    assert steps > 1  # or this would compare a single step


def test_termination_takes_precedence_over_a_restart() -> None:
    class EndsAtOnce(SwingUp):
        def step(self, action: Any) -> Any:
            observation, reward, _, truncated, info = super().step(action)
            return observation, reward, True, truncated, info

    env = kreps.RandomRestart(EndsAtOnce(), probability=0.999)  # a restart after one step
    env.reset(seed=0)
    _, _, terminated, truncated, info = env.step(np.zeros(1))
    assert terminated and not truncated and "restart" not in info


@pytest.mark.parametrize("probability", [0.0, 1.0, -0.1, 2.0, float("nan")])
def test_an_invalid_restart_probability_raises(probability: float) -> None:
    with pytest.raises(ConfigurationError, match="restart probability"):
        kreps.RandomRestart(SwingUp(), probability)


def test_the_specification_of_the_task_is_that_of_the_environment() -> None:
    task = task_of(kreps.RandomRestart(gym.make(NAME)))
    assert isinstance(task, TaskSpec)
    assert task.observation_size == 2 and task.periodic == (0,)
    np.testing.assert_array_equal(task.action_low, [-30.0])
    np.testing.assert_array_equal(task.action_high, [30.0])
