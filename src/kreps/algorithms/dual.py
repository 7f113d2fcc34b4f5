"""Eqs. 1, 2 and 5: the convex dual of the bounded policy update, and its certified solution.

Every variant of REPS is ``delta = R + B theta``; they differ only in how B came about.  So one
solver serves them all.  It sees B only through `Moments`, which add up over chunks of the samples:
the same Newton method runs on a matrix in memory and on a million rows that never are.

The ridge ``rho / 2 |theta|^2`` is not in the paper: without it stationarity is enforced in every
direction of a rich basis, and the dual need not be bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np

from kreps.kernels.arrays import Array, FloatArray, as_numpy, namespace

MIN_ETA = 1e-6
"""Floor of the temperature where none is asked for: below it there is nothing left to gain."""


class Problem(Protocol):
    """The data of one update, as the solver sees it."""

    @property
    def rewards(self) -> FloatArray:
        """(n,) rewards R in units of their standard deviation, largest one zero."""
        ...

    @property
    def rank(self) -> int:
        """Number of features r."""
        ...

    @property
    def kl_bound(self) -> float: ...

    @property
    def ridge(self) -> float: ...

    @property
    def eta_floor(self) -> float: ...

    def bellman_errors(self, theta: FloatArray) -> FloatArray:
        """``delta``, (n,)."""
        ...

    def moments(self, eta: float, theta: FloatArray, *, scatter: bool) -> Moments:
        """Of all rows of B and all Bellman errors at temperature eta and theta (r,).

        ``scatter`` says whether their covariance, the costly part, is needed.
        """
        ...


@dataclass(frozen=True)
class DualProblem:
    """A `Problem` in memory.

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

    @property
    def rank(self) -> int:
        return self.differences.shape[1]

    def bellman_errors(self, theta: FloatArray) -> FloatArray:
        return self.rewards + self.differences @ theta

    def moments(self, eta: float, theta: FloatArray, *, scatter: bool) -> Moments:
        delta = self.bellman_errors(theta)
        return Moments.of(delta, self.differences, eta, scatter=scatter)


@dataclass(frozen=True)
class Moments:
    """Rows b of B and Bellman errors under weights p proportional to ``exp(delta / eta)``.

    They are all that value, gradient and Hessian of the dual need, and they add up over chunks.

    Attributes:
        samples: n.
        eta: temperature of the weights.
        top: ``max delta``.
        log_mass: ``log sum_i exp((delta_i - top) / eta)``.
        below: ``E_p[delta] - top``.
        row: (r,) ``E_p[b] = B'p``.
        scatter: (r + 1, r + 1) covariance under p of ``(b, -delta)``, or None if not asked for.
    """

    samples: int
    eta: float
    top: float
    log_mass: float
    below: float
    row: FloatArray
    scatter: FloatArray | None

    @classmethod
    def of(cls, delta: Array, rows: Array, eta: float, *, scatter: bool) -> Moments:
        """Of some samples.

        Args:
            delta: (n,) their Bellman errors.
            rows: (n, r) of B, of any array library, as ``delta``.
            eta: temperature.
            scatter: whether the covariance is needed.
        """
        xp = namespace(rows)
        n, r = rows.shape
        top = float(xp.max(delta))
        lag = delta - top
        p = xp.exp(lag / eta)
        mass = float(xp.sum(p))
        p = p / mass
        below, row = float(p @ lag), p @ rows
        covariance = None
        if scatter:
            root = xp.sqrt(p)
            centred = rows - row
            centred *= root[:, None]
            fall = root * (below - lag)
            covariance = np.empty((r + 1, r + 1))
            covariance[:r, :r] = as_numpy(centred.T @ centred)
            covariance[:r, r] = covariance[r, :r] = as_numpy(fall @ centred)
            covariance[r, r] = float(fall @ fall)
        return cls(n, eta, top, float(np.log(mass)), below, as_numpy(row), covariance)

    def __add__(self, other: Moments) -> Moments:
        """Those of the samples of both."""
        top = max(self.top, other.top)
        logs = np.array([m.log_mass + (m.top - top) / m.eta for m in (self, other)])
        log_mass = float(np.logaddexp(*logs))
        mine, theirs = np.exp(logs - log_mass).tolist()
        apart = np.append(
            self.row - other.row, other.top + other.below - self.top - self.below
        )  # of (b, -delta)
        covariance = None
        if self.scatter is not None and other.scatter is not None:
            covariance = mine * self.scatter + theirs * other.scatter
            covariance += mine * theirs * np.outer(apart, apart)
        return Moments(
            samples=self.samples + other.samples,
            eta=self.eta,
            top=top,
            log_mass=log_mass,
            below=mine * (self.below + self.top - top) + theirs * (other.below + other.top - top),
            row=mine * self.row + theirs * other.row,
            scatter=covariance,
        )

    @property
    def kl(self) -> float:
        """``KL(p || uniform)`` in nats."""
        return self.below / self.eta - self.log_mass + float(np.log(self.samples))

    @property
    def soft_maximum(self) -> float:
        """``eta log mean exp(delta / eta)``."""
        return self.top + self.eta * (self.log_mass - float(np.log(self.samples)))


