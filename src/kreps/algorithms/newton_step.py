"""One iteration of damped Newton's method on the dual of Eq. 2.

`newton_step` computes a direction (`newton_direction`), tests whether its Newton decrement is small
enough (`is_optimal`), and otherwise searches along it (`line_search`).  The temperature is kept at
or above its floor by projection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from kreps.algorithms.dual import Moments, Problem, gradient_of, hessian_of, value_of
from kreps.kernels.arrays import FloatArray
from kreps.kernels.linalg import Cholesky, cholesky

DECREMENT_TOLERANCE = 1e-9
"""Largest Newton decrement of a solution, in units of the rewards."""

GAP_TOLERANCE = 1e-6
"""Largest ``|B'p + rho theta|^2 / (2 rho)`` of a solution: its share of the duality gap."""

KL_TOLERANCE = 1e-4
"""Largest relative deviation of KL from its bound.  All three tolerances have to be met: as eta
goes to zero the curvature diverges, and the decrement is small far from the optimum."""

CENTRED_DECREMENT = 0.01
"""Newton decrement in theta, in units of eta, up to which eta is changed together with theta.

``exp(delta / eta)`` is nearly quadratic only where delta changes by less than eta.  If eta falls
while theta is far from its optimum for that eta, only tiny steps decrease the dual.  The product of
this constant and `kreps.algorithms.dual.MIN_ETA` exceeds `DECREMENT_TOLERANCE`, so a run in which
eta still has to change does not count as converged."""

CHORD_MARGIN = 10.0
"""Factor of a decrement that is computed with the Hessian of the iteration before."""

SUFFICIENT_DECREASE = 1e-4
"""Smallest decrease of the dual in a line search, as a share of the linear prediction (Armijo)."""

VALUE_RTOL = 1e-14
"""Increases of the dual below this, relative to its value, are rounding errors."""

MIN_STEP_LENGTH = 1e-12
"""A line search that is shorter than this share of Newton's step has stalled."""

FLOOR_RTOL = 1e-9
"""Temperatures closer than this to their floor, relative to it, are set to the floor exactly."""


class Status(Enum):
    """State of a Newton run."""

    RUNNING = "running"
    CONVERGED = "converged"
    STALLED = "stalled: no step along the Newton direction decreases the dual"


@dataclass(frozen=True)
class Point:
    """A point of the dual.

    Attributes:
        eta: temperature.
        theta: (r,) coordinates of V.
        moments: at eta and theta.
        value: of the dual there.
    """

    eta: float
    theta: FloatArray
    moments: Moments
    value: float


@dataclass(frozen=True)
class NewtonState:
    """State of a Newton run.

    Attributes:
        point: where the run is; its moments include the covariance while the run continues.
        decrement: half the squared Newton decrement of the latest direction.
        previous_decrement: at the beginning of the latest iteration; 1 before the first.
        backtracked: whether the latest line search had to shorten its step.
        jitter: largest jitter of a Newton system so far.
        iterations: accepted steps.
        status: whether the run continues, has converged or has stalled.
    """

    point: Point
    decrement: float = np.inf
    previous_decrement: float = 1.0
    backtracked: bool = False
    jitter: float = 0.0
    iterations: int = 0
    status: Status = Status.RUNNING

    @property
    def converged(self) -> bool:
        return self.status is Status.CONVERGED


@dataclass(frozen=True)
class NewtonSystem:
    """The Hessian at one point.

    Attributes:
        hessian: (r + 1, r + 1) in ``(theta, eta)``, as of `kreps.algorithms.dual.dual_hessian`.
        factor: Cholesky factor of its block of theta.
    """

    hessian: FloatArray
    factor: Cholesky

    def theta_step(self, g_theta: FloatArray) -> FloatArray:
        """Newton's step (r,) in theta at fixed eta, from the gradient (r,)."""
        return -self.factor.solve(g_theta)

    def joint_step(self, theta_step: FloatArray, g_eta: float) -> tuple[FloatArray, float]:
        """Newton's step in theta (r,) and the relative change of eta, by block elimination.

        Args:
            theta_step: (r,) at fixed eta.
            g_eta: gradient in eta, times eta.
        """
        mixed, own = self.hessian[:-1, -1], float(self.hessian[-1, -1])
        coupling = self.factor.solve(mixed)
        # positive in exact arithmetic; rounding is kept from making the step in eta infinite
        complement = max(own - float(mixed @ coupling), 1e-12 * own, 1e-300)
        eta_step = -(g_eta + float(mixed @ theta_step)) / complement
        return theta_step - eta_step * coupling, eta_step


