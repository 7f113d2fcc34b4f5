"""Eqs. 1, 2 and 5: the convex dual of the bounded policy update, and its certified solution.

Every variant of REPS is ``delta = R + B theta``; they differ only in how B came about.  So one
solver serves them all.  It sees B only through `Moments`, which add up over chunks of the samples:
the same Newton method runs on a matrix in memory and on a million rows that never are.

The ridge ``rho / 2 |theta|^2`` is not in the paper: without it stationarity is enforced in every
direction of a rich basis, and the dual need not be bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.algorithms.dual import (
    DualSolution,
    Moments,
    Outcome,
    Problem,
    _gradient,
    _hessian,
    _primal,
    _value,
    dual_value,
    kl_from_uniform,
    sample_weights,
)
from kreps.kernels.arrays import FloatArray
from kreps.kernels.linalg import Cholesky, cholesky


@dataclass(frozen=True)
class _Progress:
    """Where a Newton run stands."""

    eta: float
    theta: FloatArray
    moments: Moments
    decrement: float
    iterations: int
    jitter: float
    converged: bool


DECREMENT_TOLERANCE = 1e-9
GAP_TOLERANCE = 1e-6
KL_TOLERANCE = 1e-4  # relative to the bound
"""All three are asked for: the decrement alone lies as eta -> 0, where the curvature explodes."""

CENTRED = 0.01
"""Decrement, in units of eta, above which theta has to be mended before eta may move.

