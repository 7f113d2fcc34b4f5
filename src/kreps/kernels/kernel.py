"""Kernels as Gaussian kernels of an embedding.

Every kernel of the paper is ``k(x, y) = exp(-|e(x) - e(y)|^2 / 2)`` for some map ``e`` to
Euclidean coordinates: a squared exponential has ``e(x) = x / l``, the periodic kernel
``exp(-2 sin^2((x - y) / 2) / l^2)`` has ``e(x) = (cos x, sin x) / l``, and a product of kernels
concatenates the embeddings.  So whoever adds a kernel writes one short method, and a Gram matrix
is one thin matrix product and one exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Protocol

import numpy as np

from kreps.kernels.arrays import Array, FloatArray, IntArray, columns, like, namespace
from kreps.kernels.gram import gaussian_gram
from kreps.kernels.linalg import principal_coordinates
from kreps.kernels.pivoted_cholesky import PivotedCholesky, pivoted_cholesky


class Factor(Protocol):
    """One factor of a product kernel, with one lengthscale."""

    @property
    def dims(self) -> tuple[int, ...]:
        """The columns of the input that it is over."""
        ...

    def coordinates(self, x: Array) -> Array:
        """Euclidean coordinates (n, m) of inputs (n, d) at lengthscale one."""
        ...


@dataclass(frozen=True)
class SquaredExponential:
    """``exp(-|x - y|^2 / (2 l^2))`` over the columns ``dims`` of the input."""

    dims: tuple[int, ...]

    def coordinates(self, x: Array) -> Array:
        return columns(x, self.dims)


@dataclass(frozen=True)
class Periodic:
    """``exp(-2 sin^2((x - y) / 2) / l^2)`` over the columns ``dims``, angles in rad (Sec. 4.3)."""

    dims: tuple[int, ...]

    def coordinates(self, x: Array) -> Array:
        xp, angles = namespace(x), columns(x, self.dims)
        return xp.concat([xp.cos(angles), xp.sin(angles)], axis=1)


@dataclass(frozen=True)
class WrapAngle:
    """``exp(-|x - y|^2 / (2 l^2))`` of an angle by its number, from ``begin`` to a turn later.

    Beside a periodic factor of the same angle it tells the two sides of the cut apart, where the
    numbers begin anew, and hardly anything else.
    """

    dims: tuple[int, ...]
    begin: float

    def coordinates(self, x: Array) -> Array:
        return (columns(x, self.dims) - self.begin) % (2.0 * np.pi)


IMAGE_BLUR = 0.3
"""Standard deviation of the smoothing of images, in units of their side."""


@dataclass(frozen=True)
class SmoothedImage:
    """``exp(-|Gx - Gy|^2 / (2 l^2))`` over the pixels ``dims``, G a Gaussian smoothing.

    Pixel by pixel, two sharp pictures of a thing differ as much when it has moved by twice its
    width as when it has moved anywhere.  Smoothed pictures differ the more, the farther it moved.
    """

    dims: tuple[int, ...]
    shape: tuple[int, int]

    def coordinates(self, x: Array) -> Array:
        xp, n = namespace(x), x.shape[0]
        down, across = (like(smoothing(size), x) for size in self.shape)
        smooth = down @ xp.reshape(columns(x, self.dims), (n, *self.shape)) @ across.T
        return xp.reshape(smooth, (n, down.shape[0] * across.shape[0]))


@cache
def smoothing(size: int) -> FloatArray:
    """A matrix (k, size), k <= size, that gives rows of pixels the distances of smoothed ones.

    Smooth rows lie in few dimensions: only their coordinates there are kept.
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

    Columns named in ``periodic`` are periodic, the others squared exponential; groups are images
    of ``image_shape``, row by row, if one is given.
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
    """One factor for each column of angles, cut where its numbers begin."""
    return tuple(WrapAngle((i,), float(begin)) for i, begin in zip(angles, begins, strict=True))


@dataclass(frozen=True)
class Kernel:
    """A product of factors, each with its lengthscale (the paper's "bandwidth").

    Attributes:
        factors: g factors.
        lengthscales: (g,) in the units of the columns; of the chord for periodic ones.
    """

    factors: tuple[Factor, ...]
    lengthscales: FloatArray

    def __post_init__(self) -> None:
        assert self.lengthscales.shape == (len(self.factors),)

    def with_lengthscales(self, lengthscales: FloatArray) -> Kernel:
        return replace(self, lengthscales=lengthscales)

    def part(self, chosen: slice) -> Kernel:
        """The product of some of the factors."""
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

    def gram(self, x: Array, y: Array | None = None) -> Array:
        """``[k(x_i, y_j)]``, (n, k), for inputs (n, d) and (k, d); ``y`` None means ``x``."""
        return gaussian_gram(self.embed(x), None if y is None else self.embed(y))


def pivots_of(kernel: Kernel, x: FloatArray, *, tolerance: float, max_rank: int) -> PivotedCholesky:
    """Pivoted Cholesky of the Gram matrix of inputs (n, d), which is never formed."""
    e = kernel.embed(x)

    def entries(rows: IntArray | None, across: IntArray) -> FloatArray:
        if rows is across:  # symmetric, with ones on its diagonal
            return gaussian_gram(e[across])
        return gaussian_gram(e[across], e if rows is None else e[rows]).T

    return pivoted_cholesky(np.ones(len(e)), entries, tolerance=tolerance, max_rank=max_rank)


def squared_distances(factor: Factor, x: FloatArray) -> FloatArray:
    """``D_g`` (n, n): squared distances of one factor at lengthscale one."""
    c = factor.coordinates(x)
    c = c - c.mean(axis=0)
    norms = np.einsum("ij,ij->i", c, c)
    d = norms[:, None] + norms - 2.0 * (c @ c.T)
    np.maximum(d, 0.0, out=d)
    np.fill_diagonal(d, 0.0)
    return d


def median_lengthscales(
    factors: Sequence[Factor],
    x: FloatArray,
    rng: np.random.Generator,
    sample: int = 500,
) -> FloatArray:
    """Median distance of each factor (g,) between pairs of ``sample`` random rows of ``x`` (n, d).

    Pairs at distance zero are left out (duplicates say nothing about scale); a factor in which
    all rows agree gets lengthscale 1, which is then without effect.
    """
    if len(x) > sample:
        x = x[rng.choice(len(x), sample, replace=False)]
    above = np.triu_indices(len(x), 1)
    scales = []
    for factor in factors:
        d = squared_distances(factor, x)[above]
        d = d[d > 1e-12 * d.max(initial=0.0)]
        scales.append(np.sqrt(np.median(d)) if len(d) else 1.0)
    return np.array(scales)
