"""Dense linear algebra: Cholesky with reported jitter, triangular solves, pivoted Cholesky.

The only file that knows which library does these: LAPACK for NumPy, the library itself for arrays
of others.  The array API standard has Cholesky but no triangular solve, hence the three names.
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

_JITTERS = (0.0, 1e-12, 1e-10, 1e-8, 1e-6)


@dataclass(frozen=True)
class Cholesky:
    """``L L' = A + jitter I``, with ``L`` lower triangular (n, n)."""

    lower: Array
    jitter: float

    def solve(self, b: Array) -> Array:
        """``A^-1 b`` for ``b`` of shape (n,) or (n, k)."""
        if not isinstance(b, np.ndarray):
            return solve_lower_transposed(self.lower, solve_lower(self.lower, b))
        if not b.size:  # LAPACK would not have it
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

    If rounding has made it indefinite, the least of 1e-12, 1e-10, 1e-8, 1e-6 times its mean
    diagonal is added to the diagonal; what was added is reported in ``Cholesky.jitter``.

    Raises:
        NumericalError: not positive definite at the largest jitter, or not finite.
    """
    xp, n = namespace(a), a.shape[0]
    scale = float(xp.mean(xp.linalg.diagonal(a))) if n else 1.0
    factorise = _potrf if xp is np else _cholesky_of(xp)
    for relative in _JITTERS if np.isfinite(scale) else ():
        jitter = relative * scale
        lower = factorise(with_diagonal(a, jitter) if jitter else a)
        if lower is not None and bool(xp.all(xp.isfinite(xp.linalg.diagonal(lower)))):
            return Cholesky(lower, jitter)
    raise NumericalError(
        f"a {n} x {n} matrix with mean diagonal {scale:.3g} is not positive definite, "
        f"even with {_JITTERS[-1]:g} of that added to its diagonal; "
        "check the data for infinities or increase the regularisation"
    )


def _potrf(a: FloatArray) -> FloatArray | None:
    lower, info = lapack.dpotrf(a, lower=1, clean=1)
    return lower if info == 0 else None


def _cholesky_of(xp: Any) -> Callable[[Array], Array | None]:
    """Cholesky of another library, None where it refuses."""

    def factorise(a: Array) -> Array | None:
        try:
            return xp.linalg.cholesky(a)
        except (ArithmeticError, ValueError, RuntimeError):  # what the libraries raise
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
    if b.ndim == 1 or b.shape[1] == 1:  # the control loop: no threads, no blocking
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
    """``a^-1 b`` for a triangular matrix of a library other than NumPy."""
    xp = namespace(b)
    if b.ndim == 1:
        return _triangular(a, b[:, None], upper=upper)[:, 0]
    if array_api_compat.is_torch_array(b):
        return xp.linalg.solve_triangular(a, b, upper=upper)
    if array_api_compat.is_cupy_array(b):
        from cupyx.scipy.linalg import solve_triangular

        return solve_triangular(a, b, lower=not upper)
    return xp.linalg.solve(a, b)


STRIP = 64
"""Rows of a triangular matrix that are inverted at once."""

STRIPS_UP_TO = 512
"""Rows up to which strips are faster than LAPACK, which then works in blocks of its own."""


def inverse_lower(lower: FloatArray) -> FloatArray:
    """``L^-1`` of a lower triangular (n, n) matrix.

    If it is small, strip by strip with matrix products, in up to half of the time.
    """
    n = len(lower)
    if n > STRIPS_UP_TO:
        return lapack.dtrtri(lower, lower=1)[0]
    inverse = np.zeros((n, n), order="F")
    for i in range(0, n, STRIP):
        strip = slice(i, i + STRIP)
        corner, _ = lapack.dtrtri(lower[strip, strip], lower=1)
        inverse[strip, strip] = corner
        inverse[strip, :i] = -corner @ (lower[strip, :i] @ inverse[:i, :i])
    return inverse


def principal_coordinates(a: FloatArray, tolerance: float = 1e-8) -> FloatArray:
    """``B`` (k, n) with ``|B x| = |A x|`` for symmetric A (n, n), up to ``tolerance |A| |x|``."""
    values, vectors = np.linalg.eigh(a)
    kept = np.abs(values) > tolerance * np.abs(values).max()
    return values[kept, None] * vectors[:, kept].T
