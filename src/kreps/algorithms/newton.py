"""Minimises the dual of Eq. 2: damped Newton's method, with bisection on eta as the fallback.

`solve_dual` is the solver.  Newton's method is a fixed loop (`minimise_by_newton`) over the state
and step of `kreps.algorithms.newton_step`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kreps.algorithms.dual import (
    DualSolution,
    Outcome,
    Problem,
    dual_value,
    gradient_of,
    kl_from_uniform,
    penalised_reward,
    sample_weights,
    value_of,
)
from kreps.algorithms.newton_step import (
    KL_TOLERANCE,
    NewtonState,
    Status,
    initial_state,
    newton_step,
)
from kreps.kernels.arrays import FloatArray

MAX_ITERATIONS_PER_TEMPERATURE = 100
MAX_TEMPERATURES = 100
"""Limits of the fallback: Newton iterations per temperature, and temperatures.  Twenty halvings go
from 1 to the smallest floor, and the others bisect a factor of two to double precision."""


def solve_dual(
    problem: Problem,
    max_iterations: int = 80,
    start: tuple[float, FloatArray] | None = None,
) -> DualSolution:
    """Minimise the dual over ``eta >= eta_floor`` and theta.

    Args:
        problem: data of the update.
        max_iterations: of Newton's method, before the fallback is used.
        start: eta and theta (r,) from which the run starts if the dual is smaller there than at
            theta = 0, such as the solution for a part of the samples.

    Returns:
        The solution with its certificate, and how the run ended (``outcome``).
    """
    end = minimise_by_newton(problem, *starting_point(problem, start), max_iterations)
    outcome = Outcome.BOUND_ACTIVE
    if not end.converged:
        end = bisect_temperature(problem, end)
        outcome = Outcome.FALLBACK if end.converged else Outcome.NOT_CONVERGED
    if end.converged and end.point.eta <= problem.eta_floor:
        outcome = Outcome.AT_FLOOR
    return certify(problem, end, outcome)


def starting_point(
    problem: Problem, start: tuple[float, FloatArray] | None
) -> tuple[float, FloatArray]:
    """Eta and theta (r,) to start from: those given if the dual is smaller there than at theta = 0.

    If all rewards are equal, no policy is better than another, and eta starts at its floor.
    """
    eta = max(1.0, problem.eta_floor) if problem.rewards.any() else problem.eta_floor
    theta = np.zeros(problem.rank)
    if start is None:
        return eta, theta
    given = max(start[0], problem.eta_floor), start[1]
    # the dual at theta = 0, where delta is R: this needs no pass over the features
    at_zero = eta * (problem.kl_bound + float(np.log(np.mean(np.exp(problem.rewards / eta)))))
    return given if dual_value(problem, *given) <= at_zero else (eta, theta)


def certify(problem: Problem, end: NewtonState, outcome: Outcome) -> DualSolution:
    """The solution at the end of a run, with primal value, KL and residuals."""
    point = end.point
    weights = sample_weights(problem.bellman_errors(point.theta), point.eta)
    kl = kl_from_uniform(weights)
    primal = penalised_reward(problem, weights, point.moments.mean_row)
    if outcome is Outcome.AT_FLOOR:  # here eta is a given price of KL, no Lagrange multiplier
        primal += point.eta * (problem.kl_bound - kl)
    _, g_theta = gradient_of(problem, point.theta, point.moments)
    return DualSolution(
        eta=point.eta,
        theta=point.theta,
        weights=weights,
        dual=value_of(problem, point.theta, point.moments),
        primal=primal,
        kl=kl,
        decrement=end.decrement,
        stationarity=float(np.linalg.norm(g_theta)),
        iterations=end.iterations,
        jitter=end.jitter,
        outcome=outcome,
    )


def minimise_by_newton(
    problem: Problem,
    eta: float,
    theta: FloatArray,
    max_iterations: int,
    *,
    fixed_eta: bool = False,
) -> NewtonState:
    """Damped Newton's method from eta and theta (r,).

    Args:
        problem: data of the update.
        eta: first temperature, at or above the floor.
        theta: (r,) first coordinates of V.
        max_iterations: largest number of steps.
        fixed_eta: whether only theta is changed.
    """
    state = initial_state(problem, eta, theta)
    while state.status is Status.RUNNING and state.iterations < max_iterations:
        state = newton_step(problem, state, fixed_eta=fixed_eta)
    return state


def bisect_temperature(problem: Problem, stalled: NewtonState) -> NewtonState:
    """The fallback: minimises over theta at fixed temperatures; KL decreases with eta.

    From eta = 1 the temperature is halved (or doubled) until KL has passed its bound, then bisected
    in its logarithm.  Each minimisation starts from the solution of the one before.

    Args:
        problem: data of the update.
        stalled: end of the run of Newton's method, whose iterations and jitter are included.
    """
    eta, theta = max(1.0, problem.eta_floor), np.zeros(problem.rank)
    low, high = 0.0, np.inf  # KL exceeds its bound at low and is below it at high
    iterations, jitter, end = stalled.iterations, stalled.jitter, stalled
    for _ in range(MAX_TEMPERATURES):
        end = minimise_by_newton(
            problem, eta, theta, MAX_ITERATIONS_PER_TEMPERATURE, fixed_eta=True
        )
        theta = end.point.theta
        iterations += end.iterations
        jitter = max(jitter, end.jitter)
        end = replace(end, iterations=iterations, jitter=jitter)
        g_eta = problem.kl_bound - end.point.moments.kl
        at_floor = eta <= problem.eta_floor and g_eta >= 0
        if at_floor or abs(g_eta) <= KL_TOLERANCE * problem.kl_bound:
            return end
        if g_eta < 0:
            low = eta
        else:
            high = eta
        eta = next_temperature(low, high, eta, problem.eta_floor)
    return replace(end, status=Status.STALLED)


def next_temperature(low: float, high: float, eta: float, floor: float) -> float:
    """The next temperature of the bisection, from the bracket (0 and infinity if still open)."""
    if np.isinf(high):
        return 2.0 * eta
    if low == 0.0:
        return max(0.5 * eta, floor)
    return float(np.sqrt(low * high))
