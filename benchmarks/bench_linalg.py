"""Operations per second of factorisations and solves, as a share of the peak."""

from __future__ import annotations

from functools import cache

import flops
import numpy as np
import pytest
from criteria import Quality, Share, TimesFaster
from measuring import Measure

from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.gram import gaussian_gram
from kreps.kernels.linalg import cholesky
from kreps.kernels.pivoted_cholesky import PivotedCholesky, pivoted_cholesky

RNG = np.random.default_rng(0)
ROWS, RANK = 100_000, 500


@cache
def positive_definite(n: int) -> FloatArray:
    e = RNG.standard_normal((n, 5))
    a = gaussian_gram(e)
    a.flat[:: n + 1] += 0.1
    return a


@pytest.mark.parametrize(("n", "limit"), [(500, None), (1500, 0.55), (3000, 0.65), (6000, 0.75)])
def bench_cholesky(measure: Measure, n: int, limit: float | None) -> None:
    a = positive_definite(n)
    work = Share(flops.cholesky(n), at_least=limit)
    measure("Cholesky", f"n = {n}", lambda: cholesky(a), work)


@pytest.mark.parametrize(("n", "limit"), [(1500, 0.6), (3000, 0.7)])
def bench_solve(measure: Measure, n: int, limit: float) -> None:
    factor = cholesky(positive_definite(n))
    b = RNG.standard_normal((n, n))
    work = Share(flops.solve(n, n), at_least=limit)
    measure("solve, n right-hand sides", f"n = {n}", lambda: factor.solve(b), work)


def one_by_one(e: FloatArray, rank: int) -> FloatArray:
    """Textbook pivoted Cholesky: the columns (n, rank), computed one pivot at a time."""
    left = np.ones(len(e))
    columns = np.zeros((len(e), rank), order="F")
    for j in range(rank):
        pivot = int(np.argmax(left))
        column = gaussian_gram(e, e[pivot : pivot + 1])[:, 0]
        column -= columns[:, :j] @ columns[pivot, :j]
        columns[:, j] = column / np.sqrt(left[pivot])
        left = np.maximum(left - columns[:, j] ** 2, 0.0)
        left[pivot] = 0.0
    return columns


def bench_pivoted_cholesky(measure: Measure) -> None:
    e = np.random.default_rng(1).standard_normal((ROWS, 3))

    def entries(rows: IntArray | None, across: IntArray) -> FloatArray:
        return gaussian_gram(e[across], e if rows is None else e[rows]).T

    kept: dict[str, FloatArray] = {}

    def blocked() -> None:
        kept.clear()
        found: PivotedCholesky = pivoted_cholesky(
            np.ones(ROWS), entries, tolerance=0.0, max_rank=RANK
        )
        kept["blocked"] = found.columns

    def reference() -> None:
        kept.clear()
        kept["reference"] = one_by_one(e, RANK)

    reference()
    least_residual = ROWS - float(np.sum(kept["reference"] ** 2))

    def relative_residual() -> float:
        return (ROWS - float(np.sum(kept["blocked"] ** 2))) / least_residual

    measure(
        "pivoted Cholesky",
        f"n = {ROWS:,}, rank {RANK}",
        blocked,
        Share(flops.product(ROWS, RANK, RANK) // 2),
        TimesFaster("one pivot at a time", reference, at_least=3.0),
        Quality("x the residual trace of one pivot at a time", relative_residual, at_most=1.02),
        rounds=2,
    )


def bench_symmetric_product(measure: Measure) -> None:
    phi = np.random.default_rng(2).standard_normal((ROWS, 1000))
    nominal = flops.product(1000, 1000, ROWS)
    share = Share(nominal, nominal=True, at_least=1.4)
    measure("Phi'Phi", f"n = {ROWS:,}, rank 1000", lambda: phi.T @ phi, share)
