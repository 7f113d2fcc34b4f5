"""Linear-quadratic regulators of the learnt model, which the paper has not.

The model is linearised in equilibria near a start state and the samples of the largest reward, and
the linear-quadratic regulator of each is the linear feedback that keeps the state there.  Policies
are made of them in `kreps.algorithms.regulated_policies`.

Deviations of the state are in standard deviations of the samples, and a regulator minimises the sum
of their squares and of a multiple of the squared scaled action.  The reward decides only near which
states there are regulators, as its curvature is often unknown (a reward for being alive has none).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.models.dynamics import CONSTANT_RTOL
from kreps.models.model_env import ModelEnv
from kreps.models.world_model import WorldModel

ACTION_COSTS = (0.01, 0.3)
"""Prices of the squared scaled action, relative to that of the squared deviation of a coordinate.
There is a regulator for each."""

EQUILIBRIUM_STEPS = 4
"""Gauss-Newton steps from a sample to an equilibrium."""

EQUILIBRIUM_ERROR = 1e-3
"""Variance of the error of an equilibrium relative to that of the samples around it: how far it may
be from them."""

MIN_DISTANCE = 0.05
"""Smallest mean squared distance, in variances, of two samples near which there are equilibria."""

MIN_CONTROLLABILITY = 0.1
"""Effect of the action on a mode of the linearised model, relative to the largest one, below which
the mode is left out.  Coordinates that follow from others (the cosine of an angle beside its sine),
noise and goals make such modes, and a regulator would move them at any price."""

MAX_CONDITION = 1e8
"""Of the matrix of modes; with a larger one they are no basis."""

MAX_RICCATI_STEPS, RICCATI_RTOL, MAX_COST = 300, 1e-6, 1e12
"""Riccati recursions at most, the relative change after which there is no further one, and the cost
at which the recursion diverges."""

COST_JITTER = 1e-6
"""Added to the diagonal of P, scaled to one, before it is inverted: there is no cost of modes that
are left out."""

TINY = 1e-100
"""Smallest variance of samples around a state, and smallest cost of a deviation."""


@dataclass(frozen=True)
class Linearisation:
    """The model around a state, in standard deviations of the states and scaled actions.

    Attributes:
        transition: (ds, ds) A.
        control: (ds, da) B.
        drift: (ds,) predicted change of the state.
    """

    transition: FloatArray
    control: FloatArray
    drift: FloatArray


@dataclass(frozen=True)
class Regulator:
    """A policy that is linear in the deviation of the state from an equilibrium.

    Attributes:
        task: gives centre and scale of the actions, and which coordinates are angles.
        state: (ds,) the equilibrium.
        action: (da,) scaled, there.
        gains: (da, ds) of deviations in units of the state.
        cost: (ds, ds) P; the linearised model expects the cost ``d' P d`` of a deviation d.
    """

    task: TaskSpec
    state: FloatArray
    action: FloatArray
    gains: FloatArray
    cost: FloatArray

    def scaled(self, states: FloatArray) -> FloatArray:
        """Scaled actions (m, da) around the centre, at states (m, ds); they are not limited."""
        return self.with_expected_costs(states)[0]

    def with_expected_costs(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scaled actions (m, da) at states (m, ds), and expected costs (m,) of the way from there.

        Deviations of angles are their sine, and the cost is infinite where an angle is more than a
        quarter of a turn away.
        """
        angles = list(self.task.periodic)
        deviations = differences(states, self.state, self.task)
        far = (np.abs(deviations[:, angles]) > 0.5 * np.pi).any(axis=1)
        deviations[:, angles] = np.sin(deviations[:, angles])
        costs = np.sum((deviations @ self.cost) * deviations, axis=1)
        return self.action + deviations @ self.gains.T, np.where(far, np.inf, costs)

    @cached_property
    def cost_of_unit_feedback(self) -> float:
        """Largest expected cost up to which feedback alone changes no scaled action by over one.

        In the ellipsoid ``d' P d <= c`` the largest feedback ``k' d`` is ``sqrt(c k' P^-1 k)``.
        """
        unit = np.sqrt(np.maximum(np.diag(self.cost), TINY))
        cost = self.cost / np.outer(unit, unit) + COST_JITTER * np.eye(len(unit))
        gains = self.gains / unit
        largest = np.max(np.sum(gains.T * np.linalg.solve(cost, gains.T), axis=0))
        return 1.0 / max(float(largest), TINY)

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        """Actions (m, da) without noise."""
        return self.task.unscaled(self.scaled(states))


