"""Linear-quadratic regulators of the learnt model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are

from kreps.algorithms.regulators import (
    MIN_DISTANCE,
    Linearisation,
    Regulator,
    controllable,
    differences,
    equilibrium,
    regulator_gains,
    regulators,
    spread,
)
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from tests.pole import TASK, compared, observed, steps_upright


def test_gains_are_those_of_the_riccati_equation() -> None:
    rng = np.random.default_rng(0)
    a, b = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    for action_cost, p in ((0.01, 0.0), (0.5, 0.05)):
        gains, offset, found = regulator_gains(Linearisation(a, b, np.zeros(3)), action_cost, p, 3)
        # a discount scales both matrices by its root
        root = np.sqrt(1.0 - p)
        cost = solve_discrete_are(root * a, root * b, np.eye(3), action_cost * np.eye(2))
        price = action_cost * np.eye(2) + root**2 * b.T @ cost @ b
        wanted = -np.linalg.solve(price, root**2 * b.T @ cost @ a)
        np.testing.assert_allclose(gains, wanted, rtol=1e-4)
        np.testing.assert_allclose(found, cost, rtol=1e-4)
        np.testing.assert_array_equal(offset, 0.0)


def test_the_offset_counters_a_drift() -> None:
    """A wind of 0.3 per step on an integrator: the action that cancels it keeps the state."""
    model = Linearisation(np.eye(1), np.eye(1), np.array([0.3]))
    gains, offset, _ = regulator_gains(model, 0.01, 0.001, 1)
    x = np.zeros(1)
    for _ in range(50):
        x = x + gains @ x + offset + 0.3
    assert abs(x[0]) < 0.02


def test_modes_that_the_action_does_not_move_are_left_out() -> None:
    """An unstable coordinate beside the one that is regulated: its gains would be huge."""
    a, b = np.diag([1.1, 1.5]), np.array([[1.0], [0.01]])
    np.testing.assert_allclose(controllable(Linearisation(a, b, np.zeros(2))), np.diag([1.0, 0.0]))
    gains, _, _ = regulator_gains(Linearisation(a, b, np.zeros(2)), 0.01, 0.01, 2)
    alone, _, _ = regulator_gains(Linearisation(a[:1, :1], b[:1], np.zeros(1)), 0.01, 0.01, 1)
    np.testing.assert_allclose(gains, [[alone[0, 0], 0.0]], atol=1e-12)


def test_equilibria_are_found_from_falling_states() -> None:
    world, env = compared().world, compared().from_starts
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


def test_a_regulator_keeps_the_pole_upright() -> None:
    world, env = compared().world, compared().from_starts
    found = regulators(world, env, 4)
    assert max(map(steps_upright, found)) == 300
    # two action costs for each equilibrium, and none twice
    kept = np.array([each.state for each in found[::2]]) / spread(world.states, TASK)
    np.testing.assert_array_equal(found[0].state, found[1].state)
    apart = np.mean((kept[:, None] - kept) ** 2, axis=2) + np.eye(len(kept))
    assert 2 * len(kept) == len(found) and len(kept) < 4 and apart.min() > MIN_DISTANCE


def test_a_chain_of_delayed_actions_is_regulated() -> None:
    """Position, two waiting actions: the matrix of modes is singular."""
    a = np.array([[1.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    model = Linearisation(a, np.array([[0.0], [1.0], [0.0]]), np.zeros(3))
    np.testing.assert_array_equal(controllable(model), np.eye(3))
    gains, offset, _ = regulator_gains(model, 0.01, 0.0, 1)
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
    upside_down, gains = np.array([0.0, 0.0, 3.1]), np.array([[0.0, 0.0, 2.0]])
    regulator = Regulator(task, upside_down, np.zeros(1), gains, np.diag([1.0, 2.0, 4.0]))
    turned = regulator.scaled(np.array([[0.0, 0.0, 3.1], [0.0, 0.0, 3.2 - 2.0 * np.pi]]))
    np.testing.assert_allclose(turned, [[0.0], [2.0 * np.sin(0.1)]], atol=1e-12)
    around = np.array([[3.0, 1.0, 3.1], [0.0, 0.0, 3.2 - 2.0 * np.pi], [0.0, 0.0, 1.5]])
    wanted = [9.0 + 2.0, 4.0 * np.sin(0.1) ** 2, np.inf]  # the last one is beyond a quarter turn
    np.testing.assert_allclose(regulator.with_expected_costs(around)[1], wanted, rtol=1e-12)


def test_feedback_stays_within_the_limits_up_to_a_cost() -> None:
    """In the ellipsoid of that cost the largest feedback is one."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    regulator = Regulator(TASK, np.zeros(3), np.zeros(1), rng.normal(size=(1, 3)), root.T @ root)
    sphere = rng.normal(size=(20_000, 3))
    sphere *= np.sqrt(regulator.cost_of_unit_feedback) / np.linalg.norm(sphere, axis=1)[:, None]
    states = np.linalg.solve(root, sphere.T).T
    np.testing.assert_allclose(
        regulator.with_expected_costs(states)[1], regulator.cost_of_unit_feedback, rtol=1e-9
    )
    np.testing.assert_allclose(np.abs(regulator.scaled(states)).max(), 1.0, rtol=1e-3)


def test_derivatives_that_are_not_finite_give_no_regulator() -> None:
    @dataclass(frozen=True)
    class Broken:
        """Dynamics whose derivatives overflow."""

        def jacobian(self, inputs: FloatArray) -> FloatArray:
            return np.full((len(inputs), 3, 4), np.nan)

        def predict(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
            return inputs[:, :3], np.zeros(len(inputs))

    broken: Any = Broken()
    assert regulators(replace(compared().world, dynamics=broken), compared().from_starts, 3) == []
