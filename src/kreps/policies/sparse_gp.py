"""A Gaussian process policy on few centres, which the control loop evaluates.

It is made from an exact process, with as many centres as its noise requires
(`CostSensitiveGP.predictor`) or with a given number (`CostSensitiveGP.compressed`), or from sums
over any number of samples (`SparseGP.fit`).  Steps by the gradient of the return change its mean
(`kreps.algorithms.policy_gradient`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kreps.data.task import TaskSpec
from kreps.kernels.arrays import Array, FloatArray, as_float, as_numpy, namespace
from kreps.kernels.basis import KernelExpansion, RKHSBasis
from kreps.kernels.kernel import Kernel
from kreps.kernels.linalg import solve_lower_transposed

MIN_RESIDUAL = 1e-12
"""Squared kernel residual of a point below which it never becomes another centre.  Smaller
residuals are dominated by rounding."""

TRIANGULAR_BLOCK_ROWS = 128
"""Rows of a triangular matrix that are multiplied at once, without the zeros to their right."""


@dataclass(frozen=True)
class PolicySums:
    """Weighted sums over samples that determine a policy linear in features z, (r,).

    Those of chunks add up.

    Attributes:
        precision: (r, r), ``sum_i w_i z_i z_i'``.
        weighted_targets: (r, da), ``sum_i w_i z_i u_i'``.
    """

    precision: FloatArray
    weighted_targets: FloatArray

    @classmethod
    def from_samples(cls, features: Array, weights: Array, targets: Array) -> PolicySums:
        """Sums over n samples, of any array library.

        Args:
            features: (n, r) z.
            weights: (n,) w.
            targets: (n, da) actions u around their centre, in units of the action scale.
        """
        root = namespace(features).sqrt(weights)[:, None]
        weighted = root * features
        return cls(as_numpy(weighted.T @ weighted), as_numpy(weighted.T @ (root * targets)))

    def __add__(self, other: PolicySums) -> PolicySums:
        return PolicySums(
            self.precision + other.precision, self.weighted_targets + other.weighted_targets
        )


@dataclass(frozen=True)
class SparseGP:
    """Mean and variance of actions from the kernel values ``k`` of a state with r centres.

    Attributes:
        task: gives centre, scale and limits of the actions.
        kernel: over states.
        states: (r, ds) the centres.
        mean_weights: (r, da), the scaled mean is ``k' mean_weights``.
        explained: (r, r), the explained variance is ``|explained k|^2``.
        signal, noise: variances sf2 and l.
    """

    task: TaskSpec
    kernel: Kernel
    states: FloatArray
    mean_weights: FloatArray
    explained: FloatArray
    signal: float
    noise: float

    @classmethod
    def fit(
        cls, task: TaskSpec, basis: RKHSBasis, sums: PolicySums, signal: float, noise: float
    ) -> SparseGP:
        """The posterior of the projected process (deterministic training conditional).

        With features ``z(s)`` of the basis and ``P = I + (sf2 / l) sum_i w_i z_i z_i'``:
        ``mu(s) = (sf2 / l) z(s)' P^-1 sum_i w_i z_i u_i`` and
        ``sigma^2(s) = sf2 (1 - z(s)' z(s)) + sf2 z(s)' P^-1 z(s) + l``.
        The first part of the variance is what the centres cannot represent.  Without it (subset of
        regressors) the variance would vanish far from all data.
        """
        values, vectors = np.linalg.eigh(signal / noise * sums.precision)
        values = np.maximum(values, 0.0)
        mean = vectors @ ((vectors.T @ sums.weighted_targets) / (1.0 + values)[:, None])
        # I - P^-1 = vectors diag(values / (1 + values)) vectors'
        explained = np.sqrt(signal * values / (1.0 + values)) * vectors
        return cls(
            task,
            basis.kernel,
            basis.pivots,
            np.ascontiguousarray(solve_lower_transposed(basis.lower, signal / noise * mean)),
            np.ascontiguousarray(solve_lower_transposed(basis.lower, explained).T),
            signal,
            noise,
        )

    def deflated(self, std_scale: float) -> SparseGP:
        """The same mean with the standard deviation divided by ``std_scale``.

        Standard deviations of process and noise are divided alike.
        """
        return replace(
            self,
            explained=self.explained / std_scale,
            signal=self.signal / std_scale**2,
            noise=self.noise / std_scale**2,
        )

    def compressed(self, centres: int) -> SparseGP:
        """This policy on at most ``centres`` of its centres.

        With ``k(s) = Z z(s)`` up to what fewer centres cannot represent, the mean is fitted to that
        at all centres by least squares, and the explained variance is ``|explained Z z(s)|^2``.
        """
        if centres >= len(self.states):
            return self
        basis, features = RKHSBasis.fit(
            self.kernel, self.states, tolerance=MIN_RESIDUAL, max_rank=centres
        )
        theta = np.linalg.lstsq(features, self.scaled_mean(self.states), rcond=None)[0]
        explained = as_float(np.linalg.qr(self.explained @ features, mode="r"))
        return replace(
            self,
            states=basis.pivots,
            mean_weights=np.ascontiguousarray(solve_lower_transposed(basis.lower, theta)),
            explained=np.ascontiguousarray(solve_lower_transposed(basis.lower, explained.T).T),
        )

    @cached_property
    def coordinates(self) -> FloatArray:
        """Embedded centres (r, e)."""
        return self.kernel.embed(self.states)

    @cached_property
    def _centred(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean (e,) of the coordinates, distances (r, e) from it, half of their squares (r,)."""
        origin = self.coordinates.mean(axis=0)
        centred = self.coordinates - origin
        return origin, centred, 0.5 * np.sum(centred * centred, axis=1)

    @cached_property
    def _explained_blocks(self) -> list[FloatArray]:
        """Blocks of rows of `explained`; of a triangular matrix without the zeros on the right."""
        rows = TRIANGULAR_BLOCK_ROWS
        triangular = len(self.explained) > rows and not np.triu(self.explained, 1).any()
        if not triangular:
            return [self.explained]
        starts = range(0, len(self.explained), rows)
        return [self.explained[i : i + rows, : i + rows] for i in starts]

    def greedy(self, states: FloatArray) -> FloatArray:
        """Mean action (m, da) at states (m, ds), in the task's units, not clipped."""
        return self.task.unscaled(self._mean(self._covariances(states)))

    def standard_deviation(self, states: FloatArray) -> FloatArray:
        """Standard deviation (m, da) of the commanded action, in the task's units."""
        return self._deviation(self._covariances(states))[:, None] * self.task.action_scale

    def scaled_mean_and_deviation(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m, da) and standard deviation (m, 1) of commanded actions at states (m, ds).

        In units of the action scale, the mean around the centre.
        """
        k = self._covariances(states)
        return self._mean(k), self._deviation(k)[:, None]

    def scaled_mean(self, states: FloatArray) -> FloatArray:
        """Mean action (m, da) at states (m, ds), around its centre in units of the action scale."""
        return self._mean(self._covariances(states))

    def mean_jacobian(self, states: FloatArray) -> FloatArray:
        """Derivatives (m, da, ds) of `scaled_mean`."""
        return KernelExpansion(self.kernel, self.states, self.mean_weights).jacobian(states)

    def kernel_values(self, states: FloatArray) -> FloatArray:
        """Kernel values (m, r) of states (m, ds) with the centres."""
        return self._covariances(states).T

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        mean, deviation = self.scaled_mean_and_deviation(states)
        return self.task.unscaled(mean + deviation * noise)

    def _covariances(self, states: FloatArray) -> FloatArray:
        """Kernel values (r, m) of the centres with states (m, ds).

        They are those of `gaussian_gram`.  What depends on the centres alone is computed once, and
        not in each control cycle.
        """
        origin, centred, half_squares = self._centred
        f = self.kernel.embed(states) - origin
        k = centred @ f.T
        k -= half_squares[:, None]
        with np.errstate(over="ignore"):  # infinitely far: then the kernel value is zero
            k -= 0.5 * np.sum(f * f, axis=1)
        np.minimum(k, 0.0, out=k)
        return np.exp(k, out=k)

    def _mean(self, k: FloatArray) -> FloatArray:
        return k.T @ self.mean_weights

    def _deviation(self, k: FloatArray) -> FloatArray:
        variance = np.full(k.shape[1], self.signal)
        for block in self._explained_blocks:
            explained = block @ k[: block.shape[1]]
            variance -= np.einsum("ij,ij->j", explained, explained)
        return np.sqrt(np.maximum(variance, 0.0) + self.noise)
