"""The tasks of the authors' scripts: their constants, and what differs from ours."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.envs.authors.image_swing_up import image
from kreps.envs.authors.reaching import AuthorsReachingBatch, end_effector
from kreps.envs.authors.swing_up import AuthorsSwingUpBatch
from kreps.envs.reaching import ReachingBatch
from kreps.envs.swing_up import SwingUpBatch, integrate
from kreps.kernels.kernel import SquaredExponential
from kreps.learning.environment import batch_model_of, task_of


def generators(count: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, i]) for i in range(count)]


# ---- swing-up ---------------------------------------------------------------------------------


def test_noise_is_added_before_the_torque_is_clipped() -> None:
    count = 2000
    states = np.tile([2.0, 1.0], (count, 1))
    model = AuthorsSwingUpBatch()
    pushed, rewards, ended = model.step(states, np.full((count, 1), 70.0), generators(count))
    # at a command of 50 N m the noise, of 4.5 N m, never matters: the torque is 30 N m
    theta, velocity = integrate(states[:1, 0], states[:1, 1], np.array([30.0]))
    np.testing.assert_allclose(pushed, np.tile([theta[0], velocity[0]], (count, 1)))
    np.testing.assert_allclose(rewards, -40.0 - 0.1 - 1e-3 * 50.0**2)
    assert not ended.any()
    # at 30 N m half of the torques are clipped, and none is larger
    half, _, _ = model.step(states, np.full((count, 1), 30.0), generators(count))
    assert np.mean(np.isclose(half[:, 1], velocity[0])) == pytest.approx(0.5, abs=0.05)
    assert half[:, 1].max() <= velocity[0] + 1e-12
    # and far from the limit the noise has the standard deviation 1 / sqrt(dt)
    free, _, _ = model.step(states, np.zeros((count, 1)), generators(count))
    still, _, _ = SwingUpBatch().step(states, np.zeros((count, 1)), generators(count))
    np.testing.assert_array_equal(free, still)


def test_rollouts_start_at_rest_around_the_hanging_angle() -> None:
    states = AuthorsSwingUpBatch().initial(generators(4000))
    assert (states[:, 1] == 0.0).all()
    assert ((states[:, 0] >= -0.5 * np.pi) & (states[:, 0] < 1.5 * np.pi)).all()
    # the angle pi + 0.4 pi z, wrapped
    turned = np.exp(1j * states[:, 0]).mean()
    assert np.angle(turned) % (2.0 * np.pi) == pytest.approx(np.pi, abs=0.1)
    assert abs(turned) == pytest.approx(np.exp(-0.5 * (0.4 * np.pi) ** 2), abs=0.03)


# ---- reaching ---------------------------------------------------------------------------------


def test_the_joints_are_double_integrators_of_unit_mass() -> None:
    model, action = AuthorsReachingBatch(), np.array([[60.0, -2.0]])
    state = np.array([[0.3, -0.2, 1.0, -3.0]])
    moved, rewards, _ = model.step(state, action, generators(1))
    a, t = np.array([50.0, -2.0]), 0.03
    wanted = [0.3 + t * 1.0 + 0.5 * t**2 * a[0], -0.2 - t * 3.0 + 0.5 * t**2 * a[1]]
    np.testing.assert_allclose(moved[0], [*wanted, 1.0 + t * a[0], -3.0 + t * a[1]])
    tip = [np.sin(0.3) + np.sin(0.1), np.cos(0.3) + np.cos(0.1)]
    cost = (tip[0] - 0.5) ** 2 + tip[1] ** 2 + 1e-4 * (a @ a)
    np.testing.assert_allclose(rewards, -cost)
    np.testing.assert_allclose(end_effector(np.zeros((1, 2))), [[0.0, 2.0]])


def test_the_arm_starts_stretched_at_rest_and_restarts_more_often() -> None:
    env = gym.make("kreps/AuthorsReaching-v0")
    observation, _ = env.reset(seed=1)
    np.testing.assert_array_equal(observation, np.zeros(4))
    task = task_of(env)
    assert (task.periodic, task.dt) == ((0, 1), 0.03)
    np.testing.assert_array_equal(task.action_high, [50.0, 50.0])
    learner = kreps.KREPS(kreps.RandomRestart(env, 0.04))
    assert learner.settings.restart_probability == 0.04


# ---- images -----------------------------------------------------------------------------------


def test_images_are_blurred_renderings_of_the_rod() -> None:
    upright, right = image(np.array([0.0, -0.5 * np.pi])).reshape(2, 20, 20)
    assert np.unravel_index(upright.argmax(), (20, 20))[0] < 10  # in the upper half
    np.testing.assert_allclose(right, np.rot90(upright, -1), atol=2e-3)
    np.testing.assert_allclose(upright, upright[:, ::-1], atol=1e-12)
    # blurred by 20 % of the side: across the rod a Gaussian of 4 pixels, widened by the rod
    row = upright[5] / upright[5].max()
    offsets = np.arange(20) - 9.5
    width = np.sqrt(np.sum(row * offsets**2) / row.sum())
    assert 3.5 < width < 4.5


def test_the_previous_image_is_that_of_an_extrapolated_angle() -> None:
    model: Any = batch_model_of(gym.make("kreps/AuthorsImageSwingUp-v0"))
    states = np.array([[1.0, 2.0], [3.0, -4.0]])
    seen = model.observe(states)
    np.testing.assert_allclose(seen[:, :400], image(states[:, 0]))
    before = image(np.array([1.0 - 0.1, 3.0 + 0.2]))
    np.testing.assert_allclose(seen[:, 400:], seen[:, :400] - before)


def test_images_are_compared_pixel_by_pixel() -> None:
    task = task_of(gym.make("kreps/AuthorsImageSwingUp-v0"))
    assert all(isinstance(factor, SquaredExponential) for factor in task.state_factors)
    assert [len(factor.dims) for factor in task.state_factors] == [400, 400]


# ---- known rewards ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "model", [SwingUpBatch(), ReachingBatch(), AuthorsSwingUpBatch(), AuthorsReachingBatch()]
)
def test_known_rewards_are_those_of_a_step(model: Any) -> None:
    rng = np.random.default_rng(3)
    states = model.initial(generators(5))
    width = 1 if states.shape[1] == 2 else 2
    for _ in range(5):
        actions = rng.normal(0.0, 60.0, (5, width))
        observations = model.observe(states)
        states, rewards, _ = model.step(states, actions, generators(5, 1))
        np.testing.assert_array_equal(model.rewards(observations, actions), rewards)
