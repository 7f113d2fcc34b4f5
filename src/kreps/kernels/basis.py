"""Eq. 3: where the features of V come from, an RKHS basis chosen from the data or a fixed grid.

With features ``phi`` the value function is ``V(s) = phi(s)' theta`` and its squared RKHS norm
``theta' theta``, so the dual sees only a matrix of features and never a kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from kreps.errors import ConfigurationError
from kreps.kernels.arrays import Array, FloatArray, like, namespace
from kreps.kernels.kernel import Factor, Kernel, Periodic, pivots_of
from kreps.kernels.linalg import cholesky, solve_lower, solve_lower_transposed

MAX_CENTRES = 4096
"""Most centres of a grid: the dual costs their cube."""


class Basis(Protocol):
    """Features of the value function, or of anything else that is a function of its inputs."""

    @property
    def residual(self) -> float:
        """Largest squared residual of a sampled state's kernel function; 0 for fixed features."""
        ...

    def features(self, states: Array) -> Array:
        """``phi``, (m, r), at states (m, ds)."""
        ...

    def function(self, theta: FloatArray) -> LinearFunction:
        """``phi(s)' theta``, for ``theta`` of shape (r,) or (r, k)."""
        ...


class LinearFunction(Protocol):
    """A function that is linear in features: V, in units of the reward, or a part of mu."""

    @property
    def kernel(self) -> Kernel: ...

    def __call__(self, states: Array) -> Array:
        """Its values (m,) or (m, k) at states (m, ds)."""
        ...


@dataclass(frozen=True)
class KernelExpansion:
    """``V(s) = sum_j alpha_j k_s(s~_j, s)`` (Eq. 3), in units of the reward.

    Attributes:
        kernel: over states.
        centres: (r, ds) the s~_j.
        alpha: (r,); or (r, k) for k functions at once.
    """

    kernel: Kernel
    centres: FloatArray
    alpha: FloatArray

    def __call__(self, states: Array) -> Array:
        k = self.kernel.gram(like(self.centres, states), states)
        return k.T @ like(self.alpha, states)


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
    jitter: float = 0.0

    @classmethod
    def fit(
        cls, kernel: Kernel, points: FloatArray, *, tolerance: float, max_rank: int
    ) -> tuple[RKHSBasis, FloatArray]:
        """The basis, and the features (m, r) of the ``points`` (m, ds) that it was chosen from."""
        chosen = pivots_of(kernel, points, tolerance=tolerance, max_rank=max_rank)
        lower = np.asfortranarray(np.tril(chosen.columns[chosen.pivots]))
        basis = cls(kernel, points[chosen.pivots], lower, chosen.residual)
        return basis, chosen.columns

    @classmethod
    def uniform(
        cls, kernel: Kernel, points: FloatArray, *, max_rank: int, rng: np.random.Generator
    ) -> RKHSBasis:
        """The same with pivots drawn at random among the ``points`` (m, ds): Nystroem's way."""
        rows = np.sort(rng.choice(len(points), min(max_rank, len(points)), replace=False))
        factor = cholesky(kernel.gram(points[rows]))
        basis = cls(kernel, points[rows], factor.lower, 0.0, factor.jitter)
        features = basis.features(points)
        left = 1.0 - np.einsum("ij,ij->i", features, features)
        return replace(basis, residual=max(float(left.max()), 0.0))

    def features(self, states: Array) -> Array:
        k = self.kernel.gram(like(self.pivots, states), states)
        return solve_lower(like(self.lower, states), k).T

    def function(self, theta: FloatArray) -> LinearFunction:
        return KernelExpansion(self.kernel, self.pivots, solve_lower_transposed(self.lower, theta))


@dataclass(frozen=True)
class FourierBasis:
    """Random Fourier features of the embedded coordinates (Rahimi and Recht 2007).

    ``phi(s) = (cos W e(s), sin W e(s)) / sqrt(r / 2)`` with standard normal W: inner products are
    unbiased estimates of the kernel, with an error of order ``sqrt(2 / r)``.

    Attributes:
        kernel: over states; its embedding is e.
        frequencies: (r / 2, m) the W.
    """

    kernel: Kernel
    frequencies: FloatArray
    residual: float = 0.0

    @classmethod
    def draw(
        cls, kernel: Kernel, dimension: int, *, max_rank: int, rng: np.random.Generator
    ) -> FourierBasis:
        """At most ``max_rank`` features (but two at least) of inputs (m, dimension)."""
        coordinates = kernel.embed(np.zeros((1, dimension))).shape[1]
        return cls(kernel, rng.standard_normal((max(1, max_rank // 2), coordinates)))

    def features(self, states: Array) -> Array:
        xp = namespace(states)
        phases = self.kernel.embed(states) @ like(self.frequencies, states).T
        both = xp.concat([xp.cos(phases), xp.sin(phases)], axis=1)
        return both / len(self.frequencies) ** 0.5

    def function(self, theta: FloatArray) -> LinearFunction:
        return FourierExpansion(self.kernel, self.frequencies, theta)


@dataclass(frozen=True)
class FourierExpansion:
    """``V(s) = phi(s)' theta`` in random Fourier features.

    Attributes:
        kernel: over states.
        frequencies: (r / 2, m).
        theta: (r,), in units of the reward; or (r, k) for k functions at once.
    """

    kernel: Kernel
    frequencies: FloatArray
    theta: FloatArray

    def __call__(self, states: Array) -> Array:
        phi = FourierBasis(self.kernel, self.frequencies).features(states)
        return phi @ like(self.theta, states)


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

    def features(self, states: Array) -> Array:
        return self.kernel.gram(like(self.centres, states), states).T

    def function(self, theta: FloatArray) -> LinearFunction:
        return KernelExpansion(self.kernel, self.centres, theta)
