"""Angles by their numbers: where the turn is cut, and what may jump there."""

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
    WRAP_LENGTHSCALE,
    fit_regression,
    state_actions,
    state_kernel,
    with_wrap_discontinuity,
)

TASK = TaskSpec(2, np.array([-1.0]), np.array([1.0]), periodic=(0,))
TURN = 2.0 * np.pi


def turning(begin: float, samples: int = 400, turns: float = 1.0) -> Transitions:
    """Angles spread over turns from ``begin`` on; the reward is minus their square."""
    rng = np.random.default_rng(0)
    angles = begin + turns * TURN * rng.permutation(samples + 1) / (samples + 1)
    states = np.column_stack([angles, rng.normal(size=samples + 1)])
    rewards = -(states[:-1, 0] ** 2)
    return Transitions.from_rollouts([Rollout(states, rng.uniform(-1, 1, (samples, 1)), rewards)])


def kernels_of(data: Transitions, settings: kreps.Settings) -> tuple[Kernel, Kernel]:
    kernel = state_kernel(data, TASK, np.random.default_rng(0))
    return kernel, with_wrap_discontinuity(kernel, data, TASK, settings)


@pytest.mark.parametrize("begin", [-np.pi, -0.5 * np.pi, 0.0, 4.0])
def test_the_cut_lies_in_the_gap_that_the_angles_leave(begin: float) -> None:
    kernel, cut = kernels_of(turning(begin), kreps.Settings())
    factor = cut.factors[-1]
    assert isinstance(factor, WrapAngle) and factor.dims == (0,)
    assert abs(factor.begin - begin) <= TURN / 401
    residual_signs = begin + np.array([[-0.1, 0.0], [0.1, 0.0]])
    inside = residual_signs + np.array([1.0, 0.0])
    alike = kernel.gram(residual_signs[:1], residual_signs[1:])[0, 0]
    assert kernel.gram(inside[:1], inside[1:])[0, 0] == pytest.approx(alike)
    # across the cut they are nearly a turn apart, elsewhere as near as before
    apart = np.exp(-0.5 * ((TURN - 0.2) / WRAP_LENGTHSCALE) ** 2)
    assert cut.gram(residual_signs[:1], residual_signs[1:])[0, 0] == pytest.approx(alike * apart)
    assert cut.gram(inside[:1], inside[1:])[0, 0] == pytest.approx(alike, rel=0.01)
    # whole turns are not felt: roll-outs in the model do not come back into the range
    np.testing.assert_allclose(
        cut.gram(residual_signs + np.array([3 * TURN, 0.0]), residual_signs),
        cut.gram(residual_signs),
    )


def test_angles_that_count_their_turns_are_not_cut() -> None:
    kernel, cut = kernels_of(turning(0.3, turns=1.7), kreps.Settings())
    states = np.column_stack([np.linspace(-9.0, 9.0, 50), np.zeros(50)])
    np.testing.assert_allclose(cut.gram(states), kernel.gram(states), atol=1e-9)


@pytest.mark.parametrize(
    "settings",
    [kreps.Settings(angles="round"), kreps.Settings(features="grid")],
    ids=["round", "grid"],
)
def test_nothing_is_cut_where_it_is_not_asked_for(settings: kreps.Settings) -> None:
    kernel, cut = kernels_of(turning(0.0), settings)
    assert cut is kernel


def test_the_recipe_of_the_paper_is_round() -> None:
    learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), recipe="paper", initial_rollouts=5)
    value = learner.learn(1, progress=False).state.value
    assert value is not None
    assert isinstance(value.kernel.factors[0], Periodic)
    assert not any(isinstance(factor, WrapAngle) for factor in value.kernel.factors)


def expected_rewards(data: Transitions, kernel: Kernel, around: FloatArray) -> FloatArray:
    """Of angles (m,) at rest without an action, by the reward's regression."""
    targets = (data.rewards - data.rewards.mean())[:, None]
    rng = np.random.default_rng(0)
    regression, _ = fit_regression(data, targets, kernel, TASK, None, rng)
    inputs = np.column_stack([around, np.zeros((len(around), 2))])
    assert inputs.shape[1] == state_actions(data, TASK).shape[1]
    return data.rewards.mean() + regression.predictor(targets)(inputs)[:, 0]


def test_a_reward_of_the_number_is_learnt_up_to_the_cut() -> None:
    data = turning(-0.5 * np.pi)
    concat = np.array([-0.5 * np.pi + 0.05, 1.5 * np.pi - 0.05])
    loo_residuals, missed_cut = (
        np.abs(expected_rewards(data, kernel, concat) + concat**2).max()
        for kernel in kernels_of(data, kreps.Settings())
    )
    assert loo_residuals > 1.0
    assert missed_cut < 0.05


def test_a_reward_that_is_round_loses_nothing() -> None:
    data = turning(-np.pi)
    data = replace(data, rewards=np.cos(data.states[:, 0]))
    around = np.linspace(-np.pi, np.pi, 60)
    for kernel in kernels_of(data, kreps.Settings()):
        assert np.abs(expected_rewards(data, kernel, around) - np.cos(around)).max() < 0.01


@pytest.mark.parametrize("approximation", ["exact", "pivoted", "fourier"])
def test_the_value_function_jumps_with_the_reward_and_survives_a_checkpoint(
    approximation: str, tmp_path: Path
) -> None:
    env = gym.make("kreps/SwingUp-v0")
    jumps = {}
    for angles in ("cut", "round"):
        learner = kreps.KREPS(env, seed=1, angles=angles, approximation=approximation)
        learner.learn(2, progress=False)
        residual_signs = np.array([[1.5 * np.pi - 0.01, 8.0], [-0.5 * np.pi + 0.01, 8.0]])
        low, high = learner.value_function(residual_signs)
        jumps[angles] = high - low
        learner.save(tmp_path / angles)
        again = kreps.KREPS.resume(tmp_path / angles, env)
        np.testing.assert_array_equal(again.value_function(residual_signs), [low, high])
        assert again.learn(1, progress=False).state.iteration == 3
    # the reward does by 10 ((3 pi / 2)^2 - (pi / 2)^2), 197, and V has some of it after two updates
    assert jumps["cut"] > 40.0 > 5.0 * abs(jumps["round"])
