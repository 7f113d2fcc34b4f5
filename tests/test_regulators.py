"""Linear-quadratic regulators of the learnt model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import kreps
from kreps.algorithms.acceptance import ModelComparison
from kreps.algorithms.model_based import with_regulators
from kreps.algorithms.policy_targets import PolicyFit
from kreps.algorithms.regulators import (
    Linearisation,
    Regulator,
    best_regulator,
    controllable,
    differences,
    equilibrium,
    regulator_gains,
    regulators,
    spread,
)
from kreps.algorithms.state import Stopwatch
from kreps.data.history import stacked
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import KernelExpansion
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.models.dynamics import fit_dynamics
from kreps.models.model_env import ModelEnv
from kreps.models.reward_model import RewardModel
from kreps.models.transition import state_kernel
from kreps.models.world_model import WorldModel
from kreps.policies.cost_sensitive_gp import CostSensitiveGP

TASK = TaskSpec(3, np.array([-2.0]), np.array([2.0]))
"""A pole that falls: sine and cosine of its angle, and its speed in rad/s that a torque changes."""


def pole(angle: float, speed: float, torque: float) -> tuple[float, float]:
    speed = speed + 0.1 * (9.0 * np.sin(angle) + 4.0 * np.clip(torque, -2.0, 2.0))
    return angle + 0.1 * speed, speed


def observed(angle: float, speed: float) -> FloatArray:
    return np.array([np.sin(angle), np.cos(angle), speed])


def falls() -> list[Rollout]:
    """The pole under random torques, from near the upright until it lies."""
    rng, found = np.random.default_rng(0), []
    for _ in range(25):
        angle, speed = rng.normal(0.0, 0.1, 2)
        states, torques = [observed(angle, speed)], rng.normal(0.0, 1.5, (12, 1))
        for torque in torques[:, 0]:
            angle, speed = pole(angle, speed, torque)
            states.append(observed(angle, speed))
            if abs(angle) > 1.0:
                break
        steps = len(states) - 1
        terminated = bool(abs(angle) > 1.0)
        found.append(Rollout(np.array(states), torques[:steps], np.ones(steps), terminated))
    return found


@pytest.fixture(scope="module")
def compared() -> ModelComparison:
    """The model of `falls`, with a reward of one until the pole lies."""
    rng = np.random.default_rng(0)
    data = stacked(Rollouts.from_list(falls()), TASK).transitions
    kernel = state_kernel(data, TASK, rng)
    dynamics, _, _ = fit_dynamics(data, kernel, TASK, None, rng)
    constant = KernelExpansion(
        Kernel((SquaredExponential((0,)),), np.ones(1)), np.zeros((1, 4)), np.zeros((1, 1))
    )
    env = ModelEnv(dynamics, data, kernel, TASK, 0.02, 0.0, 40, 0.0)
    world = WorldModel(
        task=TASK,
        states=data.states,
        features=np.empty((len(data), 0)),
        phi=lambda states: np.empty((len(states), 0)),
        restart=np.empty(0),
        expected_features=lambda rows, inputs: np.empty((len(rows), 0)),
        dynamics=dynamics,
        terminations=None,
        reward_model=RewardModel(constant, 1.0, 0.0, 0.0, 1.0),
        model_env=env,
        bonus=None,
    )
    return ModelComparison(world, 20, seed=3)


def steps_upright(act: CostSensitiveGP | Regulator, limit: int = 300) -> float:
    """Mean number of steps of the true pole, from five starts."""
    lengths = []
    for seed in range(5):
        angle, speed = np.random.default_rng(seed).normal(0.0, 0.1, 2)
        steps = 0
        while abs(angle) <= 1.0 and steps < limit:
            torque = act.act(observed(angle, speed)[None], np.zeros((1, 1)))[0, 0]
            angle, speed = pole(angle, speed, torque)
            steps += 1
        lengths.append(steps)
    return float(np.mean(lengths))


def test_gains_are_those_of_the_riccati_equation() -> None:
    rng = np.random.default_rng(0)
    a, b = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    for action_cost, p in ((0.01, 0.0), (0.5, 0.05)):
        gains, offset = regulator_gains(Linearisation(a, b, np.zeros(3)), action_cost, p, 3)
        # a discount scales both matrices by its root
        root = np.sqrt(1.0 - p)
        cost = solve_discrete_are(root * a, root * b, np.eye(3), action_cost * np.eye(2))
        price = action_cost * np.eye(2) + root**2 * b.T @ cost @ b
        wanted = -np.linalg.solve(price, root**2 * b.T @ cost @ a)
        np.testing.assert_allclose(gains, wanted, rtol=1e-4)
        np.testing.assert_array_equal(offset, 0.0)


def test_the_offset_counters_a_drift() -> None:
    """A wind of 0.3 per step on an integrator: the action that cancels it keeps the state."""
    model = Linearisation(np.eye(1), np.eye(1), np.array([0.3]))
    gains, offset = regulator_gains(model, 0.01, 0.001, 1)
    x = np.zeros(1)
    for _ in range(50):
        x = x + gains @ x + offset + 0.3
    assert abs(x[0]) < 0.02


def test_modes_that_the_action_does_not_move_are_left_out() -> None:
    """An unstable coordinate beside the one that is regulated: its gains would be huge."""
    a, b = np.diag([1.1, 1.5]), np.array([[1.0], [0.01]])
    np.testing.assert_allclose(controllable(Linearisation(a, b, np.zeros(2))), np.diag([1.0, 0.0]))
    gains, _ = regulator_gains(Linearisation(a, b, np.zeros(2)), 0.01, 0.01, 2)
    alone, _ = regulator_gains(Linearisation(a[:1, :1], b[:1], np.zeros(1)), 0.01, 0.01, 1)
    np.testing.assert_allclose(gains, [[alone[0, 0], 0.0]], atol=1e-12)


def test_equilibria_are_found_from_falling_states(compared: ModelComparison) -> None:
    world, env = compared.world, compared.from_starts
    scale = world.states.std(axis=0)
    state, action = equilibrium(world, env, observed(0.3, 0.5), scale)
    # upright at rest, or leaning against a torque: 9 sin(angle) + 4 torque = 0
    assert abs(state[2]) < 0.1
    assert abs(9.0 * state[0] + 4.0 * TASK.unscaled(action[None])[0, 0]) < 0.5
    np.testing.assert_allclose(state[0] ** 2 + state[1] ** 2, 1.0, atol=0.02)


def test_differences_of_angles_are_wrapped() -> None:
    task = replace(TASK, periodic=(0,))
    found = differences(np.array([[3.0, 3.0, 1.0]]), np.array([-3.0, -3.0, 0.0]), task)
    np.testing.assert_allclose(found, [[6.0 - 2.0 * np.pi, 6.0, 1.0]])


def test_the_best_regulator_keeps_the_pole_upright(compared: ModelComparison) -> None:
    """Random torques keep it up for about ten steps, and no sample is of a longer rollout."""
    world, env = compared.world, compared.from_starts
    states = world.states[::5]
    none = np.zeros((len(states), 1))
    policy = CostSensitiveGP(TASK, env.kernel, states, none, np.ones(len(states)), 1.0, 0.25)
    assert steps_upright(policy) < 15
    assert max(map(steps_upright, regulators(world, env, 2))) == 300
    found = best_regulator(compared, policy.predictor, env.kernel, 2)
    assert found is not None
    assert steps_upright(found) == 300  # type: ignore[arg-type]
    np.testing.assert_allclose(found.standard_deviation(states), 0.01 * 2.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("ends", "count", "taken"), [(True, 2, True), (False, 2, False), (True, 0, False)]
)
def test_regulators_are_candidates_where_episodes_end(
    compared: ModelComparison, ends: bool, count: int, taken: bool
) -> None:
    world, env = compared.world, compared.from_starts
    states = world.states[::5]
    none, one = np.zeros((len(states), 1)), np.ones(len(states))
    policy = CostSensitiveGP(TASK, env.kernel, states, none, one, 1.0, 0.25)
    batch: Any = SimpleNamespace(
        settings=SimpleNamespace(model_based=kreps.ModelBased(regulators=count)), clock=Stopwatch()
    )
    step: Any = Generated(PolicyFit(policy, np.zeros(1), len(states), 0.25))
    before = compared.returns(policy)
    case = replace(compared, has_ends=ends)
    found, returns = with_regulators(batch, step, before, case, env.kernel)
    assert (found is not step) is taken
    np.testing.assert_array_equal(returns, case.returns(found.policy.policy))
    if taken:
        assert returns.mean() > before.mean()
        assert found.policy.noise == pytest.approx(1e-4)
        # one that is already there is not given up for one that is worse
        hopeless = returns + 1.0
        again, kept = with_regulators(batch, found, hopeless, case, env.kernel)
        assert again is found and kept is hopeless


@dataclass(frozen=True)
class Generated:
    """Of a generated step what `with_regulators` changes."""

    policy: PolicyFit


def test_a_chain_of_delayed_actions_is_regulated() -> None:
    """Position, two waiting actions: the matrix of modes is singular."""
    a = np.array([[1.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    model = Linearisation(a, np.array([[0.0], [1.0], [0.0]]), np.zeros(3))
    np.testing.assert_array_equal(controllable(model), np.eye(3))
    gains, offset = regulator_gains(model, 0.01, 0.0, 1)
    x = np.array([1.0, 0.0, 0.0])
    for _ in range(12):
        x = a @ x + model.control[:, 0] * (gains @ x + offset)[0]
    assert abs(x[0]) < 1e-2


def test_constant_coordinates_and_angles_have_a_scale() -> None:
    task = TaskSpec(3, np.array([-1.0]), np.array([1.0]), periodic=(2,))
    angles = np.where(np.arange(100) % 2 == 0, 3.1, -3.1)  # hanging, on both sides of pi
    states = np.stack([np.linspace(0.0, 1.0, 100), np.full(100, 0.1), angles], axis=1)
    found = spread(states, task)
    np.testing.assert_allclose(found, [states[:, 0].std(), 1.0, np.sin(np.pi - 3.1)], rtol=1e-6)
    regulator = Regulator(task, np.array([0.0, 0.0, 3.1]), np.zeros(1), np.array([[0.0, 0.0, 2.0]]))
    turned = regulator.scaled(np.array([[0.0, 0.0, 3.1], [0.0, 0.0, 3.2 - 2.0 * np.pi]]))
    np.testing.assert_allclose(turned, [[0.0], [2.0 * np.sin(0.1)]], atol=1e-12)


def test_derivatives_that_are_not_finite_give_no_regulator(compared: ModelComparison) -> None:
    @dataclass(frozen=True)
    class Broken:
        """Dynamics whose derivatives overflow."""

        def jacobian(self, inputs: FloatArray) -> FloatArray:
            return np.full((len(inputs), 3, 4), np.nan)

        def predict(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
            return inputs[:, :3], np.zeros(len(inputs))

    broken: Any = Broken()
    assert regulators(replace(compared.world, dynamics=broken), compared.from_starts, 3) == []
