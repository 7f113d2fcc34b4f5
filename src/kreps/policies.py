"""Stochastic policies: the cost-sensitive Gaussian process (CrKR, Sec. 2) and first explorers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from kreps.arrays import FloatArray
from kreps.data import TaskSpec
from kreps.kernels import Kernel, gaussian_gram
from kreps.linalg import cholesky, solve_lower


class StochasticPolicy(Protocol):
    """A map from states and standard normal noise to commanded (unclipped) actions."""

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        """Commanded actions (m, da) for states (m, ds) and noise (m, da), in the task's units."""
        ...


@dataclass(frozen=True)
class BangBang:
    """Each action at one of its limits, with random sign: what bounded control mostly looks like."""

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


@dataclass(frozen=True)
class CostSensitiveGP:
    """Gaussian process policy in which a sample of weight w counts as w samples.

    With ``C = sf2 K + l diag(1/w)``, in units of the action scale around the centre,
    ``mu(s) = k(s)' C^-1 U`` and ``sigma^2(s) = sf2 - k(s)' C^-1 k(s) + l``.

    Attributes:
        task: gives centre, scale and limits of the actions.
        kernel: over states.
        support: (m, ds) states.
        alpha: (m, da) ``C^-1 U``.
        lower: (m, m) Cholesky factor of C.
        signal: sf2.
        noise: l.
        jitter: what C needed on its diagonal to be factorised.
    """

    task: TaskSpec
    kernel: Kernel
    support: FloatArray
    alpha: FloatArray
    lower: FloatArray
    signal: float
    noise: float
    jitter: float

    @classmethod
    def fit(
        cls,
        task: TaskSpec,
        kernel: Kernel,
        support: FloatArray,
        targets: FloatArray,
        weights: FloatArray,
        signal: float,
        noise: float,
    ) -> CostSensitiveGP:
        """The posterior for ``targets`` (m, da) in units of the action scale and weights (m,)."""
        c = signal * kernel.gram(support)
        c.flat[:: len(c) + 1] += noise / weights
        factor = cholesky(c)
        alpha = factor.solve(targets)
        return cls(task, kernel, support, alpha, factor.lower, signal, noise, factor.jitter)

    def mean(self, states: FloatArray) -> FloatArray:
        """Mean action (m, da) at states (m, ds), in the task's units, not clipped."""
        return self._actions(self._covariances(states).T @ self.alpha)

    def standard_deviation(self, states: FloatArray) -> FloatArray:
        """Standard deviation (m, da) of the commanded action, in the task's units."""
        spread = self._spread(self._covariances(states))
        return spread[:, None] * self.task.action_scale

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        k = self._covariances(states)
        return self._actions(k.T @ self.alpha + self._spread(k)[:, None] * noise)

    @cached_property
    def _support_coordinates(self) -> FloatArray:
        """Embedded once, as the control loop asks for one state at a time."""
        return self.kernel.embed(self.support)

    def _covariances(self, states: FloatArray) -> FloatArray:
        return self.signal * gaussian_gram(self._support_coordinates, self.kernel.embed(states))

    def _spread(self, k: FloatArray) -> FloatArray:
        explained = solve_lower(self.lower, k)
        variance = self.signal - np.einsum("ij,ij->j", explained, explained)
        return np.sqrt(np.maximum(variance, 0.0) + self.noise)

    def _actions(self, scaled: FloatArray) -> FloatArray:
        return self.task.action_centre + self.task.action_scale * scaled
