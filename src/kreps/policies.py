"""Stochastic policies: the cost-sensitive Gaussian process (CrKR, Sec. 2) and first explorers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from kreps.arrays import FloatArray
from kreps.data import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels import Kernel, gaussian_gram
from kreps.linalg import (
    Cholesky,
    cholesky,
    inverse_lower,
    pivoted_cholesky,
    qr_factor,
    solve_lower,
    solve_lower_transposed,
)


class StochasticPolicy(Protocol):
    """A map from states and standard normal noise to commanded (unclipped) actions."""

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        """Commanded actions (m, da) for states (m, ds) and noise (m, da), in the task's units."""
        ...


class LearntPolicy(StochasticPolicy, Protocol):
    """A policy that can also be followed without its exploration."""

    @property
    def task(self) -> TaskSpec: ...

    def greedy(self, states: FloatArray) -> FloatArray:
        """Actions (m, da) at states (m, ds) without exploration, in the task's units."""
        ...


@dataclass(frozen=True)
class BangBang:
    """Each action at one of its limits, with random sign: what bounded control often is."""

    task: TaskSpec

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.task.action_centre + self.task.action_scale * np.where(noise < 0, -1.0, 1.0)


@dataclass(frozen=True)
class Gaussian:
    """Actions ``N(centre, (spread * scale)^2)``, whatever the state."""

    task: TaskSpec
    spread: float

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.task.action_centre + self.spread * self.task.action_scale * noise


MAX_SUPPORT = 6_000
"""Most support points of an exact policy: it costs their square in memory, their cube in time."""

PIVOT_TOLERANCE = 1e-12
"""Largest squared residual of a support point's kernel function outside the span of the pivots'.

The scaled mean is off by at most ``sf2 sqrt(1e-12) sum |alpha|``: about 1e-5 on learnt policies."""


@dataclass(frozen=True)
class CostSensitiveGP:
    """Gaussian process policy in which a sample of weight w counts as w samples.

    With ``C = sf2 K + l diag(1/w)``, in units of the action scale around the centre,
    ``mu(s) = k(s)' C^-1 U`` and ``sigma^2(s) = sf2 - k(s)' C^-1 k(s) + l``.

    Attributes:
        task: gives centre, scale and limits of the actions.
        kernel: over states.
        states: (m, ds) support points.
        targets: (m, da) their actions U, in units of the action scale around the centre.
        weights: (m,) their weights w > 0.
        signal: sf2.
        noise: l.

    Raises:
        ConfigurationError: more than `MAX_SUPPORT` support points.
        NumericalError: C cannot be factorised.
    """

    task: TaskSpec
    kernel: Kernel
    states: FloatArray
    targets: FloatArray
    weights: FloatArray
    signal: float
    noise: float

    def __post_init__(self) -> None:
        if len(self.weights) > MAX_SUPPORT:
            raise ConfigurationError(
                f"the policy would have {len(self.weights)} support points, the limit is "
                f"{MAX_SUPPORT}; keep fewer roll-outs by a smaller window"
            )
        _ = self.predictor  # now, not in the first control cycle

    @cached_property
    def factor(self) -> Cholesky:
        """Of C."""
        c = self.signal * self.kernel.gram(self.states)
        c.flat[:: len(c) + 1] += self.noise / self.weights
        return cholesky(c)

    @cached_property
    def alpha(self) -> FloatArray:
        """``C^-1 U``, (m, da)."""
        return self.factor.solve(self.targets)

    @cached_property
    def predictor(self) -> Predictor:
        """What the control loop evaluates."""
        return Predictor.of(self)

    def mean(self, states: FloatArray) -> FloatArray:
        """Mean action (m, da) at states (m, ds), in the task's units, not clipped."""
        return self.task.unscaled(self.predictor.mean(self.predictor.covariances(states)))

    def greedy(self, states: FloatArray) -> FloatArray:
        return self.mean(states)

    def standard_deviation(self, states: FloatArray) -> FloatArray:
        """Standard deviation (m, da) of the commanded action, in the task's units."""
        spread = self.predictor.standard_deviation(self.predictor.covariances(states))
        return spread[:, None] * self.task.action_scale

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        k = self.predictor.covariances(states)
        spread = self.predictor.standard_deviation(k)
        return self.task.unscaled(self.predictor.mean(k) + spread[:, None] * noise)


@dataclass(frozen=True)
class Predictor:
    """Mean and variance of a cost-sensitive GP from its kernel values at r pivots only.

    The kernel of any state with the m support points is, up to `PIVOT_TOLERANCE`, a linear function
    of its kernel with r of them (the pivots of a Cholesky factorisation), and r << m for smooth
    kernels.  So both moments become products with (r, r) matrices computed once: a control
    cycle costs r^2 instead of m^2.

    Attributes:
        kernel: over states.
        coordinates: (r, e) embedded pivots.
        mean_weights: (r, da), the mean is ``k' mean_weights``.
        explained: (r, r), the explained variance is ``|explained k|^2``.
        signal, noise: sf2 and l.
    """

    kernel: Kernel
    coordinates: FloatArray
    mean_weights: FloatArray
    explained: FloatArray
    signal: float
    noise: float

    @classmethod
    def of(cls, policy: CostSensitiveGP) -> Predictor:
        kernel, states = policy.kernel, policy.states
        chosen = pivoted_cholesky(
            np.ones(len(states)),
            lambda rows: kernel.gram(states, states[rows]),
            tolerance=PIVOT_TOLERANCE,
            max_rank=len(states) // 2,
        )
        if chosen.residual > PIVOT_TOLERANCE:  # not so smooth: all support points are pivots
            return cls(
                kernel,
                kernel.embed(states),
                policy.signal * policy.alpha,
                policy.signal * inverse_lower(policy.factor.lower),
                policy.signal,
                policy.noise,
            )
        # k(states, s) = columns phi(s) with phi(s) = lower^-1 k(pivots, s)
        lower = np.tril(chosen.columns[chosen.pivots])
        columns = policy.signal * chosen.columns
        mean_weights = solve_lower_transposed(lower, columns.T @ policy.alpha)
        # k' C^-1 k = |L^-1 columns phi|^2 = |R phi|^2 with R from the QR of L^-1 columns
        r = qr_factor(solve_lower(policy.factor.lower, columns))
        return cls(
            kernel,
            kernel.embed(states[chosen.pivots]),
            mean_weights,
            np.ascontiguousarray(solve_lower_transposed(lower, r.T).T),
            policy.signal,
            policy.noise,
        )

    def covariances(self, states: FloatArray) -> FloatArray:
        """Kernel values (r, m) of the pivots with states (m, ds)."""
        return gaussian_gram(self.coordinates, self.kernel.embed(states))

    def mean(self, k: FloatArray) -> FloatArray:
        """(m, da), scaled."""
        return k.T @ self.mean_weights

    def standard_deviation(self, k: FloatArray) -> FloatArray:
        """(m,), scaled: ``sqrt(sf2 - k' C^-1 k + l)``."""
        explained = self.explained @ k
        variance = self.signal - np.einsum("ij,ij->j", explained, explained)
        return np.sqrt(np.maximum(variance, 0.0) + self.noise)