def standardise(rewards: FloatArray) -> tuple[FloatArray, float]:
    """``(R - max R) / std R`` and ``std R``; zeros and 1 where all rewards agree to rounding."""
    top = float(rewards.max())
    spread = float((rewards - top).std())
    if spread <= 1e-13 * float(np.abs(rewards).max()):
        return np.zeros_like(rewards), 1.0
    return (rewards - top) / spread, spread


def bellman_errors(problem: Problem, theta: FloatArray) -> FloatArray:
    """Eq. 5: ``delta = R + B theta``, (n,)."""
    return problem.bellman_errors(theta)


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


def dual_value(problem: Problem, eta: float, theta: FloatArray) -> float:
    """Eq. 2: ``g = eta epsilon + eta log mean exp(delta / eta) + rho / 2 |theta|^2``."""
    return _value(problem, theta, problem.moments(eta, theta, scatter=False))


def dual_gradient(problem: Problem, eta: float, theta: FloatArray) -> tuple[float, FloatArray]:
    """``(g_eta, g_theta) = (epsilon - KL(p || uniform), B'p + rho theta)``."""
    return _gradient(problem, theta, problem.moments(eta, theta, scatter=False))


def dual_hessian(problem: Problem, eta: float, theta: FloatArray) -> FloatArray:
    """Hessian (r + 1, r + 1) in ``(theta, eta)``, the eta row and column multiplied by eta.

    So scaled it is ``Cov_p(b, -delta) / eta`` plus rho on the diagonal of theta.
    """
    return _hessian(problem, problem.moments(eta, theta, scatter=True))


def _value(problem: Problem, theta: FloatArray, m: Moments) -> float:
    return m.eta * problem.kl_bound + m.soft_maximum + 0.5 * problem.ridge * float(theta @ theta)


def _gradient(problem: Problem, theta: FloatArray, m: Moments) -> tuple[float, FloatArray]:
    return problem.kl_bound - m.kl, m.row + problem.ridge * theta


def _hessian(problem: Problem, m: Moments) -> FloatArray:
    assert m.scatter is not None
    hessian = m.scatter / m.eta
    r = len(m.row)
    hessian.flat[: r * (r + 2) : r + 2] += problem.ridge
    return hessian


def primal_value(problem: DualProblem, p: FloatArray) -> float:
    """``p'R - |B'p|^2 / (2 rho)``: expected reward less the price of not being stationary."""
    return _primal(problem, p, problem.differences.T @ p)


def _primal(problem: Problem, p: FloatArray, imbalance: FloatArray) -> float:
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
