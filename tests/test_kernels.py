"""Kernels against the textbook formulas; symmetry, positive semi-definiteness, lengthscales."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kreps.kernels.arrays import FloatArray
from kreps.kernels.gram import gaussian_gram, squared_distances
from kreps.kernels.kernel import (
    Kernel,
    Periodic,
    SquaredExponential,
    as_wide_as_spread,
    factors_of,
    median_lengthscales,
)
from kreps.kernels.pivoted_cholesky import pivoted_gaussian_gram

# The same examples in every run, so that a failure can be reproduced.
reproducible = settings(max_examples=60, deadline=None, derandomize=True)

lengthscales = st.floats(0.2, 5.0)
values = st.floats(-10.0, 10.0, allow_subnormal=False)


def inputs(columns: int, min_rows: int = 1, max_rows: int = 12) -> st.SearchStrategy[FloatArray]:
    return st.integers(min_rows, max_rows).flatmap(
        lambda rows: arrays(np.float64, (rows, columns), elements=values)
    )


def mixed_kernel(a: float, b: float, c: float) -> Kernel:
    """Periodic in column 0, squared exponential in column 1, and jointly in columns 2 and 3."""
    factors = (Periodic((0,)), SquaredExponential((1,)), SquaredExponential((2, 3)))
    return Kernel(factors, np.array([a, b, c]))


def squared_exponential(x: float, y: float, lengthscale: float) -> float:
    return math.exp(-((x - y) ** 2) / (2.0 * lengthscale**2))


def periodic(x: float, y: float, lengthscale: float) -> float:
    return math.exp(-2.0 * math.sin((x - y) / 2.0) ** 2 / lengthscale**2)


@reproducible
@given(inputs(4), inputs(4), lengthscales, lengthscales, lengthscales)
def test_a_product_kernel_is_the_product_of_the_textbook_formulas(
    x: FloatArray, y: FloatArray, a: float, b: float, c: float
) -> None:
    wanted = [
        [
            periodic(s[0], t[0], a)
            * squared_exponential(s[1], t[1], b)
            * squared_exponential(s[2], t[2], c)
            * squared_exponential(s[3], t[3], c)
            for t in y
        ]
        for s in x
    ]
    gram = mixed_kernel(a, b, c).gram(x, y)
    assert gram.shape == (len(x), len(y))
    np.testing.assert_allclose(gram, wanted, rtol=1e-8, atol=1e-10)


@reproducible
@given(inputs(4), lengthscales, lengthscales, lengthscales)
def test_a_gram_matrix_is_symmetric_with_unit_diagonal_and_positive_semi_definite(
    x: FloatArray, a: float, b: float, c: float
) -> None:
    gram = mixed_kernel(a, b, c).gram(x)
    np.testing.assert_allclose(gram, gram.T, rtol=0.0, atol=1e-11)
    np.testing.assert_array_equal(np.diagonal(gram), 1.0)
    assert (gram >= 0.0).all()
    assert (gram <= 1.0).all()
    assert np.linalg.eigvalsh(gram).min() >= -1e-10


@reproducible
@given(inputs(4), lengthscales, lengthscales, lengthscales)
def test_the_gram_matrix_of_one_set_equals_that_of_the_set_with_its_copy(
    x: FloatArray, a: float, b: float, c: float
) -> None:
    kernel = mixed_kernel(a, b, c)
    np.testing.assert_allclose(kernel.gram(x), kernel.gram(x, x.copy()), atol=1e-9)


@reproducible
@given(inputs(4), inputs(4), lengthscales, st.integers(-3, 3))
def test_full_turns_change_nothing_in_periodic_coordinates_only(
    x: FloatArray, y: FloatArray, a: float, turns: int
) -> None:
    kernel = mixed_kernel(a, 1.0, 1.0)
    turned = x + np.array([2.0 * np.pi * turns, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(kernel.gram(turned, y), kernel.gram(x, y), rtol=1e-9, atol=1e-12)
    shifted = x[:1] + np.array([0.0, 2.0 * np.pi, 0.0, 0.0])
    assert kernel.gram(shifted, x[:1])[0, 0] == pytest.approx(math.exp(-2.0 * math.pi**2))


def test_a_periodic_kernel_depends_on_the_shorter_arc() -> None:
    kernel = Kernel((Periodic((0,)),), np.array([0.5]))
    near, far = kernel.gram(np.array([[np.pi - 0.1]]), np.array([[-np.pi + 0.1], [0.0]]))[0]
    assert near == pytest.approx(periodic(0.2, 0.0, 0.5))
    assert far < 0.01 * near


@pytest.mark.parametrize("offset", [1e4, 1e6])
def test_a_large_common_offset_does_not_change_the_gram_matrix(offset: float) -> None:
    rng = np.random.default_rng(0)
    # Multiples of 2^-20, so that adding the offset rounds nothing away.
    x = np.round(rng.normal(size=(40, 3)) * 2**20) / 2**20
    kernel = Kernel(factors_of(3), np.array([0.5, 1.0, 2.0]))
    np.testing.assert_allclose(kernel.gram(x + offset), kernel.gram(x), atol=1e-8)
    np.testing.assert_allclose(
        kernel.gram(x[:9] + offset, x[9:] + offset), kernel.gram(x[:9], x[9:]), atol=1e-8
    )


def test_gaussian_gram_does_not_change_its_arguments() -> None:
    rng = np.random.default_rng(1)
    e, f = rng.normal(size=(6, 2)), rng.normal(size=(4, 2))
    before = e.copy(), f.copy()
    gaussian_gram(e)
    gaussian_gram(e, f)
    np.testing.assert_array_equal(e, before[0])
    np.testing.assert_array_equal(f, before[1])


@reproducible
@given(inputs(3), lengthscales)
def test_the_kernel_is_gaussian_in_the_embedding(x: FloatArray, lengthscale: float) -> None:
    kernel = Kernel((Periodic((2,)), SquaredExponential((0, 1))), np.array([lengthscale, 0.7]))
    e = kernel.embed(x)
    distances = ((e[:, None] - e) ** 2).sum(axis=2)
    np.testing.assert_allclose(np.exp(-0.5 * distances), kernel.gram(x), atol=1e-9)


def test_with_lengthscales_makes_a_new_kernel() -> None:
    kernel = Kernel(factors_of(1), np.array([1.0]))
    wider = kernel.with_lengthscales(np.array([3.0]))
    x, y = np.array([[0.0]]), np.array([[1.5]])
    assert wider.gram(x, y)[0, 0] == pytest.approx(squared_exponential(0.0, 1.5, 3.0))
    assert kernel.gram(x, y)[0, 0] == pytest.approx(squared_exponential(0.0, 1.5, 1.0))


def test_one_factor_per_column_periodic_where_named() -> None:
    assert factors_of(3, periodic=(1,)) == (
        SquaredExponential((0,)),
        Periodic((1,)),
        SquaredExponential((2,)),
    )


@reproducible
@given(inputs(2))
def test_squared_distances_of_a_squared_exponential(x: FloatArray) -> None:
    found = squared_distances(SquaredExponential((0, 1)).coordinates(x))
    wanted = ((x[:, None] - x) ** 2).sum(axis=2)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-11)
    np.testing.assert_array_equal(np.diagonal(found), 0.0)


def test_a_large_common_offset_does_not_change_squared_distances() -> None:
    x = np.round(np.random.default_rng(6).normal(size=(30, 2)) * 2**20) / 2**20
    wanted = squared_distances(x)
    np.testing.assert_allclose(squared_distances(x + 1e6), wanted, atol=1e-8)


@reproducible
@given(inputs(2))
def test_squared_distances_of_a_periodic_factor_are_those_of_chords(x: FloatArray) -> None:
    found = squared_distances(Periodic((1,)).coordinates(x))
    wanted = 4.0 * np.sin((x[:, None, 1] - x[:, 1]) / 2.0) ** 2
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_median_lengthscales_are_median_distances_between_pairs() -> None:
    rng = np.random.default_rng(2)
    x = np.column_stack([rng.uniform(-3, 3, 39), rng.normal(size=39), 5.0 * rng.normal(size=39)])
    factors = (Periodic((0,)), SquaredExponential((1, 2)))
    i, j = np.triu_indices(39, 1)  # an odd number of pairs, so that the median is one of them
    wanted = [
        np.median(np.abs(2.0 * np.sin((x[i, 0] - x[j, 0]) / 2.0))),
        np.median(np.hypot(x[i, 1] - x[j, 1], x[i, 2] - x[j, 2])),
    ]
    np.testing.assert_allclose(median_lengthscales(factors, x, rng), wanted, rtol=1e-9)


@pytest.mark.parametrize("value", [0.0, 0.1, -2.7, 1e6 + 0.1])
@pytest.mark.parametrize("rows", [1, 2, 7, 333])
def test_a_constant_column_gets_lengthscale_one(rows: int, value: float) -> None:
    rng = np.random.default_rng(3)
    x = np.column_stack([np.full(rows, value), rng.normal(size=rows)])
    found = median_lengthscales((SquaredExponential((0,)), Periodic((0,))), x, rng)
    np.testing.assert_array_equal(found, 1.0)


def test_lengthscales_are_raised_to_the_spread_of_chords_and_groups() -> None:
    """An angle held at pi, read on both sides of it, and one sample in ten elsewhere."""
    rest = np.where(np.arange(100) % 2 == 0, 3.1, -3.1)
    x = np.column_stack([rest, np.tile([-3.0, 3.0], 50), np.repeat([-4.0, 4.0], 50), rest])
    x[::10, 0] = 0.0
    factors = (Periodic((0,)), SquaredExponential((1, 2)), Periodic((3,)))
    kernel = Kernel(factors, np.array([0.01, 0.01, 0.5]))
    found = as_wide_as_spread(kernel, x)
    points = np.exp(1j * x[:, 0])  # root mean square distance from their mean, of points in a plane
    of_angle = np.sqrt(np.mean(np.abs(points - points.mean()) ** 2))
    assert of_angle == pytest.approx(0.6, abs=0.01) and np.std(x[:, 0]) > 2.0
    np.testing.assert_allclose(found.lengthscales, [of_angle, 5.0, 0.5], rtol=1e-12)
    assert found.factors == kernel.factors
    turned = x + 2.0 * np.pi * np.arange(100)[:, None] * [1, 0, 0, 1]
    again = as_wide_as_spread(kernel, turned).lengthscales
    np.testing.assert_allclose(again, found.lengthscales, rtol=1e-9)


def test_duplicates_do_not_change_median_lengthscales() -> None:
    rng = np.random.default_rng(4)
    x = rng.normal(size=(30, 2))
    many = np.concatenate([x, x, x])
    once = median_lengthscales(factors_of(2), x, rng)
    thrice = median_lengthscales(factors_of(2), many, rng)
    np.testing.assert_allclose(thrice, once, rtol=1e-9)
    # Two distinct values, almost all pairs of which are duplicates.
    binary = np.array([[0.0]] * 50 + [[3.0]])
    assert median_lengthscales(factors_of(1), binary, rng)[0] == pytest.approx(3.0)


def test_the_median_is_taken_over_a_random_sample_of_many_rows() -> None:
    x = np.random.default_rng(5).normal(size=(1000, 1))
    found = [
        median_lengthscales(factors_of(1), x, np.random.default_rng(seed), sample_size=100)[0]
        for seed in (0, 0, 1)
    ]
    assert found[0] == found[1] != found[2]
    # The median distance of two standard normals is 0.6745 sqrt 2.
    np.testing.assert_allclose(found, 0.954, rtol=0.15)


def test_duplicated_rows_in_many_coordinates_give_one_pivot() -> None:
    # Rounding grows with the number of coordinates.  If a diagonal entry were slightly below one in
    # whole columns but one in small blocks, duplicates would seem to have a residual.
    rng = np.random.default_rng(0)
    x = np.repeat(rng.normal(size=(150, 60)), 2, axis=0)
    kernel = Kernel((SquaredExponential(tuple(range(60))),), np.array([5.0]))
    found = pivoted_gaussian_gram(kernel.embed(x), tolerance=1e-12, max_rank=300)
    assert len(set((found.pivots // 2).tolist())) == len(found.pivots) <= 150
