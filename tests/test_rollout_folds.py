"""Cross-validation over rollouts, as in the authors' scripts: its losses and what they choose."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.linalg import inv

from kreps.algorithms.state import LearnerState
from kreps.algorithms.update import update
from kreps.data.compute import Compute
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.folds import (
    EmbeddingFoldLoss,
    Fold,
    PolicyFoldLoss,
    TemporalDifferenceFold,
    TemporalDifferenceFoldLoss,
)
from kreps.kernels.hyperparameters import PolicyLoss
from kreps.kernels.kernel import Kernel
from kreps.models.rollout_folds import fit_embedding_by_folds, fitted_state_kernel, folds_of
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.presets import settings_of

TASK = TaskSpec(2, [-2.0], [2.0])


def squares(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.moveaxis((a[:, None] - b[None]) ** 2, 2, 0)


def gram(a: FloatArray, b: FloatArray, lengthscales: FloatArray) -> FloatArray:
    return np.exp(-0.5 * np.sum((a[:, None] - b[None]) ** 2 / lengthscales**2, axis=2))


def assert_gradient(loss: Callable[[FloatArray], tuple[float, FloatArray]], x: FloatArray) -> None:
    h = 1e-6
    steps = h * np.eye(len(x))
    numeric = [(loss(x + step)[0] - loss(x - step)[0]) / (2.0 * h) for step in steps]
    np.testing.assert_allclose(loss(x)[1], numeric, rtol=1e-6, atol=1e-8)


# ---- losses -----------------------------------------------------------------------------------


def test_the_embedding_loss_is_the_error_on_the_other_fold() -> None:
    rng = np.random.default_rng(0)
    a, b, s, t = (rng.normal(size=(n, 2)) for n in (12, 9, 12, 9))
    ones = np.ones(2)
    inside, across = gram(s, s, ones), gram(s, t, ones)
    fold = Fold(
        squares(a, a),
        squares(a, b),
        inside,
        across,
        rng.normal(size=(12, 3)),
        rng.normal(size=(9, 3)),
    )
    loss, x = EmbeddingFoldLoss([fold, fold]), np.array([0.1, -0.2, -1.0])
    lengthscales, ridge = np.exp(x[:2]), np.exp(-1.0)
    solved = inv(inside * gram(a, a, lengthscales) + ridge * np.eye(12)) @ fold.targets
    error = fold.held_out - (across * gram(a, b, lengthscales)).T @ solved
    assert loss(x)[0] == pytest.approx(np.log(np.mean(error**2)))
    assert_gradient(loss, x)


def test_the_loss_of_v_is_the_temporal_difference_error_of_a_ridge_regression() -> None:
    rng = np.random.default_rng(1)
    before, after, held, held_after = (rng.normal(size=(n, 2)) for n in (12, 12, 9, 9))
    pairs = [(after, each) for each in (after, before, held_after, held)]
    fold = TemporalDifferenceFold(
        tuple(squares(*pair) for pair in pairs),  # type: ignore[arg-type]
        np.full(12, 0.9),
        np.where(np.arange(9) == 4, 0.0, 0.9),
        rng.normal(size=12),
        rng.normal(size=9),
    )
    loss, x = TemporalDifferenceFoldLoss([fold]), np.array([0.1, -0.2, -2.0])
    k = [gram(*pair, np.exp(x[:2])) for pair in pairs]
    # V = sum_j c_j k(s'_j, .); V(s) - gamma V(s') is to be the reward
    train, test = k[1] - 0.9 * k[0], k[3] - fold.held_out_discounts * k[2]
    c = inv(train @ train.T + np.exp(-2.0) * np.eye(12)) @ train @ fold.rewards
    error = test.T @ c - fold.held_out_rewards
    assert loss(x)[0] == pytest.approx(np.log(np.mean(error**2)))
    assert_gradient(loss, x)


def test_the_loss_of_the_policy_leaves_out_whole_rollouts() -> None:
    rng = np.random.default_rng(2)
    states, actions = rng.normal(size=(12, 2)), rng.normal(size=(12, 2))
    weights = rng.uniform(0.2, 1.0, 12)
    rollouts = np.array([0, 0, 0, 1, 1, 2, 2, 2, 2, 3, 3, 0])
    x = np.array([0.1, -0.2, -0.3, -1.0])
    loss = PolicyFoldLoss(squares(states, states), actions, weights, rollouts)
    assert_gradient(loss, x)
    # each rollout under the Gaussian process of all others
    signal, noise, lengthscales = np.exp(-0.3), np.exp(-1.0), np.exp(x[:2])
    total = 0.0
    for left_out in range(4):
        test, rest = rollouts == left_out, rollouts != left_out
        k = signal * gram(states[rest], states[test], lengthscales)
        c = signal * gram(states[rest], states[rest], lengthscales) + np.diag(noise / weights[rest])
        mean = k.T @ inv(c) @ actions[rest]
        variance = signal + noise - np.einsum("ij,ij->j", k, inv(c) @ k)
        squared = np.sum((actions[test] - mean) ** 2, axis=1)
        density = -np.log(2.0 * np.pi * variance) - 0.5 * squared / variance
        total -= float(weights[test] @ density) / weights.sum()
    assert loss(x)[0] == pytest.approx(total)


def test_of_rollouts_of_one_step_it_is_the_leave_one_out_loss() -> None:
    rng = np.random.default_rng(3)
    states, actions = rng.normal(size=(10, 2)), rng.normal(size=(10, 1))
    weights, x = rng.uniform(0.2, 1.0, 10), np.array([0.1, -0.2, -0.3, -1.0])
    folds = PolicyFoldLoss(squares(states, states), actions, weights, np.arange(10))(x)
    each = PolicyLoss(squares(states, states), actions, weights)(x)
    assert folds[0] == pytest.approx(each[0])
    np.testing.assert_allclose(folds[1], each[1])


# ---- what they choose -------------------------------------------------------------------------


def rollouts_of(count: int, steps: int = 20, seed: int = 0) -> list[Rollout]:
    """A state that moves with the action, beside one that is noise; reward of the first only."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        actions = rng.normal(0.0, 1.5, (steps, 1))
        position = np.cumsum(np.append(2.0 * rng.normal(), 0.1 * np.clip(actions[:, 0], -2, 2)))
        points = np.column_stack([position, rng.normal(size=steps + 1)])
        made.append(Rollout(points, actions, -np.minimum(position[:-1] ** 2, 3.0)))
    return made


