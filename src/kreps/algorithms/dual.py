"""Eqs. 1, 2 and 5: the convex dual of the bounded policy update, and the certificate of a solution.

All variants of REPS have Bellman errors ``delta = R + B theta`` and differ only in the matrix B, so
they share one solver (`kreps.algorithms.newton`).  It accesses B only through `Moments`, which add
up over chunks of the samples.  The same Newton method therefore runs on a matrix in memory and on
samples that are streamed chunk by chunk.

The ridge ``rho / 2 |theta|^2`` is not in the paper.  Without it stationarity is enforced in every
direction of a rich basis, and the dual can be unbounded below.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np

from kreps.kernels.arrays import Array, FloatArray, as_numpy, namespace

MIN_ETA = 1e-6
"""Smallest temperature of any update, in standard deviations of the reward.  At this temperature
the weights are already those of the samples with the largest Bellman errors."""

EQUAL_REWARDS_RTOL = 1e-13
"""Rewards whose standard deviation is at most this share of their largest absolute value count as
equal: the differences are rounding errors."""


class Problem(Protocol):
    """The data of one update, as the solver needs it: n samples and r features."""

    @property
    def rewards(self) -> FloatArray:
        """(n,) rewards R in units of their standard deviation; the largest one is zero."""
        ...

    @property
    def rank(self) -> int:
        """Number of features r."""
        ...

    @property
    def kl_bound(self) -> float:
        """Epsilon, in nats."""
        ...

    @property
    def ridge(self) -> float:
        """Rho."""
        ...

    @property
    def eta_floor(self) -> float:
        """Smallest temperature eta, in units of the rewards."""
        ...

    def bellman_errors(self, theta: FloatArray) -> FloatArray:
        """Eq. 5: ``delta = R + B theta``, (n,)."""
        ...

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        """Moments of the rows of B and of the Bellman errors under the weights of Eq. 1.

        Args:
            eta: temperature.
            theta: (r,) coordinates of V.
            with_covariance: whether the covariance is computed, which costs O(n r^2) instead of
                O(n r); the Hessian needs it.
        """
        ...


@dataclass(frozen=True)
class DualProblem:
    """A `Problem` in memory.

    Attributes:
        rewards: (n,) rewards R in units of their standard deviation; the largest one is zero.
        differences: B: (n, r) rows ``E[phi(s') | s_i, a_i] - phi(s_i)``, restarts included.
        kl_bound: epsilon, in nats.
        ridge: rho.
        eta_floor: smallest temperature, in units of the rewards.  Where the optimum is below it,
            the KL bound is inactive and the update is a soft maximum at this temperature.
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

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        delta = self.bellman_errors(theta)
        return Moments.from_rows(delta, self.differences, eta, with_covariance=with_covariance)


@dataclass(frozen=True)
class Moments:
    """Moments of rows b of B and Bellman errors delta, weighted by p.

    The weights p are proportional to ``exp(delta / eta)`` (Eq. 1).  Value, gradient and Hessian of
    the dual are functions of these moments.  Moments of two sets of samples add up to those of
    their union, by the update of means and covariances of Chan, Golub and LeVeque (1979).

    Attributes:
        samples: n.
        eta: temperature of the weights.
        max_delta: ``max_i delta_i``.
        log_mass: ``log sum_i exp((delta_i - max_delta) / eta)``.
        mean_delta: ``E_p[delta] - max_delta``, at most zero.
        mean_row: (r,) ``E_p[b] = B'p``.
        covariance: (r + 1, r + 1) covariance under p of ``(b, -delta)``, or None if it was not
            computed.
    """

    samples: int
    eta: float
    max_delta: float
    log_mass: float
    mean_delta: float
    mean_row: FloatArray
    covariance: FloatArray | None

    @classmethod
    def from_rows(cls, delta: Array, rows: Array, eta: float, *, with_covariance: bool) -> Moments:
        """The moments of n samples.

        Args:
            delta: (n,) Bellman errors, of any array library.
            rows: (n, r) rows of B, of the same library.
            eta: temperature.
            with_covariance: whether the covariance is computed.
        """
        xp = namespace(rows)
        n, r = rows.shape
        max_delta = float(xp.max(delta))
        centred_delta = delta - max_delta
        p = xp.exp(centred_delta / eta)
        mass = float(xp.sum(p))
        p = p / mass
        mean_delta, mean_row = float(p @ centred_delta), p @ rows
        covariance = None
        if with_covariance:
            root = xp.sqrt(p)
            centred = rows - mean_row
            centred *= root[:, None]
            negative_delta = root * (mean_delta - centred_delta)
            covariance = np.empty((r + 1, r + 1))
            covariance[:r, :r] = as_numpy(centred.T @ centred)
            covariance[:r, r] = covariance[r, :r] = as_numpy(negative_delta @ centred)
            covariance[r, r] = float(negative_delta @ negative_delta)
        log_mass = float(np.log(mass))
        return cls(n, eta, max_delta, log_mass, mean_delta, as_numpy(mean_row), covariance)

    def __add__(self, other: Moments) -> Moments:
        """The moments of the union of two sets of samples."""
        top = max(self.max_delta, other.max_delta)
        logs = np.array([m.log_mass + (m.max_delta - top) / m.eta for m in (self, other)])
        log_mass = float(np.logaddexp(*logs))
        own_share, other_share = np.exp(logs - log_mass).tolist()
        mean_difference = np.append(
            self.mean_row - other.mean_row,
            other.max_delta + other.mean_delta - self.max_delta - self.mean_delta,
        )  # of (b, -delta)
        covariance = None
        if self.covariance is not None and other.covariance is not None:
            covariance = own_share * self.covariance + other_share * other.covariance
            covariance += own_share * other_share * np.outer(mean_difference, mean_difference)
        return Moments(
            samples=self.samples + other.samples,
            eta=self.eta,
            max_delta=top,
            log_mass=log_mass,
            mean_delta=own_share * (self.mean_delta + self.max_delta - top)
            + other_share * (other.mean_delta + other.max_delta - top),
            mean_row=own_share * self.mean_row + other_share * other.mean_row,
            covariance=covariance,
        )

    @property
    def kl(self) -> float:
        """``KL(p || uniform)`` in nats."""
        return self.mean_delta / self.eta - self.log_mass + float(np.log(self.samples))

    @property
    def soft_maximum(self) -> float:
        """``eta log mean exp(delta / eta)``."""
        return self.max_delta + self.eta * (self.log_mass - float(np.log(self.samples)))


def standardise(rewards: FloatArray) -> tuple[FloatArray, float]:
    """``(R - max R) / std R`` (n,) and ``std R``; zeros and 1 if all rewards agree to rounding."""
    top = float(rewards.max())
    deviation = float((rewards - top).std())
    if deviation <= EQUAL_REWARDS_RTOL * float(np.abs(rewards).max()):
        return np.zeros_like(rewards), 1.0
    return (rewards - top) / deviation, deviation


def bellman_errors(problem: Problem, theta: FloatArray) -> FloatArray:
    """Eq. 5: ``delta = R + B theta``, (n,)."""
    return problem.bellman_errors(theta)


def sample_weights(delta: FloatArray, eta: float) -> FloatArray:
    """Eq. 1: ``p_i`` proportional to ``exp(delta_i / eta)``, (n,), with sum one."""
    p = np.exp((delta - delta.max()) / eta)
    return p / p.sum()


def kl_from_uniform(p: FloatArray) -> float:
    """``KL(p || uniform)`` in nats."""
    positive = p[p > 0]
    return float(positive @ np.log(positive * len(p)))


def effective_sample_size(p: FloatArray) -> float:
    """``1 / sum p^2``: the number of equally weighted samples with the same sum of squares."""
    return 1.0 / float(p @ p)


def dual_value(problem: Problem, eta: float, theta: FloatArray) -> float:
    """Eq. 2: ``g = eta epsilon + eta log mean exp(delta / eta) + rho / 2 |theta|^2``."""
    return value_of(problem, theta, problem.moments(eta, theta, with_covariance=False))


def dual_gradient(problem: Problem, eta: float, theta: FloatArray) -> tuple[float, FloatArray]:
    """``(g_eta, g_theta) = (epsilon - KL(p || uniform), B'p + rho theta)``."""
    return gradient_of(problem, theta, problem.moments(eta, theta, with_covariance=False))


def dual_hessian(problem: Problem, eta: float, theta: FloatArray) -> FloatArray:
    """Hessian (r + 1, r + 1) in ``(theta, eta)``, the eta row and column multiplied by eta.

    With this scaling it is ``Cov_p(b, -delta) / eta`` plus rho on the diagonal of theta.
    """
    return hessian_of(problem, problem.moments(eta, theta, with_covariance=True))


def value_of(problem: Problem, theta: FloatArray, m: Moments) -> float:
    """`dual_value`, from moments at theta (r,)."""
    return m.eta * problem.kl_bound + m.soft_maximum + 0.5 * problem.ridge * float(theta @ theta)


def gradient_of(problem: Problem, theta: FloatArray, m: Moments) -> tuple[float, FloatArray]:
    """`dual_gradient`, from moments at theta (r,)."""
    return problem.kl_bound - m.kl, m.mean_row + problem.ridge * theta


def hessian_of(problem: Problem, m: Moments) -> FloatArray:
    """`dual_hessian`, from moments with their covariance."""
    assert m.covariance is not None
    hessian = m.covariance / m.eta
    r = len(m.mean_row)
    hessian.flat[: r * (r + 2) : r + 2] += problem.ridge
    return hessian


def primal_value(problem: DualProblem, p: FloatArray) -> float:
    """``p'R - |B'p|^2 / (2 rho)``: expected reward less the penalty of a nonstationary p (n,)."""
    return penalised_reward(problem, p, problem.differences.T @ p)


def penalised_reward(problem: Problem, p: FloatArray, mean_row: FloatArray) -> float:
    """`primal_value`, from weights p (n,) and ``B'p`` (r,)."""
    return float(p @ problem.rewards - mean_row @ mean_row / (2.0 * problem.ridge))


class Outcome(StrEnum):
    """How a solve ended; the value is the message for users.

    Attributes:
        note: the same in a few words, for a progress display; empty in the usual case.
    """

    note: str

    BOUND_ACTIVE = "converged: KL equals its bound", ""
    AT_FLOOR = (
        "converged: the temperature is at its floor, the KL bound is inactive",
        "eta at its floor",
    )
    FALLBACK = (
        "converged by bisection on the temperature, after Newton's method had stalled",
        "by bisection",
    )
    NOT_CONVERGED = (
        "not converged: the weights are usable but not certified; "
        "increase the ridge, or check the data for duplicated or enormous features",
        "NOT CONVERGED",
    )

    def __new__(cls, message: str, note: str) -> Outcome:
        member = str.__new__(cls, message)
        member._value_ = message
        member.note = note
        return member


@dataclass(frozen=True)
class DualSolution:
    """The solution of one update with its certificate.

    For weights that meet the constraints ``dual >= primal``, so a small ``gap`` proves that both
    values are optimal.

    Attributes:
        eta: temperature, in units of the standardised rewards.
        theta: (r,) coordinates of V.
        weights: (n,) ``p_i`` of Eq. 1.
        dual, primal: values of the two problems.  At the floor both are those of the problem with
            the temperature fixed there.
        kl: realised ``KL(p || uniform)`` in nats; equal to the bound unless eta is at its floor.
        decrement: half the squared Newton decrement.
        stationarity: ``|B'p + rho theta|``, the residual of the stationarity condition.
        iterations: Newton iterations, those of the fallback included.
        jitter: largest jitter added to the diagonal of a Newton system; zero if none was needed.
        outcome: how the solve ended.
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
        """``dual - primal = eta (epsilon - KL) + |B'p + rho theta|^2 / (2 rho)``.

        It can be negative by the tolerance of the KL bound: 1e-4 of the bound, times eta.
        """
        return self.dual - self.primal

    @property
    def converged(self) -> bool:
        """Whether the solution is certified to the tolerances of `kreps.algorithms.newton`."""
        return self.outcome is not Outcome.NOT_CONVERGED
