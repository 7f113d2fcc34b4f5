"""The gradient of the return in the model, and the ascent along it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from kreps.algorithms.acceptance import ModelComparison
from kreps.algorithms.policy_gradient import (
    GRADIENT,
    Ascent,
    improve,
    natural_direction,
)
from kreps.algorithms.random_policies import RandomLinear, best_random_policy
from kreps.data.history import stacked
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.basis import KernelExpansion
from kreps.kernels.kernel import (
    Kernel,
    Periodic,
    SmoothedImage,
    SquaredExponential,
    WrapAngle,
)
from kreps.kernels.regression import KernelEmbedding
from kreps.models import return_gradient
from kreps.models.dynamics import fit_dynamics
from kreps.models.model_env import ModelEnv
from kreps.models.return_gradient import FixedNoise, action_gradient
from kreps.models.reward_model import RewardModel
from kreps.models.transition import state_actions, state_kernel
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP
from tests.compared import compared_in

TASKS = {
    "plain": TaskSpec(2, np.array([-2.0]), np.array([2.0]), periodic=(0,)),
    "ends": TaskSpec(2, np.array([-2.0]), np.array([2.0]), periodic=(0,)),
    "history": TaskSpec(2, np.array([-2.0]), np.array([2.0]), periodic=(0,), history=1, delay=2),
}
"""A wheel: an angle in rad and a speed, which a force changes."""


def wheel(ends: bool) -> list[Rollout]:
    """The wheel under random forces; fast ones end an episode."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(12):
        states, actions = [rng.normal(0.0, 0.5, 2)], rng.normal(0.0, 1.5, (20, 1))
        for force in np.clip(actions[:, 0], -2.0, 2.0):
            speed = 0.9 * states[-1][1] + 0.3 * force
            states.append(np.array([states[-1][0] + 0.3 * speed, speed]))
            if ends and abs(speed) > 1.2:
                break
        observations = np.array(states)
        steps = len(observations) - 1
        rewards = np.cos(observations[1:, 0]) - 0.05 * observations[1:, 1] ** 2
        terminated = ends and steps < 20
        found.append(Rollout(observations, actions[:steps], rewards, terminated=terminated))
    return found


@cache
def comparison(name: str) -> ModelComparison:
    """The learnt model without noise, so that the return is a smooth function of the policy."""
    task, rng = TASKS[name], np.random.default_rng(0)
    data = stacked(Rollouts.from_list(wheel(name == "ends")), task).transitions
    kernel = state_kernel(data, task, rng)
    dynamics, _, _ = fit_dynamics(data, kernel, task, None, rng)
    assert (dynamics.terminations is not None) == (name == "ends")
    dynamics = replace(dynamics, loo_residuals=np.zeros_like(dynamics.loo_residuals))
    targets = data.rewards[:, None] - data.rewards.mean()
    of_action = Kernel((SquaredExponential((task.state_size,)),), np.full(1, 1e6))  # no effect
    factors = (*kernel.factors, *of_action.factors)
    over_both = Kernel(factors, np.append(2.0 * kernel.lengthscales, of_action.lengthscales))
    regression = KernelEmbedding.fit(over_both, state_actions(data, task), 1e-2)
    reward_model = RewardModel(
        regression.predictor(targets), float(data.rewards.mean()), -0.5, -9.0, 9.0
    )
    env = ModelEnv(dynamics, data, kernel, task, 0.1, 0.0, 15, -2.0)
    return compared_in(env, reward_model, 8, seed=3)


def policy_of(name: str, noise: float = 0.01) -> CostSensitiveGP:
    """A weak spring, far from the best policy and from the limits of the force."""
    compared = comparison(name)
    assert compared.world.model_env is not None
    states = compared.world.states[::6]
    targets = -0.2 * np.sin(states[:, :1])
    kernel = compared.world.model_env.kernel
    full = Kernel(TASKS[name].state_factors, np.full(TASKS[name].factor_count, 1.5))
    assert len(kernel.factors) <= len(full.factors)
    weights = np.ones(len(states))
    return CostSensitiveGP(TASKS[name], full, states, targets, weights, 1.0, noise)


