"""Linear-quadratic regulators in the model as candidates for the policy, which the paper has not.

Bounded steps and the gradient improve a policy by small changes.  Where the dynamics are unstable
their results stay far behind what the model allows: from 330 steps of a double pendulum they keep
it up for 20 steps, and the feedback that is optimal for the linearised model for 200 or more.

So where episodes end the model is linearised in equilibria near a start state and the samples of
the largest reward, and the linear-quadratic regulator of each, which keeps the state there, is a
candidate.  The best of them takes the place of the policy unless it is worse in the model.

Deviations of the state are in standard deviations of the samples, and a regulator minimises the sum
of their squares and of a multiple of the squared scaled action.  The reward decides only which
states are kept and how regulators compare, as its curvature is often unknown (a reward for being
alive has none).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kreps.algorithms.acceptance import ModelComparison
from kreps.algorithms.policy_targets import MIN_ACTION_VARIANCE
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel, as_wide_as_spread
from kreps.kernels.linalg import solve_lower_transposed
from kreps.models.dynamics import CONSTANT_RTOL
from kreps.models.model_env import ModelEnv
from kreps.models.world_model import WorldModel
from kreps.policies.sparse_gp import SparseGP

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

WIDER, MAX_CENTRES, MAX_RESIDUAL = 3.0, 300, 1e-10
"""The policy that is fitted to a regulator: its lengthscales in spreads of the samples, the number
of its centres, and the squared residual of the kernel at which these are enough.  A linear function
needs long lengthscales."""

TINY = 1e-100
"""Smallest variance of samples around a state."""

NO_SIGNAL = 1e-12
"""Signal variance of that policy: its standard deviation is that of the noise everywhere."""

RIDGE = 1e-9
"""Of that fit, for features of norm one."""


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
    """

    task: TaskSpec
    state: FloatArray
    action: FloatArray
    gains: FloatArray

    def scaled(self, states: FloatArray) -> FloatArray:
        """Scaled actions (m, da) around the centre, at states (m, ds); they are not limited."""
        deviation = differences(states, self.state, self.task)
        angles = list(self.task.periodic)
        deviation[:, angles] = np.sin(deviation[:, angles])
        actions: FloatArray = self.action + deviation @ self.gains.T
        return actions

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
) -> tuple[FloatArray, FloatArray]:
    """Gains (da, ds) and an offset (da,) of the action, which counter deviations and the drift.

    Args:
        model: around the state that is kept.
        action_cost: price of the squared scaled action.
        restart_probability: p; with it the process restarts, so that later costs count less.
        observed: number of coordinates, the first ones, whose deviations have a cost.  Earlier
            changes and actions in the state have none.
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
    return gains[:, :size], gains[:, size]


def regulators(world: WorldModel, model_env: ModelEnv, count: int) -> list[Regulator]:
    """Regulators of equilibria near a start state and the samples with the largest rewards.

    Args:
        world: the learnt model.
        model_env: of the same samples.
        count: number of equilibria.
    """
    scale = spread(world.states, world.task)
    size, width = len(world.states), world.task.action_size
    inputs = np.concatenate([world.states, np.zeros((size, width))], axis=1)
    rewards = world.reward_model(inputs, np.zeros(size))
    sample = model_env.data.points[model_env.data.start[0]]
    apart = np.ones(size, dtype=bool)
    found: list[Regulator] = []
    for number in range(count):
        if number:
            sample = world.states[np.argmax(np.where(apart, rewards, -np.inf))]
        distance = np.mean((differences(world.states, sample, world.task) / scale) ** 2, axis=1)
        apart &= distance > MIN_DISTANCE
        try:
            found += regulators_at(world, model_env, sample, scale)
        except np.linalg.LinAlgError:  # derivatives of the model that are not finite
            continue
        if not apart.any():
            break
    return found


def regulators_at(
    world: WorldModel, model_env: ModelEnv, sample: FloatArray, scale: FloatArray
) -> list[Regulator]:
    """Regulators of the equilibrium near a sample (ds,), for each of the action costs.

    Raises:
        LinAlgError: the derivatives of the model are not finite.
    """
    state, action = equilibrium(world, model_env, sample, scale)
    model, found = linearised(world, state, action, scale), []
    p, observed = model_env.restart_probability, world.task.observation_size
    for action_cost in ACTION_COSTS:
        gains, offset = regulator_gains(model, action_cost, p, observed)
        regulator = Regulator(world.task, state, action + offset, gains / scale)
        if all(np.isfinite(each).all() for each in (state, regulator.action, regulator.gains)):
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


def best_regulator(
    comparison: ModelComparison, policy: SparseGP, kernel: Kernel, count: int
) -> SparseGP | None:
    """The regulator with the largest return in the model, as a policy with the least noise.

    Args:
        comparison: of policies in the model.
        policy: that has the arrays of a policy.
        kernel: over states, at median lengthscales.
        count: number of equilibria.

    Returns:
        None if there is no finite regulator.
    """
    found = regulators(comparison.world, comparison.from_starts, count)
    if not found:
        return None
    best = max(found, key=lambda each: float(comparison.returns(each).mean()))
    return fitted(best, policy, kernel, comparison.world.states)


def fitted(regulator: Regulator, policy: SparseGP, kernel: Kernel, states: FloatArray) -> SparseGP:
    """A regulator as a policy with long lengthscales, and with the least exploration noise.

    A policy that keeps an unstable state has to act precisely; the explorer is there to explore.

    Args:
        regulator: that the mean is fitted to at the states.
        policy: that all but kernel, centres, mean and variances are taken from.
        kernel: over states, at median lengthscales.
        states: (n, ds), among which its centres are.
    """
    kernel = as_wide_as_spread(kernel, states)
    wide = kernel.with_lengthscales(WIDER * kernel.lengthscales)
    basis, features = RKHSBasis.fit(wide, states, tolerance=MAX_RESIDUAL, max_rank=MAX_CENTRES)
    gram = features.T @ features + RIDGE * len(states) * np.eye(features.shape[1])
    theta = np.linalg.solve(gram, features.T @ regulator.scaled(states))
    return replace(
        policy,
        kernel=wide,
        states=np.ascontiguousarray(basis.pivots),
        mean_weights=np.ascontiguousarray(solve_lower_transposed(basis.lower, theta)),
        explained=np.zeros_like(basis.lower),
        signal=NO_SIGNAL,
        noise=MIN_ACTION_VARIANCE,
    )
