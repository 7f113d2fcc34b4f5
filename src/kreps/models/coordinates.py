"""A regression of several targets, each with its own kernel where that predicts it better.

The coordinates of a state depend on different columns.  The angle of a joint changes with its
velocity, a velocity with torques and angles, and a column of noise with nothing.  One kernel for
all of them has the lengthscales and the regulariser of the coordinate with the largest errors,
which is the one that can be predicted least.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, default_errstate
from kreps.kernels.basis import KernelExpansion, moments_of_centres, slopes_by_coordinates
from kreps.kernels.gram import BLOCK_ENTRIES
from kreps.kernels.kernel import Kernel, as_wide_as_spread
from kreps.kernels.regression import embedding_of
from kreps.models.transition import LOG_LENGTHSCALE_STD as SHARED_LOG_LENGTHSCALE_STD
from kreps.models.transition import HyperparameterFit, state_actions

LOG_LENGTHSCALE_STD = 2.0
"""Prior standard deviation of a log lengthscale of one coordinate.  It is twice that of all
coordinates together, as one of them depends on fewer columns."""

MAX_ERROR_RATIO = 0.9
"""Largest mean squared leave-one-out error of a coordinate's own regression, relative to that of
the shared one, at which it is used.  Predictions with one kernel cost less than with several."""

SMALLEST_EXPONENT = -650.0
"""Exponents below it are raised to it, as exponentials that are not normal numbers take ten times
as long.  The kernel value, 1e-282, has no effect on a sum."""


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
    """Regressions of different targets on the same inputs, side by side.

    All kernels are products of the same factors, ``exp(-(c - x)'W(c - x) / 2)`` in coordinates x at
    lengthscale one, with a diagonal W of inverse squared lengthscales.  So x is computed once for
    all of them, and what depends on the centres c alone once for all predictions: model rollouts
    predict few inputs at a time, at which these would take more time than the kernel values.

    Attributes:
        columns: of each part, the targets that it predicts.
        parts: a regression for each.
        width: number of all targets k.
    """

    columns: tuple[list[int], ...]
    parts: tuple[KernelExpansion, ...]
    width: int

    @default_errstate()
    def __call__(self, inputs: FloatArray) -> FloatArray:
        predictions = np.empty((len(inputs), self.width))
        embedded = self._embedded(inputs)
        for columns, part in zip(self.columns, self._prepared, strict=True):
            for rows, k in part.kernel_values(embedded):
                predictions[rows, columns] = k.T @ part.alpha
        return predictions

    @default_errstate()
    def jacobian(self, inputs: FloatArray) -> FloatArray:
        embedded = self._embedded(inputs)
        slopes = np.empty((len(inputs), self.width, embedded.shape[1]))
        for columns, part in zip(self.columns, self._prepared, strict=True):
            for rows, k in part.kernel_values(embedded):
                slopes[rows, columns] = part.slopes(k, embedded[rows])
        return self._unit_kernel.pullback(inputs, slopes)

    @cached_property
    def _unit_kernel(self) -> Kernel:
        kernel = self.parts[0].kernel
        return kernel.with_lengthscales(np.ones(len(kernel.factors)))

    @cached_property
    def _origin(self) -> FloatArray:
        """Mean coordinates (e,): a common shift, which reduces the rounding of inner products."""
        origin: FloatArray = self._unit_kernel.embed(self.parts[0].centres).mean(axis=0)
        return origin

    def _embedded(self, inputs: FloatArray) -> FloatArray:
        """Coordinates (m, e) at lengthscale one, around their origin."""
        embedded: FloatArray = self._unit_kernel.embed(inputs) - self._origin
        return embedded

    @cached_property
    def _prepared(self) -> tuple[_Part, ...]:
        first = self.parts[0].centres[:1]
        widths = [f.coordinates(first).shape[1] for f in self._unit_kernel.factors]
        return tuple(
            _Part(
                np.repeat(part.kernel.lengthscales**-2.0, widths),
                self._embedded(part.centres),
                part.alpha,
            )
            for part in self.parts
        )


@dataclass(frozen=True)
class _Part:
    """What one regression on r centres needs of them.

    Attributes:
        precision: (e,) inverse squared lengthscales W.
        centres: (r, e) c at lengthscale one, around the origin.
        alpha: (r, k) weights of k targets.
    """

    precision: FloatArray
    centres: FloatArray
    alpha: FloatArray

    @cached_property
    def _factor(self) -> FloatArray:
        """Rows ``(W c, -c'W c / 2, 1)``, (r, e + 2)."""
        scaled = self.centres * self.precision
        half_squares = 0.5 * np.sum(scaled * self.centres, axis=1, keepdims=True)
        return np.concatenate([scaled, -half_squares, np.ones_like(half_squares)], axis=1)

    @cached_property
    def _is_narrow(self) -> bool:
        """Whether exponents within the range of the centres reach `SMALLEST_EXPONENT`."""
        squares = self.precision @ np.ptp(self.centres, axis=0) ** 2
        return bool(-0.5 * squares < SMALLEST_EXPONENT)

    @cached_property
    def _moments(self) -> FloatArray:
        return moments_of_centres(self.centres, self.alpha)

    def kernel_values(self, embedded: FloatArray) -> Iterator[tuple[slice, FloatArray]]:
        """Kernel values (r, b) with inputs (m, e), in blocks of b that stay in the cache."""
        count, width = embedded.shape
        extended = np.empty((count, width + 2))  # (x, 1, -x'W x / 2)
        extended[:, :width], extended[:, width] = embedded, 1.0
        extended[:, width + 1] = -0.5 * ((embedded * embedded) @ self.precision)
        size = max(1, BLOCK_ENTRIES // len(self._factor))
        for first in range(0, count, size):
            rows = slice(first, first + size)
            k = self._factor @ extended[rows].T
            np.minimum(k, 0.0, out=k)  # rounding of a very narrow kernel could be far above
            if self._is_narrow:
                np.maximum(k, SMALLEST_EXPONENT, out=k)
            yield rows, np.exp(k, out=k)

    def slopes(self, k: FloatArray, embedded: FloatArray) -> FloatArray:
        """Derivatives (b, k, e) by the coordinates, from kernel values (r, b) of inputs (b, e)."""
        slopes: FloatArray = self.precision * slopes_by_coordinates(k.T, self._moments, embedded)
        return slopes


def wide_hyperparameters(
    inputs: FloatArray,
    targets: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
    log_lengthscale_std: float = SHARED_LOG_LENGTHSCALE_STD,
) -> tuple[Kernel, float, FloatArray]:
    """`embedding_hyperparameters` with prior lengthscales no shorter than the inputs are spread.

    Where a policy holds a state, most actions are near each other too, and their median distance
    says nothing about the others (`as_wide_as_spread`).
    """
    fit = HyperparameterFit.from_samples(
        inputs, targets, state_kernel, task, start, rng, log_lengthscale_std
    )
    kernel = as_wide_as_spread(fit.kernel, inputs)
    wider = np.append(np.log(kernel.lengthscales / fit.kernel.lengthscales), 0.0)
    prior = replace(
        fit.prior,
        centre=fit.prior.centre + wider,
        low=fit.prior.low + wider,
        high=fit.prior.high + wider,
    )
    given = fit.starts[:-2]
    others = tuple(each + wider for each in fit.starts[-2:])
    x = replace(fit, kernel=kernel, prior=prior, starts=(*given, *others)).solve()
    return kernel.with_lengthscales(np.exp(x[:-1])), float(np.exp(x[-1])), x


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
    kernel, regulariser, x = wide_hyperparameters(inputs, targets, state_kernel, task, start, rng)
    shared = embedding_of(kernel, inputs, regulariser)
    errors = shared.leave_one_out(targets).errors
    columns: list[list[int]] = []
    parts: list[KernelExpansion] = []
    of_own = rng.spawn(1)[0]  # so that all else of an update has the same random numbers as before
    jitter = shared.factor.jitter
    for group in _groups(targets, task):
        target = targets[:, group]
        kernel, regulariser, _ = wide_hyperparameters(
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
