"""Dense linear algebra: Cholesky with reported jitter, triangular solves, pivoted Cholesky.

The only file that knows which library does these: LAPACK for NumPy, the library itself for arrays
of others.  The array API standard has Cholesky but no triangular solve, hence the three names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas, lapack

from kreps.kernels.arrays import FloatArray, IntArray

_ROUNDING = 1e-14
"""Residuals below this share of the diagonal are rounding errors and make no pivots."""


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


CANDIDATES = 256
"""Candidates of a round of `pivoted_cholesky`."""

PIVOT_RATIO = 0.5
"""Least residual of a candidate, as a share of the largest."""

PIVOT_RATIO_IN_BLOCK = 0.3
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
        candidates = np.flatnonzero(left >= max(PIVOT_RATIO * top, tolerance))
        if len(candidates) > CANDIDATES:
            spread = np.linspace(0, len(candidates) - 1, CANDIDATES).astype(np.intp)
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
        kept = max(1, int(np.argmin(np.append(sizes > PIVOT_RATIO_IN_BLOCK * top, False))))
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
