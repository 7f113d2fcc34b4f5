"""Leave-one-out fits of lengthscales and regularisers, in closed form with analytic gradients.

Both losses depend on their parameters through one matrix ``C = K + noise`` and need only ``C^-1``.
Each is minimised over log parameters on a subsample of the data (`kreps.kernels.sampling`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from kreps.errors import NumericalError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.gram import squared_distances
from kreps.kernels.kernel import Factor
from kreps.kernels.linalg import cholesky, with_diagonal

LOSS_TOLERANCE = 1e-3
"""Decrease of the loss below which an iteration ends a fit, as a share of the loss or of one,
whichever is larger.  The losses are logarithms, and their estimates from some hundred samples are
less precise than this."""

MAX_ITERATIONS = 30
"""Largest number of iterations of a fit.  Fits start where those of the previous update ended, so
that one which stops here is continued by the next update."""

REJECTED_LOSS = 1e10
"""Loss of parameters whose matrix cannot be factorised; it makes the line search step back."""

Loss = Callable[[FloatArray], tuple[float, FloatArray]]
"""Value and gradient (k,) at parameters (k,)."""

MIN_SQUARED_ERROR = 1e-200
"""Smallest mean squared error whose logarithm is taken: that of targets which are all zero."""


@dataclass(frozen=True)
class EmbeddingLoss:
    """Leave-one-out error of the conditional embedding as a predictor of features.

    ``log mean_i w_i |e_i|^2`` with ``e_i = [C^-1 F']_i / [C^-1]_ii`` and
    ``C = K_sa + lambda diag(1 / w_i)``: the features of the i-th successor less their prediction
    from all other samples.  The weights w enter the mean and the regulariser, so that samples which
    were drawn with a higher probability are not predicted with a higher one.

    The parameters are g log lengthscales, then log lambda.

    Attributes:
        distances: (g, m, m) squared distances of each factor at lengthscale one.
        features: (m, r) successor features F'.
        weights: (m,) inverse inclusion probabilities w_i, scaled to a mean of one.
    """

    distances: FloatArray
    features: FloatArray
    weights: FloatArray

    def errors(self, x: FloatArray) -> FloatArray:
        """``e``, (m, r), at parameters ``x`` (g + 1,)."""
        inverse = self._inverse(*self._gram(x))
        return inverse @ self.features / np.diagonal(inverse)[:, None]

    def _gram(self, x: FloatArray) -> tuple[FloatArray, float]:
        inverse_squares = np.exp(-2.0 * x[:-1])
        return np.exp(-0.5 * np.tensordot(inverse_squares, self.distances, 1)), float(np.exp(x[-1]))

    def _inverse(self, gram: FloatArray, regulariser: float) -> FloatArray:
        return cholesky(with_diagonal(gram, regulariser / self.weights)).inverse()

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient (g + 1,) at parameters ``x`` (g + 1,)."""
        gram, regulariser = self._gram(x)
        inverse = self._inverse(gram, regulariser)
        d = np.diagonal(inverse)
        a = inverse @ self.features
        e = a / d[:, None]
        share = self.weights / len(d)
        squares = share * np.einsum("ij,ij->i", e, e)
        total = max(float(squares.sum()), MIN_SQUARED_ERROR)
        # d total = 2 <dC, M>: de_i = -[C^-1 dC a]_i / d_i + e_i [C^-1 dC C^-1]_ii / d_i
        half = inverse * np.sqrt(squares / d)
        m = half @ half.T - a @ ((e * (share / d)[:, None]).T @ inverse)
        weighted = m * gram
        gradient = [
            2.0 * np.einsum("ij,ij->", weighted, distance) * np.exp(-2.0 * log_l)
            for distance, log_l in zip(self.distances, x[:-1], strict=True)
        ]
        gradient.append(2.0 * regulariser * float(np.sum(np.diagonal(m) / self.weights)))
        return float(np.log(total)), np.array(gradient) / total


@dataclass(frozen=True)
class PolicyLoss:
    """Negative weighted leave-one-out log density of the cost-sensitive Gaussian process.

    ``-sum_i p_i log N(u_i; mu_-i, sigma^2_-i)``: the expected KL divergence of Sec. 2 up to a
    constant, where the density of each sample is that of the policy fitted to all *other* samples.
    It is the density of a commanded action, so its variance contains the noise l once, and not the
    ``l / w_i`` of a sample.

    The parameters are g log lengthscales, log signal variance sf2, log noise l.

    Attributes:
        distances: (g, m, m) squared distances of each factor at lengthscale one.
        targets: (m, da) commanded actions in units of the action scale.
        weights: (m,) the w_i; ``p_i = w_i / sum w``.
        target_variance: (m,) variance of the actions whose mean is a target, summed over
            coordinates.  The loss is then the expected one over these actions.
    """

    distances: FloatArray
    targets: FloatArray
    weights: FloatArray
    target_variance: FloatArray | float = 0.0

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient (g + 2,) at parameters ``x`` (g + 2,)."""
        signal, noise = np.exp(x[-2:])
        share = self.weights / self.weights.sum()
        actions = self.targets.shape[1]
        gram = signal * np.exp(-0.5 * np.tensordot(np.exp(-2.0 * x[:-2]), self.distances, 1))
        inverse = cholesky(gram + np.diag(noise / self.weights)).inverse()
        kappa = np.diagonal(inverse)
        alpha = inverse @ self.targets
        e = alpha / kappa[:, None]
        squares = np.einsum("ij,ij->i", e, e) + self.target_variance
        variance = 1.0 / kappa + noise * (1.0 - 1.0 / self.weights)
        value = share @ (0.5 * actions * np.log(2.0 * np.pi * variance) + 0.5 * squares / variance)
        by_variance = 0.5 * share * (actions - squares / variance) / variance
        # d value = <dC, M> + (the noise's own share in the variance)
        a = (share / variance / kappa)[:, None] * e
        b = -(np.einsum("ij,ij->i", a, alpha) + by_variance / kappa) / kappa
        half = (inverse @ a) @ alpha.T
        m = -0.5 * (half + half.T) - (inverse * b) @ inverse
        weighted = m * gram
        gradient = [
            np.einsum("ij,ij->", weighted, distance) * np.exp(-2.0 * log_l)
            for distance, log_l in zip(self.distances, x[:-2], strict=True)
        ]
        gradient.append(float(weighted.sum()))
        gradient.append(
            noise
            * float(
                np.diagonal(m) @ (1.0 / self.weights) + by_variance @ (1.0 - 1.0 / self.weights)
            )
        )
        return float(value), np.array(gradient)


@dataclass(frozen=True)
class Prior:
    """Independent Gaussians over log parameters, and the box in which these are searched.

    Attributes:
        centre: (k,) means.
        std: (k,) standard deviations.
        low, high: (k,) limits of the box.
        strength: factor of ``sum ((x - centre) / std)^2 / 2`` beside the loss.
    """

    centre: FloatArray
    std: FloatArray
    low: FloatArray
    high: FloatArray
    strength: float

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient (k,) of the term that is added to the loss."""
        z = (x - self.centre) / self.std
        return 0.5 * self.strength * float(z @ z), self.strength * z / self.std


def factor_distances(factors: tuple[Factor, ...], x: FloatArray) -> FloatArray:
    """Squared distances (g, m, m) of g factors at lengthscale one, between inputs (m, d)."""
    return np.stack([squared_distances(factor.coordinates(x)) for factor in factors])


def minimise(
    loss: Loss,
    prior: Prior,
    *starts: FloatArray,
    max_iterations: int = MAX_ITERATIONS,
) -> FloatArray:
    """Parameters with the smallest loss plus prior within the prior's box (L-BFGS-B).

    Args:
        loss, prior: add up to what is minimised.
        starts: one or more parameters (k,), which are clipped to the box.  The search begins at the
            best of them.  Where lengthscales are so short that no sample predicts another, the
            gradient of the loss vanishes; a search from there alone would not move.
        max_iterations: of the search.
    """

    def objective(x: Any) -> tuple[float, Any]:
        try:
            value, gradient = loss(x)
        except NumericalError:
            return REJECTED_LOSS, np.zeros_like(x)
        penalty, pull = prior(x)
        return value + penalty, gradient + pull

    inside = [np.clip(start, prior.low, prior.high) for start in starts]
    best = min(inside, key=lambda x: objective(x)[0]) if len(inside) > 1 else inside[0]
    found = minimize(
        objective,
        best,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(prior.low, prior.high, strict=True)),
        options={"maxiter": max_iterations, "ftol": LOSS_TOLERANCE},
    )
    return np.asarray(found.x, dtype=np.float64)
