"""The reaching task and the image swing-up: environments, batch models, physics, learning."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import kreps
from kreps.envs import reaching
from kreps.envs.image_swing_up import PIXELS, ImageSwingUpBatch, image
from kreps.envs.references import REFERENCE_REWARDS
from kreps.envs.swing_up import SwingUpBatch
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Periodic, SquaredExponential
from kreps.learning.collect import simulate
from kreps.learning.environment import batch_model_of, task_of
from kreps.learning.evaluate import evaluate
from kreps.policies.exploration import Gaussian

NAMES = [
    "kreps/Reaching-v0",
    "kreps/ImageSwingUp-v0",
    "kreps/AuthorsSwingUp-v0",
    "kreps/AuthorsReaching-v0",
    "kreps/AuthorsImageSwingUp-v0",
]
TINY = {"initial_rollouts": 6, "rollouts_per_iteration": 3, "window": 6}


@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_checker_has_no_substantial_warning(name: str) -> None:
    env = gym.make(name, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # velocities of these tasks are unbounded
        warnings.filterwarnings("ignore", message=".*infinity.*")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version.*")
        check_env(env.unwrapped)


@pytest.mark.parametrize("name", NAMES)
def test_batch_and_environment_give_the_same_trajectories(name: str) -> None:
    env = gym.make(name)
    model = batch_model_of(env)
    assert model is not None
    seeds, steps = [3, 4, 5], 25
    size = env.action_space.shape[0]  # type: ignore[index]
    actions = np.random.default_rng(0).uniform(-40.0, 40.0, (steps, len(seeds), size))
    rngs = [gym.utils.seeding.np_random(seed)[0] for seed in seeds]
    states = model.initial(rngs)
    batch = [model.observe(states)]
    rewards = []
    for a in actions:
        states, r, _ = model.step(states, a, rngs)
        batch.append(model.observe(states))
        rewards.append(r)
    for j, seed in enumerate(seeds):
        single = env.unwrapped
        observation, _ = single.reset(seed=seed)
        np.testing.assert_array_equal(observation, batch[0][j])
        for t in range(steps):
            observation, reward, *_ = single.step(actions[t, j])
            np.testing.assert_array_equal(observation, batch[t + 1][j])
            assert reward == rewards[t][j]


@pytest.mark.parametrize("name", NAMES)
def test_pictures_depend_on_the_state(name: str) -> None:
    env = gym.make(name, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    first: Any = env.render()
    for _ in range(10):
        env.step(env.action_space.high)
    later: Any = env.render()
    assert first.shape == (240, 240, 3)
    assert first.dtype == np.uint8
    assert (first != later).any()


# ---- reaching ---------------------------------------------------------------------------------


def kinetic_energy(state: FloatArray) -> FloatArray:
    """Kinetic energy (m,) of the two rods, from the velocities of their centres."""
    upper, fore = state[:, 0], state[:, 0] + state[:, 1]
    w1, w2 = state[:, 2], state[:, 2] + state[:, 3]
    length, mass = reaching.LINK, reaching.MASS
    inertia = mass * length**2 / 12.0
    first = 0.5 * length * w1
    vx = -length * np.sin(upper) * w1 - 0.5 * length * np.sin(fore) * w2
    vy = length * np.cos(upper) * w1 + 0.5 * length * np.cos(fore) * w2
    return 0.5 * (mass * first**2 + inertia * w1**2 + mass * (vx**2 + vy**2) + inertia * w2**2)


def coast(state: FloatArray, torque: FloatArray, steps: int) -> FloatArray:
    model = reaching.ReachingBatch()
    for _ in range(steps):
        state, _, _ = model.step(state, torque, [None] * len(state))  # type: ignore[list-item]
    return state


def test_energy_of_the_arm_is_conserved_without_torque() -> None:
    rng = np.random.default_rng(1)
    start = np.concatenate([rng.uniform(-3, 3, (6, 2)), rng.uniform(-4, 4, (6, 2))], axis=1)
    end = coast(start, np.zeros((6, 2)), 40)
    np.testing.assert_allclose(kinetic_energy(end), kinetic_energy(start), rtol=1e-5)
    assert np.abs(end[:, 2:] - start[:, 2:]).max() > 0.5


def test_power_of_the_arm_is_that_of_the_torques() -> None:
    h, torque = 1e-5, np.array([[1.3, -0.7]])
    state = np.array([[0.4, 1.1, 0.8, -0.5]])
    moved = state + h * np.concatenate([state[:, 2:], reaching.accelerations(state, torque)], 1)
    power = (kinetic_energy(moved) - kinetic_energy(state)) / h
    np.testing.assert_allclose(power, torque[0] @ state[0, 2:], rtol=1e-3)


def test_the_arm_starts_stretched_upwards_and_its_cost_is_of_distance_and_torque() -> None:
    start = np.array([reaching.START])
    np.testing.assert_allclose(reaching.end_effector(start), [[0.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(reaching.reward(start, np.array([[3.0, 4.0]])), -1.25 - 25e-4)
    folded = np.array([[np.pi / 3, -2 * np.pi / 3, 0.0, 0.0]])
    np.testing.assert_allclose(reaching.end_effector(folded), [reaching.TARGET], atol=1e-12)
    np.testing.assert_allclose(reaching.reward(folded, np.zeros((1, 2))), 0.0, atol=1e-20)


def test_torques_beyond_the_limit_have_the_effect_and_cost_of_the_limit() -> None:
    model, start = reaching.ReachingBatch(), np.array([reaching.START])
    beyond, at = (
        model.step(start, np.array([torques]), [None])  # type: ignore[list-item]
        for torques in ([99.0, -99.0], [10.0, -10.0])
    )
    np.testing.assert_array_equal(beyond[0], at[0])
    np.testing.assert_array_equal(beyond[1], at[1])


def test_angles_stay_inside_the_observation_space() -> None:
    env = gym.make("kreps/Reaching-v0").unwrapped
    env.reset(seed=0)
    for _ in range(100):
        observation, *_ = env.step(np.array([10.0, -10.0]))
        assert env.observation_space.contains(observation)


def test_reference_value_of_random_torques() -> None:
    env = gym.make("kreps/Reaching-v0")
    task = task_of(env)
    found = evaluate(env, task, Gaussian(task, 0.05), restart_probability=0.02, steps=300)
    value = REFERENCE_REWARDS["kreps/Reaching-v0"]["random torques (0.5 N m)"]
    assert found.mean == pytest.approx(value, abs=0.04)


# ---- images -----------------------------------------------------------------------------------


def test_an_image_is_brightest_at_the_rod() -> None:
    def brightest(theta: float) -> FloatArray:
        picture = image(np.array([theta])).reshape(PIXELS, PIXELS)
        rows, columns = np.nonzero(picture > 0.9 * picture.max())
        return np.array([rows.mean(), columns.mean()])

    middle = (PIXELS - 1) / 2
    up, down = brightest(0.0), brightest(np.pi)
    assert up[0] < middle - 2
    assert down[0] > middle + 2
    np.testing.assert_allclose([up[1], down[1]], middle, atol=0.6)
    assert brightest(np.pi / 2)[1] < middle - 2  # a positive angle is counterclockwise: left


def test_a_pixel_falls_off_with_its_distance_from_the_rod() -> None:
    axis = np.linspace(-1.2, 1.2, PIXELS)
    picture = image(np.array([0.0])).reshape(PIXELS, PIXELS)
    row = int(np.argmin(np.abs(-axis - 0.5)))  # beside the upright rod's middle
    np.testing.assert_allclose(picture[row], np.exp(-(axis**2) / (2 * 0.3**2)), rtol=1e-12)


def test_the_difference_image_is_the_change_since_the_previous_step() -> None:
    model = ImageSwingUpBatch()
    rngs = [np.random.default_rng(0)]
    states = model.initial(rngs)
    before = model.observe(states)
    assert not before[:, PIXELS**2 :].any()
    for _ in range(5):
        states, _, _ = model.step(states, np.array([[30.0]]), rngs)
        after = model.observe(states)
        np.testing.assert_array_equal(
            after[:, PIXELS**2 :], after[:, : PIXELS**2] - before[:, : PIXELS**2]
        )
        before = after


def test_dynamics_of_the_image_swing_up_are_those_of_the_swing_up() -> None:
    images, states = ImageSwingUpBatch(), SwingUpBatch()
    one, other = [np.random.default_rng(5)], [np.random.default_rng(5)]
    a, b = images.initial(one), states.initial(other)
    for torque in (30.0, -30.0, 12.0, 0.0):
        a, reward_a, _ = images.step(a, np.array([[torque]]), one)
        b, reward_b, _ = states.step(b, np.array([[torque]]), other)
        np.testing.assert_array_equal(a[:, :2], b)
        assert reward_a == reward_b


def test_observations_are_pixels_with_one_lengthscale_per_image() -> None:
    env = gym.make("kreps/ImageSwingUp-v0")
    task = task_of(env)
    assert task.observation_size == 2 * PIXELS**2
    assert [len(factor.dims) for factor in task.state_factors] == [400, 400]  # type: ignore[attr-defined]
    learner = kreps.KREPS(env, **TINY).learn(1, progress=False)
    for rollout in learner.state.window.rollouts:
        assert rollout.observations.shape[1] == 2 * PIXELS**2
    policy = learner.state.policy
    assert policy is not None
    assert policy.kernel.lengthscales.shape == (2,)


def test_a_learner_from_images_resumes_with_the_same_bytes(tmp_path: Any) -> None:
    env = gym.make("kreps/ImageSwingUp-v0")
    whole = kreps.KREPS(env, seed=1, **TINY).learn(2, progress=False)
    half = kreps.KREPS(env, seed=1, **TINY).learn(1, progress=False)
    half.save(tmp_path / "checkpoint")
    resumed = kreps.KREPS.resume(tmp_path / "checkpoint", env).learn(1, progress=False)
    whole.policy.save(tmp_path / "one")
    resumed.policy.save(tmp_path / "other")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


# ---- groups of coordinates --------------------------------------------------------------------


def test_coordinates_of_a_group_share_a_lengthscale() -> None:
    task = kreps.TaskSpec(5, [-1.0], [1.0], periodic=(0,), groups=((2, 4),))
    assert task.state_factors == (
        Periodic((0,)),
        SquaredExponential((1,)),
        SquaredExponential((2, 4)),
        SquaredExponential((3,)),
    )
    assert task.factor_count == 4


@pytest.mark.parametrize(
    ("groups", "says"),
    [
        (((0, 1), (1, 2)), "two groups"),
        (((0, 1),), "mixes angles"),
        (((2, 9),), "do not exist"),
        (("ab",), "whole number"),
    ],
)
def test_invalid_groups_raise(groups: Any, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        kreps.TaskSpec(3, [-1.0], [1.0], periodic=(0,), groups=groups)


def test_a_grid_over_images_raises_with_a_remedy() -> None:
    env = gym.make("kreps/ImageSwingUp-v0")
    with pytest.raises(ConfigurationError, match="RKHS"):
        kreps.KREPS(env, value=kreps.Grid(), **TINY).learn(1, progress=False)


def test_rollouts_in_batches_and_step_by_step_agree() -> None:
    env = gym.make("kreps/Reaching-v0")
    task = task_of(env)

    class Noise:
        def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
            return 3.0 * noise

    def rollouts(form: gym.Env[Any, Any]) -> kreps.Rollouts:
        rng = np.random.default_rng(0)
        noises = [rng.standard_normal((length, 2)) for length in (7, 3, 9)]
        return simulate(form, task, Noise(), [1, 2, 3], noises)

    wrapped: gym.Env[Any, Any] = gym.Wrapper(env)
    assert batch_model_of(wrapped) is None
    for one, other in zip(rollouts(env), rollouts(wrapped), strict=True):
        np.testing.assert_allclose(one.observations, other.observations, atol=1e-12)
        np.testing.assert_allclose(one.rewards, other.rewards, atol=1e-12)
