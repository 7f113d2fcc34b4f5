"""Subsampling: inclusion probabilities, unbiased weights, and systematic resampling."""

from __future__ import annotations

import numpy as np
import pytest

from kreps.kernels.arrays import FloatArray
from kreps.kernels.sampling import (
    effective_target_count,
    inclusion_probabilities,
    pps_subsample,
    systematic_resampling,
    uniform_subsample,
)


def heavy_tailed(n: int = 1500) -> FloatArray:
    return np.random.default_rng(0).standard_normal(n) ** 6


# ---- uniform ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "size", "count"), [(0, 5, 0), (5, 5, 5), (6, 5, 5), (300, 40, 40)])
def test_a_uniform_subsample_has_different_rows_in_order(n: int, size: int, count: int) -> None:
    rows = uniform_subsample(n, np.random.default_rng(0), size)
    assert len(rows) == count
    assert (np.diff(rows) > 0).all()
    assert np.isin(rows, np.arange(n)).all()


def test_every_row_is_in_a_uniform_subsample_equally_often() -> None:
    rng = np.random.default_rng(1)
    counts = sum(np.bincount(uniform_subsample(20, rng, 5), minlength=20) for _ in range(4000))
    np.testing.assert_allclose(counts / 4000.0, 0.25, atol=5 * np.sqrt(0.25 * 0.75 / 4000.0))


def test_hyper_parameters_are_fitted_to_two_hundred_rows_by_default() -> None:
    assert len(uniform_subsample(1000, np.random.default_rng(2))) == 200
    assert len(pps_subsample(np.ones(1000), np.random.default_rng(2))[0]) == 200


# ---- proportional to size ---------------------------------------------------------------------


def test_all_rows_are_taken_if_there_are_no_more_than_the_size() -> None:
    rows, weights = pps_subsample(heavy_tailed(50), np.random.default_rng(0), 50)
    np.testing.assert_array_equal(rows, np.arange(50))
    np.testing.assert_array_equal(weights, 1.0)


@pytest.mark.parametrize("squares", [heavy_tailed(), np.ones(777), np.zeros(777)])
def test_weighted_sums_are_unbiased_estimates_of_those_over_all_rows(squares: FloatArray) -> None:
    summed = np.cos(np.arange(len(squares))) ** 2 + squares
    found = []
    for seed in range(400):
        rows, weights = pps_subsample(squares, np.random.default_rng(seed))
        assert len(np.unique(rows)) == len(rows) and abs(len(rows) - 200) <= 1
        found.append(weights @ summed[rows])
    error = np.std(found) / np.sqrt(len(found))
    assert np.mean(found) == pytest.approx(summed.sum(), abs=4.0 * error + 1e-9)


def test_rare_large_targets_are_never_missed() -> None:
    squares = np.full(1500, 1e-4)
    rare = np.array([3, 700, 1499])
    squares[rare] = 100.0
    for seed in range(20):
        rows, weights = pps_subsample(squares, np.random.default_rng(seed))
        assert np.isin(rare, rows).all()
        np.testing.assert_array_equal(weights[np.isin(rows, rare)], 1.0)


def test_half_of_the_inclusion_probability_is_uniform() -> None:
    # A row without a target has the probability 0.5 size / n, here 0.1, and so a weight of ten.
    squares = np.append(np.ones(500), np.zeros(500))
    rows, weights = pps_subsample(squares, np.random.default_rng(5), 200)
    np.testing.assert_allclose(weights[rows >= 500], 10.0)
    np.testing.assert_allclose(weights[rows < 500], 1.0 / (0.1 + 0.2))


@pytest.mark.parametrize("count", [1, 10, 99])
def test_inclusion_probabilities_are_proportional_where_they_are_below_one(count: int) -> None:
    share = np.random.default_rng(1).exponential(size=100) ** 3
    share /= share.sum()
    found = inclusion_probabilities(share, count)
    assert found.sum() == pytest.approx(count)
    assert found.max() <= 1.0
    free = found < 1.0
    np.testing.assert_allclose(found[free] / share[free], (found[free] / share[free])[0])
    assert not free.all() or count < 1.0 / share.max()


def test_the_effective_count_is_the_number_of_rows_with_targets() -> None:
    squares = np.array([4.0, 4.0, 4.0, 0.0, 0.0])
    assert effective_target_count(squares, np.ones(5)) == pytest.approx(3.0)
    weights = np.array([2.0, 2.0, 2.0, 1.0, 9.0])
    assert effective_target_count(squares, weights) == pytest.approx(6.0)
    assert effective_target_count(1e-200 * squares, np.ones(5)) == pytest.approx(3.0)
    assert effective_target_count(np.zeros(5), np.full(5, 2.0)) == pytest.approx(10.0)


def test_unequal_targets_count_less() -> None:
    # (4 + 1)^2 / (4^2 + 1^2)
    assert effective_target_count(np.array([4.0, 1.0]), np.ones(2)) == pytest.approx(25.0 / 17.0)


# ---- systematic resampling --------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 7, 40, 1000])
@pytest.mark.parametrize("seed", range(5))
def test_rows_are_drawn_as_often_as_expected_to_the_next_whole_number(
    seed: int, count: int
) -> None:
    rng = np.random.default_rng(seed)
    p = np.exp(3.0 * rng.normal(size=30))
    p[rng.uniform(size=30) < 0.3] = 0.0
    p /= p.sum()
    rows = systematic_resampling(p, count, rng)
    assert len(rows) == count
    assert (np.diff(rows) >= 0).all()
    counts = np.bincount(rows, minlength=30)
    assert (counts >= np.floor(count * p - 1e-9)).all()
    assert (counts <= np.ceil(count * p + 1e-9)).all()
    assert not counts[p == 0.0].any()


def test_resampling_is_unbiased() -> None:
    rng = np.random.default_rng(0)
    p = np.array([0.5, 0.03, 0.17, 0.3])
    counts = sum(np.bincount(systematic_resampling(p, 7, rng), minlength=4) for _ in range(4000))
    # Each count is one of two neighbours: a standard deviation of at most one half.
    np.testing.assert_allclose(counts / 4000.0, 7.0 * p, atol=5 * 0.5 / np.sqrt(4000.0))


def test_probabilities_need_not_sum_to_one() -> None:
    p = np.array([0.1, 0.2, 0.3])
    one, other = (
        systematic_resampling(scale * p, 60, np.random.default_rng(1)) for scale in (1.0, 1e-3)
    )
    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(np.bincount(one), [10, 20, 30])
