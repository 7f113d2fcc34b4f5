"""Gram matrices and squared distances of embedded coordinates.

Every kernel of the library is ``k(x, y) = exp(-|e(x) - e(y)|^2 / 2)`` for an embedding e into
Euclidean coordinates (`kreps.kernels.kernel`).  The functions here take the coordinates.
"""

from __future__ import annotations

import numpy as np

from kreps.kernels.arrays import Array, FloatArray, namespace

MAX_AUGMENTED_COORDINATES = 32
"""Largest number of coordinates m for which the half squared norms are appended to the factors of
the matrix product.  This costs two columns more than m, but saves two passes over the result."""

BLOCK_ENTRIES = 65_536
"""Entries of the Gram matrix that are worked on at once.  At 8 bytes each they are 512 KiB and stay
in the processor's cache, so that each entry is written to memory once."""

MAX_BLOCK_COLUMNS = 4_096
"""Largest number of columns of such a block."""


def gaussian_gram(e: Array, f: Array | None = None) -> Array:
    """``exp(-|e_i - f_j|^2 / 2)``, (n, k), for coordinates (n, m) and (k, m); None means ``e``."""
    xp = namespace(e)
    # A common shift leaves distances as they are but reduces the rounding of inner products.
    centre = xp.mean(e, axis=0)
    e = e - centre
    g = e if f is None else f - centre
    if xp is np:
        return _gaussian_gram_in_blocks(e, g)
    k = e @ g.T
    k -= 0.5 * xp.sum(e * e, axis=1)[:, None]
    k -= 0.5 * xp.sum(g * g, axis=1)
    return xp.exp(xp.clip(k, max=0.0))


def _gaussian_gram_in_blocks(e: FloatArray, f: FloatArray) -> FloatArray:
    """`gaussian_gram` of centred NumPy arrays.

    The time is little more than that of the exponentials.
    """
    n, m = e.shape
    augmented = m <= MAX_AUGMENTED_COORDINATES
    # In few coordinates the half squares are enlarged by a bound of the product's rounding error,
    # so that no exponent is positive.  In many coordinates that would bias the result, and
    # exponents are clipped at zero instead.
    half = -0.5 * (1.0 + (m + 6) * np.finfo(np.float64).eps if augmented else 1.0)
    left, right = (half * np.einsum("ij,ij->i", c, c)[:, None] for c in (e, f))
    k = np.empty((n, len(f)))
    if augmented:
        a = np.concatenate([e, left, np.ones_like(left)], axis=1)
        b = np.concatenate([f, np.ones_like(right), right], axis=1).T
    else:
        np.matmul(e, f.T, out=k)  # BLAS computes only one triangle where both are one array
    width = max(1, min(len(f), MAX_BLOCK_COLUMNS))
    height = BLOCK_ENTRIES // width
    for i in range(0, n, height):
        for j in range(0, len(f), width):
            rows, across = slice(i, i + height), slice(j, j + width)
            block = k[rows, across]
            if augmented:
                np.matmul(a[rows], b[:, across], out=block)
            else:
                block += left[rows]
                block += right[across].T
                np.minimum(block, 0.0, out=block)
            np.exp(block, out=block)
    if e is f:
        np.fill_diagonal(k, 1.0)
    return k


def squared_distances(e: FloatArray) -> FloatArray:
    """``|e_i - e_j|^2``, (n, n), for coordinates (n, m); the diagonal is exactly zero."""
    e = e - e.mean(axis=0)  # reduces rounding, as in `gaussian_gram`
    norms = np.einsum("ij,ij->i", e, e)
    d = norms[:, None] + norms - 2.0 * (e @ e.T)
    np.maximum(d, 0.0, out=d)
    np.fill_diagonal(d, 0.0)
    return d