``exp(delta / eta)`` is nearly quadratic only where delta changes by less than eta.  A temperature
that runs ahead of its theta leaves no step that is both long and downhill.  (Times the least eta it
exceeds `DECREMENT_TOLERANCE`: a run whose eta still waits is never done.)"""


def solve_dual(
    problem: Problem,
    max_iterations: int = 80,
    start: tuple[float, FloatArray] | None = None,
) -> DualSolution:
    """Minimise the dual over eta >= floor and theta: damped Newton, with bisection to fall back on.

    Args:
        problem: the update's data.
        max_iterations: of the joint Newton method before the fallback takes over.
        start: eta and theta to start from where that is better than to know nothing, such as the
            solution for a part of the samples.
    """
    # Where all rewards agree nothing can be gained: the temperature belongs to its floor.
    eta = max(1.0, problem.eta_floor) if problem.rewards.any() else problem.eta_floor
    theta = np.zeros(problem.rank)
    if start is not None:
        given = max(start[0], problem.eta_floor), start[1]
        # the dual where V is zero: delta is R, so it needs no pass over the features
        nothing = eta * (problem.kl_bound + float(np.log(np.mean(np.exp(problem.rewards / eta)))))
        if dual_value(problem, *given) <= nothing:
            eta, theta = given
    end = _newton(problem, eta, theta, max_iterations, eta_free=True)
    outcome = Outcome.BOUND_ACTIVE
    if not end.converged:
        end = _bisection(problem, end)
        outcome = Outcome.FALLBACK if end.converged else Outcome.NOT_CONVERGED
    if end.converged and end.eta <= problem.eta_floor:
        outcome = Outcome.AT_FLOOR
    return _certify(problem, end, outcome)


def _certify(problem: Problem, end: _Progress, outcome: Outcome) -> DualSolution:
    weights = sample_weights(problem.bellman_errors(end.theta), end.eta)
    kl = kl_from_uniform(weights)
    primal = _primal(problem, weights, end.moments.row)
    if outcome is Outcome.AT_FLOOR:  # the temperature is a given price of KL, not a multiplier
        primal += end.eta * (problem.kl_bound - kl)
    _, g_theta = _gradient(problem, end.theta, end.moments)
    return DualSolution(
        eta=end.eta,
        theta=end.theta,
        weights=weights,
        dual=_value(problem, end.theta, end.moments),
        primal=primal,
        kl=kl,
        decrement=end.decrement,
        stationarity=float(np.linalg.norm(g_theta)),
        iterations=end.iterations,
        jitter=end.jitter,
        outcome=outcome,
    )


def _newton(
    problem: Problem, eta: float, theta: FloatArray, max_iterations: int, *, eta_free: bool
) -> _Progress:
    """Damped Newton from ``(eta, theta)``, projected on ``eta >= floor``; or in theta alone.

    Eta waits until theta is `CENTRED`, so that the run follows the path of best thetas.
    """
    floor = problem.eta_floor
    here = problem.moments(eta, theta, scatter=True)
    value = _value(problem, theta, here)
    decrement, before, jitter = np.inf, 1.0, 0.0
    shortened = False
    for iteration in range(max_iterations):
        g_eta, g_theta = _gradient(problem, theta, here)
        hessian = _hessian(problem, here)
        factor = cholesky(hessian[:-1, :-1])
        jitter = max(jitter, factor.jitter)
        step, stretch = -factor.solve(g_theta), 0.0  # the latter a relative change of eta
        at_floor = eta <= floor
        centred = -0.5 * float(g_theta @ step) <= CENTRED * eta
        moves_eta = eta_free and centred and not (at_floor and g_eta >= 0)
        if moves_eta:
            both, change = _joint_step(factor, hessian, step, eta * g_eta)
            moves_eta = not (at_floor and change < 0)
            if moves_eta:
                step, stretch = both, change
        slope = float(g_theta @ step) + eta * g_eta * stretch
        decrement = -0.5 * slope
        if _done(problem, g_eta if moves_eta else 0.0, g_theta, decrement):
            return _Progress(eta, theta, here, decrement, iteration, jitter, True)
        # eta at most halves or doubles, and never passes its floor
        most = 1.0 if stretch > 0.0 else max(0.5, floor / eta) - 1.0
        length = min(1.0, most / stretch) if stretch else 1.0
        rounding = 1e-14 * max(1.0, abs(value))
        # The first try is good enough where the one before was, so its curvature is taken in the
        # same pass; but where it should be the last, converging as fast as before, none is needed.
        expected = decrement * min(1.0, decrement / before)
        before = decrement
        scatter = not shortened and 10.0 * expected > DECREMENT_TOLERANCE
        shortened = False
        while length > 1e-12:
            new_eta = max(eta * (1.0 + length * stretch), floor)
            if new_eta <= floor * (1.0 + 1e-9):
                new_eta = floor  # exactly, not a rounding error above it
            new_theta = theta + length * step
            there = problem.moments(new_eta, new_theta, scatter=scatter)
            new_value = _value(problem, new_theta, there)
            if new_value <= value + 1e-4 * length * slope + rounding:
                break
            length *= 0.5
            scatter, shortened = False, True
        else:
            return _Progress(eta, theta, here, decrement, iteration, jitter, False)
        eta, theta, value, here = new_eta, new_theta, new_value, there
        if here.scatter is None:
            g_eta, g_theta = _gradient(problem, theta, here)
            step, stretch = -factor.solve(g_theta), 0.0
            if moves_eta:
                step, stretch = _joint_step(factor, hessian, step, eta * g_eta)
            decrement = -0.5 * (float(g_theta @ step) + eta * g_eta * stretch)
            # by the last Hessian, hence the margin; where eta comes to its floor or leaves it, no
            settled = eta > floor if moves_eta else (at_floor and g_eta >= 0) or not eta_free
            if settled and _done(problem, g_eta if moves_eta else 0.0, g_theta, 10.0 * decrement):
                return _Progress(eta, theta, here, decrement, iteration + 1, jitter, True)
            here = problem.moments(eta, theta, scatter=True)
    return _Progress(eta, theta, here, decrement, max_iterations, jitter, False)


def _joint_step(
    factor: Cholesky, hessian: FloatArray, step: FloatArray, g_eta: float
) -> tuple[FloatArray, float]:
    """Newton's step in theta (r,) and eta, from that in theta alone: the last row eliminated.

    Args:
        factor: of the block of theta.
        hessian: (r + 1, r + 1) whole.
        step: (r,) in theta alone.
        g_eta: gradient in the scaled eta.
    """
    mixed, own = hessian[:-1, -1], float(hessian[-1, -1])
    pulled = factor.solve(mixed)  # how far theta has to go back for eta
    complement = max(own - float(mixed @ pulled), 1e-12 * own, 1e-300)
    stretch = -(g_eta + float(mixed @ step)) / complement
    return step - stretch * pulled, stretch


def _done(problem: Problem, g_eta: float, g_theta: FloatArray, decrement: float) -> bool:
    """Whether a gradient and its Newton decrement are small enough."""
    gap = float(g_theta @ g_theta) / (2.0 * problem.ridge)
    kl_met = abs(g_eta) <= KL_TOLERANCE * problem.kl_bound
    return decrement <= DECREMENT_TOLERANCE and gap <= GAP_TOLERANCE and kl_met


def _bisection(problem: Problem, stalled: _Progress) -> _Progress:
    """Newton in theta along a path of temperatures: slow and sure, as KL falls with eta.

    From eta = 1 the temperature is halved (or doubled) until the KL bound is passed, then
    bisected in the logarithm.  Each solve starts from the one before, so none has far to go.
    """
    eta, theta = max(1.0, problem.eta_floor), np.zeros(problem.rank)
    low, high = 0.0, np.inf  # KL is too large at low, too small at high
    iterations, jitter, end = stalled.iterations, stalled.jitter, stalled
    for _ in range(100):
        end = _newton(problem, eta, theta, 100, eta_free=False)
        theta = end.theta
        iterations += end.iterations
        jitter = max(jitter, end.jitter)
        g_eta = problem.kl_bound - end.moments.kl
        at_floor = eta <= problem.eta_floor and g_eta >= 0
        if at_floor or abs(g_eta) <= KL_TOLERANCE * problem.kl_bound:
            return _Progress(
                eta, theta, end.moments, end.decrement, iterations, jitter, end.converged
            )
        if g_eta < 0:
            low = eta
        else:
            high = eta
        if np.isinf(high):
            eta *= 2.0
        elif low == 0.0:
            eta = max(0.5 * eta, problem.eta_floor)
        else:
            eta = float(np.sqrt(low * high))
    return _Progress(eta, theta, end.moments, end.decrement, iterations, jitter, False)
