"""Eqs. 1, 2 and 5: the convex dual of the bounded policy update, and its certified solution.

Every variant of REPS is ``delta = R + B theta``; they differ only in how B came about.  So one
solver serves them all.  The ridge ``rho / 2 |theta|^2`` is not in the paper: without it
stationarity is enforced in every direction of a rich basis, and the dual need not be bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kreps.arrays import FloatArray
from kreps.linalg import cholesky


@dataclass(frozen=True)
class DualProblem:
    """The data of one update.

    Attributes:
        rewards: (n,) rewards R in units of their standard deviation, largest one zero.
        differences: (n, r) rows ``E[phi(s') | s_i, a_i] - phi(s_i)``, restarts included: B.
        kl_bound: epsilon, in nats.
        ridge: rho.
        eta_floor: least temperature, in the units of the rewards.  Where the optimum lies
            below it the KL bound is inactive and the update an honest soft maximum.
    """

    rewards: FloatArray
    differences: FloatArray
    kl_bound: float
    ridge: float
    eta_floor: float


def standardise(rewards: FloatArray) -> tuple[FloatArray, float]:
    """``(R - max R) / std R`` and ``std R``; zeros and 1 where all rewards agree to rounding."""
    top = float(rewards.max())
    spread = float((rewards - top).std())
    if spread <= 1e-13 * float(np.abs(rewards).max()):
        return np.zeros_like(rewards), 1.0
    return (rewards - top) / spread, spread


def bellman_errors(problem: DualProblem, theta: FloatArray) -> FloatArray:
    """Eq. 5: ``delta = R + B theta``, (n,)."""
    return problem.rewards + problem.differences @ theta


def sample_weights(delta: FloatArray, eta: float) -> FloatArray:
    """Eq. 1: ``p_i`` proportional to ``exp(delta_i / eta)``, (n,), adding up to one."""
    p = np.exp((delta - delta.max()) / eta)
    return p / p.sum()


def kl_from_uniform(p: FloatArray) -> float:
    """``KL(p || uniform)`` in nats."""
    positive = p[p > 0]
    return float(positive @ np.log(positive * len(p)))


def effective_sample_size(p: FloatArray) -> float:
    """``1 / sum p^2``: how many equally weighted samples the weights are worth."""
    return 1.0 / float(p @ p)


def dual_value(problem: DualProblem, eta: float, theta: FloatArray) -> float:
    """Eq. 2: ``g = eta epsilon + eta log mean exp(delta / eta) + rho / 2 |theta|^2``."""
    delta = bellman_errors(problem, theta)
    top = float(delta.max())
    log_mean = top / eta + float(np.log(np.mean(np.exp((delta - top) / eta))))
    return eta * (problem.kl_bound + log_mean) + 0.5 * problem.ridge * float(theta @ theta)


def dual_gradient(problem: DualProblem, eta: float, theta: FloatArray) -> tuple[float, FloatArray]:
    """``(g_eta, g_theta) = (epsilon - KL(p || uniform), B'p + rho theta)``."""
    p = sample_weights(bellman_errors(problem, theta), eta)
    g_theta = problem.differences.T @ p + problem.ridge * theta
    return problem.kl_bound - kl_from_uniform(p), g_theta


def dual_hessian(problem: DualProblem, eta: float, theta: FloatArray) -> FloatArray:
    """Hessian (r + 1, r + 1) in ``(theta, eta)``, the eta row and column multiplied by eta.

    So scaled it is one symmetric product: with ``J = sqrt(p) [B - E_p B, -(delta - E_p delta)]``
    it is ``J'J / eta`` plus rho on the diagonal of theta.
    """
    delta = bellman_errors(problem, theta)
    p = sample_weights(delta, eta)
    root = np.sqrt(p)[:, None]
    r = problem.differences.shape[1]
    j = np.empty((len(p), r + 1))
    np.multiply(problem.differences - p @ problem.differences, root, out=j[:, :r])
    j[:, r] = -(delta - p @ delta) * root[:, 0]
    hessian = j.T @ j / eta
    hessian.flat[: r * (r + 2) : r + 2] += problem.ridge
    return hessian


def primal_value(problem: DualProblem, p: FloatArray) -> float:
    """``p'R - |B'p|^2 / (2 rho)``: expected reward less the price of not being stationary."""
    imbalance = problem.differences.T @ p
    return float(p @ problem.rewards - imbalance @ imbalance / (2.0 * problem.ridge))


class Outcome(StrEnum):
    """How a solve ended; the value is the message for people."""

    BOUND_ACTIVE = "converged: the update moves as far as the KL bound permits"
    AT_FLOOR = "converged: the temperature is at its floor, the KL bound is inactive"
    FALLBACK = "converged by bisection on the temperature, after Newton's method had stalled"
    NOT_CONVERGED = (
        "not converged: the weights are usable but not certified; "
        "increase the ridge, or check the data for duplicated or enormous features"
    )


@dataclass(frozen=True)
class DualSolution:
    """The solution of one update together with its certificate.

    Attributes:
        eta: temperature, in units of the standardised rewards.
        theta: (r,) coordinates of V.
        weights: (n,) the p_i of Eq. 1.
        dual, primal: values of the two problems.  For feasible weights ``dual >= primal``, so a
            small ``gap`` proves both optimal; it is ``eta (epsilon - KL) + |B'p + rho theta|^2 /
            (2 rho)``, and as negative as KL may exceed its bound (1e-4 of it).  At the floor both
            are those of the problem with the temperature held there.
        kl: realised ``KL(p || uniform)``, equal to the bound unless eta is at its floor.
        decrement: half the squared Newton decrement.
        stationarity: ``|B'p + rho theta|``, the residual of the stationarity condition.
        iterations: Newton iterations, those of the fallback included.
        jitter: largest jitter that a Newton system needed.
        outcome: how it ended.
    """

    eta: float
    theta: FloatArray
    weights: FloatArray
    dual: float
    primal: float
    kl: float
    decrement: float
    stationarity: float
    iterations: int
    jitter: float
    outcome: Outcome

    @property
    def gap(self) -> float:
        return self.dual - self.primal

    @property
    def converged(self) -> bool:
        return self.outcome is not Outcome.NOT_CONVERGED


@dataclass(frozen=True)
class _Progress:
    """Where a Newton run stands."""

    eta: float
    theta: FloatArray
    decrement: float
    iterations: int
    jitter: float
    converged: bool


DECREMENT_TOLERANCE = 1e-9
GAP_TOLERANCE = 1e-6
KL_TOLERANCE = 1e-4  # relative to the bound
"""All three are asked for: the decrement alone lies as eta -> 0, where the curvature explodes."""


def solve_dual(problem: DualProblem, max_iterations: int = 40) -> DualSolution:
    """Minimise the dual over eta >= floor and theta: damped Newton, with bisection to fall back on.

    Args:
        problem: the update's data.
        max_iterations: of the joint Newton method before the fallback takes over.
    """
    # Where all rewards agree nothing can be gained, and the temperature belongs to its floor.
    start = max(1.0, problem.eta_floor) if problem.rewards.any() else problem.eta_floor
    zero = np.zeros(problem.differences.shape[1])
    end = _newton(problem, start, zero, max_iterations, eta_free=True)
    outcome = Outcome.BOUND_ACTIVE
    if not end.converged:
        end = _bisection(problem, end)
        outcome = Outcome.FALLBACK if end.converged else Outcome.NOT_CONVERGED
    if end.converged and end.eta <= problem.eta_floor:
        outcome = Outcome.AT_FLOOR
    return _certify(problem, end, outcome)


def _certify(problem: DualProblem, end: _Progress, outcome: Outcome) -> DualSolution:
    weights = sample_weights(bellman_errors(problem, end.theta), end.eta)
    kl = kl_from_uniform(weights)
    primal = primal_value(problem, weights)
    if outcome is Outcome.AT_FLOOR:  # the temperature is a given price of KL, not a multiplier
        primal += end.eta * (problem.kl_bound - kl)
    _, g_theta = dual_gradient(problem, end.eta, end.theta)
    return DualSolution(
        eta=end.eta,
        theta=end.theta,
        weights=weights,
        dual=dual_value(problem, end.eta, end.theta),
        primal=primal,
        kl=kl,
        decrement=end.decrement,
        stationarity=float(np.linalg.norm(g_theta)),
        iterations=end.iterations,
        jitter=end.jitter,
        outcome=outcome,
    )


def _newton(
    problem: DualProblem, eta: float, theta: FloatArray, max_iterations: int, *, eta_free: bool
) -> _Progress:
    """Damped Newton from ``(eta, theta)``, projected on ``eta >= floor``; or in theta alone."""
    floor = problem.eta_floor
    value = dual_value(problem, eta, theta)
    decrement, jitter = np.inf, 0.0
    for iteration in range(max_iterations):
        g_eta, g_theta = dual_gradient(problem, eta, theta)
        hessian = dual_hessian(problem, eta, theta)
        at_floor = eta <= floor
        moves_eta = eta_free and not (at_floor and g_eta >= 0)
        stretch = 0.0  # relative change of eta
        if moves_eta:
            factor = cholesky(hessian)
            step = -factor.solve(np.append(g_theta, eta * g_eta))
            step, stretch = step[:-1], float(step[-1])
            moves_eta = not (at_floor and stretch < 0)
        if not moves_eta:
            factor = cholesky(hessian[:-1, :-1])
            step, stretch = -factor.solve(g_theta), 0.0
        jitter = max(jitter, factor.jitter)
        slope = float(g_theta @ step) + eta * g_eta * stretch
        decrement = -0.5 * slope
        kl_met = not moves_eta or abs(g_eta) <= KL_TOLERANCE * problem.kl_bound
        gap = float(g_theta @ g_theta) / (2.0 * problem.ridge)
        if decrement <= DECREMENT_TOLERANCE and gap <= GAP_TOLERANCE and kl_met:
            return _Progress(eta, theta, decrement, iteration, jitter, True)
        least = max(0.5, floor / eta) - 1.0  # eta at most halves and never passes its floor
        length = 1.0 if stretch >= least else least / stretch
        rounding = 1e-14 * max(1.0, abs(value))
        while length > 1e-12:
            new_eta = max(eta * (1.0 + length * stretch), floor)
            new_theta = theta + length * step
            new_value = dual_value(problem, new_eta, new_theta)
            if new_value <= value + 1e-4 * length * slope + rounding:
                break
            length *= 0.5
        else:
            return _Progress(eta, theta, decrement, iteration, jitter, False)
        # land on the floor exactly, not a rounding error above it
        eta = floor if new_eta <= floor * (1.0 + 1e-9) else new_eta
        theta, value = new_theta, new_value
    return _Progress(eta, theta, decrement, max_iterations, jitter, False)


def _bisection(problem: DualProblem, stalled: _Progress) -> _Progress:
    """Newton in theta along a path of temperatures: slow and sure, as KL falls with eta.

    From eta = 1 the temperature is halved (or doubled) until the KL bound is passed, then
    bisected in the logarithm.  Each solve starts from the one before, so none has far to go.
    """
    eta, theta = max(1.0, problem.eta_floor), np.zeros(problem.differences.shape[1])
    low, high = 0.0, np.inf  # KL is too large at low, too small at high
    iterations, jitter, end = stalled.iterations, stalled.jitter, stalled
    for _ in range(100):
        end = _newton(problem, eta, theta, 100, eta_free=False)
        theta = end.theta
        iterations += end.iterations
        jitter = max(jitter, end.jitter)
        g_eta, _ = dual_gradient(problem, eta, theta)
        at_floor = eta <= problem.eta_floor and g_eta >= 0
        if at_floor or abs(g_eta) <= KL_TOLERANCE * problem.kl_bound:
            return _Progress(eta, theta, end.decrement, iterations, jitter, end.converged)
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
    return _Progress(eta, theta, end.decrement, iterations, jitter, False)