# ---- derivatives ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "factors",
    [
        (SquaredExponential((0, 2)), SquaredExponential((1,))),
        (Periodic((1,)), SquaredExponential((0,))),
        (Periodic((0, 2)), WrapAngle((0,), -3.0)),
        (SmoothedImage((0, 1, 2, 3), (2, 2)),),
    ],
)
def test_derivatives_of_kernel_functions_are_differences_of_them(factors: Any) -> None:
    rng = np.random.default_rng(0)
    kernel = Kernel(factors, 0.5 + rng.uniform(size=len(factors)))
    function = KernelExpansion(kernel, rng.normal(size=(7, 4)), rng.normal(size=(7, 3)))
    points, step = rng.normal(size=(5, 4)), 1e-6
    slopes = function.jacobian(points)
    assert slopes.shape == (5, 3, 4)
    for j, unit in enumerate(np.eye(4)):
        change = function(points + step * unit) - function(points - step * unit)
        np.testing.assert_allclose(slopes[:, :, j], change / (2.0 * step), atol=1e-7)


@pytest.mark.parametrize("name", list(TASKS))
def test_derivatives_of_successors_are_differences_of_them(name: str) -> None:
    dynamics = comparison(name).world.dynamics
    assert dynamics is not None
    rng, step = np.random.default_rng(1), 1e-6
    width = TASKS[name].state_size + 1
    inputs = rng.normal(0.0, 0.4, (6, width))
    slopes = dynamics.jacobian(inputs)
    assert slopes.shape == (6, TASKS[name].state_size, width)
    for j, unit in enumerate(np.eye(width)):
        later, earlier = (dynamics.predict(inputs + s * step * unit)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(slopes[:, :, j], (later - earlier) / (2.0 * step), atol=1e-5)


@pytest.mark.parametrize("name", list(TASKS))
def test_the_gradient_is_the_derivative_of_the_return(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By changes of the policy's mean, through all steps; the limit against growth is off."""
    monkeypatch.setattr(return_gradient, "_adjoint_limits", lambda env, shares, *_: shares + np.inf)
    compared = comparison(name)
    env, policy = compared.from_starts, policy_of(name).predictor
    rng = np.random.default_rng(compared.seed)
    ascent = Ascent(compared, FixedNoise.of_policy(env, policy, 8, rng))
    value, record, rewards = ascent.evaluate(policy)
    if name == "ends":
        assert (record.alive[-1] < 0.9).any()
    assert (np.abs(record.commanded) < 1.0).all()
    gradient = action_gradient(env, policy, record, rewards)
    states = record.states.reshape(-1, TASKS[name].state_size)
    by_weights = policy.kernel_values(states).T @ gradient.reshape(len(states), -1) / 8
    step = 1e-6
    for seed in range(3):
        change = np.random.default_rng(seed).normal(size=policy.mean_weights.shape)
        ahead, behind = (
            ascent.evaluate(replace(policy, mean_weights=policy.mean_weights + s * step * change))[
                0
            ]
            for s in (1.0, -1.0)
        )
        wanted = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(np.sum(by_weights * change), wanted, rtol=2e-4, atol=1e-6)
    assert np.isfinite(value)


def test_the_return_is_that_of_the_comparison_where_no_episode_ends() -> None:
    compared = comparison("plain")
    policy = policy_of("plain").predictor
    rng = np.random.default_rng(compared.seed)
    ascent = Ascent(compared, FixedNoise.of_policy(compared.from_starts, policy, 8, rng))
    np.testing.assert_allclose(
        ascent.evaluate(policy)[0], compared.returns(policy).mean(), rtol=1e-10
    )


def test_derivatives_do_not_grow_without_limit_in_an_unstable_loop() -> None:
    """A policy that pushes away from the upright position, as steeply as a kernel can."""
    compared = comparison("plain")
    env, policy = compared.from_starts, policy_of("plain").predictor
    steep = replace(policy, mean_weights=-300.0 * policy.mean_weights)
    rng = np.random.default_rng(compared.seed)
    ascent = Ascent(compared, FixedNoise.of_policy(env, steep, 8, rng))
    _, record, rewards = ascent.evaluate(steep)
    gradient = action_gradient(env, steep, record, rewards)
    assert np.isfinite(gradient).all()
    slopes, _ = rewards.slopes(record)
    scale = env.data.states.std(axis=0)
    typical = np.sqrt(np.mean(np.sum((slopes[:, :, :2] * scale) ** 2, axis=2)))
    by_action = env.dynamics.jacobian(record.inputs.reshape(-1, 3))[:, :, 2:] / scale[:, None]
    largest = typical * np.linalg.norm(by_action, axis=1).max() + np.abs(slopes[:, :, 2]).max()
    assert np.abs(gradient).max() <= largest * (1.0 + 1e-9)


# ---- ascent -----------------------------------------------------------------------------------


def test_a_direction_changes_the_actions_by_one_and_follows_the_gradient() -> None:
    policy = policy_of("plain").predictor
    states = comparison("plain").world.states[:100]
    weights = np.random.default_rng(0).uniform(size=100)
    weights /= weights.sum()
    wanted = np.cos(states[:, :1])  # a smooth change, which the policy can represent
    found = natural_direction(policy, states, weights[:, None] * wanted, weights)
    change = policy.kernel_values(states) @ found
    np.testing.assert_allclose(weights @ np.sum(change**2, axis=1), 1.0, rtol=1e-9)
    # a natural gradient is the change of the actions itself, not its image under the kernel
    limited = np.clip(wanted, -np.inf, 0.5 * float(weights @ np.abs(wanted[:, 0])))
    limited = np.sign(wanted) * np.minimum(np.abs(wanted), np.abs(limited).max())
    assert np.corrcoef(change[:, 0], limited[:, 0])[0, 1] > 0.95


@pytest.mark.parametrize("name", list(TASKS))
def test_the_ascent_raises_the_return_and_keeps_the_noise(name: str) -> None:
    compared, policy = comparison(name), policy_of(name)
    improved = improve(compared, policy.predictor, 10)
    assert isinstance(improved, SparseGP)
    noise = FixedNoise.of_policy(
        compared.from_starts, policy.predictor, 8, np.random.default_rng((compared.seed, GRADIENT))
    )
    ascent = Ascent(compared, noise)
    assert ascent.evaluate(improved)[0] > ascent.evaluate(policy.predictor)[0] + 0.02
    if name != "ends":  # there the comparison has random ends
        assert compared.returns(improved).mean() > compared.returns(policy).mean()
    states = compared.world.states[:20]
    np.testing.assert_allclose(
        improved.standard_deviation(states), policy.standard_deviation(states), rtol=1e-9
    )
    again = improve(compared, policy.predictor, 10)
    np.testing.assert_array_equal(again.mean_weights, improved.mean_weights)


def test_without_steps_or_gain_the_policy_stays() -> None:
    compared, policy = comparison("plain"), policy_of("plain").predictor
    np.testing.assert_array_equal(improve(compared, policy, 0).mean_weights, policy.mean_weights)
    flat = replace(
        compared.world.reward_model,
        regression=KernelExpansion(
            Kernel((SquaredExponential((0,)),), np.ones(1)), np.zeros((1, 3)), np.zeros((1, 1))
        ),
    )
    indifferent = replace(compared, world=replace(compared.world, reward_model=flat))
    found = improve(indifferent, policy, 5)
    np.testing.assert_array_equal(found.mean_weights, policy.mean_weights)


# ---- random policies --------------------------------------------------------------------------


def test_random_policies_act_each_in_its_part_of_the_rows() -> None:
    policy, states = policy_of("plain").predictor, comparison("plain").world.states
    drawn = RandomLinear.draw(policy, states, 3, np.random.default_rng(0))
    rows = np.tile(states[:5], (3, 1))
    together = drawn.scaled(rows)
    for k in range(3):
        np.testing.assert_allclose(together[5 * k : 5 * k + 5], drawn.one(k).scaled(states[:5]))
    assert not np.allclose(together[:5], together[5:10])
    # in the task's units, which are those of the scaled action times two
    np.testing.assert_allclose(drawn.act(rows, np.zeros((15, 1))), 2.0 * together)
    many = RandomLinear.draw(policy, states, 200, np.random.default_rng(1))
    at_limits = np.abs(many.scaled(np.repeat(states[:1], 200, axis=0))) >= 1.0
    assert 0.5 < at_limits.mean() < 0.95


def test_the_best_of_random_policies_leaves_a_local_optimum() -> None:
    """A policy that pushes the wrong way as hard as it can: gradients vanish at the limits."""
    compared, policy = comparison("plain"), policy_of("plain").predictor
    stuck = replace(policy, mean_weights=-50.0 * policy.mean_weights)
    rng = np.random.default_rng(0)
    found = best_random_policy(compared, stuck, 20, rng)
    np.testing.assert_array_equal(found.states, stuck.states)
    states = compared.world.states[:20]
    np.testing.assert_array_equal(
        found.standard_deviation(states), stuck.standard_deviation(states)
    )
    best = compared.returns(found).mean()
    assert best > compared.returns(stuck).mean() + 0.1
    assert best > compared.returns(improve(compared, stuck, 10)).mean()
