"""Features of V (Eq. 3) from an RKHS basis and from a fixed grid."""

from __future__ import annotations

import numpy as np
import pytest

from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import Basis, RBFGrid, RKHSBasis
from kreps.kernels.kernel import Kernel, factors_of

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


def test_features_at_the_points_equal_those_that_fit_returns() -> None:
    points = states(250, 2)
    basis, features = RKHSBasis.fit(KERNEL, points, tolerance=1e-6, max_rank=400)
    np.testing.assert_allclose(basis.features(points), features, atol=1e-9)


def test_the_rank_is_limited_and_the_residual_is_reported() -> None:
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
    value = basis.function(theta)
    new = states(40, 7)
    np.testing.assert_allclose(value(new), basis.features(new) @ theta, atol=1e-8)
    np.testing.assert_allclose(value(states(200, 5)), features @ theta, atol=1e-8)


def test_the_squared_norm_of_the_value_function_is_that_of_theta() -> None:
    basis, features = RKHSBasis.fit(KERNEL, states(100, 8), tolerance=1e-4, max_rank=400)
    theta = np.random.default_rng(9).normal(size=(features.shape[1],))
    value = basis.function(theta)
    norm = value.alpha @ KERNEL.gram(value.centres) @ value.alpha
    assert norm == pytest.approx(theta @ theta, rel=1e-8)


def test_the_value_function_is_periodic_where_its_kernel_is() -> None:
    basis, features = RKHSBasis.fit(KERNEL, states(100, 10), tolerance=1e-4, max_rank=400)
    value = basis.function(np.ones(features.shape[1]))
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
    np.testing.assert_allclose(grid.function(theta)(new), wanted @ theta, atol=1e-12)


def test_the_lengthscale_of_a_grid_is_its_spacing() -> None:
    points = np.array([[0.3, -2.0], [5.0, 1.0], [-4.0, 4.0]])
    grid, features = RBFGrid.from_points(factors_of(2, periodic=(0,)), points, 4)
    assert features.shape == (3, 16)
    np.testing.assert_array_equal(features, grid.features(points))
    # The angle gets a whole turn without its end, the velocity the range of the data.
    np.testing.assert_allclose(np.unique(grid.centres[:, 0]), np.pi * np.array([0, 0.5, 1, 1.5]))
    np.testing.assert_allclose(np.unique(grid.centres[:, 1]), [-2.0, 0.0, 2.0, 4.0])
    assert len(np.unique(grid.centres, axis=0)) == 16
    # A neighbour in either direction is one lengthscale away, across the turn too.
    angle = grid.features(np.array([[1.5 * np.pi, 0.0], [2.0 * np.pi, 0.0]]))
    at = np.flatnonzero((grid.centres[:, 0] == 0.0) & (np.abs(grid.centres[:, 1]) < 1e-12))
    np.testing.assert_allclose(angle[:, at[0]], [np.exp(-0.5), 1.0])
    velocity = grid.features(np.array([[0.0, 2.0]]))
    np.testing.assert_allclose(velocity[:, at[0]], np.exp(-0.5))
    assert grid.residual == 0.0


@pytest.mark.parametrize("periodic", [(), (0,)])
@pytest.mark.parametrize("size", [1, 2, 5])
def test_a_grid_of_any_size_covers_the_data(size: int, periodic: tuple[int, ...]) -> None:
    points = np.random.default_rng(13).uniform(-1.0, 1.0, size=(50, 1))
    _, features = RBFGrid.from_points(factors_of(1, periodic), points, size)
    assert features.shape == (50, size)
    assert features.max(axis=1).min() > 0.1  # no point is far from all centres


def test_a_constant_coordinate_gets_lengthscale_one_in_a_grid() -> None:
    points = np.column_stack([np.full(9, 0.7), np.linspace(0.0, 1.0, 9)])
    grid, features = RBFGrid.from_points(factors_of(2), points, 3)
    assert np.isfinite(features).all()
    assert features.max(axis=1).min() > 0.5
    np.testing.assert_allclose(grid.kernel.lengthscales, [1.0, 0.5])


def test_a_grid_with_too_many_centres_is_rejected() -> None:
    with pytest.raises(ConfigurationError, match=r"9\^4 centres, but at most 4096.*kreps\.RKHS"):
        RBFGrid.from_points(factors_of(4), np.random.default_rng(14).normal(size=(5, 4)), 9)


def bases(points: FloatArray) -> dict[str, Basis]:
    """One of each kind, with sixteen features."""
    return {
        "pivoted": RKHSBasis.fit(KERNEL, points, tolerance=1e-4, max_rank=16)[0],
        "grid": RBFGrid.from_points(KERNEL.factors, points, 4)[0],
    }


@pytest.mark.parametrize("name", ["pivoted", "grid"])
@pytest.mark.parametrize("outputs", [(), (3,)])
def test_a_function_is_the_product_of_features_and_theta(
    outputs: tuple[int, ...], name: str
) -> None:
    basis, new = bases(states(80, 25))[name], states(30, 26)
    theta = np.random.default_rng(27).normal(size=(16, *outputs))
    value = basis.function(theta)(new)
    assert value.shape == (30, *outputs)
    np.testing.assert_allclose(value, basis.features(new) @ theta, atol=1e-8)


@pytest.mark.parametrize("name", ["pivoted", "grid"])
def test_an_empty_array_of_states_has_an_empty_array_of_features(name: str) -> None:
    # A chunk in which all samples have weight zero passes no states.
    assert bases(states(80, 25))[name].features(np.empty((0, 2))).shape == (0, 16)


@pytest.mark.parametrize("kind", ["kernel", "grid"])
def test_mean_features_are_those_of_pairs_of_states(kind: str) -> None:
    points, first, second = states(80, 12), states(7, 13), states(7, 14)
    basis: Basis
    if kind == "kernel":
        basis, _ = RKHSBasis.fit(KERNEL, points, tolerance=1e-3, max_rank=40)
    else:
        basis, _ = RBFGrid.from_points(KERNEL.factors, points, 4)
    wanted = 0.5 * (basis.features(first) + basis.features(second))
    np.testing.assert_allclose(basis.mean_features(first, second), wanted, rtol=1e-8, atol=1e-10)
