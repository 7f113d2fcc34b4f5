"""A regression of several targets, each with its own kernel where that predicts it better.

The coordinates of a state depend on different columns.  The angle of a joint changes with its
velocity, a velocity with torques and angles, and a column of noise with nothing.  One kernel for
all of them has the lengthscales and the regulariser of the coordinate with the largest errors,
which is the one that can be predicted least.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import KernelExpansion
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import embedding_of
from kreps.models.transition import embedding_hyperparameters, fit_regression, state_actions

LOG_LENGTHSCALE_STD = 2.0
"""Prior standard deviation of a log lengthscale of one coordinate.  It is twice that of all
coordinates together, as one of them depends on fewer columns."""

MAX_ERROR_RATIO = 0.9
"""Largest mean squared leave-one-out error of a coordinate's own regression, relative to that of
the shared one, at which it is used.  Predictions with one kernel cost less than with several."""


class Regression(Protocol):
    """A differentiable regression of k targets on d inputs."""

    def __call__(self, inputs: FloatArray, /) -> FloatArray:
        """Predictions (m, k) at inputs (m, d)."""
        ...

    def jacobian(self, inputs: FloatArray, /) -> FloatArray:
        """Their derivatives (m, k, d)."""
        ...


@dataclass(frozen=True)
class CoordinateRegressions:
    """Regressions of different targets, side by side.

    Attributes:
        columns: of each part, the targets that it predicts.
        parts: a regression for each.
        width: number of all targets k.
    """

    columns: tuple[list[int], ...]
    parts: tuple[KernelExpansion, ...]
    width: int

    def __call__(self, inputs: FloatArray) -> FloatArray:
        predictions = np.empty((len(inputs), self.width))
        for columns, part in zip(self.columns, self.parts, strict=True):
            predictions[:, columns] = part(inputs)
        return predictions

    def jacobian(self, inputs: FloatArray) -> FloatArray:
        slopes = np.empty((len(inputs), self.width, inputs.shape[1]))
        for columns, part in zip(self.columns, self.parts, strict=True):
            slopes[:, columns] = part.jacobian(inputs)
        return slopes


def fit_coordinates(
    data: Transitions,
    targets: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> tuple[CoordinateRegressions, FloatArray, FloatArray, float]:
    """The regression of targets (n, k) on n states and applied actions.

    Args:
        data: n transitions.
        targets: (n, k), one for each coordinate of the observation.
        state_kernel: over states, at median lengthscales.
        task: limits and scale of the actions.
        start: log hyper-parameters (g + da + 1,) of the shared kernel in the last fit, if there was
            one.
        rng: draws the samples of the fits.

    Returns:
        The regression, its leave-one-out errors (n, k), the log hyper-parameters of the shared
        kernel, and the largest jitter.
    """
    inputs = state_actions(data, task)
    shared, x = fit_regression(data, targets, state_kernel, task, start, rng)
    errors = shared.leave_one_out(targets).errors
    columns: list[list[int]] = []
    parts: list[KernelExpansion] = []
    of_own = rng.spawn(1)[0]  # so that all else of an update has the same random numbers as before
    jitter = shared.factor.jitter
    for group in _groups(targets, task):
        target = targets[:, group]
        kernel, regulariser, _ = embedding_hyperparameters(
            inputs, target, state_kernel, task, x, of_own, LOG_LENGTHSCALE_STD
        )
        single = embedding_of(kernel, inputs, regulariser)
        new = single.leave_one_out(target).errors
        if np.sum(new**2) < MAX_ERROR_RATIO * np.sum(errors[:, group] ** 2):
            errors[:, group] = new
            columns.append(group)
            parts.append(single.predictor(target))
            jitter = max(jitter, single.factor.jitter)
    own = {j for group in columns for j in group}
    rest = [j for j in range(targets.shape[1]) if j not in own]
    if rest:
        columns, parts = [*columns, rest], [*parts, shared.predictor(targets[:, rest])]
    return CoordinateRegressions(tuple(columns), tuple(parts), targets.shape[1]), errors, x, jitter


def _groups(targets: FloatArray, task: TaskSpec) -> list[list[int]]:
    """The columns that may have a kernel of their own: those that share a lengthscale together.

    None in images, whose pixels are no coordinates, nor where there is only one; nor targets of
    zero.
    """
    groups = [list(factor.dims) for factor in task.observation_factors]
    if task.image_shape is not None or len(groups) < 2:
        return []
    return [group for group in groups if targets[:, group].any()]