def differences(states: FloatArray, state: FloatArray, task: TaskSpec) -> FloatArray:
    """States (m, ds) relative to one (ds,); angles in [-pi, pi)."""
    relative, angles = states - state, list(task.periodic)
    relative[:, angles] = (relative[:, angles] + np.pi) % (2.0 * np.pi) - np.pi
    return relative


def linearised(
    world: WorldModel, state: FloatArray, action: FloatArray, scale: FloatArray
) -> Linearisation:
    """The model around a state (ds,) and a scaled action (da,), with a scale (ds,) of states."""
    assert world.dynamics is not None
    inputs = np.concatenate([state, action])[None]
    slopes = world.dynamics.jacobian(inputs)[0] / scale[:, None]
    successor, _ = world.dynamics.predict(inputs)
    size = len(state)
    drift = differences(successor, state, world.task)[0] / scale
    return Linearisation(slopes[:, :size] * scale, slopes[:, size:], drift)


def equilibrium(
    world: WorldModel, model_env: ModelEnv, state: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A state (ds,) near a given one, and a scaled action (da,), that change the state least.

    Moves are those of a Gaussian with the covariance of the samples around, weighted by the kernel.
    """
    size, width, action = len(state), world.task.action_size, np.zeros(world.task.action_size)
    covariance = np.eye(size + width)
    for _ in range(EQUILIBRIUM_STEPS):
        model = linearised(world, state, action, scale)
        near = model_env.kernel.gram(state[None], world.states)[0]
        around = differences(world.states, state, world.task) / scale
        local = (around * near[:, None]).T @ around
        covariance[:size, :size] = local / max(float(np.linalg.norm(local, 2)), TINY)
        slopes = np.concatenate([model.transition - np.eye(size), model.control], axis=1)
        predicted = slopes @ covariance @ slopes.T + EQUILIBRIUM_ERROR * np.eye(size)
        move = -covariance @ slopes.T @ np.linalg.solve(predicted, model.drift)
        moved = state + scale * np.clip(move[:size], -1.0, 1.0)
        state = model_env.within_range(moved[None])[0]
        action = np.clip(action + move[size:], -1.0, 1.0)
    return state, action


def controllable(model: Linearisation) -> FloatArray:
    """Projection (ds, ds) on the modes that the action moves, along the others.

    The identity where the modes are no basis, as in a chain of delayed actions.
    """
    _, modes = np.linalg.eig(model.transition)
    if not np.linalg.cond(modes) < MAX_CONDITION:
        return np.eye(len(modes))
    left = np.linalg.inv(modes)
    effect = np.linalg.norm(left @ model.control, axis=1) / np.linalg.norm(left, axis=1)
    others = effect < MIN_CONTROLLABILITY * effect.max()
    projection: FloatArray = np.eye(len(modes)) - np.real(modes[:, others] @ left[others])
    return projection


def regulator_gains(
    model: Linearisation, action_cost: float, restart_probability: float, observed: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gains (da, ds) and an offset (da,) of the action, which counter deviations and the drift.

    Args:
        model: around the state that is kept.
        action_cost: price of the squared scaled action.
        restart_probability: p; with it the process restarts, so that later costs count less.
        observed: number of coordinates, the first ones, whose deviations have a cost.  Earlier
            changes and actions in the state have none.

    Returns:
        The gains, the offset, and the expected cost (ds, ds) as a quadratic form.
    """
    size, width = model.control.shape
    projection = controllable(model)
    # the last coordinate is one: the drift
    a, b = np.zeros((size + 1, size + 1)), np.zeros((size + 1, width))
    a[:size, :size], a[:size, size] = model.transition @ projection, projection @ model.drift
    a[size, size], b[:size] = 1.0, model.control
    state_cost = np.zeros((size + 1, size + 1))
    state_cost[:size, :size] = projection[:observed].T @ projection[:observed]
    cost, gains, go_on = state_cost, np.zeros((width, size + 1)), 1.0 - restart_probability
    for _ in range(MAX_RICCATI_STEPS):
        of_control = b.T @ cost
        price = action_cost * np.eye(width) + go_on * of_control @ b
        gains = -go_on * np.linalg.solve(price, of_control @ a)
        closed = a + b @ gains
        before = cost
        cost = state_cost + action_cost * gains.T @ gains + go_on * closed.T @ before @ closed
        largest = float(np.abs(cost).max())
        if not largest < MAX_COST or np.abs(cost - before).max() < RICCATI_RTOL * largest:
            break
    return gains[:, :size], gains[:, size], cost[:size, :size]


def regulators(world: WorldModel, model_env: ModelEnv, count: int) -> list[Regulator]:
    """Regulators of equilibria near a start state and the samples with the largest rewards.

    Args:
        world: the learnt model.
        model_env: of the same samples.
        count: largest number of equilibria; close to another one there is none.
    """
    scale = spread(world.states, world.task)

    def distances(states: FloatArray, state: FloatArray) -> FloatArray:
        return np.mean((differences(states, state, world.task) / scale) ** 2, axis=1)

    size, width = len(world.states), world.task.action_size
    inputs = np.concatenate([world.states, np.zeros((size, width))], axis=1)
    rewards = world.reward_model(inputs, np.zeros(size))
    sample = model_env.data.points[model_env.data.start[0]]
    apart = np.ones(size, dtype=bool)
    found: list[Regulator] = []
    for number in range(count):
        if number:
            sample = world.states[np.argmax(np.where(apart, rewards, -np.inf))]
        apart &= distances(world.states, sample) > MIN_DISTANCE
        try:
            state, action = equilibrium(world, model_env, sample, scale)
            others = np.array([each.state for each in found]).reshape(-1, len(state))
            if (distances(others, state) > MIN_DISTANCE).all():
                found += regulators_at(world, model_env, state, action, scale)
        except np.linalg.LinAlgError:  # derivatives of the model that are not finite
            continue
        if not apart.any():
            break
    return found


def regulators_at(
    world: WorldModel,
    model_env: ModelEnv,
    state: FloatArray,
    action: FloatArray,
    scale: FloatArray,
) -> list[Regulator]:
    """Regulators of an equilibrium (ds,) with a scaled action (da,), one for each action cost.

    Raises:
        LinAlgError: the derivatives of the model are not finite.
    """
    model, found = linearised(world, state, action, scale), []
    p, observed = model_env.restart_probability, world.task.observation_size
    for action_cost in ACTION_COSTS:
        gains, offset, cost = regulator_gains(model, action_cost, p, observed)
        regulator = Regulator(
            world.task, state, action + offset, gains / scale, cost / np.outer(scale, scale)
        )
        numbers = (state, regulator.action, regulator.gains, regulator.cost)
        if all(np.isfinite(each).all() for each in numbers):
            found.append(regulator)
    return found


def spread(states: FloatArray, task: TaskSpec) -> FloatArray:
    """Standard deviation (ds,) of states (n, ds); of angles that of the point on the circle.

    One for coordinates that are constant up to rounding.
    """
    found, angles = states.std(axis=0), list(task.periodic)
    turns = np.exp(1j * states[:, angles])
    found[angles] = turns.std(axis=0)
    constant = found <= CONSTANT_RTOL * np.abs(states).max(axis=0)
    return np.where(constant, 1.0, found)
