"""Leave-one-out losses against explicit refits and finite differences; the bounded search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from kreps.data.task import TaskSpec
from kreps.errors import NumericalError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.hyperparameters import (
    EmbeddingLoss,
    PolicyLoss,
    Prior,
    factor_distances,
    minimise,
)
from kreps.kernels.kernel import Kernel, Periodic, SquaredExponential
from kreps.policies.cost_sensitive_gp import CostSensitiveGP

FACTORS = (Periodic((0,)), SquaredExponential((1,)), SquaredExponential((2,)))


def inputs(n: int, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(-np.pi, np.pi, n), rng.normal(size=n), 3.0 * rng.normal(size=n)]
    )


def embedding_case(n: int, seed: int) -> tuple[EmbeddingLoss, FloatArray, FloatArray]:
    """The loss, the inputs that it is made of, and parameters at which to evaluate it."""
    x = inputs(n, seed)
    rng = np.random.default_rng(seed + 100)
    features = np.column_stack([np.sin(x[:, 0]), x[:, 1] * x[:, 2], rng.normal(size=n)])
    parameters = np.log([0.7, 1.3, 2.5, 0.05])
    weights = rng.uniform(0.5, 5.0, n)
    weights /= weights.mean()
    return EmbeddingLoss(factor_distances(FACTORS, x), features, weights), x, parameters


def policy_case(n: int, seed: int, actions: int) -> tuple[PolicyLoss, FloatArray, FloatArray]:
    """The same for the policy; weights lie on both sides of one."""
    x = inputs(n, seed)
    rng = np.random.default_rng(seed + 200)
    targets = np.column_stack([np.sin(x[:, 0] + j) for j in range(actions)])
    targets += 0.3 * rng.normal(size=targets.shape)
    weights = np.exp(rng.normal(size=n))
    assert weights.min() < 0.5
    assert weights.max() > 2.0
    parameters = np.log([0.8, 1.5, 4.0, 0.6, 0.15])
    return PolicyLoss(factor_distances(FACTORS, x), targets, weights), x, parameters


def finite_differences(loss: EmbeddingLoss | PolicyLoss, x: FloatArray) -> FloatArray:
    step = 1e-5
    return np.array(
        [(loss(x + step * e)[0] - loss(x - step * e)[0]) / (2.0 * step) for e in np.eye(len(x))]
    )


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("shift", [0.0, -1.0, 1.0])
def test_the_gradient_of_the_embedding_loss(seed: int, shift: float) -> None:
    loss, _, parameters = embedding_case(25, seed)
    _, gradient = loss(parameters + shift)
    wanted = finite_differences(loss, parameters + shift)
    np.testing.assert_allclose(gradient, wanted, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("actions", [1, 3])
@pytest.mark.parametrize("shift", [0.0, -1.0, 1.0])
def test_the_gradient_of_the_policy_loss(actions: int, shift: float) -> None:
    loss, _, parameters = policy_case(25, 2, actions)
    _, gradient = loss(parameters + shift)
    wanted = finite_differences(loss, parameters + shift)
    np.testing.assert_allclose(gradient, wanted, rtol=1e-5, atol=1e-8)


def test_embedding_errors_equal_those_of_refits_without_each_sample() -> None:
    loss, x, parameters = embedding_case(20, 3)
    kernel = Kernel(FACTORS, np.exp(parameters[:-1]))
    wanted = []
    noise = np.exp(parameters[-1]) / loss.weights
    for i in range(20):
        rest = np.arange(20) != i
        matrix = kernel.gram(x[rest]) + np.diag(noise[rest])
        k = kernel.gram(x[rest], x[i : i + 1])[:, 0]
        wanted.append(loss.features[i] - k @ np.linalg.solve(matrix, loss.features[rest]))
    np.testing.assert_allclose(loss.errors(parameters), wanted, atol=1e-10)
    value, _ = loss(parameters)
    mean_square = np.mean(loss.weights * np.sum(np.square(wanted), axis=1))
    assert value == pytest.approx(np.log(mean_square), rel=1e-9)


@pytest.mark.parametrize("actions", [1, 2])
def test_the_policy_loss_equals_that_of_refits_without_each_sample(actions: int) -> None:
    loss, x, parameters = policy_case(20, 4, actions)
    kernel = Kernel(FACTORS, np.exp(parameters[:-2]))
    signal, noise = np.exp(parameters[-2:])
    unit = TaskSpec(3, -np.ones(actions), np.ones(actions))
    log_densities = []
    for i in range(20):
        rest = np.arange(20) != i
        policy = CostSensitiveGP(
            unit, kernel, x[rest], loss.targets[rest], loss.weights[rest], signal, noise
        )
        mean = policy.mean(x[i : i + 1])[0]
        sigma = policy.standard_deviation(x[i : i + 1])[0]
        z = (loss.targets[i] - mean) / sigma
        log_densities.append(np.sum(-0.5 * z**2 - np.log(sigma) - 0.5 * np.log(2.0 * np.pi)))
    wanted = -np.average(log_densities, weights=loss.weights)
    assert loss(parameters)[0] == pytest.approx(wanted, rel=1e-7)


@pytest.mark.parametrize("actions", [1, 3])
@pytest.mark.parametrize("shift", [0.0, -1.0, 1.0])
def test_the_gradient_of_the_policy_loss_of_means(actions: int, shift: float) -> None:
    loss, _, parameters = policy_case(25, 11, actions)
    target_variance = np.random.default_rng(12).exponential(0.5, 25)
    alone, gradient_alone = loss(parameters + shift)
    loss = replace(loss, target_variance=target_variance)
    value, gradient = loss(parameters + shift)
    assert value > alone
    wanted = finite_differences(loss, parameters + shift)
    np.testing.assert_allclose(gradient, wanted, rtol=1e-5, atol=1e-8)
    assert np.abs(gradient - gradient_alone).max() > 0.01


@pytest.mark.parametrize("actions", [1, 2])
def test_the_loss_of_means_is_the_expected_loss_of_their_actions(actions: int) -> None:
    """Each target is the mean of five actions, whose densities follow from other states only."""
    loss, x, parameters = policy_case(12, 13, actions)
    rng = np.random.default_rng(14)
    each = rng.uniform(0.2, 1.0, size=(12, 5))
    every = rng.normal(0.0, 0.7, size=(12, 5, actions))
    weights = each.sum(axis=1)
    means = np.einsum("ij,ijk->ik", each, every) / weights[:, None]
    squares = np.sum((every - means[:, None]) ** 2, axis=2)
    target_variance = np.sum(each * squares, axis=1) / weights
    of_means = PolicyLoss(loss.distances, means, weights, target_variance)

    kernel = Kernel(FACTORS, np.exp(parameters[:-2]))
    signal, noise = np.exp(parameters[-2:])
    unit = TaskSpec(3, -np.ones(actions), np.ones(actions))
    log_densities = np.empty((12, 5))
    for i in range(12):
        rest = np.arange(12) != i
        policy = CostSensitiveGP(
            unit,
            kernel,
            np.repeat(x[rest], 5, axis=0),
            every[rest].reshape(-1, actions),
            each[rest].ravel(),
            signal,
            noise,
        )
        sigma = policy.standard_deviation(x[i : i + 1])
        z = (every[i] - policy.mean(x[i : i + 1])) / sigma
        log_densities[i] = np.sum(-0.5 * z**2 - np.log(sigma) - 0.5 * np.log(2.0 * np.pi), axis=1)
    wanted = -np.average(log_densities, weights=each)
    assert of_means(parameters)[0] == pytest.approx(wanted, rel=1e-6)


def test_factor_distances_are_those_of_each_factor() -> None:
    x = inputs(12, 5)
    found = factor_distances(FACTORS, x)
    assert found.shape == (3, 12, 12)
    lengthscales = np.array([0.5, 1.1, 2.0])
    gram = np.exp(-0.5 * np.tensordot(lengthscales**-2, found, 1))
    np.testing.assert_allclose(gram, Kernel(FACTORS, lengthscales).gram(x), atol=1e-10)


def box(parameters: FloatArray, half_width: float, strength: float = 0.0) -> Prior:
    return Prior(
        centre=parameters,
        std=np.ones_like(parameters),
        low=parameters - half_width,
        high=parameters + half_width,
        strength=strength,
    )


def test_a_prior_is_a_sum_of_quadratic_penalties() -> None:
    prior = Prior(
        centre=np.array([1.0, -2.0]),
        std=np.array([0.5, 3.0]),
        low=np.full(2, -9.0),
        high=np.full(2, 9.0),
        strength=0.7,
    )
    x = np.array([2.0, 1.0])
    value, gradient = prior(x)
    assert value == pytest.approx(0.7 * 0.5 * ((1.0 / 0.5) ** 2 + (3.0 / 3.0) ** 2))
    np.testing.assert_allclose(gradient, [0.7 * 1.0 / 0.25, 0.7 * 3.0 / 9.0])


def test_the_search_lowers_the_loss_to_a_stationary_point() -> None:
    loss, _, parameters = policy_case(60, 6, 1)
    found = minimise(loss, box(parameters, 4.0, strength=0.05), parameters, max_iterations=200)
    value, gradient = loss(found)
    penalty, pull = box(parameters, 4.0, strength=0.05)(found)
    assert value + penalty < loss(parameters)[0] - 0.01
    assert np.abs(gradient + pull).max() < 0.01


def test_the_search_recovers_the_lengthscale_of_smooth_data() -> None:
    # Columns 1 and 2 are irrelevant: a long lengthscale removes their effect.
    rng = np.random.default_rng(7)
    x = inputs(80, 7)
    features = np.column_stack([np.cos(3.0 * x[:, 0]), np.sin(3.0 * x[:, 0])])
    features += 0.05 * rng.normal(size=features.shape)
    loss = EmbeddingLoss(factor_distances(FACTORS, x), features, np.ones(len(x)))
    start = np.log([1.0, 1.0, 3.0, 1e-2])
    found = minimise(loss, box(start, 3.0), start, max_iterations=100)
    assert loss(found)[0] < np.log(0.05)
    assert found[0] < start[0]
    assert found[1] > start[1] + 1.0
    assert found[2] > start[2] + 1.0


def test_the_search_begins_at_the_best_of_its_starts() -> None:
    loss, _, parameters = embedding_case(60, 15)
    flat = np.append(
        np.full(3, -7.0), parameters[-1]
    )  # lengthscales so short that nothing is predicted
    prior = box(parameters, 12.0)
    np.testing.assert_allclose(loss(flat)[1], 0.0, atol=1e-12)
    np.testing.assert_array_equal(minimise(loss, prior, flat), flat)
    wanted = minimise(loss, prior, parameters)
    for starts in ((flat, parameters), (parameters, flat)):
        np.testing.assert_array_equal(minimise(loss, prior, *starts), wanted)
    assert loss(wanted)[0] < loss(flat)[0]


@pytest.mark.parametrize("half_width", [0.01, 0.3])
def test_the_search_stays_within_the_box(half_width: float) -> None:
    loss, _, parameters = embedding_case(30, 8)
    prior = box(parameters, half_width)
    found = minimise(loss, prior, parameters)
    assert (found >= prior.low).all()
    assert (found <= prior.high).all()
    assert np.isin(found, [prior.low, prior.high]).any()  # the minimum lies outside


class RecordedLoss:
    """A function of one parameter with its gradient, and where it was evaluated."""

    def __init__(self, function: Callable[[float], tuple[float, float]]) -> None:
        self.function, self.asked = function, list[float]()

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        self.asked.append(float(x[0]))
        value, slope = self.function(float(x[0]))
        return value, np.array([slope])


BOX = Prior(np.zeros(1), np.ones(1), np.full(1, -1.0), np.full(1, 2.0), 0.0)


def searched(
    function: Callable[[float], tuple[float, float]], *starts: float
) -> tuple[float, list[float]]:
    """Where the search within -1 and 2 ends, and the points that it evaluated."""
    loss = RecordedLoss(function)
    points = (np.array([start]) for start in starts)
    return float(minimise(loss, BOX, *points)[0]), loss.asked  # type: ignore[arg-type]


def test_a_start_outside_the_box_is_moved_into_it() -> None:
    loss, _, parameters = embedding_case(30, 9)
    prior = box(parameters, 0.1)
    found = minimise(loss, prior, parameters + 50.0)
    assert (found <= prior.high).all()
    assert loss(found)[0] <= loss(prior.high)[0]


@pytest.mark.parametrize(("start", "clipped"), [(-7.0, -1.0), (0.5, 0.5), (9.0, 2.0)])
def test_a_search_without_slope_ends_at_its_start_clipped_to_the_box(
    start: float, clipped: float
) -> None:
    assert searched(lambda x: (0.0, 0.0), start)[0] == clipped
    assert searched(lambda x: (0.0, 0.0), start, 1.5)[0] == clipped


def test_no_point_outside_the_box_is_evaluated() -> None:
    for starts in ((-7.0,), (9.0,), (-7.0, 9.0), (9.0, 0.5, -7.0)):
        found, asked = searched(lambda x: ((x - 30.0) ** 2, 2.0 * (x - 30.0)), *starts)
        assert found == 2.0
        assert min(asked) >= -1.0 and max(asked) <= 2.0


def test_starts_are_compared_where_they_are_clipped_to() -> None:
    """Beyond the box the loss is lower than anywhere within; at the edge it is the highest."""

    def stepped(x: float) -> tuple[float, float]:
        return (-9.0 if x > 2.0 else 3.0 if x == 2.0 else 1.0), 0.0

    assert searched(stepped, 9.0, 0.5)[0] == 0.5
    assert searched(stepped, 0.5, 9.0)[0] == 0.5


def test_the_search_stops_at_its_limit_of_iterations() -> None:
    def narrow(x: FloatArray) -> tuple[float, FloatArray]:
        a, b = x  # Rosenbrock's valley, which takes dozens of iterations
        value = (1.0 - a) ** 2 + 100.0 * (b - a * a) ** 2
        slopes = [-2.0 * (1.0 - a) - 400.0 * a * (b - a * a), 200.0 * (b - a * a)]
        return 1e6 * value, 1e6 * np.array(slopes)

    prior = Prior(np.zeros(2), np.ones(2), np.full(2, -9.0), np.full(2, 9.0), 0.0)
    start = np.array([-1.2, 1.0])
    values = [
        narrow(minimise(narrow, prior, start, max_iterations=n))[0]  # type: ignore[arg-type]
        for n in (1, 5, 30)
    ]
    assert values[0] > values[1] > values[2]
    by_default = minimise(narrow, prior, start)  # type: ignore[arg-type]
    np.testing.assert_allclose(narrow(by_default)[0], values[2])


def test_a_strong_prior_pulls_to_its_centre_and_a_weak_one_does_not() -> None:
    loss, _, parameters = policy_case(40, 10, 1)
    free, weak, strong = (
        minimise(loss, box(parameters, 5.0, strength), parameters + 0.5, max_iterations=100)
        for strength in (0.0, 0.02, 1e4)
    )
    distance = [np.linalg.norm(x - parameters) for x in (free, weak, strong)]
    assert distance[0] > distance[1] > distance[2]
    assert distance[2] < 1e-3


@dataclass(frozen=True)
class BrokenBeyond:
    """A convex function with its minimum at 2.5 that cannot be evaluated beyond 3."""

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        if x[0] > 3.0:
            raise NumericalError("too far")
        # Steep far away, so that the first step of a line search overshoots.
        return float(np.exp(2.5 - x[0]) + x[0]), 1.0 - np.exp(2.5 - x)


def test_the_search_survives_parameters_that_cannot_be_factorised() -> None:
    prior = Prior(np.zeros(1), np.ones(1), np.full(1, -2.0), np.full(1, 100.0), 0.0)
    found = minimise(BrokenBeyond(), prior, np.array([-2.0]))  # type: ignore[arg-type]
    assert found[0] == pytest.approx(2.5, abs=0.1)
