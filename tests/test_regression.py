"""Conditional embeddings (Eq. 4) against dense solves, refits, and a system with known moments."""

from __future__ import annotations

from functools import reduce
from operator import add

import numpy as np
import pytest

from kreps.kernels import basis
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel, Periodic, SquaredExponential, factors_of
from kreps.kernels.regression import (
    FeatureRegression,
    KernelEmbedding,
    LeaveOneOut,
    PivotedEmbedding,
    RegressionSums,
)


def fitted(n: int, seed: int, regulariser: float) -> tuple[KernelEmbedding, FloatArray]:
    """An embedding over an angle, a velocity and an action, and features of n successors."""
    rng = np.random.default_rng(seed)
    inputs = np.column_stack(
        [rng.uniform(-np.pi, np.pi, n), rng.normal(size=n), rng.uniform(-1, 1, n)]
    )
    factors = (Periodic((0,)), SquaredExponential((1,)), SquaredExponential((2,)))
    kernel = Kernel(factors, np.array([0.8, 1.2, 0.9]))
    return KernelEmbedding.fit(kernel, inputs, regulariser), rng.normal(size=(n, 6))


@pytest.mark.parametrize("regulariser", [1e-3, 0.1, 1.0])
def test_strengths_solve_the_regularised_system(regulariser: float) -> None:
    model, _ = fitted(40, 0, regulariser)
    queries = np.random.default_rng(1).normal(size=(7, 3))
    gram = model.kernel.gram(model.inputs) + regulariser * np.eye(40)
    wanted = np.linalg.solve(gram, model.kernel.gram(model.inputs, queries))
    np.testing.assert_allclose(model.strengths(queries), wanted, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("regulariser", [1e-3, 0.1, 1.0])
def test_expected_features_are_the_combination_with_those_strengths(regulariser: float) -> None:
    model, successors = fitted(40, 2, regulariser)
    combined = model.strengths(model.inputs).T @ successors
    np.testing.assert_allclose(model.expected_features(successors), combined, atol=1e-9)


def test_expected_features_equal_a_dense_solve() -> None:
    model, successors = fitted(60, 3, 0.05)
    k = model.kernel.gram(model.inputs)
    wanted = k @ np.linalg.inv(k + 0.05 * np.eye(60)) @ successors
    np.testing.assert_allclose(model.expected_features(successors), wanted, atol=1e-9)
    assert model.factor.jitter == 0.0


def test_expected_features_does_not_change_its_argument() -> None:
    model, successors = fitted(20, 4, 0.1)
    before = successors.copy()
    model.expected_features(successors)
    np.testing.assert_array_equal(successors, before)


def test_the_regulariser_shrinks_a_single_sample() -> None:
    kernel = Kernel(factors_of(1), np.array([1.0]))
    model = KernelEmbedding.fit(kernel, np.array([[0.0]]), 0.25)
    found = model.expected_features(np.array([[2.0, -1.0]]))
    np.testing.assert_allclose(found, [[2.0 / 1.25, -1.0 / 1.25]])


def test_duplicated_inputs_share_the_mean_of_their_successors() -> None:
    kernel = Kernel(factors_of(1), np.array([1.0]))
    model = KernelEmbedding.fit(kernel, np.zeros((4, 1)), 1e-6)
    found = model.expected_features(np.array([[0.0], [2.0], [4.0], [6.0]]))
    np.testing.assert_allclose(found, 3.0, rtol=1e-5)


def test_the_conditional_expectation_is_learnt_from_noisy_successors() -> None:
    """``s' = sin(2 s) + a + noise``: means of s' and s'^2, known in closed form."""

    def errors(n: int) -> tuple[float, float, float]:
        rng = np.random.default_rng(6)
        s, a = rng.uniform(-2, 2, n), rng.uniform(-1, 1, n)
        mean = np.sin(2.0 * s) + a
        successor = mean + rng.normal(0.0, 0.5, n)
        observed = np.column_stack([successor, successor**2])
        truth = np.column_stack([mean, mean**2 + 0.25])
        inputs = np.column_stack([s, a])
        model = KernelEmbedding.fit(Kernel(factors_of(2), np.array([0.6, 1.0])), inputs, 0.5)
        # New inputs well inside the data.
        query = np.column_stack([rng.uniform(-1.5, 1.5, 200), rng.uniform(-0.8, 0.8, 200)])
        there = np.sin(2.0 * query[:, 0]) + query[:, 1]
        predicted = model.strengths(query).T @ observed
        return (
            float(np.mean((model.expected_features(observed) - truth) ** 2)),
            float(np.mean((predicted - np.column_stack([there, there**2 + 0.25])) ** 2)),
            float(np.mean((observed - truth) ** 2)),
        )

    few, several, many = errors(40), errors(200), errors(1000)
    # Measured: 0.43, 0.12, 0.026 at the samples.  That of observed successors stays at the noise.
    assert few[0] > 2.0 * several[0] > 4.0 * many[0]
    assert few[1] > 2.0 * several[1] > 4.0 * many[1]
    assert many[0] < 0.1 * many[2]


@pytest.mark.parametrize("regulariser", [1e-3, 0.1, 1.0])
def test_leave_one_out_errors_are_those_of_refits(regulariser: float) -> None:
    model, targets = fitted(25, 14, regulariser)
    wanted = []
    for i in range(25):
        rest = np.arange(25) != i
        refit = KernelEmbedding.fit(model.kernel, model.inputs[rest], regulariser)
        prediction = refit.strengths(model.inputs[i : i + 1]).T @ targets[rest]
        wanted.append(targets[i] - prediction[0])
    found = model.leave_one_out(targets)
    np.testing.assert_array_equal(found.targets, targets)
    np.testing.assert_allclose(found.errors, wanted, atol=1e-9)
    squares = np.sum(np.square(wanted), axis=1)
    assert found.mean_square == pytest.approx(squares.mean())
    assert found.relative == pytest.approx(np.sqrt(squares.sum() / np.sum(targets**2)))


def test_predicting_zero_has_a_relative_error_of_one() -> None:
    targets = np.random.default_rng(15).normal(size=(7, 3))
    assert LeaveOneOut(targets, targets).relative == pytest.approx(1.0)
    assert LeaveOneOut(targets, np.zeros((7, 3))).relative == 0.0
    nothing = np.zeros((7, 3))
    assert (LeaveOneOut(nothing, nothing).relative, LeaveOneOut(nothing, nothing).mean_square) == (
        0.0,
        0.0,
    )


@pytest.mark.parametrize("regulariser", [1e-3, 1.0])
def test_the_predictor_extends_the_expectation_at_the_samples(regulariser: float) -> None:
    model, targets = fitted(40, 16, regulariser)
    predict = model.predictor(targets)
    np.testing.assert_allclose(predict(model.inputs), model.expected_features(targets), atol=1e-9)
    queries = np.random.default_rng(17).normal(size=(9, 3))
    np.testing.assert_allclose(predict(queries), model.strengths(queries).T @ targets, atol=1e-9)
    far = np.array([[0.0, 80.0, 0.0]])
    np.testing.assert_array_equal(predict(far), np.zeros((1, 6)))  # the prediction tends to zero


@pytest.mark.parametrize("count", [0, 1, 7, 8, 30])
def test_predictions_in_batches_are_those_at_once(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(basis, "PREDICTION_BATCH", 8)
    model, targets = fitted(20, 21, 0.05)
    queries = np.random.default_rng(22).normal(size=(count, 3))
    found = model.predictor(targets)(queries)
    assert found.shape == (count, targets.shape[1])
    np.testing.assert_allclose(found, model.strengths(queries).T @ targets, atol=1e-9)


# ---- in features of states and actions --------------------------------------------------------


@pytest.mark.parametrize("copies", [1, 4])
@pytest.mark.parametrize("regulariser", [1e-3, 1.0])
def test_leave_one_out_errors_of_a_regression_are_those_of_refits(
    regulariser: float, copies: int
) -> None:
    """Each row stands for ``copies`` samples, one of which is left out."""
    rng = np.random.default_rng(18)
    psi, targets = rng.normal(size=(20, 6)), rng.normal(size=(20, 3))
    wanted = []
    for i in range(20):
        count = np.full(20, float(copies))
        count[i] -= 1.0
        gram = psi.T @ (count[:, None] * psi) + regulariser * np.eye(6)
        coefficients = np.linalg.solve(gram, psi.T @ (count[:, None] * targets))
        wanted.append(targets[i] - psi[i] @ coefficients)
    found = FeatureRegression.leave_one_out(psi, targets, regulariser, float(copies))
    np.testing.assert_array_equal(found.targets, targets)
    np.testing.assert_allclose(found.errors, wanted, atol=1e-9)


def test_leave_one_out_errors_on_all_features_are_those_of_the_embedding() -> None:
    model, targets = fitted(40, 19, 0.05)
    _, psi = RKHSBasis.fit(model.kernel, model.inputs, tolerance=1e-14, max_rank=40)
    found = FeatureRegression.leave_one_out(psi, targets, 0.05)
    np.testing.assert_allclose(found.errors, model.leave_one_out(targets).errors, atol=1e-8)


@pytest.mark.parametrize("regulariser", [1e-2, 1.0])
def test_regression_on_all_features_is_the_kernel_embedding(regulariser: float) -> None:
    model, successors = fitted(60, 7, regulariser)
    basis, _ = RKHSBasis.fit(model.kernel, model.inputs, tolerance=1e-14, max_rank=60)
    sums = RegressionSums.from_samples(basis.features(model.inputs), successors)
    found = FeatureRegression.fit(basis, sums, regulariser)
    assert found.jitter == 0.0
    # K + lambda I has a condition number of up to 1e4, which costs four digits.
    np.testing.assert_allclose(
        found.mean(model.inputs), model.expected_features(successors), atol=1e-8
    )
    queries = np.random.default_rng(9).normal(size=(7, 3))
    wanted = model.strengths(queries).T @ successors
    np.testing.assert_allclose(found.mean(queries), wanted, atol=1e-8)


def test_regression_on_few_features_is_the_embedding_of_their_kernel() -> None:
    model, successors = fitted(50, 10, 0.05)
    basis, _ = RKHSBasis.fit(model.kernel, model.inputs, tolerance=1e-3, max_rank=12)
    psi = basis.features(model.inputs)
    assert psi.shape == (50, 12)
    k = psi @ psi.T
    wanted = k @ np.linalg.solve(k + 0.05 * np.eye(50), successors)
    found = FeatureRegression.fit(basis, RegressionSums.from_samples(psi, successors), 0.05)
    np.testing.assert_allclose(found.mean(model.inputs), wanted, atol=1e-10)


@pytest.mark.parametrize("cuts", [[20], [1, 2, 39]])
def test_regression_sums_of_chunks_add_up(cuts: list[int]) -> None:
    rng = np.random.default_rng(12)
    psi, targets = rng.normal(size=(40, 5)), rng.normal(size=(40, 3))
    whole = RegressionSums.from_samples(psi, targets)
    np.testing.assert_allclose(whole.gram, psi.T @ psi, rtol=1e-13)
    np.testing.assert_allclose(whole.product, psi.T @ targets, rtol=1e-13)
    chunks = zip(np.split(psi, cuts), np.split(targets, cuts), strict=True)
    added = reduce(add, (RegressionSums.from_samples(*chunk) for chunk in chunks))
    np.testing.assert_allclose(added.gram, whole.gram, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(added.product, whole.product, rtol=1e-12, atol=1e-13)


def test_a_regression_on_duplicated_inputs_is_solvable() -> None:
    kernel = Kernel(factors_of(1), np.array([1.0]))
    basis, _ = RKHSBasis.fit(kernel, np.zeros((4, 1)), tolerance=1e-6, max_rank=4)
    targets = np.array([[0.0], [2.0], [4.0], [6.0]])
    sums = RegressionSums.from_samples(basis.features(np.zeros((4, 1))), targets)
    found = FeatureRegression.fit(basis, sums, 1e-6)
    np.testing.assert_allclose(found.mean(np.zeros((1, 1))), 3.0, rtol=1e-5)


@pytest.mark.parametrize("regulariser", [1e-4, 1e-2, 1.0])
def test_a_pivoted_embedding_predicts_what_the_full_one_predicts(regulariser: float) -> None:
    rng = np.random.default_rng(4)
    inputs = rng.uniform(-1.0, 1.0, size=(300, 2))
    targets = np.column_stack([np.sin(3.0 * inputs[:, 0]), inputs[:, 1] ** 2])
    targets += 0.1 * rng.standard_normal(targets.shape)
    kernel = Kernel((SquaredExponential((0,)), SquaredExponential((1,))), np.array([0.7, 0.9]))
    exact = KernelEmbedding.fit(kernel, inputs, regulariser)
    few = PivotedEmbedding.fit(kernel, inputs, regulariser)
    assert few is not None and few.features.shape[1] < 100
    loo_residuals = 1.0 - np.einsum("ij,ij->i", few.features, few.features)
    assert loo_residuals.max() < 1.001 * 1e-4 * regulariser
    np.testing.assert_allclose(few.basis.features(inputs), few.features, atol=1e-8)
    elsewhere = rng.uniform(-1.0, 1.0, size=(50, 2))
    predicted, wanted = (model.predictor(targets)(elsewhere) for model in (few, exact))
    np.testing.assert_allclose(predicted, wanted, atol=1e-3)
    found, errors = (model.leave_one_out(targets).errors for model in (few, exact))
    np.testing.assert_allclose(found, errors, atol=1e-3)


def test_dissimilar_samples_have_no_pivoted_embedding() -> None:
    kernel = Kernel((SquaredExponential((0,)),), np.array([0.1]))
    assert PivotedEmbedding.fit(kernel, np.arange(20.0)[:, None], 0.1) is None
