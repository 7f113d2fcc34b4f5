"""The probability that an episode ends, as a function of the successor.

Terminations are a function of the state that is reached (a fallen robot, a goal), whatever the
action was, and they jump where the dynamics are smooth.  So they have a regression of their own on
the successor, with its own lengthscales.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.kernels.arrays import Array, FloatArray, namespace
from kreps.kernels.basis import Basis, LinearFunction
from kreps.kernels.hyperparameters import EmbeddingLoss, Prior, factor_distances, minimise
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import (
    FeatureRegression,
    RegressionSums,
    embedding_of,
)
from kreps.kernels.sampling import effective_target_count, pps_subsample

REGULARISER = 1e-2
"""Prior mean of the regulariser; the other numbers are ranges and prior standard deviations."""
REGULARISER_RANGE = (1e-6, 1.0)
LOG_REGULARISER_STD = 3.0
LOG_LENGTHSCALE_STD = 1.5
LOG_LENGTHSCALE_RANGE = (-3.0, 5.0)
"""Of the logarithm of a lengthscale relative to the median distance.  Most coordinates have no
effect on a termination, so long lengthscales are likely."""
LONG_LENGTHSCALES = 1.0
"""Log lengthscales, relative to the median distance, of a second start of the search."""


@dataclass(frozen=True)
class Terminations:
    """The termination model of n samples.

    Attributes:
        regression: terminations (m, 1) of successors (m, ds), not clipped.
        loo_residuals: (n,) leave-one-out errors.
        jitter: of the factorisation.
    """

    regression: LinearFunction
    loo_residuals: FloatArray
    jitter: float

    def probabilities(self, successors: Array) -> Array:
        """Probabilities (m,) that an episode ends in successors (m, ds)."""
        return as_probabilities(self.regression)(successors)

    def jacobian(self, successors: FloatArray, probabilities: FloatArray) -> FloatArray:
        """Derivatives (m, ds) of probabilities (m,) by successors (m, ds); zero where clipped."""
        clipped = (probabilities <= 0.0) | (probabilities >= 1.0)
        return np.where(clipped[:, None], 0.0, self.regression.jacobian(successors)[:, 0])


def as_probabilities(regression: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Probabilities (m,) from a regression of terminations (m, 1), clipped to [0, 1]."""

    def clipped(inputs: Array) -> Array:
        predicted = regression(inputs)[:, 0]
        return namespace(predicted).clip(predicted, 0.0, 1.0)

    return clipped


def targets_of(data: Transitions) -> FloatArray:
    """One where a step terminated, else zero, (n, 1)."""
    return data.terminated[:, None].astype(np.float64)


def termination_hyperparameters(
    data: Transitions, state_kernel: Kernel, rng: np.random.Generator
) -> tuple[Kernel, float]:
    """Kernel over successors and regulariser of the termination model, by leave-one-out error.

    Args:
        data: n transitions, of which some terminated.
        state_kernel: at median lengthscales, which are the prior mean.
        rng: draws the samples of the fit.
    """
    successors = data.points[data.successor]
    terminated = targets_of(data)
    rows, weights = pps_subsample(terminated[:, 0], rng)
    median = np.log(state_kernel.lengthscales)
    prior = Prior(
        centre=np.append(median, np.log(REGULARISER)),
        std=np.append(np.full(len(median), LOG_LENGTHSCALE_STD), LOG_REGULARISER_STD),
        low=np.append(median + LOG_LENGTHSCALE_RANGE[0], np.log(REGULARISER_RANGE[0])),
        high=np.append(median + LOG_LENGTHSCALE_RANGE[1], np.log(REGULARISER_RANGE[1])),
        strength=2.0 / effective_target_count(terminated[rows, 0], weights),
    )
    distances = factor_distances(state_kernel.factors, successors[rows])
    loss = EmbeddingLoss(distances, terminated[rows], weights / weights.mean())
    long = np.append(np.full(len(median), LONG_LENGTHSCALES), 0.0)
    x = minimise(loss, prior, prior.centre, prior.centre + long)
    return state_kernel.with_lengthscales(np.exp(x[:-1])), float(np.exp(x[-1]))


def fit_terminations(
    data: Transitions, state_kernel: Kernel, rng: np.random.Generator
) -> Terminations | None:
    """The termination model of n transitions; None if no episode terminated.

    Args:
        data: n transitions.
        state_kernel: over states, at median lengthscales.
        rng: draws the samples of the fit.
    """
    if not data.terminated.any():
        return None
    kernel, regulariser = termination_hyperparameters(data, state_kernel, rng)
    successors = data.points[data.successor]
    terminated = targets_of(data)
    model = embedding_of(kernel, successors, regulariser)
    errors = model.leave_one_out(terminated).errors[:, 0]
    return Terminations(model.predictor(terminated), errors, model.factor.jitter)


def fit_terminations_in_features(
    data: Transitions,
    state_kernel: Kernel,
    rng: np.random.Generator,
    basis_of: Callable[[Kernel, FloatArray], Basis],
) -> Terminations | None:
    """The same in features of the successor, for many samples.

    Args:
        data, state_kernel, rng: as of `fit_terminations`.
        basis_of: features of a kernel over states, with centres among points (n, ds).
    """
    if not data.terminated.any():
        return None
    kernel, regulariser = termination_hyperparameters(data, state_kernel, rng)
    successors, terminated = data.points[data.successor], targets_of(data)
    basis = basis_of(kernel, successors)
    psi = basis.features(successors)
    sums = RegressionSums.from_samples(psi, terminated)
    model = FeatureRegression.fit(basis, sums, regulariser)
    errors = FeatureRegression.leave_one_out(psi, terminated, regulariser).errors[:, 0]
    return Terminations(model.mean, errors, model.jitter)
