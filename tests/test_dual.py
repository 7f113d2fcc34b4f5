"""The dual of Eq. 2 and its solution: derivatives, optimality, and what holds at the optimum."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import logsumexp

from kreps.algorithms import newton_step
from kreps.algorithms.dual import (
    MIN_ETA,
    DualProblem,
    DualSolution,
    Moments,
    Outcome,
    bellman_errors,
    dual_gradient,
    dual_hessian,
    dual_value,
    effective_sample_size,
    kl_from_uniform,
    primal_value,
    sample_weights,
    standardise,
)
from kreps.algorithms.newton import minimise_by_newton, solve_dual
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.basis import RBFGrid
from kreps.kernels.kernel import Kernel, factors_of

TINY_FLOOR = 1e-6

DECREMENT_TOLERANCE, GAP_TOLERANCE, KL_TOLERANCE = 1e-9, 1e-6, 1e-4
"""As the solver documents them."""


def random_problem(
    seed: int, n: int = 80, r: int = 7, *, kl_bound: float = 0.5, ridge: float = 0.01
) -> DualProblem:
    """Features that explain a part of the rewards."""
    rng = np.random.default_rng(seed)
    differences = rng.normal(0.0, 0.4, size=(n, r))
    rewards, _ = standardise(rng.gamma(2.0, size=n) + differences @ rng.normal(size=r))
    return DualProblem(rewards, differences, kl_bound, ridge, TINY_FLOOR)


def value_by_the_book(problem: DualProblem, eta: float, theta: FloatArray) -> float:
    """Eq. 2 with its epsilon and the ridge, by an independent log-sum-exp."""
    delta = problem.rewards + problem.differences @ theta
    soft_maximum = logsumexp(delta / eta) - np.log(len(delta))
    return float(
        eta * problem.kl_bound + eta * soft_maximum + 0.5 * problem.ridge * np.sum(theta**2)
    )


def assert_optimal(problem: DualProblem, found: DualSolution) -> None:
    """Optimality conditions and certificate of a solution."""
    assert found.converged
    assert found.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert (found.weights >= 0.0).all()
    delta = bellman_errors(problem, found.theta)
    np.testing.assert_allclose(found.weights, sample_weights(delta, found.eta), atol=1e-14)
    assert found.kl == pytest.approx(kl_from_uniform(found.weights), abs=1e-12)
    assert found.dual == pytest.approx(value_by_the_book(problem, found.eta, found.theta), abs=1e-9)
    imbalance = problem.differences.T @ found.weights + problem.ridge * found.theta
    assert found.stationarity == pytest.approx(np.linalg.norm(imbalance), abs=1e-12)
    # The Newton decrement bounds the gradient: g'g <= lambda_max g' H^-1 g.
    assert found.decrement <= DECREMENT_TOLERANCE
    assert found.stationarity**2 <= 2.01 * problem.ridge * GAP_TOLERANCE
    steepest = np.linalg.eigvalsh(dual_hessian(problem, found.eta, found.theta)).max()
    assert found.stationarity <= 1.01 * np.sqrt(2.0 * DECREMENT_TOLERANCE * steepest)
    if found.outcome is Outcome.AT_FLOOR:
        assert found.eta == problem.eta_floor
        assert found.kl <= problem.kl_bound * (1.0 + KL_TOLERANCE)
    else:
        assert found.eta > problem.eta_floor
        assert abs(found.kl - problem.kl_bound) <= 1.001 * KL_TOLERANCE * problem.kl_bound


# Parts


def test_standardised_rewards_have_their_maximum_at_zero_and_unit_spread() -> None:
    rewards = np.array([3.0, -1.0, 0.5, 3.0])
    found, unit = standardise(rewards)
    assert unit == pytest.approx(rewards.std())
    assert found.max() == 0.0
    np.testing.assert_allclose(found * unit + 3.0, rewards, atol=1e-14)


@pytest.mark.parametrize("value", [0.0, -0.1, 1e-300, 1e8 + 0.1])
def test_equal_rewards_standardise_to_zeros(value: float) -> None:
    found, unit = standardise(np.full(37, value))
    np.testing.assert_array_equal(found, 0.0)
    assert unit == 1.0


def test_small_differences_of_large_rewards_are_standardised() -> None:
    found, unit = standardise(1e6 + np.array([0.0, 1e-3, 2e-3]))
    np.testing.assert_allclose(found, [-2.449, -1.225, 0.0], atol=1e-3)
    assert unit == pytest.approx(8.165e-4, rel=1e-3)


def test_bellman_errors_are_rewards_plus_differences_of_v() -> None:
    problem = random_problem(0)
    theta = np.arange(7.0)
    wanted = [
        r + sum(b * t for b, t in zip(row, theta, strict=True))
        for r, row in zip(problem.rewards, problem.differences, strict=True)
    ]
    np.testing.assert_allclose(bellman_errors(problem, theta), wanted)


def test_weights_are_the_normalised_exponentials_and_invariant_to_a_shift() -> None:
    delta = np.array([0.3, -1.0, 2.0])
    wanted = np.exp(delta / 0.7) / np.exp(delta / 0.7).sum()
    np.testing.assert_allclose(sample_weights(delta, 0.7), wanted)
    np.testing.assert_allclose(sample_weights(delta + 1e4, 0.7), wanted, rtol=1e-9)
    np.testing.assert_array_equal(sample_weights(np.array([0.0, -1e9, 0.0]), 1e-3), [0.5, 0.0, 0.5])


def test_kl_and_effective_sample_size_of_known_weights() -> None:
    uniform, single = np.full(8, 0.125), np.eye(8)[3]
    assert kl_from_uniform(uniform) == pytest.approx(0.0, abs=1e-15)
    assert kl_from_uniform(single) == pytest.approx(np.log(8.0))
    assert effective_sample_size(uniform) == pytest.approx(8.0)
    assert effective_sample_size(single) == 1.0
    p = np.array([0.5, 0.25, 0.25, 0.0])
    assert kl_from_uniform(p) == pytest.approx(0.5 * np.log(2.0))
    assert effective_sample_size(p) == pytest.approx(1.0 / 0.375)


def test_the_primal_value_is_the_reward_less_the_penalty_of_nonstationarity() -> None:
    problem = random_problem(1)
    p = np.random.default_rng(2).dirichlet(np.ones(80))
    imbalance = sum(p[i] * problem.differences[i] for i in range(80))
    wanted = np.sum(p * problem.rewards) - np.sum(np.square(imbalance)) / (2.0 * 0.01)
    assert primal_value(problem, p) == pytest.approx(wanted)


@pytest.mark.parametrize("eta", [1e-3, 0.5, 40.0])
def test_the_dual_value(eta: float) -> None:
    problem = random_problem(3)
    theta = np.random.default_rng(4).normal(size=7)
    assert dual_value(problem, eta, theta) == pytest.approx(value_by_the_book(problem, eta, theta))


def test_enormous_bellman_errors_do_not_overflow() -> None:
    problem = replace(random_problem(5), rewards=np.linspace(-1e7, 1e7, 80))
    found = dual_value(problem, 1e-3, np.zeros(7))
    assert found == pytest.approx(1e7, rel=1e-9)


# Derivatives


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("eta", [0.15, 1.0, 6.0])
def test_the_gradient(seed: int, eta: float) -> None:
    problem = random_problem(seed)
    theta = np.random.default_rng(seed + 10).normal(size=7)
    g_eta, g_theta = dual_gradient(problem, eta, theta)
    h = 1e-5
    by_eta = (
        value_by_the_book(problem, eta + h, theta) - value_by_the_book(problem, eta - h, theta)
    ) / (2 * h)
    by_theta = [
        (
            value_by_the_book(problem, eta, theta + h * e)
            - value_by_the_book(problem, eta, theta - h * e)
        )
        / (2 * h)
        for e in np.eye(7)
    ]
    assert g_eta == pytest.approx(by_eta, rel=1e-5, abs=1e-7)
    np.testing.assert_allclose(g_theta, by_theta, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("eta", [0.15, 1.0, 6.0])
def test_the_hessian_with_its_eta_row_and_column_multiplied_by_eta(seed: int, eta: float) -> None:
    problem = random_problem(seed)
    theta = np.random.default_rng(seed + 20).normal(size=7)
    h = 1e-6

    def gradient(x: FloatArray) -> FloatArray:
        g_eta, g_theta = dual_gradient(problem, float(x[-1]), x[:-1])
        return np.append(g_theta, g_eta)

    x = np.append(theta, eta)
    plain = np.array([(gradient(x + h * e) - gradient(x - h * e)) / (2 * h) for e in np.eye(8)])
    scale = np.append(np.ones(7), eta)
    wanted = plain * np.outer(scale, scale)
    found = dual_hessian(problem, eta, theta)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found, found.T)


@pytest.mark.parametrize("seed", range(5))
def test_the_dual_is_convex_along_random_segments(seed: int) -> None:
    problem = random_problem(seed)
    rng = np.random.default_rng(seed + 30)
    for _ in range(40):
        ends = [(float(np.exp(rng.normal())), rng.normal(0, 3, size=7)) for _ in range(2)]
        share = rng.uniform()
        middle = [share * a + (1.0 - share) * b for a, b in zip(*ends, strict=True)]
        values = [dual_value(problem, eta, theta) for eta, theta in ends]
        chord = share * values[0] + (1.0 - share) * values[1]
        assert dual_value(problem, *middle) <= chord + 1e-10
    # and it is not flat
    assert np.linalg.eigvalsh(dual_hessian(problem, *ends[0])).min() > 1e-4


# Solutions


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kl_bound", [0.05, 0.5, 1.5])
@pytest.mark.parametrize("ridge", [1e-5, 1e-2, 1.0])
def test_the_realised_kl_is_the_bound_and_the_gap_is_closed(
    seed: int, kl_bound: float, ridge: float
) -> None:
    problem = random_problem(seed, kl_bound=kl_bound, ridge=ridge)
    found = solve_dual(problem)
    assert found.outcome is Outcome.BOUND_ACTIVE
    assert_optimal(problem, found)
    assert found.iterations <= 40
    assert found.jitter == 0.0
    # By algebra, whatever eta and theta are: so both parts of the gap are small, and it can be
    # negative only by what the tolerance lets KL exceed its bound.
    parts = found.eta * (kl_bound - found.kl) + found.stationarity**2 / (2.0 * ridge)
    assert found.gap == pytest.approx(parts, abs=1e-9 * max(1.0, abs(found.dual)))
    assert abs(found.gap) <= 1.01 * KL_TOLERANCE * kl_bound * found.eta + 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_the_solution_is_that_of_a_trust_region_method(seed: int) -> None:
    problem = random_problem(seed)

    def objective(x: FloatArray) -> tuple[float, FloatArray]:
        eta = float(np.exp(x[-1]))
        g_eta, g_theta = dual_gradient(problem, eta, x[:-1])
        return value_by_the_book(problem, eta, x[:-1]), np.append(g_theta, eta * g_eta)

    def hessian(x: FloatArray) -> FloatArray:
        eta = float(np.exp(x[-1]))
        second = dual_hessian(problem, eta, x[:-1])
        second[-1, -1] += eta * dual_gradient(problem, eta, x[:-1])[0]  # chain rule of log eta
        return second

    reference = minimize(
        objective, np.zeros(8), jac=True, hess=hessian, method="trust-exact", options={"gtol": 1e-9}
    )
    found = solve_dual(problem)
    assert found.dual == pytest.approx(reference.fun, abs=1e-8)
    assert found.eta == pytest.approx(np.exp(reference.x[-1]), rel=1e-3)
    np.testing.assert_allclose(found.theta, reference.x[:-1], atol=1e-2)
    delta = problem.rewards + problem.differences @ reference.x[:-1]
    wanted = sample_weights(delta, float(np.exp(reference.x[-1])))
    assert np.abs(found.weights - wanted).sum() < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_no_feasible_weights_beat_the_dual(seed: int) -> None:
    problem = random_problem(seed)
    found = solve_dual(problem)
    rng = np.random.default_rng(seed + 40)
    uniform = np.full(80, 1.0 / 80)
    for _ in range(200):
        # Near the optimum, at random, or both; mixed with uniform weights until feasible.
        p = rng.dirichlet(np.full(80, rng.choice([0.05, 1.0, 50.0])))
        share = rng.choice([0.0, 0.9, 0.999])
        p = share * found.weights + (1.0 - share) * p
        while kl_from_uniform(p) > problem.kl_bound:
            p = 0.9 * p + 0.1 * uniform
        assert primal_value(problem, p) <= found.dual + 1e-6
        eta, theta = float(np.exp(rng.normal())), rng.normal(size=7)
        assert primal_value(problem, p) <= dual_value(problem, eta, theta) + 1e-9


def floor_problem(seed: int) -> DualProblem:
    """At the KL bound the temperature would be below the floor."""
    problem = random_problem(seed, kl_bound=2.0)
    free = solve_dual(problem)
    assert free.outcome is Outcome.BOUND_ACTIVE
    return replace(problem, eta_floor=3.0 * free.eta)


@pytest.mark.parametrize("seed", range(4))
def test_at_the_floor_the_update_is_the_soft_maximum_of_that_temperature(seed: int) -> None:
    problem = floor_problem(seed)
    found = solve_dual(problem)
    assert found.outcome is Outcome.AT_FLOOR
    assert_optimal(problem, found)
    assert found.kl < 0.9 * problem.kl_bound
    # Optimal in theta at that temperature, by another method.
    reference = minimize(
        lambda theta: value_by_the_book(problem, problem.eta_floor, theta),
        np.zeros(7),
        jac=lambda theta: dual_gradient(problem, problem.eta_floor, theta)[1],
        method="BFGS",
        options={"gtol": 1e-9},
    )
    assert found.dual == pytest.approx(reference.fun, abs=1e-8)
    np.testing.assert_allclose(found.theta, reference.x, atol=1e-2)
    # And no higher temperature would be better.
    higher = replace(problem, eta_floor=1.05 * problem.eta_floor)
    assert solve_dual(higher).dual > found.dual
    assert -1e-6 <= found.gap <= 1e-4


def test_a_floor_above_the_first_temperature_is_kept() -> None:
    problem = replace(random_problem(0), eta_floor=25.0)
    found = solve_dual(problem)
    assert found.outcome is Outcome.AT_FLOOR
    assert_optimal(problem, found)


def test_a_floor_below_the_optimum_changes_nothing() -> None:
    problem = random_problem(1)
    free = solve_dual(problem)
    floored = solve_dual(replace(problem, eta_floor=0.5 * free.eta))
    assert floored.outcome is Outcome.BOUND_ACTIVE
    np.testing.assert_allclose(floored.weights, free.weights, atol=1e-6)


@pytest.mark.parametrize("floor", [TINY_FLOOR, 0.1])
def test_equal_rewards_on_stationary_samples_give_uniform_weights(floor: float) -> None:
    rewards, _ = standardise(np.full(80, -3.7))
    centred = random_problem(2).differences
    centred = centred - centred.mean(axis=0)  # already stationary
    found = solve_dual(DualProblem(rewards, centred, 0.5, 0.01, floor))
    assert found.outcome is Outcome.AT_FLOOR
    np.testing.assert_allclose(found.weights, 1.0 / 80, atol=1e-9)
    assert found.kl == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(found.theta, 0.0, atol=1e-6)


@pytest.mark.parametrize("floor", [TINY_FLOOR, 0.1])
def test_equal_rewards_on_nonstationary_samples_only_reduce_the_residual(floor: float) -> None:
    problem = replace(random_problem(3), rewards=np.zeros(80), eta_floor=floor)
    found = solve_dual(problem)
    assert_optimal(problem, found)
    before = np.linalg.norm(problem.differences.mean(axis=0))
    assert np.linalg.norm(problem.differences.T @ found.weights) < 0.5 * before


@pytest.mark.parametrize("floor", [TINY_FLOOR, 0.1])
def test_one_sample_has_all_the_weight(floor: float) -> None:
    problem = DualProblem(np.zeros(1), np.array([[0.3, -0.2]]), 0.5, 0.1, floor)
    found = solve_dual(problem)
    assert found.converged
    np.testing.assert_array_equal(found.weights, [1.0])
    np.testing.assert_allclose(found.theta, [-3.0, 2.0], atol=1e-3)  # B'p + rho theta = 0
    assert found.outcome is Outcome.AT_FLOOR


def test_two_samples_without_features_have_a_closed_form() -> None:
    # KL(p || 1/2) = epsilon fixes p, and log(p1 / p2) = (R1 - R2) / eta fixes eta.
    problem = DualProblem(np.array([0.0, -2.0]), np.zeros((2, 1)), 0.3, 0.1, TINY_FLOOR)
    found = solve_dual(problem)
    p = found.weights
    assert p[0] * np.log(2 * p[0]) + p[1] * np.log(2 * p[1]) == pytest.approx(0.3, rel=1e-4)
    assert p[0] > p[1]
    assert found.eta == pytest.approx(2.0 / np.log(p[0] / p[1]), rel=1e-6)


def test_a_bound_that_cannot_be_reached_ends_at_the_floor() -> None:
    # Two samples cannot be further than log 2 from uniform.
    problem = DualProblem(np.array([0.0, -2.0]), np.zeros((2, 1)), 1.0, 0.1, 1e-3)
    found = solve_dual(problem)
    assert found.outcome is Outcome.AT_FLOOR
    np.testing.assert_allclose(found.weights, [1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_an_optimum_at_a_tiny_floor_is_recognised_with_many_features(seed: int) -> None:
    # with nearly as many features as samples, stationarity leaves no room for the bound
    rng = np.random.default_rng(seed)
    rewards, _ = standardise(rng.normal(size=40))
    differences = rng.normal(0.0, 0.5, size=(40, 38))
    problem = DualProblem(rewards, differences, 1.0, 0.1 / 40, TINY_FLOOR)
    found = solve_dual(problem)
    assert found.kl < problem.kl_bound
    assert found.eta == pytest.approx(TINY_FLOOR, rel=1e-9)
    assert found.outcome is Outcome.AT_FLOOR
    # without waiting for theta there were 125 to 146, with the fallback
    assert found.iterations < 50


@pytest.mark.parametrize("scale", [1e-8, 1e8])
@pytest.mark.parametrize("offset", [0.0, 5.0])
def test_units_of_the_reward_do_not_change_the_weights(scale: float, offset: float) -> None:
    raw = np.random.default_rng(50).normal(size=80)
    problem = random_problem(4)
    plain = solve_dual(replace(problem, rewards=standardise(raw)[0]))
    scaled = solve_dual(replace(problem, rewards=standardise(scale * (raw + offset))[0]))
    np.testing.assert_allclose(scaled.weights, plain.weights, atol=1e-9)
    assert scaled.eta == pytest.approx(plain.eta, rel=1e-6)


def test_the_order_of_the_samples_does_not_matter() -> None:
    problem = random_problem(5)
    order = np.random.default_rng(51).permutation(80)
    shuffled = replace(
        problem, rewards=problem.rewards[order], differences=problem.differences[order]
    )
    np.testing.assert_allclose(
        solve_dual(shuffled).weights, solve_dual(problem).weights[order], atol=1e-8
    )


def test_duplicated_features_have_the_same_weights() -> None:
    problem = random_problem(6)
    doubled = replace(problem, differences=np.tile(problem.differences, (1, 2)), ridge=0.02)
    # Twice the features at twice the ridge are the same penalty on V.
    np.testing.assert_allclose(solve_dual(doubled).weights, solve_dual(problem).weights, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("iterations", [1, 2])
def test_the_fallback_finds_the_same_solution(seed: int, iterations: int) -> None:
    problem = random_problem(seed)
    direct = solve_dual(problem)
    assert direct.iterations > 2
    found = solve_dual(problem, max_iterations=iterations)
    assert found.outcome is Outcome.FALLBACK
    assert_optimal(problem, found)
    assert found.iterations > iterations
    assert found.eta == pytest.approx(direct.eta, rel=1e-3)
    assert np.abs(found.weights - direct.weights).sum() < 1e-3
    assert found.dual == pytest.approx(direct.dual, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("fraction", [0.9, 0.5, 0.3, 0.1])
def test_the_fallback_finds_an_optimum_just_above_the_floor(seed: int, fraction: float) -> None:
    problem = random_problem(seed)
    direct = solve_dual(problem)
    floored = replace(problem, eta_floor=fraction * direct.eta)
    found = solve_dual(floored, max_iterations=1)
    assert found.outcome is Outcome.FALLBACK
    assert_optimal(floored, found)
    assert found.eta == pytest.approx(direct.eta, rel=1e-3)


@pytest.mark.parametrize("eta", [0.11, 0.15, 0.2, 0.24, 0.5])
def test_equal_rewards_on_few_unbalanced_samples_are_solved_above_the_floor(eta: float) -> None:
    # All Bellman errors are zero at first and the first Newton system is singular, so that this
    # is a case for the fallback.  More features than samples: V alone must balance the samples.
    differences = np.random.default_rng(0).normal(0.0, 0.5, size=(20, 30))
    problem = DualProblem(np.zeros(20), differences, 9.0, 0.1 / 20, eta)
    at_eta = solve_dual(problem)
    assert at_eta.outcome is Outcome.AT_FLOOR
    # With the KL found there as the bound, that temperature is optimal without any floor.
    problem = replace(problem, kl_bound=at_eta.kl, eta_floor=0.1)
    found = solve_dual(problem)
    assert_optimal(problem, found)
    # KL hardly depends on the temperature here, so its tolerance leaves some room.
    assert found.eta == pytest.approx(eta, rel=5e-2)


@pytest.mark.parametrize("seed", range(3))
def test_the_fallback_finds_the_floor_too(seed: int) -> None:
    problem = floor_problem(seed)
    direct = solve_dual(problem)
    found = solve_dual(problem, max_iterations=1)
    assert found.outcome is Outcome.AT_FLOOR
    assert_optimal(problem, found)
    np.testing.assert_allclose(found.weights, direct.weights, atol=1e-5)


@pytest.mark.parametrize("kl_bound", [0.1, 1.0])
def test_observed_successors_and_fixed_features_are_the_reps_of_2010(kl_bound: float) -> None:
    """Peters, Muelling and Altun (2010), restated here without sharing code with the library.

    Minimise ``eta log(mean exp(epsilon + delta / eta))`` over eta and theta, where
    ``delta = r + theta' (phi(s') - phi(s))``; no ridge, no model, features fixed.
    """
    rng = np.random.default_rng(60)
    s = [0.0]
    actions = rng.uniform(-1.0, 1.0, size=400)
    for a in actions:  # a damped walk that mixes, so that stationary weights exist
        s.append(0.8 * s[-1] + 0.5 * a + 0.1 * rng.normal())
    states, successors = np.array(s[:-1])[:, None], np.array(s[1:])[:, None]
    rewards = -((states[:, 0] - 0.7) ** 2) - 0.1 * actions**2
    centres = np.array([-1.0, -0.3, 0.4, 1.1])

    def bumps(x: FloatArray) -> FloatArray:
        return np.array([[np.exp(-0.5 * ((v - c) / 0.7) ** 2) for c in centres] for v in x[:, 0]])

    difference = bumps(successors) - bumps(states)

    def reps_2010(x: FloatArray) -> tuple[float, FloatArray]:
        eta, theta = np.exp(x[0]), x[1:]
        z = kl_bound + (rewards + difference @ theta) / eta
        log_mean = logsumexp(z) - np.log(len(z))
        p = np.exp(z - logsumexp(z))
        by_eta = log_mean - p @ (z - kl_bound)
        return float(eta * log_mean), np.append(eta * by_eta, difference.T @ p)

    reference = minimize(
        reps_2010,
        np.zeros(5),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 5000, "maxfun": 20000, "ftol": 1e-15, "gtol": 1e-9},
    )
    eta, theta = np.exp(reference.x[0]), reference.x[1:]
    delta = rewards + difference @ theta
    wanted = np.exp((delta - delta.max()) / eta)
    wanted /= wanted.sum()

    grid = RBFGrid(Kernel(factors_of(1), np.array([0.7])), centres[:, None])
    expected = grid.features(successors)  # of the sample model
    standard, unit = standardise(rewards)
    problem = DualProblem(standard, expected - grid.features(states), kl_bound, 1e-9, TINY_FLOOR)
    found = solve_dual(problem)
    assert_optimal(problem, found)
    assert found.eta * unit == pytest.approx(eta, rel=1e-3)
    assert found.dual * unit + rewards.max() == pytest.approx(reference.fun, abs=1e-5)
    assert np.abs(found.weights - wanted).sum() < 1e-3
    # The weights are stationary in the features and better than the samples.
    assert np.abs(difference.T @ found.weights).max() < 1e-5
    assert found.weights @ rewards > rewards.mean() + 0.05


def test_rewards_that_move_with_a_potential_do_not_change_the_weights() -> None:
    # R + B theta_0 is undone by theta - theta_0 when the ridge is negligible.
    problem = random_problem(7, ridge=1e-10)
    shaped = replace(problem, rewards=problem.rewards + problem.differences @ np.linspace(-1, 1, 7))
    np.testing.assert_allclose(solve_dual(shaped).weights, solve_dual(problem).weights, atol=1e-5)


# Chunks of samples


@dataclass(frozen=True)
class InPieces(DualProblem):
    """The same problem, but its moments are added up over pieces of the samples."""

    pieces: tuple[IntArray, ...]

    @classmethod
    def of(cls, problem: DualProblem, pieces: list[IntArray]) -> InPieces:
        return cls(
            problem.rewards,
            problem.differences,
            problem.kl_bound,
            problem.ridge,
            problem.eta_floor,
            tuple(pieces),
        )

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        delta = self.bellman_errors(theta)
        parts = [
            Moments.from_rows(
                delta[rows], self.differences[rows], eta, with_covariance=with_covariance
            )
            for rows in self.pieces
        ]
        return reduce(add, parts)


def cut(samples: int, cuts: list[int], order: int) -> list[IntArray]:
    """Pieces between the cuts, forwards, backwards or shuffled."""
    pieces = np.split(np.arange(samples), cuts)
    if order < 0:
        return pieces[::-1]
    shuffled = np.random.default_rng(order).permutation(len(pieces))
    return pieces if order == 0 else [pieces[i] for i in shuffled]


def assert_same_dual(
    pieces: DualProblem, whole: DualProblem, eta: float, theta: FloatArray
) -> None:
    """Value, gradient and Hessian agree to rounding, each relative to its largest entry."""
    value, (g_eta, g_theta) = dual_value(whole, eta, theta), dual_gradient(whole, eta, theta)
    hessian = dual_hessian(whole, eta, theta)
    assert dual_value(pieces, eta, theta) == pytest.approx(value, rel=1e-11)
    found_eta, found_theta = dual_gradient(pieces, eta, theta)
    assert found_eta == pytest.approx(g_eta, rel=1e-10, abs=1e-10)
    np.testing.assert_allclose(found_theta, g_theta, rtol=0.0, atol=1e-10 * np.abs(g_theta).max())
    np.testing.assert_allclose(
        dual_hessian(pieces, eta, theta), hessian, rtol=0.0, atol=1e-10 * np.abs(hessian).max()
    )


@pytest.mark.parametrize("order", [0, -1, 1, 2])
@pytest.mark.parametrize("cuts", [[40], [1], [79], [13, 14, 60], list(range(1, 80))])
def test_moments_of_chunks_add_up_to_those_of_all_samples(cuts: list[int], order: int) -> None:
    problem = random_problem(80)
    theta = np.random.default_rng(81).normal(size=7)
    assert_same_dual(InPieces.of(problem, cut(80, cuts, order)), problem, 0.4, theta)


@pytest.mark.parametrize("order", [0, -1, 1])
@pytest.mark.parametrize("apart", [0.3, 3.0, 30.0, 1e4])
def test_chunks_with_far_lower_errors_neither_overflow_nor_count(apart: float, order: int) -> None:
    # At eta = 0.1 a chunk that is 1e4 lower weighs exp(-1e5): nothing, but not NaN either.
    problem = random_problem(82)
    lower = np.repeat([1.0, 0.0, 2.0, 0.0], 20) * apart
    problem = replace(problem, rewards=problem.rewards - lower)
    pieces = InPieces.of(problem, cut(80, [20, 40, 60], order))
    theta = 0.3 * np.random.default_rng(83).normal(size=7)
    assert_same_dual(pieces, problem, 0.1, theta)
    assert dual_value(pieces, 0.1, theta) == pytest.approx(
        value_by_the_book(problem, 0.1, theta), rel=1e-11
    )


@pytest.mark.parametrize("eta", [0.02, 0.5, 20.0])
def test_the_kl_of_moments_is_that_of_the_weights(eta: float) -> None:
    problem = random_problem(84)
    theta = np.random.default_rng(85).normal(size=7)
    delta = bellman_errors(problem, theta)
    wanted = kl_from_uniform(sample_weights(delta, eta))
    halves = InPieces.of(problem, cut(80, [33], 0))
    for each in (problem, halves):
        found = each.moments(eta, theta, with_covariance=False)
        assert found.samples == 80
        assert found.kl == pytest.approx(wanted, rel=1e-10, abs=1e-12)
        assert found.soft_maximum == pytest.approx(
            eta * (logsumexp(delta / eta) - np.log(80)), rel=1e-11
        )


def test_the_covariance_is_computed_only_on_request() -> None:
    pieces = InPieces.of(random_problem(86), cut(80, [10], 0))
    assert pieces.moments(1.0, np.zeros(7), with_covariance=False).covariance is None
    covariance = pieces.moments(1.0, np.zeros(7), with_covariance=True).covariance
    assert covariance is not None and covariance.shape == (8, 8)


@pytest.mark.parametrize("seed", range(3))
def test_a_problem_in_pieces_has_the_solution_of_the_whole(seed: int) -> None:
    problem = random_problem(seed)
    pieces = InPieces.of(problem, cut(80, [1, 30, 70], -1))
    whole, found = solve_dual(problem), solve_dual(pieces)
    assert_optimal(pieces, found)
    assert found.iterations == whole.iterations
    np.testing.assert_allclose(found.weights, whole.weights, rtol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_the_solution_does_not_depend_on_where_the_solver_starts(seed: int) -> None:
    problem = random_problem(seed)
    cold = solve_dual(problem)
    half = replace(
        problem,
        rewards=problem.rewards[::2],
        differences=np.ascontiguousarray(problem.differences[::2]),
    )
    near = solve_dual(half)
    far = np.random.default_rng(seed).normal(size=7)
    for eta, theta in [(near.eta, near.theta), (30.0, np.zeros(7)), (0.2, far)]:
        end = minimise_by_newton(
            problem, eta, theta, 80
        )  # also from a start that is worse than zero
        assert end.converged
        weights = sample_weights(problem.bellman_errors(end.point.theta), end.point.eta)
        # the tolerance of the KL bound; measured: up to 4e-5
        np.testing.assert_allclose(weights, cold.weights, atol=1e-4 * cold.weights.max())
    assert_optimal(problem, solve_dual(problem, start=(near.eta, near.theta)))
    assert solve_dual(problem, start=(cold.eta, cold.theta)).iterations == 0


def test_a_start_that_is_worse_than_zero_is_not_used() -> None:
    """With a wrong V at the floor single samples have all weight, and steps would be tiny."""
    problem = floor_problem(0)
    cold = solve_dual(problem)
    wrong = 1e3 * np.random.default_rng(0).normal(size=problem.rank)
    found = solve_dual(problem, start=(problem.eta_floor, wrong))
    assert found.iterations == cold.iterations
    np.testing.assert_array_equal(found.weights, cold.weights)


def test_a_start_below_the_floor_begins_at_it() -> None:
    problem = floor_problem(0)
    found = solve_dual(problem, start=(0.1 * problem.eta_floor, solve_dual(problem).theta))
    assert found.iterations == 0 and found.eta == problem.eta_floor


def test_the_floor_is_found_from_a_start_at_it_and_from_far_above_it() -> None:
    problem = floor_problem(0)
    cold = solve_dual(problem)
    assert cold.outcome is Outcome.AT_FLOOR
    at_it, above = (problem.eta_floor, 0.0 * cold.theta), (9.0, cold.theta)
    for eta, theta in [(cold.eta, cold.theta), at_it, above]:
        end = minimise_by_newton(problem, eta, theta, 80)
        assert end.converged and end.point.eta == problem.eta_floor
        weights = sample_weights(problem.bellman_errors(end.point.theta), end.point.eta)
        np.testing.assert_allclose(weights, cold.weights, atol=1e-5)


def test_a_temperature_that_starts_too_low_rises() -> None:
    problem = random_problem(0)
    wanted = solve_dual(problem)
    assert wanted.outcome is Outcome.BOUND_ACTIVE
    end = minimise_by_newton(problem, problem.eta_floor + 0.05 * wanted.eta, wanted.theta, 80)
    assert end.converged
    assert end.point.eta == pytest.approx(wanted.eta, rel=1e-3)


def test_without_features_only_the_temperature_is_found() -> None:
    rewards, _ = standardise(np.random.default_rng(0).normal(size=60))
    found = solve_dual(DualProblem(rewards, np.zeros((60, 0)), 0.5, 0.1, 1e-6))
    assert found.outcome is Outcome.BOUND_ACTIVE
    assert found.kl == pytest.approx(0.5, abs=1e-4)


def test_a_run_whose_temperature_waits_for_theta_is_not_converged() -> None:
    """KL is not tested while eta waits, so the decrement has to exceed its tolerance then."""
    assert newton_step.CENTRED_DECREMENT * MIN_ETA > newton_step.DECREMENT_TOLERANCE


@dataclass(frozen=True)
class OneSingularHessian(DualProblem):
    """Two equal features, whose Hessian block is reported as singular in one of the evaluations.

    Attributes:
        singular: number of that evaluation, among those with a covariance.
        temperatures: of those evaluations so far.
    """

    singular: int = 0
    temperatures: list[float] = field(default_factory=list)

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        found = super().moments(eta, theta, with_covariance=with_covariance)
        if not with_covariance:
            return found
        self.temperatures.append(eta)
        if len(self.temperatures) != self.singular:
            return found
        assert found.covariance is not None and self.ridge == 0.25
        covariance = found.covariance.copy()
        covariance[:2, :2] = eta * (np.ones((2, 2)) - 0.25 * np.eye(2))  # the Hessian is all ones
        return replace(found, covariance=covariance)


@pytest.mark.parametrize(
    ("max_iterations", "singular", "outcome", "jitter"),
    [
        (80, 0, Outcome.BOUND_ACTIVE, 0.0),
        (80, 1, Outcome.BOUND_ACTIVE, 1e-12),
        (1, 0, Outcome.FALLBACK, 0.0),
        (1, 1, Outcome.FALLBACK, 1e-12),
        (1, 3, Outcome.FALLBACK, 1e-12),
    ],
    ids=["never", "first system", "fallback, never", "before the fallback", "in the fallback"],
)
def test_the_jitter_of_a_solution_is_the_largest_of_all_its_newton_systems(
    max_iterations: int, singular: int, outcome: Outcome, jitter: float
) -> None:
    column = random_problem(0, r=1).differences
    problem = OneSingularHessian(
        random_problem(0).rewards, np.tile(column, (1, 2)), 0.5, 0.25, TINY_FLOOR, singular
    )
    found = solve_dual(problem, max_iterations)
    assert len(problem.temperatures) > singular
    assert found.outcome is outcome
    assert found.jitter == jitter


def test_every_outcome_has_a_message_and_only_unusual_ones_a_note() -> None:
    notes = {"": 1, "eta at its floor": 1, "by bisection": 1, "NOT CONVERGED": 1}
    assert {outcome.note: 1 for outcome in Outcome} == notes
    assert Outcome.BOUND_ACTIVE.note == ""
    assert Outcome.NOT_CONVERGED.note == "NOT CONVERGED"
    for outcome in Outcome:
        assert outcome == outcome.value
        assert outcome.startswith("not converged" if outcome.note == "NOT CONVERGED" else "conv")