@dataclass(frozen=True)
class Direction:
    """Newton's direction at one point.

    Attributes:
        theta_step: (r,) change of theta.
        eta_step: relative change of eta; zero where eta is not changed.
        moves_eta: whether eta is changed.
        at_floor: whether eta is at its floor.
        gradient: (g_eta, g_theta) at the point.
        slope: derivative of the dual along the direction: minus the squared Newton decrement.
        system: the Hessian.
    """

    theta_step: FloatArray
    eta_step: float
    moves_eta: bool
    at_floor: bool
    gradient: tuple[float, FloatArray]
    slope: float
    system: NewtonSystem


def initial_state(problem: Problem, eta: float, theta: FloatArray) -> NewtonState:
    """The state of a run before its first step."""
    return NewtonState(evaluate(problem, eta, theta, with_covariance=True))


def evaluate(problem: Problem, eta: float, theta: FloatArray, *, with_covariance: bool) -> Point:
    """The dual at eta and theta (r,): one pass over the samples."""
    moments = problem.moments(eta, theta, with_covariance=with_covariance)
    return Point(eta, theta, moments, value_of(problem, theta, moments))


def newton_step(problem: Problem, state: NewtonState, *, fixed_eta: bool) -> NewtonState:
    """One iteration: direction, termination test, line search.

    If the line search did not compute the covariance at the new point, convergence is tested with
    the Hessian of the old point first, and the covariance is computed only if the run continues.
    """
    direction = newton_direction(problem, state.point, fixed_eta=fixed_eta)
    decrement = -0.5 * direction.slope
    jitter = max(state.jitter, direction.system.factor.jitter)
    state = replace(state, decrement=decrement, jitter=jitter)
    g_eta, g_theta = direction.gradient
    if is_optimal(problem, g_eta if direction.moves_eta else 0.0, g_theta, decrement):
        return replace(state, status=Status.CONVERGED)
    found = line_search(problem, state, direction)
    if found is None:
        return replace(state, status=Status.STALLED)
    point, backtracked = found
    state = replace(
        state,
        point=point,
        previous_decrement=decrement,
        backtracked=backtracked,
        iterations=state.iterations + 1,
    )
    if point.moments.covariance is not None:
        return state
    state = check_by_chord(problem, state, direction, fixed_eta=fixed_eta)
    if state.converged:
        return state
    moments = problem.moments(point.eta, point.theta, with_covariance=True)
    return replace(state, point=replace(point, moments=moments))


def newton_direction(problem: Problem, point: Point, *, fixed_eta: bool) -> Direction:
    """Newton's direction in theta, and in eta too once theta is nearly optimal for its eta.

    Eta waits until theta is centred (`CENTRED_DECREMENT`), so that the run follows the path of
    optimal theta.  At its floor eta is not decreased any further.
    """
    eta, at_floor = point.eta, point.eta <= problem.eta_floor
    g_eta, g_theta = gradient_of(problem, point.theta, point.moments)
    hessian = hessian_of(problem, point.moments)
    system = NewtonSystem(hessian, cholesky(hessian[:-1, :-1]))
    theta_step, eta_step = system.theta_step(g_theta), 0.0
    centred = -0.5 * float(g_theta @ theta_step) <= CENTRED_DECREMENT * eta
    moves_eta = not fixed_eta and centred and not (at_floor and g_eta >= 0)
    if moves_eta:
        joint = system.joint_step(theta_step, eta * g_eta)
        moves_eta = not (at_floor and joint[1] < 0)
        if moves_eta:
            theta_step, eta_step = joint
    slope = float(g_theta @ theta_step) + eta * g_eta * eta_step
    return Direction(theta_step, eta_step, moves_eta, at_floor, (g_eta, g_theta), slope, system)


