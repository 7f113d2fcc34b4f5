"""Cholesky factors with jitter, and triangular solves, against NumPy."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from kreps.errors import NumericalError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.linalg import cholesky, solve_lower, solve_lower_transposed, with_diagonal


def positive_definite(n: int, seed: int) -> FloatArray:
    half = np.random.default_rng(seed).normal(size=(n, n))
    return half @ half.T + 0.1 * np.eye(n)


def test_a_positive_definite_matrix_needs_no_jitter() -> None:
    a = positive_definite(30, seed=0)
    factor = cholesky(a)
    assert factor.jitter == 0.0
    np.testing.assert_array_equal(factor.lower, np.tril(factor.lower))
    np.testing.assert_allclose(factor.lower, np.linalg.cholesky(a), atol=1e-10)


@pytest.mark.parametrize("order", ["C", "F"])
def test_cholesky_does_not_change_its_argument(order: Literal["C", "F"]) -> None:
    a = np.array(positive_definite(12, seed=1), order=order)
    before = a.copy()
    cholesky(a)
    np.testing.assert_array_equal(a, before)


@pytest.mark.parametrize("columns", [None, 1, 7])
def test_cholesky_solves_linear_systems(columns: int | None) -> None:
    a = positive_definite(25, seed=2)
    shape = 25 if columns is None else (25, columns)
    b = np.random.default_rng(3).normal(size=shape)
    x = cholesky(a).solve(b)
    assert x.shape == b.shape
    np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("n", [1, 25, 64, 65, 200, 513])
def test_inverse_is_the_inverse_and_exactly_symmetric(n: int) -> None:
    a = positive_definite(n, seed=4)
    inverse = cholesky(a).inverse()
    np.testing.assert_allclose(inverse, np.linalg.inv(a), rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(inverse, inverse.T)


@pytest.mark.parametrize(
    ("eigenvalue", "relative"), [(-3e-13, 1e-12), (-3e-11, 1e-10), (-3e-9, 1e-8), (-3e-7, 1e-6)]
)
@pytest.mark.parametrize("scale", [1.0, 1e6, 1e-6])
def test_the_smallest_sufficient_jitter_is_added_and_reported(
    eigenvalue: float, relative: float, scale: float
) -> None:
    a = scale * np.diag(np.append(np.ones(9), eigenvalue))
    factor = cholesky(a)
    assert factor.jitter == pytest.approx(relative * np.diagonal(a).mean(), rel=1e-12)
    np.testing.assert_allclose(
        factor.lower @ factor.lower.T,
        a + factor.jitter * np.eye(10),
        atol=1e-14 * scale,
        rtol=1e-12,
    )


def test_a_singular_matrix_is_factorised_with_reported_jitter() -> None:
    factor = cholesky(np.ones((20, 20)))
    assert 0.0 < factor.jitter <= 1e-6
    np.testing.assert_allclose(
        factor.lower @ factor.lower.T, np.ones((20, 20)) + factor.jitter * np.eye(20), atol=1e-14
    )


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
@pytest.mark.parametrize(
    "a",
    [
        np.diag([1.0, 1.0, -0.1]),
        np.diag([-1.0, -2.0]),
        np.zeros((3, 3)),
        np.array([[1.0, np.nan], [np.nan, 1.0]]),
        np.diag([1.0, np.nan, 1.0]),
        np.diag([np.inf, 1.0]),
        np.array([[1.0, np.inf], [np.inf, 1.0]]),
    ],
    ids=["indefinite", "negative", "zero", "nan beside", "nan on", "inf on", "inf beside"],
)
def test_a_matrix_that_cannot_be_factorised_raises(a: FloatArray) -> None:
    with pytest.raises(NumericalError):
        cholesky(a)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("columns", [None, 1, 6])
def test_triangular_solves(columns: int | None, order: Literal["C", "F"]) -> None:
    lower = np.array(np.linalg.cholesky(positive_definite(15, seed=5)), order=order)
    shape = 15 if columns is None else (15, columns)
    b = np.random.default_rng(6).normal(size=shape)
    before = b.copy()
    np.testing.assert_allclose(lower @ solve_lower(lower, b), b, atol=1e-9)
    np.testing.assert_allclose(lower.T @ solve_lower_transposed(lower, b), b, atol=1e-9)
    np.testing.assert_array_equal(b, before)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("added", [0.5, np.arange(4.0)], ids=["number", "vector"])
def test_adding_to_a_diagonal_makes_a_copy(
    added: float | FloatArray, order: Literal["C", "F"]
) -> None:
    a = np.array(np.random.default_rng(8).normal(size=(4, 4)), order=order)
    before = a.copy()
    np.testing.assert_array_equal(
        with_diagonal(a, added), before + np.diag(np.broadcast_to(added, 4))
    )
    np.testing.assert_array_equal(a, before)


def test_an_empty_right_hand_side_has_an_empty_solution() -> None:
    # A chunk in which all samples have weight zero has an empty right-hand side.
    lower = np.linalg.cholesky(positive_definite(5, seed=9))
    for solve in (solve_lower, solve_lower_transposed):
        assert solve(lower, np.empty((5, 0))).shape == (5, 0)
