"""Eq. 3: features of V from an RKHS basis and from a fixed grid."""

from __future__ import annotations

import numpy as np
import pytest

from kreps.arrays import FloatArray
from kreps.kernels import Kernel, factors_of
from kreps.value import RBFGrid, RKHSBasis

KERNEL = Kernel(factors_of(2, periodic=(0,)), np.array([1.0, 1.5]))


def states(n: int, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-np.pi, np.pi, n), rng.normal(size=n)])


@pytest.mark.parametrize("tolerance", [1e-2, 1e-6])
def test_inner_products_of_features_reproduce_the_kernel(tolerance: float) -> None:
    points = states(300, 0)
    basis, features = RKHSBasis.fit(KERNEL, points, tolerance=tolerance, max_rank=300)
    assert basis.residual <= tolerance
    assert np.abs(features @ features.T - KERNEL.gram(points)).max() <= tolerance + 1e-11
    # New states among the old ones are represented nearly as well.
    new = basis.features(states(50, 1))
    gram = KERNEL.gram(states(50, 1))
    assert np.diagonal(gram - new @ new.T).min() > -1e-10
    assert np.median(np.abs(gram - new @ new.T)) <= tolerance


def test_features_at_the_points_are_those_that_were_fitted() -> None:
    points = states(250, 2)
    basis, features = RKHSBasis.fit(KERNEL, points, tolerance=1e-6, max_rank=400)
    np.testing.assert_allclose(basis.features(points), features, atol=1e-9)


def test_the_rank_is_capped_and_the_residual_says_what_is_missing() -> None:
    points = states(250, 3)
    basis, features = RKHSBasis.fit(KERNEL, points, tolerance=1e-6, max_rank=10)
    assert features.shape == (250, 10)
    assert basis.pivots.shape == (10, 2)
    missing = np.diagonal(KERNEL.gram(points) - features @ features.T).max()
    assert basis.residual == pytest.approx(missing, abs=1e-12)
    assert basis.residual > 1e-6


def test_duplicated_states_add_no_feature() -> None:
    points = states(30, 4)
    _, once = RKHSBasis.fit(KERNEL, points, tolerance=1e-6, max_rank=400)
    basis, thrice = RKHSBasis.fit(KERNEL, np.tile(points, (3, 1)), tolerance=1e-6, max_rank=400)
    assert len(np.unique(basis.pivots, axis=0)) == len(basis.pivots) <= 30
    assert abs(thrice.shape[1] - once.shape[1]) <= 2  # the order of pivots may differ


def test_the_value_function_is_the_product_of_features_and_theta() -> None:
    basis, features = RKHSBasis.fit(KERNEL, states(200, 5), tolerance=1e-5, max_rank=400)
    theta = np.random.default_rng(6).normal(size=(features.shape[1],))
    value = basis.value_function(theta)
    new = states(40, 7)
    np.testing.assert_allclose(value(new), basis.features(new) @ theta, atol=1e-8)
    np.testing.assert_allclose(value(states(200, 5)), features @ theta, atol=1e-8)


def test_the_squared_norm_of_the_value_function_is_that_of_theta() -> None:
    basis, features = RKHSBasis.fit(KERNEL, states(100, 8), tolerance=1e-4, max_rank=400)
    theta = np.random.default_rng(9).normal(size=(features.shape[1],))
    value = basis.value_function(theta)
    norm = value.alpha @ KERNEL.gram(value.centres) @ value.alpha
    assert norm == pytest.approx(theta @ theta, rel=1e-8)


def test_the_value_function_is_periodic_where_its_kernel_is() -> None:
    basis, features = RKHSBasis.fit(KERNEL, states(100, 10), tolerance=1e-4, max_rank=400)
    value = basis.value_function(np.ones(features.shape[1]))
    new = states(20, 11)
    turn = 2.0 * np.pi * np.eye(2)
    np.testing.assert_allclose(value(new + turn[0]), value(new), atol=1e-7)
    assert not np.allclose(value(new + turn[1]), value(new))


def test_a_grid_of_radial_basis_functions() -> None:
    centres = np.array([[0.0, 0.0], [1.0, -1.0], [np.pi, 2.0]])
    grid = RBFGrid(KERNEL, centres)
    new = states(15, 12)
    wanted = np.array(
        [
            [
                np.exp(-2.0 * np.sin((s[0] - c[0]) / 2.0) ** 2 / 1.0**2)
                * np.exp(-((s[1] - c[1]) ** 2) / (2.0 * 1.5**2))
                for c in centres
            ]
            for s in new
        ]
    )
    np.testing.assert_allclose(grid.features(new), wanted, atol=1e-12)
    theta = np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(grid.value_function(theta)(new), wanted @ theta, atol=1e-12)
