"""The discontinuity of V and of the reward model where an angle wraps around."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel, Periodic, WrapAngle
from kreps.models.transition import (
    fit_regression,
    state_actions,
    state_kernel,
    with_wrap_discontinuity,
)
from kreps.settings import RKHS, Grid

TASK = TaskSpec(2, np.array([-1.0]), np.array([1.0]), periodic=(0,))
TURN = 2.0 * np.pi


def turning(begin: float, samples: int = 400, turns: float = 1.0) -> Transitions:
    """Angles spread over turns from ``begin`` on; the reward is minus their square."""
    rng = np.random.default_rng(0)
    angles = begin + turns * TURN * rng.permutation(samples + 1) / (samples + 1)
    states = np.column_stack([angles, rng.normal(size=samples + 1)])
    rewards = -(states[:-1, 0] ** 2)
    return Transitions.from_rollouts([Rollout(states, rng.uniform(-1, 1, (samples, 1)), rewards)])


def kernels_of(data: Transitions, value: RKHS | Grid) -> tuple[Kernel, Kernel]:
    """The periodic kernel, and that of V."""
    kernel = state_kernel(data, TASK, np.random.default_rng(0))
    return kernel, with_wrap_discontinuity(kernel, data, TASK, value)


@pytest.mark.parametrize("begin", [-np.pi, -0.5 * np.pi, 0.0, 4.0])
def test_the_wrap_point_is_in_the_gap_that_the_angles_leave(begin: float) -> None:
    kernel, wrapped = kernels_of(turning(begin), RKHS())
    factor = wrapped.factors[-1]
    assert isinstance(factor, WrapAngle) and factor.dims == (0,)
    assert abs(factor.begin - begin) <= TURN / 401
    either_side = begin + np.array([[-0.1, 0.0], [0.1, 0.0]])
    inside = either_side + np.array([1.0, 0.0])
    similarity = kernel.gram(either_side[:1], either_side[1:])[0, 0]
    assert kernel.gram(inside[:1], inside[1:])[0, 0] == pytest.approx(similarity)
    # on either side of the wrap point the distance is nearly a turn, elsewhere it is as before
    apart = np.exp(-0.5 * ((TURN - 0.2) / np.pi) ** 2)
    found = wrapped.gram(either_side[:1], either_side[1:])[0, 0]
    assert found == pytest.approx(similarity * apart)
    assert wrapped.gram(inside[:1], inside[1:])[0, 0] == pytest.approx(similarity, rel=0.01)
    # angles of model rollouts may leave the range; whole turns do not matter
    np.testing.assert_allclose(
        wrapped.gram(either_side + np.array([3 * TURN, 0.0]), either_side),
        wrapped.gram(either_side),
    )


def test_angles_that_count_whole_turns_have_no_discontinuity() -> None:
    kernel, wrapped = kernels_of(turning(0.3, turns=1.7), RKHS())
    states = np.column_stack([np.linspace(-9.0, 9.0, 50), np.zeros(50)])
    np.testing.assert_allclose(wrapped.gram(states), kernel.gram(states), atol=1e-9)


@pytest.mark.parametrize("value", [RKHS(angle_wrap="continuous"), Grid()], ids=["rkhs", "grid"])
def test_a_continuous_value_has_the_periodic_kernel(value: RKHS | Grid) -> None:
    kernel, wrapped = kernels_of(turning(0.0), value)
    assert wrapped is kernel


def test_the_value_of_the_papers_preset_is_periodic() -> None:
    learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), preset="paper", initial_rollouts=5)
    value = learner.learn(1, progress=False).state.value
    assert value is not None
    assert isinstance(value.kernel.factors[0], Periodic)
    assert not any(isinstance(factor, WrapAngle) for factor in value.kernel.factors)


def expected_rewards(data: Transitions, kernel: Kernel, angles: FloatArray) -> FloatArray:
    """Predictions (m,) of the reward regression for angles (m,) at rest, without an action."""
    targets = (data.rewards - data.rewards.mean())[:, None]
    rng = np.random.default_rng(0)
    regression, _ = fit_regression(data, targets, kernel, TASK, None, rng)
    inputs = np.column_stack([angles, np.zeros((len(angles), 2))])
    assert inputs.shape[1] == state_actions(data, TASK).shape[1]
    return data.rewards.mean() + regression.predictor(targets)(inputs)[:, 0]


def test_a_reward_that_is_a_function_of_the_angle_is_learnt_up_to_the_wrap_point() -> None:
    data = turning(-0.5 * np.pi)
    angles = np.array([-0.5 * np.pi + 0.05, 1.5 * np.pi - 0.05])
    periodic, wrapped = (
        np.abs(expected_rewards(data, kernel, angles) + angles**2).max()
        for kernel in kernels_of(data, RKHS())
    )
    assert periodic > 1.0
    assert wrapped < 0.05


def test_a_periodic_reward_is_learnt_as_well_with_a_discontinuity() -> None:
    data = turning(-np.pi)
    data = replace(data, rewards=np.cos(data.states[:, 0]))
    angles = np.linspace(-np.pi, np.pi, 60)
    for kernel in kernels_of(data, RKHS()):
        assert np.abs(expected_rewards(data, kernel, angles) - np.cos(angles)).max() < 0.01


@pytest.mark.parametrize("low_rank", [None, kreps.LowRank(above=0)], ids=["exact", "low rank"])
def test_the_value_function_jumps_with_the_reward_and_is_restored_from_a_checkpoint(
    low_rank: kreps.LowRank | None, tmp_path: Path
) -> None:
    env = gym.make("kreps/SwingUp-v0")
    jumps = {}
    for wrap in ("discontinuous", "continuous"):
        few = {"initial_rollouts": 30, "growth": 0.0, "model_based": None}
        learner = kreps.KREPS(env, seed=1, low_rank=low_rank, **few, **{"value.angle_wrap": wrap})
        learner.learn(2, progress=False)
        either_side = np.array([[1.5 * np.pi - 0.01, 8.0], [-0.5 * np.pi + 0.01, 8.0]])
        low, high = learner.value_function(either_side)
        jumps[wrap] = high - low
        learner.save(tmp_path / wrap)
        again = kreps.KREPS.resume(tmp_path / wrap, env)
        np.testing.assert_array_equal(again.value_function(either_side), [low, high])
        assert again.learn(1, progress=False).state.iteration == 3
    # the reward jumps by 10 ((3 pi / 2)^2 - (pi / 2)^2) = 197; after two updates V has a part of it
    assert jumps["discontinuous"] > 40.0 > 5.0 * abs(jumps["continuous"])
