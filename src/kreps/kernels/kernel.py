"""Product kernels: their factors, their lengthscales, and the median heuristic for these.

Every kernel of the paper is ``k(x, y) = exp(-|e(x) - e(y)|^2 / 2)`` for some map e into Euclidean
coordinates.  A squared exponential has ``e(x) = x / l``.  The periodic kernel
``exp(-2 sin^2((x - y) / 2) / l^2)`` has ``e(x) = (cos x, sin x) / l``.  A product of kernels
concatenates the embeddings.  So a new kernel is one class with a method `Factor.coordinates` and
its derivative, and a Gram matrix is one thin matrix product and one exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Protocol

import numpy as np

from kreps.kernels.arrays import Array, FloatArray, columns, like, namespace
from kreps.kernels.gram import gaussian_gram, squared_distances
from kreps.kernels.linalg import principal_coordinates

IMAGE_BLUR = 0.3
"""Standard deviation of the Gaussian smoothing of images, in units of their side.

At this width the distances between smoothed images of a rod are nearly those of the chord between
its tips, on which a periodic kernel of the rod's angle is based (docs/deviations.md).
"""

MEDIAN_SAMPLE_SIZE = 500
"""Rows whose pairwise distances give a median lengthscale: 124,750 pairs, whose median hardly
differs from that of all pairs, at a cost that does not grow with the data."""

DUPLICATE_RTOL = 1e-12
"""Pairs with a squared distance below this share of the largest are duplicates up to rounding."""


class Factor(Protocol):
    """One factor of a product kernel, with one lengthscale."""

    @property
    def dims(self) -> tuple[int, ...]:
        """The columns of the input that the factor depends on."""
        ...

    def coordinates(self, x: Array) -> Array:
        """Euclidean coordinates (n, m) of inputs (n, d) at lengthscale one."""
        ...

    def pullback(self, x: FloatArray, slopes: FloatArray) -> FloatArray:
        """Derivatives (n, k, len(dims)) of k functions by the columns ``dims`` at inputs (n, d).

        Args:
            x: (n, d) inputs.
            slopes: (n, k, m) derivatives by the coordinates.
        """
        ...


@dataclass(frozen=True)
class SquaredExponential:
    """``exp(-|x - y|^2 / (2 l^2))`` over the columns ``dims`` of the input."""

    dims: tuple[int, ...]

    def coordinates(self, x: Array) -> Array:
        return columns(x, self.dims)

    def pullback(self, x: FloatArray, slopes: FloatArray) -> FloatArray:
        return slopes


@dataclass(frozen=True)
class Periodic:
    """``exp(-2 sin^2((x - y) / 2) / l^2)`` over the columns ``dims``, angles in rad (Sec. 4.3)."""

    dims: tuple[int, ...]

    def coordinates(self, x: Array) -> Array:
        xp, angles = namespace(x), columns(x, self.dims)
        return xp.concat([xp.cos(angles), xp.sin(angles)], axis=1)

    def pullback(self, x: FloatArray, slopes: FloatArray) -> FloatArray:
        angles = x[:, None, list(self.dims)]
        by_cos, by_sin = np.split(slopes, 2, axis=2)
        return by_sin * np.cos(angles) - by_cos * np.sin(angles)


@dataclass(frozen=True)
class WrapAngle:
    """``exp(-|x - y|^2 / (2 l^2))`` of an angle's representation in ``[begin, begin + 2 pi)``.

    The kernel is discontinuous where the angle wraps, at ``begin``.  Multiplied with a periodic
    factor of the same angle, and with a lengthscale of the order of a turn, it lets a function
    take different values on the two sides of the wrap and changes the kernel little elsewhere.

    Attributes:
        dims: the one column of the angle, in rad.
        begin: where the angle wraps, in rad.
    """

    dims: tuple[int, ...]
    begin: float

    def coordinates(self, x: Array) -> Array:
        return (columns(x, self.dims) - self.begin) % (2.0 * np.pi)

    def pullback(self, x: FloatArray, slopes: FloatArray) -> FloatArray:
        return slopes


@dataclass(frozen=True)
class SmoothedImage:
    """``exp(-|Gx - Gy|^2 / (2 l^2))`` over the pixels ``dims``, G a Gaussian smoothing.

    Compared pixel by pixel, two sharp images of an object have the same distance after every move
    larger than the object's width.  The distance of smoothed images grows with the move.

    Attributes:
        dims: columns of the pixels, row by row.
        shape: height and width in pixels.
    """

    dims: tuple[int, ...]
    shape: tuple[int, int]

    def coordinates(self, x: Array) -> Array:
        xp, n = namespace(x), x.shape[0]
        down, across = (like(smoothing(size), x) for size in self.shape)
        smooth = down @ xp.reshape(columns(x, self.dims), (n, *self.shape)) @ across.T
        return xp.reshape(smooth, (n, down.shape[0] * across.shape[0]))

    def pullback(self, x: FloatArray, slopes: FloatArray) -> FloatArray:
        down, across = (smoothing(size) for size in self.shape)
        each = slopes.reshape(*slopes.shape[:2], len(down), len(across))
        return (down.T @ each @ across).reshape(*slopes.shape[:2], -1)


@cache
def smoothing(size: int) -> FloatArray:
    """A matrix A (k, size), k <= size, such that ``|A x - A y|`` is the distance of smoothed rows.

    Smoothed rows of pixels lie near a subspace of few dimensions; A gives coordinates in it.
    """
    i = np.arange(size) / (IMAGE_BLUR * size)
    return principal_coordinates(np.exp(-0.5 * (i[:, None] - i) ** 2))


def factors_of(
    dimension: int,
    periodic: Sequence[int] = (),
    groups: Sequence[Sequence[int]] = (),
    image_shape: tuple[int, int] | None = None,
) -> tuple[Factor, ...]:
    """One factor per group of columns, and one per column that is in no group.

    Args:
        dimension: number of columns.
        periodic: columns with angles, in rad, which get a periodic factor.  All others get a
            squared exponential.
        groups: columns that share a lengthscale.
        image_shape: height and width of images; then every group is one image, row by row.
    """
    if image_shape is not None:
        return tuple(SmoothedImage(tuple(group), image_shape) for group in groups)
    angles = set(periodic)
    grouped = {i for group in groups for i in group}
    parts = [tuple(group) for group in groups]
    parts += [(i,) for i in range(dimension) if i not in grouped]
    return tuple(
        Periodic(dims) if angles.issuperset(dims) else SquaredExponential(dims)
        for dims in sorted(parts)
    )


def wrap_factors(angles: Sequence[int], begins: Sequence[float]) -> tuple[WrapAngle, ...]:
    """One `WrapAngle` for each column of ``angles``, which wraps at its entry of ``begins``."""
    return tuple(WrapAngle((i,), float(begin)) for i, begin in zip(angles, begins, strict=True))


@dataclass(frozen=True)
class Kernel:
    """A product of factors, each with its lengthscale (the paper's "bandwidth").

    Attributes:
        factors: g factors.
        lengthscales: (g,) in the units of the columns; for periodic factors, of the chord
            ``2 sin(|x - y| / 2)``.
    """

    factors: tuple[Factor, ...]
    lengthscales: FloatArray

    def __post_init__(self) -> None:
        assert self.lengthscales.shape == (len(self.factors),)

    def with_lengthscales(self, lengthscales: FloatArray) -> Kernel:
        """The same factors with other lengthscales (g,)."""
        return replace(self, lengthscales=lengthscales)

    def part(self, chosen: slice) -> Kernel:
        """The product of the factors in a slice."""
        return Kernel(self.factors[chosen], self.lengthscales[chosen])

    def embed(self, x: Array) -> Array:
        """``e(x)``, (n, m), for inputs (n, d)."""
        return namespace(x).concat(
            [
                factor.coordinates(x) / lengthscale
                for factor, lengthscale in zip(
                    self.factors, self.lengthscales.tolist(), strict=True
                )
            ],
            axis=1,
        )

    def pullback(self, x: FloatArray, slopes: FloatArray) -> FloatArray:
        """Derivatives (n, k, d) of k functions at inputs (n, d), by the chain rule.

        Args:
            x: (n, d) inputs.
            slopes: (n, k, m) derivatives by the coordinates of `embed`.
        """
        widths = [factor.coordinates(x[:1]).shape[1] for factor in self.factors]
        parts = np.split(slopes, np.cumsum(widths)[:-1], axis=2)
        pulled = np.zeros((*slopes.shape[:2], x.shape[1]))
        for factor, lengthscale, part in zip(self.factors, self.lengthscales, parts, strict=True):
            pulled[:, :, list(factor.dims)] += factor.pullback(x, part / lengthscale)
        return pulled

    def gram(self, x: Array, y: Array | None = None) -> Array:
        """``[k(x_i, y_j)]``, (n, k), for inputs (n, d) and (k, d); ``y`` None means ``x``."""
        return gaussian_gram(self.embed(x), None if y is None else self.embed(y))


def median_lengthscales(
    factors: Sequence[Factor],
    x: FloatArray,
    rng: np.random.Generator,
    sample_size: int = MEDIAN_SAMPLE_SIZE,
) -> FloatArray:
    """Median distance of each factor (g,) between pairs of at most ``sample_size`` random rows.

    Pairs at distance zero are left out, because duplicates carry no information about the scale.
    A factor in which all rows agree gets lengthscale 1, which then has no effect.

    Args:
        factors: g factors.
        x: (n, d) inputs.
        rng: draws the rows.
        sample_size: number of rows.
    """
    if len(x) > sample_size:
        x = x[rng.choice(len(x), sample_size, replace=False)]
    above = np.triu_indices(len(x), 1)
    scales = []
    for factor in factors:
        d = squared_distances(factor.coordinates(x))[above]
        d = d[d > DUPLICATE_RTOL * d.max(initial=0.0)]
        scales.append(np.sqrt(np.median(d)) if len(d) else 1.0)
    return np.array(scales)


def as_wide_as_spread(kernel: Kernel, x: FloatArray) -> Kernel:
    """A kernel whose lengthscales are no shorter than the spread of x (n, d) in each factor.

    Where a policy holds a state, most pairs of samples are near each other.  Their median distance
    then says nothing about the others, which are few and decide what a model predicts elsewhere.
    """
    spread = [np.sqrt(np.sum(np.var(f.coordinates(x), axis=0))) for f in kernel.factors]
    return kernel.with_lengthscales(np.maximum(kernel.lengthscales, spread))
