"""The regression of several targets, each with its own kernel where that predicts it better."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.models.coordinates import (
    CoordinateRegressions,
    fit_coordinates,
    wide_hyperparameters,
)
from kreps.models.transition import (
    embedding_hyperparameters,
    fit_regression,
    state_actions,
    state_kernel,
)

TASK = TaskSpec(3, np.array([-1.0]), np.array([1.0]))


def samples(seed: int = 0) -> Transitions:
    """Independent states and actions: only inputs matter here."""
    rng = np.random.default_rng(seed)
    return Transitions.from_rollouts(
        [
            Rollout(rng.uniform(-2.0, 2.0, (26, 3)), rng.uniform(-1.0, 1.0, (25, 1)), np.zeros(25))
            for _ in range(6)
        ]
    )


def smooth_and_noise(data: Transitions) -> FloatArray:
    """A function of one column, a function of action and another one, and noise."""
    noise = np.random.default_rng(7).normal(size=len(data))
    first, second = data.states[:, 0], data.states[:, 1]
    return np.stack([np.sin(2.0 * first), data.actions[:, 0] * second, 3.0 * noise], axis=1)


def fitted(targets: FloatArray) -> tuple[CoordinateRegressions, FloatArray, FloatArray]:
    data = samples()
    rng = np.random.default_rng(1)
    kernel = state_kernel(data, TASK, rng)
    regression, errors, _, _ = fit_coordinates(data, targets, kernel, TASK, None, rng)
    return regression, errors, state_actions(data, TASK)


def root_mean_square(errors: FloatArray) -> FloatArray:
    found: FloatArray = np.sqrt(np.mean(errors**2, axis=0))
    return found


def test_a_column_of_noise_does_not_spoil_the_others() -> None:
    data = samples()
    targets = smooth_and_noise(data)
    rng = np.random.default_rng(1)
    kernel = state_kernel(data, TASK, rng)
    shared, _ = fit_regression(data, targets, kernel, TASK, None, rng)
    with_one_kernel = root_mean_square(shared.leave_one_out(targets).errors)
    regression, errors, _ = fitted(targets)
    found = root_mean_square(errors)
    assert (found[:2] < 0.2 * with_one_kernel[:2]).all()
    assert found[2] < 1.1 * targets[:, 2].std()
    assert [0] in regression.columns and [1] in regression.columns


def test_predictions_are_those_of_the_part_of_each_column() -> None:
    regression, errors, inputs = fitted(smooth_and_noise(samples()))
    found = regression(inputs)
    assert found.shape == errors.shape
    assert sorted(j for columns in regression.columns for j in columns) == [0, 1, 2]
    for columns, part in zip(regression.columns, regression.parts, strict=True):
        np.testing.assert_allclose(found[:, columns], part(inputs), rtol=1e-9, atol=1e-11)
    # in the data the regression is closer than without the sample itself
    targets = smooth_and_noise(samples())
    assert (root_mean_square(targets - found)[:2] <= root_mean_square(errors)[:2]).all()


def test_equal_targets_share_one_kernel() -> None:
    target = np.sin(samples().states[:, 0])
    regression, errors, inputs = fitted(np.stack([target, -target, target], axis=1))
    assert regression.columns == ([0, 1, 2],)
    found = regression(inputs)
    np.testing.assert_allclose(found[:, 0], -found[:, 1], atol=1e-12)
    assert errors.shape == (len(target), 3)


def test_targets_that_are_zero_are_predicted_as_zero() -> None:
    regression, errors, inputs = fitted(np.zeros((len(samples()), 3)))
    np.testing.assert_array_equal(regression(inputs), np.zeros((len(inputs), 3)))
    np.testing.assert_array_equal(errors, np.zeros((len(inputs), 3)))


@pytest.mark.parametrize(
    ("changes", "columns"),
    [
        ({"groups": ((0, 1),)}, [[0, 1], [2]]),
        ({"groups": ((0, 1, 2),)}, [[0, 1, 2]]),
        ({"groups": ((0, 1, 2),), "image_shape": (1, 3)}, [[0, 1, 2]]),
        ({"groups": ((0,), (1,), (2,)), "image_shape": (1, 1)}, [[0, 1, 2]]),
    ],
)
def test_columns_that_share_a_lengthscale_share_a_kernel(
    changes: dict[str, Any], columns: list[list[int]]
) -> None:
    """Images have one kernel for all pixels, however many they are."""
    task, data = replace(TASK, **changes), samples()
    rng = np.random.default_rng(1)
    kernel = state_kernel(data, task, rng)
    regression, *_ = fit_coordinates(data, smooth_and_noise(data), kernel, task, None, rng)
    assert sorted(regression.columns) == columns


def test_derivatives_are_those_of_the_predictions() -> None:
    regression, _, inputs = fitted(smooth_and_noise(samples()))
    points, step = inputs[:5] + 0.01, 1e-6
    slopes = regression.jacobian(points)
    assert slopes.shape == (5, 3, 4)
    for j, unit in enumerate(np.eye(4)):
        change = regression(points + step * unit) - regression(points - step * unit)
        np.testing.assert_allclose(slopes[:, :, j], change / (2.0 * step), atol=1e-5)


def test_the_narrowest_kernels_are_not_larger_than_one() -> None:
    """Where rounding leaves nothing of the distances, an exponent could be any number."""
    regression, _, inputs = fitted(smooth_and_noise(samples()))
    narrow = tuple(
        replace(part, kernel=part.kernel.with_lengthscales(1e-9 * part.kernel.lengthscales))
        for part in regression.parts
    )
    found = replace(regression, parts=narrow)(inputs + 1e-3)
    for columns, part in zip(regression.columns, narrow, strict=True):
        assert np.abs(found[:, columns]).max() <= np.abs(part.alpha).sum()


def test_narrow_kernels_predict_the_same() -> None:
    """Kernel values too small for a normal number are raised to ones without an effect."""
    regression, _, inputs = fitted(smooth_and_noise(samples()))
    narrow = tuple(
        replace(part, kernel=part.kernel.with_lengthscales(1e-2 * part.kernel.lengthscales))
        for part in regression.parts
    )
    found = replace(regression, parts=narrow)(inputs + 1e-3)
    smallest = min(part.kernel.gram(inputs).min() for part in narrow)
    assert smallest < 1e-300
    for columns, part in zip(regression.columns, narrow, strict=True):
        wanted = part(inputs + 1e-3)
        assert np.abs(wanted).max() > 1e-3
        np.testing.assert_allclose(found[:, columns], wanted, rtol=1e-7, atol=1e-11)


def test_lengthscales_are_searched_around_the_spread_of_the_actions() -> None:
    """A policy that holds a state: most actions hardly differ, and a twentieth are at a limit."""
    data, rng = samples(), np.random.default_rng(2)
    held = np.where(np.arange(len(data)) % 20 == 0, 1.0, 1e-3 * rng.normal(size=len(data)))
    inputs = np.concatenate([data.states, held[:, None]], axis=1)
    kernel = state_kernel(data, TASK, rng)
    noise = rng.normal(size=(len(data), 1))
    arguments = (inputs, noise, kernel, TASK, None)
    wide, _, _ = wide_hyperparameters(*arguments, np.random.default_rng(1))
    median, _, _ = embedding_hyperparameters(*arguments, np.random.default_rng(1))
    assert median.lengthscales[-1] < 0.02  # a tenth of the spread
    assert wide.lengthscales[-1] > 0.1
