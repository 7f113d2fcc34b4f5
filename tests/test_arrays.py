"""Other array libraries give the same numbers, and no NumPy array is mixed with theirs.

`array_api_strict` implements only the array API standard, and raises where its arrays are combined
with NumPy's or with those of another device.  Everything here is computed on its second device.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import array_api_strict
import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.algorithms.dual import Moments
from kreps.algorithms.report import UpdateInfo
from kreps.data.compute import Compute
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.errors import NumericalError
from kreps.kernels.arrays import (
    Array,
    FloatArray,
    as_float,
    as_numpy,
    columns,
    like,
    namespace,
    rows,
)
from kreps.kernels.basis import Basis, RBFGrid, RKHSBasis
from kreps.kernels.gram import gaussian_gram
from kreps.kernels.kernel import (
    Factor,
    Kernel,
    Periodic,
    SmoothedImage,
    SquaredExponential,
    WrapAngle,
    factors_of,
)
from kreps.kernels.linalg import cholesky, solve_lower, solve_lower_transposed, with_diagonal
from kreps.kernels.regression import FeatureRegression, KernelEmbedding, RegressionSums
from kreps.learning.collect import collect
from kreps.policies.exploration import BangBang
from kreps.policies.sparse_gp import PolicySums

DEVICE = array_api_strict.Device("device1")
TASK = TaskSpec(2, [-30.0], [30.0], (0,))  # type: ignore[arg-type]
KERNEL = Kernel(factors_of(2, periodic=(0,)), np.array([1.0, 1.5]))


def strict(values: FloatArray) -> Array:
    return array_api_strict.asarray(values, device=DEVICE)


def is_strict(array: Array) -> bool:
    return isinstance(array, array_api_strict.asarray(0.0).__class__) and array.device == DEVICE


def assert_agree(found: Array, wanted: FloatArray, tolerance: float = 1e-12) -> None:
    """That ``found`` is on the strict device, with the numbers of ``wanted`` to rounding."""
    assert is_strict(found)
    assert found.dtype == array_api_strict.float64
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(as_numpy(found), wanted, rtol=0.0, atol=tolerance * scale)


def normal(*shape: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(size=shape)


# ---- conversions ------------------------------------------------------------------------------


def test_the_strict_library_does_not_mix_arrays() -> None:
    with pytest.raises((TypeError, ValueError)):
        strict(np.ones(2)) + np.ones(2)
    with pytest.raises((TypeError, ValueError)):
        strict(np.ones(2)) + array_api_strict.asarray(np.ones(2))
    with pytest.raises(RuntimeError):
        np.asarray(strict(np.ones(2)))


def test_numpy_arrays_are_not_copied() -> None:
    a = normal(3, 2)
    assert as_float(a) is a and as_numpy(a) is a and like(a, a) is a
    assert namespace(a) is np
    assert as_float([1, 2]).dtype == np.float64


def test_arrays_are_copied_to_a_device_and_back() -> None:
    a = normal(4, 3)
    there = like(a, strict(np.zeros(1)))
    assert is_strict(there)
    assert is_strict(like(np.asfortranarray(a), there))
    back = as_numpy(there)
    assert type(back) is np.ndarray and back.dtype == np.float64
    np.testing.assert_array_equal(back, a)


def test_rows_and_columns_can_be_taken_in_any_order_and_repeatedly() -> None:
    a = normal(4, 3)
    chosen = np.array([2, 0, 0, 3])
    assert_agree(rows(strict(a), chosen), a[chosen])
    assert_agree(columns(strict(a), (2, 0, 0)), a[:, [2, 0, 0]])
    assert rows(strict(a), np.array([], dtype=np.intp)).shape == (0, 3)


# ---- kernels and linear algebra ---------------------------------------------------------------


@pytest.mark.parametrize(
    "factor",
    [
        SquaredExponential((0, 2)),
        Periodic((1,)),
        WrapAngle((1,), 0.5),
        SmoothedImage(tuple(range(12)), (3, 4)),
    ],
    ids=lambda factor: type(factor).__name__,
)
def test_factors_have_the_same_coordinates(factor: Factor) -> None:
    x = normal(9, 12)
    assert_agree(factor.coordinates(strict(x)), factor.coordinates(x))
    kernel = Kernel((factor, SquaredExponential((3,))), np.array([0.7, 2.0]))
    assert_agree(kernel.embed(strict(x)), kernel.embed(x))


def test_gram_matrices_agree_and_have_a_diagonal_of_one() -> None:
    x, y = normal(20, 2), normal(7, 2, seed=1)
    assert_agree(gaussian_gram(strict(x), strict(y)), gaussian_gram(x, y))
    found = gaussian_gram(strict(x))
    assert_agree(found, gaussian_gram(x))
    np.testing.assert_allclose(np.diagonal(as_numpy(found)), 1.0, atol=1e-14)
    assert_agree(KERNEL.gram(strict(x), strict(y)), KERNEL.gram(x, y))
    wide = strict(1e3 * x)  # where rounding makes some squared distances negative
    assert as_numpy(gaussian_gram(wide)).max() <= 1.0


def test_the_arguments_of_a_gram_matrix_are_not_changed() -> None:
    x = normal(5, 2)
    there = strict(x)
    KERNEL.gram(there)
    np.testing.assert_array_equal(as_numpy(there), x)


def test_cholesky_factors_and_their_solutions_agree() -> None:
    half = normal(15, 15)
    a = half @ half.T + 0.1 * np.eye(15)
    here, there = cholesky(a), cholesky(strict(a))
    assert there.jitter == 0.0
    assert_agree(there.lower, here.lower)
    for b in (normal(15, seed=1), normal(15, 1, seed=2), normal(15, 6, seed=3)):
        assert_agree(there.solve(strict(b)), here.solve(b), 1e-10)
        for solve in (solve_lower, solve_lower_transposed):
            assert_agree(solve(there.lower, strict(b)), solve(here.lower, b), 1e-10)


def test_adding_to_a_diagonal_makes_a_copy() -> None:
    a = normal(4, 4)
    there = strict(a)
    assert_agree(with_diagonal(there, 0.5), a + 0.5 * np.eye(4))
    np.testing.assert_array_equal(as_numpy(there), a)


@pytest.mark.parametrize("eigenvalue", [-3e-13, -3e-9, -3e-7])
def test_the_same_jitter_is_added_and_reported(eigenvalue: float) -> None:
    a = np.diag(np.append(np.ones(9), eigenvalue))
    there = cholesky(strict(a))
    assert there.jitter == cholesky(a).jitter > 0.0
    product = as_numpy(there.lower @ there.lower.T)
    np.testing.assert_allclose(product, a + there.jitter * np.eye(10), atol=1e-14)


@pytest.mark.parametrize(
    "a",
    [np.diag([1.0, 1.0, -0.1]), np.zeros((3, 3)), np.full((2, 2), np.nan), np.diag([np.inf, 1.0])],
    ids=["indefinite", "zero", "nan", "infinite"],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_matrix_that_cannot_be_factorised_raises(a: FloatArray) -> None:
    with pytest.raises(NumericalError):
        cholesky(strict(a))


# ---- the parts of an update -------------------------------------------------------------------


@pytest.mark.parametrize("regulariser", [0.05, 1.0])
def test_embeddings_agree(regulariser: float) -> None:
    x, queries, successors = normal(30, 2), normal(5, 2, seed=1), normal(30, 4, seed=2)
    here = KernelEmbedding.fit(KERNEL, x, regulariser)
    there = KernelEmbedding.fit(KERNEL, strict(x), regulariser)
    # K + lambda I has a condition number of up to 1e3, which costs three digits.
    found = there.expected_features(strict(successors))
    assert_agree(found, here.expected_features(successors), 1e-10)
    for q in (queries, queries[:1]):
        assert_agree(there.strengths(strict(q)), here.strengths(q), 1e-10)


def bases() -> dict[str, Basis]:
    points = normal(60, 2, seed=3)
    return {
        "pivoted": RKHSBasis.fit(KERNEL, points, tolerance=1e-4, max_rank=12)[0],
        "grid": RBFGrid.from_points(KERNEL.factors, points, 4)[0],
    }


@pytest.mark.parametrize("name", bases())
@pytest.mark.parametrize("outputs", [(), (3,)])
def test_features_and_functions_agree(outputs: tuple[int, ...], name: str) -> None:
    basis, states = bases()[name], normal(20, 2, seed=6)
    # The condition number of the pivots' Gram matrix costs some digits.
    for x in (states, states[:1]):
        assert_agree(basis.features(strict(x)), basis.features(x), 1e-10)
    assert basis.features(strict(states[:0])).shape == (0, basis.features(states).shape[1])
    theta = normal(basis.features(states).shape[1], *outputs, seed=7)
    value = basis.function(theta)
    assert_agree(value(strict(states)), value(states), 1e-10)


@pytest.mark.parametrize("eta", [0.1, 5.0])
@pytest.mark.parametrize("with_covariance", [True, False])
def test_moments_agree_and_are_numpys(with_covariance: bool, eta: float) -> None:
    delta, b = normal(40), normal(40, 6, seed=1)
    here = Moments.from_rows(delta, b, eta, with_covariance=with_covariance)
    there = Moments.from_rows(strict(delta), strict(b), eta, with_covariance=with_covariance)
    for name in ("max_delta", "log_mass", "mean_delta", "kl", "soft_maximum"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), rel=1e-12)
    assert type(there.mean_row) is np.ndarray
    np.testing.assert_allclose(there.mean_row, here.mean_row, rtol=1e-10)
    if with_covariance:
        assert type(there.covariance) is np.ndarray
        np.testing.assert_allclose(there.covariance, here.covariance, atol=1e-12)
    else:
        assert there.covariance is None


def test_sums_agree_and_are_numpy_arrays() -> None:
    psi, targets, weights = normal(40, 6), normal(40, 3, seed=1), np.abs(normal(40, seed=2))
    here = RegressionSums.from_samples(psi, targets)
    there = RegressionSums.from_samples(strict(psi), strict(targets))
    policy_here = PolicySums.from_samples(psi, weights, targets)
    policy_there = PolicySums.from_samples(strict(psi), strict(weights), strict(targets))
    for found, wanted in [
        (there.gram, here.gram),
        (there.product, here.product),
        (policy_there.precision, policy_here.precision),
        (policy_there.weighted_targets, policy_here.weighted_targets),
    ]:
        assert type(found) is np.ndarray
        np.testing.assert_allclose(found, wanted, atol=1e-12)


@pytest.mark.parametrize("name", bases())
def test_regressions_agree(name: str) -> None:
    basis, inputs = bases()[name], normal(50, 2, seed=8)
    targets = normal(50, 3, seed=9)
    sums = RegressionSums.from_samples(basis.features(strict(inputs)), strict(targets))
    found = FeatureRegression.fit(basis, sums, 0.1)
    wanted = FeatureRegression.fit(
        basis, RegressionSums.from_samples(basis.features(inputs), targets), 0.1
    )
    assert_agree(found.mean(strict(inputs)), wanted.mean(inputs), 1e-9)


# ---- a whole update ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rollouts() -> list[Rollout]:
    return collect(
        gym.make("kreps/SwingUp-v0"),
        TASK,
        BangBang(TASK),
        6,
        seed=1,
        iteration=0,
        restart_probability=0.02,
    )


def updated(
    rollouts: list[Rollout],
    to_device: Callable[[FloatArray], Array] = as_float,
    task: TaskSpec = TASK,
    **settings: Any,
) -> tuple[kreps.KREPS, UpdateInfo]:
    """An update of low rank from chunks of about 100 steps, so that the dual is streamed too."""
    learner = kreps.KREPS(task, compute=Compute(to_device=to_device), **settings)
    info = learner.update(Dataset.from_rollouts(rollouts, chunk_size=100))
    assert isinstance(info, UpdateInfo)
    return learner, info


def assert_same_update(
    found: tuple[kreps.KREPS, UpdateInfo],
    wanted: tuple[kreps.KREPS, UpdateInfo],
    states: FloatArray,
) -> None:
    """Weights and V agree to rounding, the policy as far as the choice of its pivots permits."""
    # Measured: up to 4e-7 (of the smallest weights) and 2e-8, as bases of 60 to 300 features are
    # ill-conditioned.
    weights, wanted_weights = found[1].dual.weights, wanted[1].dual.weights
    np.testing.assert_allclose(weights, wanted_weights, rtol=2e-6, atol=1e-14)
    v, truth = (each[0].value_function(states) for each in (found, wanted))
    np.testing.assert_allclose(v, truth, rtol=0.0, atol=1e-7 * np.ptp(truth))
    found_policy, policy = (each[0].policy.process for each in (found, wanted))
    # In units of the actions, which go to 30; measured: up to 6e-7.
    np.testing.assert_allclose(found_policy.greedy(states), policy.greedy(states), atol=1e-5)
    np.testing.assert_allclose(
        found_policy.standard_deviation(states), policy.standard_deviation(states), atol=1e-5
    )


# The policy has nearly all samples as centres, so that it hardly matters which of them are pivots.
# With at most 200 samples in memory, sums over all samples differ from sums over those.
SETTINGS: dict[str, Any] = {
    "preset": "single_step",
    "value": kreps.RKHS(max_rank=60, tolerance=1e-9),
    "low_rank": kreps.LowRank(rank=300, above=0, subsample=200),
}
VARIANTS: list[dict[str, Any]] = [
    {},
    {"model": "embedding"},
    {"model": "sample"},
    {"value": kreps.Grid(6)},
    {"preset": "model_based"},
]


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_an_update_in_another_library_is_the_same(
    variant: dict[str, Any], rollouts: list[Rollout]
) -> None:
    settings = SETTINGS | variant
    seen: list[Array] = []

    def to_device(values: FloatArray) -> Array:
        seen.append(strict(values))
        return seen[-1]

    wanted = updated(rollouts, **settings)
    found = updated(rollouts, to_device, **settings)
    states = np.concatenate([r.observations for r in rollouts])
    assert_same_update(found, wanted, states)
    assert sum(each.shape[0] for each in seen) > len(states)
    for array in (found[1].dual.weights, found[0].value_function(states)):
        assert type(array) is np.ndarray


def test_an_update_from_images_in_another_library_is_the_same() -> None:
    env = gym.make("kreps/ImageSwingUp-v0")
    task = kreps.KREPS(env).task
    given = collect(
        env.unwrapped,  # type: ignore[arg-type]
        task,
        BangBang(task),
        5,
        seed=1,
        iteration=0,
        restart_probability=0.02,
    )
    # the hyper-parameters that the search chose for images
    settings: dict[str, Any] = {"kl_bound": 0.5, "ridge": 0.01, "eta_floor": 0.02}
    settings |= {"preset": "single_step", "low_rank": kreps.LowRank(above=0, subsample=200)}
    weights = [
        updated(given, to_device, task, **settings)[1].dual.weights
        for to_device in (as_float, strict)
    ]
    assert len(weights[0]) > 200
    np.testing.assert_allclose(weights[1], weights[0], rtol=1e-7, atol=1e-12)


def test_an_update_in_pytorch_is_the_same(rollouts: list[Rollout]) -> None:
    torch = pytest.importorskip("torch")

    def to_device(values: FloatArray) -> Array:
        return torch.asarray(values)

    found = updated(rollouts, to_device, **SETTINGS)
    states = np.concatenate([r.observations for r in rollouts])
    assert_same_update(found, updated(rollouts, **SETTINGS), states)
    with pytest.raises(NumericalError):
        cholesky(torch.asarray(np.diag([1.0, -1.0])))
    ones = cholesky(torch.ones((5, 5), dtype=torch.float64))
    assert ones.jitter == cholesky(np.ones((5, 5))).jitter > 0.0
