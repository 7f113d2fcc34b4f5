"""Features of the value function (Eq. 3): an RKHS basis chosen from the data, or a fixed grid.

With features phi the value function is ``V(s) = phi(s)' theta`` and its squared RKHS norm is
``theta' theta``.  So the dual only needs a matrix of features and is independent of the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.linalg import blas

from kreps.errors import ConfigurationError
from kreps.kernels.arrays import Array, FloatArray, default_errstate, like, namespace
from kreps.kernels.gram import BLOCK_ENTRIES, gaussian_gram
from kreps.kernels.kernel import Factor, Kernel, Periodic
from kreps.kernels.linalg import solve_lower, solve_lower_transposed
from kreps.kernels.pivoted_cholesky import pivoted_gaussian_gram

PREDICTION_BATCH = 2048
"""Inputs predicted at once.  It bounds the memory of their Gram matrix with all samples, which
would be the largest array of an update."""

MAX_GRID_CENTRES = 4096
"""Largest number of centres of a grid: the dual costs its cube."""


class Basis(Protocol):
    """Features of the value function, or of any other function of the same inputs."""

    @property
    def kernel(self) -> Kernel:
        """Whose functions the features are, or span."""
        ...

    @property
    def residual(self) -> float:
        """Largest squared residual of a sampled state's kernel function; 0 for fixed features."""
        ...

    def features(self, states: Array) -> Array:
        """``phi``, (m, r), at states (m, ds)."""
        ...

    def mean_features(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """``(phi(first) + phi(second)) / 2``, (m, r), at pairs of states (m, ds)."""
        ...

    def function(self, theta: FloatArray) -> LinearFunction:
        """``phi(s)' theta`` as a function of s, for ``theta`` of shape (r,) or (r, k)."""
        ...


class LinearFunction(Protocol):
    """A function that is linear in features: V, in units of the reward, or a regression."""

    @property
    def kernel(self) -> Kernel: ...

    def __call__(self, states: Array) -> Array:
        """Its values (m,) or (m, k) at states (m, ds)."""
        ...

    def jacobian(self, states: FloatArray) -> FloatArray:
        """Derivatives (m, k, ds) of its values (m, k) at states (m, ds)."""
        ...


@dataclass(frozen=True)
class KernelExpansion:
    """``V(s) = sum_j alpha_j k_s(s~_j, s)`` (Eq. 3), in units of the reward.

    Attributes:
        kernel: over states.
        centres: (r, ds) the states s~_j.
        alpha: (r,); or (r, k) for k functions at once.
    """

    kernel: Kernel
    centres: FloatArray
    alpha: FloatArray

    @cached_property
    def coordinates(self) -> FloatArray:
        """Embedded centres (r, e), which model rollouts need in every step."""
        return self.kernel.embed(self.centres)

    @default_errstate()
    def __call__(self, states: Array) -> Array:
        known, alpha = like(self.coordinates, states), like(self.alpha, states)
        count = states.shape[0]
        if count <= PREDICTION_BATCH:
            return gaussian_gram(known, self.kernel.embed(states)).T @ alpha
        batches = [
            states[i : min(i + PREDICTION_BATCH, count), :]
            for i in range(0, count, PREDICTION_BATCH)
        ]
        values = [gaussian_gram(known, self.kernel.embed(batch)).T @ alpha for batch in batches]
        return namespace(states).concat(values, axis=0)

    @default_errstate()
    def jacobian(self, states: FloatArray) -> FloatArray:
        """Derivatives (m, k, ds) of its values (m, k) at states (m, ds).

        Those by the coordinates e are ``sum_j alpha_j k(s~_j, s) (e_j - e(s))``.
        """
        origin = self.coordinates.mean(axis=0)  # a common shift, which reduces the rounding
        known, e = self.coordinates - origin, self.kernel.embed(states) - origin
        moments = moments_of_centres(known, self.alpha)
        slopes = np.empty((len(states), self.alpha.shape[1], e.shape[1]))
        height = max(1, BLOCK_ENTRIES // max(len(known), 1))
        for first in range(0, len(states), height):  # so that products stay in the cache
            rows = slice(first, first + height)
            slopes[rows] = slopes_by_coordinates(gaussian_gram(e[rows], known), moments, e[rows])
        return self.kernel.pullback(states, slopes)


def moments_of_centres(centres: FloatArray, alpha: FloatArray) -> FloatArray:
    """What `slopes_by_coordinates` needs of centres (r, e) and weights (r, k): (r, k (e + 1))."""
    extended = np.concatenate([centres, np.ones((len(centres), 1))], axis=1)
    return (alpha[:, :, None] * extended[:, None]).reshape(len(centres), -1)


def slopes_by_coordinates(
    k: FloatArray, moments: FloatArray, coordinates: FloatArray
) -> FloatArray:
    """Derivatives ``sum_j alpha_j k_j (c_j - x)`` (m, k, e) of k functions by coordinates x.

    Args:
        k: (m, r) kernel values with the centres c_j.
        moments: (r, k (e + 1)) of centres and weights (`moments_of_centres`).
        coordinates: (m, e) x.
    """
    count, width = coordinates.shape
    sums = (k @ moments).reshape(count, -1, width + 1)
    slopes: FloatArray = sums[:, :, :-1] - sums[:, :, -1:] * coordinates[:, None]
    return slopes


@dataclass(frozen=True)
class RKHSBasis:
    """Orthonormal coordinates in the span of the kernel functions at pivots among sampled states.

    ``phi(s) = L^-1 k(pivots, s)`` with ``L L' = K(pivots, pivots)``.  These are the rows of the
    pivoted Cholesky factor of the Gram matrix of all sampled states, so that
    ``phi(s~_i)' phi(s~_j)`` is ``k(s~_i, s~_j)`` up to ``residual`` (Nystroem features).

    Attributes:
        kernel: over states.
        pivots: (r, ds) the chosen states.
        lower: (r, r) the factor L.
        residual: largest squared residual of a sampled state's kernel function.
    """

    kernel: Kernel
    pivots: FloatArray
    lower: FloatArray
    residual: float

    @classmethod
    def fit(
        cls, kernel: Kernel, points: FloatArray, *, tolerance: float, max_rank: int
    ) -> tuple[RKHSBasis, FloatArray]:
        """A basis for the kernel functions at points, and its features (m, r) there.

        Args:
            kernel: over points.
            points: (m, ds) among which pivots are chosen.
            tolerance: pivots are added until ``residual`` is below this.
            max_rank: largest number of pivots.
        """
        found = pivoted_gaussian_gram(kernel.embed(points), tolerance=tolerance, max_rank=max_rank)
        lower = np.asfortranarray(np.tril(found.columns[found.pivots]))
        return cls(kernel, points[found.pivots], lower, found.residual), found.columns

    def features(self, states: Array) -> Array:
        k = self.kernel.gram(like(self.pivots, states), states)
        return solve_lower(like(self.lower, states), k).T

    def mean_features(self, first: FloatArray, second: FloatArray) -> FloatArray:
        pivots = self.kernel.embed(self.pivots)
        k = gaussian_gram(self.kernel.embed(first), pivots)
        k += gaussian_gram(self.kernel.embed(second), pivots)
        # half of the transposed sum, solved in place
        return blas.dtrsm(0.5, self.lower, k.T, lower=1, overwrite_b=1).T

    def function(self, theta: FloatArray) -> KernelExpansion:
        return KernelExpansion(self.kernel, self.pivots, solve_lower_transposed(self.lower, theta))


@dataclass(frozen=True)
class RBFGrid:
    """Fixed radial basis functions on a grid: the features of feature-based REPS (Sec. 4.2).

    Attributes:
        kernel: over states; its lengthscales are the spacings of the grid.
        centres: (r, ds).
        residual: zero, as fixed features approximate no kernel.
    """

    kernel: Kernel
    centres: FloatArray
    residual: float = 0.0

    @classmethod
    def from_points(
        cls, factors: tuple[Factor, ...], points: FloatArray, size: int
    ) -> tuple[RBFGrid, FloatArray]:
        """A grid over the range of points, and its features (m, r) there.

        The lengthscale of a coordinate is the spacing of its centres.  Periodic coordinates get a
        whole turn.

        Args:
            factors: of the kernel, one for each coordinate.
            points: (m, ds).
            size: number of centres of each coordinate, so that ``r = size^ds``.

        Raises:
            ConfigurationError: more than `MAX_GRID_CENTRES` centres, or coordinates that share a
                lengthscale.
        """
        dimension = points.shape[1]
        if size**dimension > MAX_GRID_CENTRES or len(factors) < dimension:
            raise ConfigurationError(
                f"a grid of {size} centres in {dimension} coordinates has {size}^{dimension} "
                f"centres, but at most {MAX_GRID_CENTRES} are possible, and every coordinate needs "
                "a lengthscale of its own; use value=kreps.RKHS(), which needs no grid"
            )
        axes, lengthscales = [], []
        for i, factor in enumerate(factors):
            if isinstance(factor, Periodic):
                axes.append(np.arange(size) * 2.0 * np.pi / size)
                lengthscales.append(2.0 * np.sin(np.pi / max(size, 2)))  # the chord of the spacing
            else:
                low, high = points[:, i].min(), points[:, i].max()
                axes.append(np.linspace(low, high, size))
                lengthscales.append((high - low) / max(size - 1, 1) or 1.0)
        centres = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=1)
        grid = cls(Kernel(factors, np.array(lengthscales)), centres)
        return grid, grid.features(points)

    def features(self, states: Array) -> Array:
        return self.kernel.gram(like(self.centres, states), states).T

    def mean_features(self, first: FloatArray, second: FloatArray) -> FloatArray:
        mean: FloatArray = 0.5 * (self.features(first) + self.features(second))
        return mean

    def function(self, theta: FloatArray) -> LinearFunction:
        return KernelExpansion(self.kernel, self.centres, theta)
