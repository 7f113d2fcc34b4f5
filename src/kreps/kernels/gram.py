"""Kernels as Gaussian kernels of an embedding.

Every kernel of the paper is ``k(x, y) = exp(-|e(x) - e(y)|^2 / 2)`` for some map ``e`` to
Euclidean coordinates: a squared exponential has ``e(x) = x / l``, the periodic kernel
``exp(-2 sin^2((x - y) / 2) / l^2)`` has ``e(x) = (cos x, sin x) / l``, and a product of kernels
concatenates the embeddings.  So whoever adds a kernel writes one short method, and a Gram matrix
is one thin matrix product and one exponential.
"""

from __future__ import annotations

import numpy as np

from kreps.kernels.arrays import Array, FloatArray, namespace

THIN = 32
"""Coordinates up to which norms are worth a column of the matrix product."""

PANEL = 65_536
"""Numbers that are worked on at once: they fit the cache, so that memory is passed but once."""

WIDEST = 4_096
"""Columns of a panel at most."""


def gaussian_gram(e: Array, f: Array | None = None) -> Array:
    """``exp(-|e_i - f_j|^2 / 2)`` for coordinates (n, m) and (k, m); ``f`` None means ``e``."""
    xp = namespace(e)
    # Distances do not feel a common shift, but rounding does: centre first.
    centre = xp.mean(e, axis=0)
    e = e - centre
    g = e if f is None else f - centre
    if xp is np:
        return _gram(e, g)
    k = e @ g.T
    k -= 0.5 * xp.sum(e * e, axis=1)[:, None]
    k -= 0.5 * xp.sum(g * g, axis=1)
    return xp.exp(xp.clip(k, max=0.0))


def _gram(e: FloatArray, f: FloatArray) -> FloatArray:
    """`gaussian_gram` of NumPy's arrays, panel by panel: hardly slower than the exponentials."""
    n, m = e.shape
    # In few coordinates half squares are larger by what rounding does to the product, so that no
    # exponent is positive; in many that would be a bias, and exponents are clipped.
    half = -0.5 * (1.0 + (m + 6) * np.finfo(np.float64).eps if m <= THIN else 1.0)
    left, right = (half * np.einsum("ij,ij->i", c, c)[:, None] for c in (e, f))
    k = np.empty((n, len(f)))
    if m <= THIN:
        a = np.concatenate([e, left, np.ones_like(left)], axis=1)
        b = np.concatenate([f, np.ones_like(right), right], axis=1).T
    else:
        np.matmul(e, f.T, out=k)  # the symmetric product if both are one array
    wide = max(1, min(len(f), WIDEST))
    tall = PANEL // wide
    for i in range(0, n, tall):
        for j in range(0, len(f), wide):
            rows, across = slice(i, i + tall), slice(j, j + wide)
            panel = k[rows, across]
            if m <= THIN:
                np.matmul(a[rows], b[:, across], out=panel)
            else:
                panel += left[rows]
                panel += right[across].T
                np.minimum(panel, 0.0, out=panel)
            np.exp(panel, out=panel)
    if e is f:
        np.fill_diagonal(k, 1.0)
    return k
