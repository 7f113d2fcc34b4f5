"""The fit of a regression's hyper-parameters: its subsample, weights, prior and starts."""

from __future__ import annotations

import numpy as np
import pytest

from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.sampling import effective_target_count, pps_subsample
from kreps.models.transition import (
    HyperparameterFit,
    embedding_hyperparameters,
    fit_regression,
    state_actions,
    state_kernel,
)

TASK = TaskSpec(2, np.array([-1.0]), np.array([1.0]))


@pytest.mark.parametrize("start", [None, np.array([0.3, -0.2, 0.1, -2.0])])
def test_a_fit_has_weights_a_prior_and_more_than_one_start(start: FloatArray | None) -> None:
    rng = np.random.default_rng(3)
    rollout = Rollout(rng.normal(size=(901, 2)), rng.normal(size=(900, 1)), np.zeros(900))
    data = Transitions.from_rollouts([rollout])
    kernel = state_kernel(data, TASK, rng)
    targets = rng.normal(size=(900, 2)) ** 3
    fit = HyperparameterFit.from_samples(
        state_actions(data, TASK), targets, kernel, TASK, start, np.random.default_rng(4)
    )
    squares = np.sum((targets - targets.mean(axis=0)) ** 2, axis=1)
    rows, weights = pps_subsample(squares, np.random.default_rng(4))
    assert len(rows) == 200
    np.testing.assert_array_equal(fit.loss.features, targets[rows])
    np.testing.assert_allclose(fit.loss.weights, weights / weights.mean())
    assert weights.max() > 2.0 * weights.min()
    count = effective_target_count(squares[rows], weights)
    assert fit.prior.strength == pytest.approx(2.0 / count)
    np.testing.assert_allclose(fit.prior.centre[:2], np.log(kernel.lengthscales))
    np.testing.assert_allclose(fit.kernel.lengthscales[:2], kernel.lengthscales)
    np.testing.assert_allclose(fit.prior.std, [1.0, 1.0, 1.0, 3.0])
    np.testing.assert_allclose(fit.prior.centre - fit.prior.low, [3.0, 3.0, 3.0, np.log(1e3)])
    np.testing.assert_allclose(fit.prior.high - fit.prior.centre, [3.0, 3.0, 3.0, np.log(1e3)])
    assert [float(np.exp(each[-1])) for each in fit.starts[-2:]] == pytest.approx([1e-3, 0.1])
    assert len(fit.starts) == (2 if start is None else 3)
    if start is not None:
        np.testing.assert_array_equal(fit.starts[0], start)


def test_the_kernel_and_regulariser_are_those_of_the_solved_fit() -> None:
    rng = np.random.default_rng(3)
    rollout = Rollout(rng.normal(size=(61, 2)), rng.normal(size=(60, 1)), np.zeros(60))
    data = Transitions.from_rollouts([rollout])
    kernel, targets = state_kernel(data, TASK, rng), data.states**2
    arguments = state_actions(data, TASK), targets, kernel, TASK, None
    x = HyperparameterFit.from_samples(*arguments, np.random.default_rng(4)).solve()
    found, regulariser, log_parameters = embedding_hyperparameters(
        *arguments, np.random.default_rng(4)
    )
    np.testing.assert_array_equal(log_parameters, x)
    np.testing.assert_array_equal(found.lengthscales, np.exp(x[:3]))
    assert [factor.dims for factor in found.factors] == [(0,), (1,), (2,)]
    assert regulariser == float(np.exp(x[3]))


def test_a_goal_in_eight_of_1500_samples_is_learnt() -> None:
    """A uniform draw of 200 rows would contain one of the eight on average."""
    rng = np.random.default_rng(2)
    states = rng.uniform(-1.0, 1.0, size=(1501, 2))
    at_goal = np.linspace(0.86, 1.0, 8)
    states[states[:, 0] > 0.85, 0] -= 0.3
    goals = np.arange(100, 1500, 180)
    states[goals, 0] = at_goal
    actions = rng.uniform(-1.0, 1.0, size=(1500, 1))
    rewards = -0.1 * actions[:, 0] ** 2
    rewards[goals] += 100.0
    data = Transitions.from_rollouts([Rollout(states, actions, rewards)])
    kernel = state_kernel(data, TASK, rng)
    targets = (rewards - rewards.mean())[:, None] / rewards.std()
    asked = np.column_stack([rng.uniform(0.88, 0.98, 60), rng.uniform(-0.9, 0.9, (60, 2))])
    away = asked * np.array([0.6, 1.0, 1.0])
    for seed in range(6):
        model, _ = fit_regression(data, targets, kernel, TASK, None, np.random.default_rng(seed))
        earned, elsewhere = (
            rewards.mean() + rewards.std() * model.predictor(targets)(inputs)[:, 0]
            for inputs in (asked, away)
        )
        assert np.mean(earned) > 30.0
        assert np.abs(np.mean(elsewhere)) < 5.0
