"""Eq. 3: where the features of V come from, an RKHS basis chosen from the data or a fixed grid.

With features ``phi`` the value function is ``V(s) = phi(s)' theta`` and its squared RKHS norm
``theta' theta``, so the dual sees only a matrix of features and never a kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kreps.arrays import FloatArray
from kreps.errors import ConfigurationError
from kreps.kernels import Factor, Kernel, Periodic
from kreps.linalg import pivoted_cholesky, solve_lower, solve_lower_transposed

MAX_CENTRES = 4096
"""Most centres of a grid: the dual costs their cube."""


class Basis(Protocol):
    """Features of the value function."""

    @property
    def residual(self) -> float:
        """Largest squared residual of a sampled state's kernel function; 0 for fixed features."""
        ...

    def value_function(self, theta: FloatArray) -> ValueFunction:
        """``V(s) = phi(s)' theta`` as a kernel expansion, for ``theta`` of shape (r,)."""
        ...


@dataclass(frozen=True)
class ValueFunction:
    """``V(s) = sum_j alpha_j k_s(s~_j, s)`` (Eq. 3), in units of the reward.

    Attributes:
        kernel: over states.
        centres: (r, ds) the s~_j.
        alpha: (r,).
    """

    kernel: Kernel
    centres: FloatArray
    alpha: FloatArray

    def __call__(self, states: FloatArray) -> FloatArray:
        """V (m,) at states (m, ds)."""
        return self.kernel.gram(self.centres, states).T @ self.alpha


@dataclass(frozen=True)
class RKHSBasis:
    """Orthonormal coordinates of the span of kernels at pivots chosen among the sampled states.

    ``phi(s) = L^-1 k(pivots, s)`` with ``L L' = K(pivots, pivots)``: the pivoted Cholesky factor
    of the full Gram matrix of S~, so that ``phi(s~_i)' phi(s~_j)`` is ``k(s~_i, s~_j)`` up to
    ``residual``.
    """

    kernel: Kernel
    pivots: FloatArray
    lower: FloatArray
    residual: float

    @classmethod
    def fit(
        cls, kernel: Kernel, points: FloatArray, *, tolerance: float, max_rank: int
    ) -> tuple[RKHSBasis, FloatArray]:
        """The basis, and the features (m, r) of the ``points`` (m, ds) that it was chosen from."""
        chosen = pivoted_cholesky(
            np.ones(len(points)),
            lambda rows: kernel.gram(points, points[rows]),
            tolerance=tolerance,
            max_rank=max_rank,
        )
        lower = np.asfortranarray(np.tril(chosen.columns[chosen.pivots]))
        basis = cls(kernel, points[chosen.pivots], lower, chosen.residual)
        return basis, chosen.columns

    def features(self, states: FloatArray) -> FloatArray:
        """``phi``, (m, r), at states (m, ds)."""
        return solve_lower(self.lower, self.kernel.gram(self.pivots, states)).T

    def value_function(self, theta: FloatArray) -> ValueFunction:
        return ValueFunction(self.kernel, self.pivots, solve_lower_transposed(self.lower, theta))


@dataclass(frozen=True)
class RBFGrid:
    """Fixed radial basis functions on a grid: the features of feature-based REPS (Sec. 4.2)."""

    kernel: Kernel
    centres: FloatArray
    residual: float = 0.0

    @classmethod
    def over(
        cls, factors: tuple[Factor, ...], points: FloatArray, size: int
    ) -> tuple[RBFGrid, FloatArray]:
        """``size`` centres per coordinate over the range of ``points`` (m, ds), and their features.

        The spacing is the lengthscale.  Periodic coordinates get a whole turn.

        Raises:
            ConfigurationError: more than `MAX_CENTRES` centres.
        """
        dimension = points.shape[1]
        if size**dimension > MAX_CENTRES or len(factors) < dimension:
            raise ConfigurationError(
                f"a grid of {size} centres in {dimension} coordinates has {size}^{dimension} "
                f"centres, the limit is {MAX_CENTRES} (and no coordinate may share a lengthscale); "
                'use features="rkhs", which needs no grid'
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

    def features(self, states: FloatArray) -> FloatArray:
        """``phi``, (m, r), at states (m, ds)."""
        return self.kernel.gram(self.centres, states).T

    def value_function(self, theta: FloatArray) -> ValueFunction:
        return ValueFunction(self.kernel, self.centres, theta)