def is_optimal(problem: Problem, g_eta: float, g_theta: FloatArray, decrement: float) -> bool:
    """Whether decrement, stationarity and KL are within their tolerances.

    Args:
        problem: data of the update.
        g_eta: ``epsilon - KL``, or zero where eta is not changed.
        g_theta: (r,) gradient in theta.
        decrement: half the squared Newton decrement.
    """
    gap = float(g_theta @ g_theta) / (2.0 * problem.ridge)
    kl_met = abs(g_eta) <= KL_TOLERANCE * problem.kl_bound
    return decrement <= DECREMENT_TOLERANCE and gap <= GAP_TOLERANCE and kl_met


def line_search(
    problem: Problem, state: NewtonState, direction: Direction
) -> tuple[Point, bool] | None:
    """The first of the halved steps that decreases the dual enough, and whether any was halved.

    In one step eta at most halves or doubles, and it does not pass its floor.

    Returns:
        None if no step is long enough (`MIN_STEP_LENGTH`).
    """
    here, floor, eta_step = state.point, problem.eta_floor, direction.eta_step
    max_eta_step = 1.0 if eta_step > 0.0 else max(0.5, floor / here.eta) - 1.0
    length = min(1.0, max_eta_step / eta_step) if eta_step else 1.0
    rounding = VALUE_RTOL * max(1.0, abs(here.value))
    with_covariance, backtracked = first_trial_needs_covariance(state), False
    while length > MIN_STEP_LENGTH:
        eta = max(here.eta * (1.0 + length * eta_step), floor)
        if eta <= floor * (1.0 + FLOOR_RTOL):
            eta = floor
        theta = here.theta + length * direction.theta_step
        there = evaluate(problem, eta, theta, with_covariance=with_covariance)
        decrease = SUFFICIENT_DECREASE * length * direction.slope
        if there.value <= here.value + decrease + rounding:
            return there, backtracked
        length *= 0.5
        with_covariance, backtracked = False, True
    return None


def first_trial_needs_covariance(state: NewtonState) -> bool:
    """Whether the first trial point of a line search is likely to be where the next step starts.

    Then its covariance is computed in the same pass over the samples as its value.  It is not if
    the last line search rejected its first trial point, nor if the run is expected to end there,
    with the decrement falling by the same factor as in the last iteration.
    """
    ratio = min(1.0, state.decrement / state.previous_decrement)
    return not state.backtracked and CHORD_MARGIN * state.decrement * ratio > DECREMENT_TOLERANCE


def check_by_chord(
    problem: Problem, state: NewtonState, direction: Direction, *, fixed_eta: bool
) -> NewtonState:
    """Checks convergence with the gradient of the new point and the Hessian of the old one.

    The decrement is multiplied by `CHORD_MARGIN`, as the Hessian is not the one of the new point.
    Where eta has just come to its floor, or could leave it, the test is not made.

    Args:
        problem: data of the update.
        state: after the line search.
        direction: along which it searched.
        fixed_eta: whether only theta is changed.
    """
    point, system = state.point, direction.system
    g_eta, g_theta = gradient_of(problem, point.theta, point.moments)
    theta_step, eta_step = system.theta_step(g_theta), 0.0
    if direction.moves_eta:
        theta_step, eta_step = system.joint_step(theta_step, point.eta * g_eta)
    decrement = -0.5 * (float(g_theta @ theta_step) + point.eta * g_eta * eta_step)
    state = replace(state, decrement=decrement)
    if direction.moves_eta:
        same_constraints = point.eta > problem.eta_floor
    else:
        same_constraints = (direction.at_floor and g_eta >= 0) or fixed_eta
    kl_excess = g_eta if direction.moves_eta else 0.0
    if same_constraints and is_optimal(problem, kl_excess, g_theta, CHORD_MARGIN * decrement):
        return replace(state, status=Status.CONVERGED)
    return state
