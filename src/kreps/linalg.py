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

from kreps.arrays import Array, FloatArray, IntArray, namespace
from kreps.errors import NumericalError

_JITTERS = (0.0, 1e-12, 1e-10, 1e-8, 1e-6)

_ROUNDING = 1e-14
"""Residuals below this share of the diagonal are rounding errors and make no pivots."""


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


@dataclass(frozen=True)
class PivotedCholesky:
    """``columns @ columns.T`` approximates the matrix; exact on the rows named by ``pivots``.

    Attributes:
        columns: (n, r).  Its rows at ``pivots`` form a lower triangular (r, r) matrix.
        pivots: (r,) row numbers in the order in which they were chosen.
        residual: largest diagonal entry of the part that is left out.
    """

    columns: FloatArray
    pivots: IntArray
    residual: float


POOL = 256
"""Candidates of a round of `pivoted_cholesky`."""

WORTH = 0.5
"""Least residual of a candidate, as a share of the largest."""

STILL_WORTH = 0.3
"""Least residual of a candidate once the earlier ones of its round are accounted for; likewise."""


TIE = 1e-9
"""Residuals that differ by less than this share of the largest are worth the same."""


def pivoted_cholesky(
    diagonal: FloatArray,
    entries: Callable[[IntArray | None, IntArray], FloatArray],
    *,
    tolerance: float,
    max_rank: int,
    block: int = 64,
) -> PivotedCholesky:
    """Blocked pivoted Cholesky of a symmetric positive semi-definite matrix K (n, n).

    Each round looks at some rows with large residuals, spread over all such rows, orders them by a
    small pivoted Cholesky of their own, and takes those that remain large once the earlier ones
    are accounted for.  Only their columns are computed, and all rows are updated with two matrix
    products instead of one thin update per pivot.

    Args:
        diagonal: (n,) diagonal of K.
        entries: maps numbers of rows (a,), None for all, and columns (b,) to ``K[rows, columns]``.
            Whole columns are best laid out one after the other (Fortran's order).  Where rows and
            columns are the same object the diagonal must be exact.
        tolerance: stop when the largest residual diagonal entry is below this.
        max_rank: stop at this many pivots.
        block: most pivots of a round.
    """
    n = len(diagonal)
    max_rank = min(max_rank, n)
    left = diagonal.astype(np.float64, copy=True)
    tolerance = max(tolerance, _ROUNDING * float(left.max(initial=0.0)))
    columns = np.zeros((n, max_rank), order="F")
    pivots = np.empty(max_rank, dtype=np.intp)
    rank = 0
    while rank < max_rank and (top := float(left.max())) > tolerance:
        candidates = np.flatnonzero(left >= max(WORTH * top, tolerance))
        if len(candidates) > POOL:
            spread = np.linspace(0, len(candidates) - 1, POOL).astype(np.intp)
            candidates = candidates[spread]
        known = columns[candidates, :rank]
        small = entries(candidates, candidates) - known @ known.T
        # of rows that are worth the same but for rounding, the first
        first = small + np.diag(np.linspace(TIE * top, 0.0, len(small)))
        local, order, kept, _ = lapack.dpstrf(first, tol=tolerance, lower=1)
        if kept == 0:  # what seemed left of them was rounding
            left[candidates] = 0.0
            continue
        # A candidate close to an earlier one is left for a later round, where a better row
        # than it may have turned up: this keeps the trace near that of one-by-one pivoting.
        sizes = np.diagonal(local)[:kept] ** 2
        kept = max(1, int(np.argmin(np.append(sizes > STILL_WORTH * top, False))))
        kept = min(kept, block, max_rank - rank)
        order = order[:kept] - 1
        chosen = candidates[order]
        new = np.array(entries(None, chosen), order="F")
        if rank:
            before = columns[:, :rank]
            blas.dgemm(-1.0, before, before[chosen], beta=1.0, c=new, trans_b=1, overwrite_c=1)
        lower, _ = lapack.dpotrf(small[np.ix_(order, order)], lower=1, clean=1)
        blas.dtrsm(1.0, lower, new, side=1, lower=1, trans_a=1, overwrite_b=1)
        columns[:, rank : rank + kept] = new
        pivots[rank : rank + kept] = chosen
        left -= np.einsum("ij,ij->i", new, new)
        left[pivots[: rank + kept]] = 0.0
        np.maximum(left, 0.0, out=left)
        rank += kept
    return PivotedCholesky(columns[:, :rank], pivots[:rank], float(left.max(initial=0.0)))
