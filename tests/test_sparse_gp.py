"""Gaussian process policies on few centres, against the exact process and dense formulas."""

from __future__ import annotations

import numpy as np
import pytest

from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.gram import gaussian_gram
from kreps.kernels.kernel import Kernel, factors_of
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import PolicySums, SparseGP

TASK = TaskSpec(2, np.array([-1.0, 10.0]), np.array([1.0, 30.0]))
CENTRE, SCALE = np.array([0.0, 20.0]), np.array([1.0, 10.0])
KERNEL = Kernel(factors_of(2), np.array([0.8, 1.3]))
SIGNAL, NOISE = 0.7, 0.2
FAR = np.array([[1e3, -1e3], [40.0, 0.0]])


def samples(n: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States, scaled actions that are a smooth function of them with noise, weights."""
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(n, 2))
    smooth = np.stack([np.sin(2.0 * states[:, 0]), np.tanh(states[:, 1])], axis=1)
    return states, smooth + 0.3 * rng.normal(size=(n, 2)), rng.uniform(0.1, 4.0, size=n)


def queries(n: int, seed: int) -> FloatArray:
    return 1.5 * np.random.default_rng(seed).normal(size=(n, 2))


def exact(n: int, seed: int, kernel: Kernel = KERNEL) -> CostSensitiveGP:
    return CostSensitiveGP(TASK, kernel, *samples(n, seed), SIGNAL, NOISE)


def posterior(policy: CostSensitiveGP, states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation in the task's units, by dense solves with C."""
    c = policy.signal * policy.kernel.gram(policy.states) + np.diag(policy.noise / policy.weights)
    k = policy.signal * policy.kernel.gram(policy.states, states)
    variance = policy.signal - np.einsum("ij,ij->j", k, np.linalg.solve(c, k)) + policy.noise
    mean = CENTRE + SCALE * (k.T @ np.linalg.solve(c, policy.targets))
    return mean, np.sqrt(variance)[:, None] * SCALE


def projected(
    policy: CostSensitiveGP, basis: RKHSBasis, states: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scaled mean, variance and the variance of subset of regressors, by the printed formulas."""
    z, at = basis.features(policy.states), basis.features(states)
    ratio = policy.signal / policy.noise
    p = np.eye(z.shape[1]) + ratio * z.T @ (policy.weights[:, None] * z)
    pulled = z.T @ (policy.weights[:, None] * policy.targets)
    mean = ratio * at @ np.linalg.solve(p, pulled)
    left = np.einsum("ij,ij->i", at, np.linalg.solve(p, at.T).T)
    regressors = policy.signal * left + policy.noise
    norms = np.einsum("ij,ij->i", at, at)
    return mean, policy.signal * (1.0 - norms) + regressors, regressors


def fit(policy: CostSensitiveGP, centres: int, tolerance: float = 0.0) -> SparseGP:
    basis, features = RKHSBasis.fit(
        policy.kernel, policy.states, tolerance=tolerance, max_rank=centres
    )
    sums = PolicySums.from_samples(features, policy.weights, policy.targets)
    return SparseGP.fit(TASK, basis, sums, policy.signal, policy.noise)


# ---- the fit ----------------------------------------------------------------------------------


def test_with_all_states_as_centres_the_process_is_exact() -> None:
    """Up to rounding: K of 30 states has a condition number near 1e5."""
    policy = exact(30, 0)
    few = fit(policy, 30)
    assert len(few.states) == 30
    at = np.concatenate([policy.states, queries(200, 1), FAR])
    mean, deviation = posterior(policy, at)
    np.testing.assert_allclose(few.greedy(at), mean, atol=1e-8)
    np.testing.assert_allclose(few.standard_deviation(at), deviation, rtol=1e-8)


def test_with_few_centres_the_process_is_projected() -> None:
    policy = exact(120, 2)
    basis, _ = RKHSBasis.fit(KERNEL, policy.states, tolerance=0.0, max_rank=15)
    few, at = fit(policy, 15), np.concatenate([queries(100, 3), FAR])
    assert len(few.states) == 15
    mean, variance, _ = projected(policy, basis, at)
    np.testing.assert_allclose(few.greedy(at), CENTRE + SCALE * mean, atol=1e-9)
    wanted = np.sqrt(variance)[:, None] * SCALE
    np.testing.assert_allclose(few.standard_deviation(at), wanted, rtol=1e-9)


def test_far_from_all_data_the_variance_is_the_priors_unlike_in_subset_of_regressors() -> None:
    policy = exact(120, 4)
    basis, _ = RKHSBasis.fit(KERNEL, policy.states, tolerance=0.0, max_rank=15)
    few = fit(policy, 15)
    prior = np.sqrt(SIGNAL + NOISE) * SCALE
    np.testing.assert_allclose(few.standard_deviation(FAR), [prior, prior], rtol=1e-12)
    np.testing.assert_allclose(few.greedy(FAR), [CENTRE, CENTRE], atol=1e-12)
    # without the part that the centres cannot represent, only the noise would be left
    _, _, regressors = projected(policy, basis, FAR)
    np.testing.assert_allclose(regressors, NOISE, rtol=1e-12)
    # three lengthscales from the data it is already far smaller
    near = np.array([[3.0 * 0.8 + np.abs(policy.states[:, 0]).max(), 0.0]])
    _, variance, regressors = projected(policy, basis, near)
    assert regressors[0] < 0.3 * variance[0]
    assert few.standard_deviation(near)[0, 0] ** 2 > 0.95 * (SIGNAL + NOISE)


def test_a_sample_of_weight_three_counts_as_three_samples() -> None:
    states, targets, _ = samples(40, 5)
    weights = np.random.default_rng(6).integers(1, 4, size=40)
    basis, features = RKHSBasis.fit(KERNEL, states, tolerance=0.0, max_rank=10)
    rows = np.repeat(np.arange(40), weights)
    once = PolicySums.from_samples(features, weights.astype(np.float64), targets)
    repeated = PolicySums.from_samples(features[rows], np.ones(len(rows)), targets[rows])
    a, b = (SparseGP.fit(TASK, basis, sums, SIGNAL, NOISE) for sums in (once, repeated))
    np.testing.assert_allclose(a.greedy(FAR), b.greedy(FAR), rtol=1e-10)
    at = queries(50, 7)
    np.testing.assert_allclose(a.greedy(at), b.greedy(at), atol=1e-9)
    np.testing.assert_allclose(a.standard_deviation(at), b.standard_deviation(at), rtol=1e-10)


# ---- sums -------------------------------------------------------------------------------------


def test_policy_sums_follow_their_definition() -> None:
    rng = np.random.default_rng(8)
    z, w, u = rng.normal(size=(30, 4)), rng.uniform(0.1, 2.0, 30), rng.normal(size=(30, 2))
    sums = PolicySums.from_samples(z, w, u)
    precision = sum(w[i] * np.outer(z[i], z[i]) for i in range(30))
    weighted_targets = sum(w[i] * np.outer(z[i], u[i]) for i in range(30))
    np.testing.assert_allclose(sums.precision, precision, atol=1e-12)
    np.testing.assert_allclose(sums.weighted_targets, weighted_targets, atol=1e-12)


@pytest.mark.parametrize("cuts", [[10], [1, 2, 59], [20, 40]])
def test_sums_add_up_over_chunks(cuts: list[int]) -> None:
    policy = exact(60, 9)
    basis, features = RKHSBasis.fit(KERNEL, policy.states, tolerance=0.0, max_rank=12)
    whole = PolicySums.from_samples(features, policy.weights, policy.targets)
    chunks = [
        PolicySums.from_samples(*parts)
        for parts in zip(
            *(np.split(a, cuts) for a in (features, policy.weights, policy.targets)), strict=True
        )
    ]
    total = chunks[0]
    for chunk in chunks[1:]:
        total = total + chunk
    np.testing.assert_allclose(total.precision, whole.precision, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        total.weighted_targets, whole.weighted_targets, rtol=1e-12, atol=1e-12
    )
    at = queries(50, 10)
    a, b = (SparseGP.fit(TASK, basis, sums, SIGNAL, NOISE) for sums in (whole, total))
    np.testing.assert_allclose(a.greedy(at), b.greedy(at), atol=1e-9)
    np.testing.assert_allclose(a.standard_deviation(at), b.standard_deviation(at), rtol=1e-10)


# ---- compression ------------------------------------------------------------------------------


@pytest.mark.parametrize("centres", [1, 3, 10, 30, 100])
def test_the_variance_of_a_compressed_policy_is_between_noise_and_prior(centres: int) -> None:
    few = exact(150, 11).compressed(centres)
    assert len(few.states) <= centres
    at = np.concatenate([few.states, queries(500, 12), FAR])
    scaled = few.standard_deviation(at) / SCALE
    assert (scaled >= np.sqrt(NOISE)).all()
    assert (scaled <= np.sqrt(SIGNAL + NOISE) * (1 + 1e-12)).all()


def test_a_compressed_policy_converges_with_the_number_of_centres() -> None:
    """With 5 centres the error is a large part of the action scale, with 80 a thousandth of it."""
    policy, at = exact(200, 13), queries(300, 14)
    at = at[np.abs(at).max(axis=1) < 2.0]
    mean, deviation = posterior(policy, at)
    errors = {}
    for centres in (5, 20, 40, 80):
        few = policy.compressed(centres)
        errors[centres] = (
            np.abs((few.greedy(at) - mean) / SCALE).max(),
            np.abs((few.standard_deviation(at) - deviation) / SCALE).max(),
        )
    for smaller, larger in ((5, 20), (20, 40), (40, 80)):
        assert errors[larger][0] < 0.6 * errors[smaller][0]
        assert errors[larger][1] < 0.6 * errors[smaller][1]
    assert errors[5][0] > 0.1 and errors[20][0] < 0.5
    assert max(errors[80]) < 1e-3


@pytest.mark.parametrize("centres", [25, 26, 10_000])
def test_a_policy_is_not_compressed_to_more_centres_than_it_has_samples(centres: int) -> None:
    policy, at = exact(25, 15), queries(50, 16)
    few = policy.compressed(centres)
    assert len(few.states) <= 25
    mean, deviation = posterior(policy, at)
    np.testing.assert_allclose(few.greedy(at), mean, atol=1e-5)
    np.testing.assert_allclose(few.standard_deviation(at), deviation, rtol=1e-5)


def test_centres_are_distinct_samples() -> None:
    policy = exact(20, 17)
    twice = CostSensitiveGP(
        TASK,
        KERNEL,
        np.tile(policy.states, (2, 1)),
        np.tile(policy.targets, (2, 1)),
        np.tile(policy.weights, 2),
        SIGNAL,
        NOISE,
    )
    few = twice.compressed(40)
    assert len(few.states) <= 20
    assert len(np.unique(few.states, axis=0)) == len(few.states)
    assert {tuple(s) for s in few.states} <= {tuple(s) for s in policy.states}


@pytest.mark.parametrize("centres", [0, -1])
def test_fewer_than_one_centre_is_rejected(centres: int) -> None:
    with pytest.raises(ConfigurationError, match=f"centres = {centres}"):
        exact(10, 18).compressed(centres)


def test_one_centre_is_enough_for_a_policy() -> None:
    few = exact(50, 19).compressed(1)
    assert few.greedy(queries(5, 20)).shape == (5, 2)
    assert len(few.states) == 1


# ---- evaluation -------------------------------------------------------------------------------


def test_an_action_is_the_mean_plus_the_deviation_times_the_noise() -> None:
    few, rng = exact(60, 21).compressed(10), np.random.default_rng(22)
    at, noise = queries(9, 23), rng.normal(size=(9, 2))
    wanted = few.greedy(at) + few.standard_deviation(at) * noise
    np.testing.assert_allclose(few.act(at, noise), wanted, rtol=1e-12)
    np.testing.assert_array_equal(few.act(at, np.zeros((9, 2))), few.greedy(at))


def test_kernel_values_are_those_of_gaussian_gram() -> None:
    few = exact(60, 24).compressed(30)
    for at in (queries(1, 25), queries(40, 26), FAR, few.states):
        wanted = gaussian_gram(KERNEL.embed(few.states), KERNEL.embed(at))
        # gaussian_gram reduces rounding in another way
        np.testing.assert_allclose(few._covariances(at), wanted, rtol=0, atol=1e-13)


def test_a_triangular_matrix_is_multiplied_in_blocks_with_the_same_result() -> None:
    """Lengthscales are so short that every support point is a centre."""
    count = 273
    rough = exact(count, 27, KERNEL.with_lengthscales(np.array([0.02, 0.02])))
    few = rough.predictor
    assert len(few.states) == count
    assert [rows.shape for rows in few._explained_blocks] == [
        (128, 128),
        (128, 256),
        (17, count),
    ]
    at = np.concatenate([rough.states, queries(20, 28)])
    mean, deviation = posterior(rough, at)
    for states in (at, at[:1]):
        np.testing.assert_allclose(few.greedy(states), mean[: len(states)], atol=1e-10)
        np.testing.assert_allclose(
            few.standard_deviation(states), deviation[: len(states)], rtol=1e-9
        )


def test_a_full_matrix_is_multiplied_at_once() -> None:
    few = exact(256, 29, KERNEL.with_lengthscales(np.array([0.1, 0.1]))).compressed(137)
    assert len(few.states) == 137
    assert [rows.shape for rows in few._explained_blocks] == [(137, 137)]
