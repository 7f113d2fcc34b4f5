"""Blocked pivoted Cholesky: low-rank approximation of a matrix of which few columns are computed.

Pivots are chosen greedily by the largest diagonal entry of what is not yet represented.  Choosing
several in one round turns thin updates of all rows into products of matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas, lapack

from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.gram import gaussian_gram

ROUNDING_RTOL = 1e-14
"""Residuals below this share of the largest diagonal entry are rounding errors, not pivots."""

MAX_CANDIDATES = 256
"""Largest number of rows that a round considers as pivots.  Their own pivoted Cholesky costs the
cube of this number, which stays small beside the update of all rows."""

PIVOT_RATIO = 0.5
"""Smallest residual of a candidate, as a share of the largest residual.  With a smaller one a round
would choose pivots that one-by-one pivoting takes much later."""

PIVOT_RATIO_IN_BLOCK = 0.3
"""Smallest residual of a candidate after the earlier pivots of its round, as a share of the largest
residual.  The left-out trace then stays within 1.3 times that of one-by-one pivoting."""

TIE_RTOL = 1e-9
"""Residuals that differ by less than this share of the largest are equal, and the first row wins,
so that rounding does not decide which rows are pivots."""


@dataclass(frozen=True)
class PivotedCholesky:
    """``columns @ columns.T`` approximates the matrix; exact on the rows named by ``pivots``.

    Attributes:
        columns: (n, r).  Its rows at ``pivots`` form a lower triangular (r, r) matrix.
        pivots: (r,) row numbers in the order in which they were chosen.
        residual: largest diagonal entry of the matrix less its approximation.
    """

    columns: FloatArray
    pivots: IntArray
    residual: float


def pivoted_cholesky(
    diagonal: FloatArray,
    entries: Callable[[IntArray | None, IntArray], FloatArray],
    *,
    tolerance: float,
    max_rank: int,
    block: int = 64,
) -> PivotedCholesky:
    """Blocked pivoted Cholesky of a symmetric positive semi-definite matrix K (n, n).

    Each round takes candidates among the rows with large residuals, orders them by a small pivoted
    Cholesky of their own, and keeps those whose residual stays large after the earlier ones.  Only
    the columns of these are computed.

    Args:
        diagonal: (n,) diagonal of K.
        entries: maps row numbers (a,), None for all, and column numbers (b,) to
            ``K[rows, columns]``, (a, b).  Whole columns are best in Fortran order.  Where rows and
            columns are the same object, the diagonal must be exact.
        tolerance: stop when the largest diagonal entry of the residual is below this.
        max_rank: stop at this many pivots.
        block: largest number of pivots of a round.
    """
    n = len(diagonal)
    max_rank = min(max_rank, n)
    residuals = diagonal.astype(np.float64, copy=True)
    tolerance = max(tolerance, ROUNDING_RTOL * float(residuals.max(initial=0.0)))
    columns = np.zeros((n, max_rank), order="F")
    pivots = np.empty(max_rank, dtype=np.intp)
    rank = 0
    while rank < max_rank and (largest := float(residuals.max())) > tolerance:
        candidates = _candidates(residuals, max(PIVOT_RATIO * largest, tolerance))
        known = columns[candidates, :rank]
        schur = entries(candidates, candidates) - known @ known.T
        order = _pivots_of_block(schur, largest, tolerance)[: min(block, max_rank - rank)]
        if not len(order):  # their residuals were rounding errors
            residuals[candidates] = 0.0
            continue
        chosen = candidates[order]
        new = np.array(entries(None, chosen), order="F")
        if rank:
            before = columns[:, :rank]
            blas.dgemm(-1.0, before, before[chosen], beta=1.0, c=new, trans_b=1, overwrite_c=1)
        lower, _ = lapack.dpotrf(schur[np.ix_(order, order)], lower=1, clean=1)
        blas.dtrsm(1.0, lower, new, side=1, lower=1, trans_a=1, overwrite_b=1)
        following = slice(rank, rank + len(order))
        columns[:, following] = new
        pivots[following] = chosen
        rank += len(order)
        residuals -= np.einsum("ij,ij->i", new, new)
        residuals[pivots[:rank]] = 0.0
        np.maximum(residuals, 0.0, out=residuals)
    return PivotedCholesky(columns[:, :rank], pivots[:rank], float(residuals.max(initial=0.0)))


def _candidates(residuals: FloatArray, smallest: float) -> IntArray:
    """At most `MAX_CANDIDATES` of the rows with residuals from ``smallest`` on, evenly spaced."""
    rows = np.flatnonzero(residuals >= smallest)
    if len(rows) > MAX_CANDIDATES:
        rows = rows[np.linspace(0, len(rows) - 1, MAX_CANDIDATES).astype(np.intp)]
    return rows


def _pivots_of_block(schur: FloatArray, largest: float, tolerance: float) -> IntArray:
    """The candidates that become pivots, in order; none if all residuals are rounding errors.

    A candidate close to an earlier one is left for a later round, where another row may have a
    larger residual.  The trace of the residual then stays near that of one-by-one pivoting.

    Args:
        schur: (c, c) the residual matrix of the candidates.
        largest: residual of any row.
        tolerance: residuals below it make no pivot.
    """
    favour_first = np.diag(np.linspace(TIE_RTOL * largest, 0.0, len(schur)))
    local, order, rank, _ = lapack.dpstrf(schur + favour_first, tol=tolerance, lower=1)
    if rank == 0:
        return np.empty(0, dtype=np.intp)
    residuals = np.diagonal(local)[:rank] ** 2
    large = np.append(residuals > PIVOT_RATIO_IN_BLOCK * largest, False)
    kept = max(1, int(np.argmin(large)))
    return order[:kept] - 1


def pivoted_gaussian_gram(e: FloatArray, *, tolerance: float, max_rank: int) -> PivotedCholesky:
    """Pivoted Cholesky of `gaussian_gram` of coordinates (n, m), which is never formed as a whole.

    Args:
        e: (n, m) embedded coordinates.
        tolerance, max_rank: as of `pivoted_cholesky`.
    """

    def entries(rows: IntArray | None, across: IntArray) -> FloatArray:
        if rows is across:  # symmetric, with ones on its diagonal
            return gaussian_gram(e[across])
        return gaussian_gram(e[across], e if rows is None else e[rows]).T

    return pivoted_cholesky(np.ones(len(e)), entries, tolerance=tolerance, max_rank=max_rank)
