"""Dense linear algebra: Cholesky with reported jitter, and triangular solves.

NumPy arrays are passed to LAPACK and BLAS, arrays of other libraries to these libraries.  The array
API standard has a Cholesky factorisation but no triangular solve, so `_triangular` branches on the
library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import array_api_compat
import numpy as np
from scipy.linalg import blas, lapack

from kreps.errors import NumericalError
from kreps.kernels.arrays import Array, FloatArray, namespace

RELATIVE_JITTERS = (0.0, 1e-12, 1e-10, 1e-8, 1e-6)
"""Jitters that a factorisation tries, as shares of the mean diagonal.  The smallest is sufficient
where rounding alone has made the matrix indefinite.  One above the largest would exceed the
smallest regulariser of an embedding (1e-6)."""

STRIP_ROWS = 64
"""Rows of a triangular matrix that `inverse_lower` inverts at once."""

MAX_STRIPPED_ROWS = 512
"""Largest matrix that `inverse_lower` inverts in strips.  Above it LAPACK's blocks are faster."""


@dataclass(frozen=True)
class Cholesky:
    """``L L' = A + jitter I``.

    Attributes:
        lower: (n, n) the lower triangular L.
        jitter: what was added to the diagonal to make the factorisation possible, in units of A.
    """

    lower: Array
    jitter: float

    def solve(self, b: Array) -> Array:
        """``A^-1 b`` for ``b`` of shape (n,) or (n, k)."""
        if not isinstance(b, np.ndarray):
            return solve_lower_transposed(self.lower, solve_lower(self.lower, b))
        if not b.size:  # LAPACK rejects empty right-hand sides
            return b.copy()
        x, _ = lapack.dpotrs(self.lower, b, lower=1)
        return x

    def inverse(self) -> FloatArray:
        """``A^-1``, (n, n) and symmetric."""
        half, _ = lapack.dlauum(inverse_lower(self.lower), lower=1, overwrite_c=1)  # zero above
        diagonal = np.diagonal(half).copy()
        whole = half + half.T
        np.fill_diagonal(whole, diagonal)
        return whole


def cholesky(a: Array) -> Cholesky:
    """Factorise a symmetric positive definite matrix (n, n).

    If rounding has made it indefinite, the smallest sufficient one of 1e-12, 1e-10, 1e-8, 1e-6
    times its mean diagonal is added to the diagonal and reported in ``Cholesky.jitter``.

    Raises:
        NumericalError: not positive definite at the largest jitter, or not finite.
    """
    xp, n = namespace(a), a.shape[0]
    scale = float(xp.mean(xp.linalg.diagonal(a))) if n else 1.0
    factorise = _potrf if xp is np else _cholesky_of(xp)
    for relative in RELATIVE_JITTERS if np.isfinite(scale) else ():
        jitter = relative * scale
        lower = factorise(with_diagonal(a, jitter) if jitter else a)
        if lower is not None and bool(xp.all(xp.isfinite(xp.linalg.diagonal(lower)))):
            return Cholesky(lower, jitter)
    raise NumericalError(
        f"a {n} x {n} matrix with mean diagonal {scale:.3g} is not positive definite, "
        f"even with {RELATIVE_JITTERS[-1]:g} of that added to its diagonal; "
        "check the data for infinities or increase the regularisation"
    )


def _potrf(a: FloatArray) -> FloatArray | None:
    lower, info = lapack.dpotrf(a, lower=1, clean=1)
    return lower if info == 0 else None


def _cholesky_of(xp: Any) -> Callable[[Array], Array | None]:
    """Cholesky of another array library; None for a matrix that it cannot factorise."""

    def factorise(a: Array) -> Array | None:
        try:
            return xp.linalg.cholesky(a)
        except (ArithmeticError, ValueError, RuntimeError):  # whichever the library raises
            return None

    return factorise


def with_diagonal(a: Array, added: float | FloatArray) -> Array:
    """A copy of ``a`` (n, n) with ``added``, a number or (n,), on its diagonal."""
    xp, n = namespace(a), a.shape[0]
    if xp is np:
        shifted = a.copy()
        shifted.flat[:: n + 1] += added
        return shifted
    return a + added * xp.eye(n, dtype=a.dtype, device=array_api_compat.device(a))


def solve_lower(lower: Array, b: Array) -> Array:
    """``L^-1 b`` for lower triangular ``L`` (n, n) and ``b`` (n,) or (n, k)."""
    if not isinstance(b, np.ndarray):
        return _triangular(lower, b, upper=False)
    if b.ndim == 1 or b.shape[1] == 1:  # in the control loop, one vector at a time
        return blas.dtrsv(lower, b.ravel(), lower=1).reshape(b.shape)
    return blas.dtrsm(1.0, lower, b, lower=1)


def solve_lower_transposed(lower: Array, b: Array) -> Array:
    """``L'^-1 b`` for lower triangular ``L`` (n, n) and ``b`` (n,) or (n, k)."""
    if not isinstance(b, np.ndarray):
        return _triangular(lower.T, b, upper=True)
    if b.ndim == 1:
        return blas.dtrsv(lower, b, lower=1, trans=1)
    return blas.dtrsm(1.0, lower, b, lower=1, trans_a=1)


def _triangular(a: Array, b: Array, *, upper: bool) -> Array:
    """``a^-1 b`` for a triangular matrix of an array library other than NumPy."""
    xp = namespace(b)
    if b.ndim == 1:
        return _triangular(a, b[:, None], upper=upper)[:, 0]
    if array_api_compat.is_torch_array(b):
        return xp.linalg.solve_triangular(a, b, upper=upper)
    if array_api_compat.is_cupy_array(b):
        from cupyx.scipy.linalg import solve_triangular

        return solve_triangular(a, b, lower=not upper)
    return xp.linalg.solve(a, b)


def inverse_lower(lower: FloatArray) -> FloatArray:
    """``L^-1`` of a lower triangular (n, n) matrix.

    Small matrices are inverted strip by strip with matrix products, which takes down to half of
    LAPACK's time.
    """
    n = len(lower)
    if n > MAX_STRIPPED_ROWS:
        return lapack.dtrtri(lower, lower=1)[0]
    inverse = np.zeros((n, n), order="F")
    for i in range(0, n, STRIP_ROWS):
        strip = slice(i, i + STRIP_ROWS)
        corner, _ = lapack.dtrtri(lower[strip, strip], lower=1)
        inverse[strip, strip] = corner
        inverse[strip, :i] = -corner @ (lower[strip, :i] @ inverse[:i, :i])
    return inverse


def principal_coordinates(a: FloatArray, tolerance: float = 1e-8) -> FloatArray:
    """``B`` (k, n) with ``|B x| = |A x|`` for symmetric A (n, n), up to ``tolerance |A| |x|``.

    Its rows are the eigenvectors of A times their eigenvalues.  Eigenvalues below ``tolerance``
    times the largest are left out, so that k <= n.
    """
    values, vectors = np.linalg.eigh(a)
    kept = np.abs(values) > tolerance * np.abs(values).max()
    return values[kept, None] * vectors[:, kept].T