def test_folds_are_even_and_odd_rollouts() -> None:
    data = Transitions.from_rollouts(rollouts_of(5))
    first, second = folds_of(data)
    assert {*(data.rollout[first[0]] % 2)} == {0} and {*(data.rollout[first[1]] % 2)} == {1}
    np.testing.assert_array_equal(np.sort(np.concatenate(first)), np.arange(100))
    assert (second[0] == first[1]).all() and (second[1] == first[0]).all()
    alone, _ = folds_of(Transitions.from_rollouts(rollouts_of(1)))
    np.testing.assert_array_equal(alone[0], np.arange(0, 20, 2))
    assert folds_of(Transitions.from_rollouts(rollouts_of(1, steps=1))) == []
    many, _ = folds_of(Transitions.from_rollouts(rollouts_of(40)))
    assert 450 <= len(many[0]) + len(many[1]) <= 500


def test_v_ignores_a_coordinate_without_information() -> None:
    # with frequent restarts; the longer rollouts are, the less the criterion tells them apart
    for seed in range(3):
        data = Transitions.from_rollouts(rollouts_of(12, seed=seed))
        kernel = Kernel(TASK.state_factors, np.array([1.0, 1.7]))
        fitted = fitted_state_kernel(data, data.rewards, kernel, 0.9)
        assert fitted.lengthscales[1] > 3.0 * fitted.lengthscales[0]


def test_the_embedding_has_the_kernel_of_v_and_predicts_unseen_rollouts() -> None:
    data = Transitions.from_rollouts(rollouts_of(12))
    kernel = Kernel(TASK.state_factors, np.array([0.8, 20.0]))
    targets = data.points[data.successor][:, :1]
    model, x = fit_embedding_by_folds(data, targets, kernel, TASK)
    np.testing.assert_allclose(np.exp(x[:2]), kernel.lengthscales)
    np.testing.assert_allclose(model.kernel.lengthscales, np.exp(x[:3]))
    assert model.regulariser == pytest.approx(np.exp(x[3]))
    new = Transitions.from_rollouts(rollouts_of(4, seed=5))
    inputs = np.concatenate([new.states, TASK.scaled_applied(new.actions)], axis=1)
    error = model.predictor(targets)(inputs) - new.points[new.successor][:, :1]
    assert np.mean(error**2) < 0.1 * np.var(new.points[new.successor][:, 0])


def test_an_update_by_the_authors_settings_is_certified_and_holds_the_bound() -> None:
    settings = settings_of("authors", restart_probability=0.05)
    state = LearnerState(ReplayWindow(TASK, 30))
    new, info = update(state, rollouts_of(8), settings, np.random.default_rng(0), Compute())
    assert info.dual.converged
    assert info.dual.kl == pytest.approx(0.5, rel=1e-3)
    assert info.ridge == 1e-6
    assert info.embedding_parameters is not None
    # Eq. 4 has the kernel of V
    np.testing.assert_allclose(info.embedding_parameters[:2], info.state_lengthscales)
    assert isinstance(new.policy, CostSensitiveGP)
    assert new.policy.weights.max() == 1.0


@pytest.mark.parametrize("changes", [{"low_rank": "low_rank"}, {"model": "dynamics"}])
def test_cross_validation_over_rollouts_is_of_exact_embeddings(changes: dict[str, str]) -> None:
    with pytest.raises(
        ConfigurationError, match=r'cross_validation = "rollouts".*preset="authors"'
    ):
        settings_of("authors", **changes)
