"""Leave-one-out fits of lengthscales and regularisers, in closed form with analytic gradients.

Both criteria depend on their parameters through one matrix ``C = K + noise`` and need only
``C^-1``.  Each is minimised over log parameters, on a sample of the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from kreps.errors import NumericalError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Factor, squared_distances
from kreps.kernels.linalg import cholesky, with_diagonal


@dataclass(frozen=True)
class EmbeddingLoss:
    """Leave-one-out error of the conditional embedding as a predictor of features.

    ``log mean_i w_i |e_i|^2`` with ``e_i = [C^-1 F']_i / [C^-1]_ii`` and
    ``C = K_sa + lambda diag(1 / w_i)``: the i-th successor's features less their prediction from
    all other samples.  Weights count in both: a kind of sample that was chosen more often than
    others would else be expected more often.  Parameters: g log lengthscales, then log lambda.

    Attributes:
        distances: (g, m, m) squared distances of each factor at lengthscale one.
        features: (m, r) successor features F'.
        weights: (m,) the w_i, one on average: in which proportion these stand for all samples.
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
        """Value and gradient (g + 1,)."""
        gram, regulariser = self._gram(x)
        inverse = self._inverse(gram, regulariser)
        d = np.diagonal(inverse)
        a = inverse @ self.features
        e = a / d[:, None]
        share = self.weights / len(d)
        squares = share * np.einsum("ij,ij->i", e, e)
        total = max(float(squares.sum()), 1e-200)  # nothing to predict: a state that never moves
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
    """Weighted leave-one-out log density of the cost-sensitive Gaussian process, negated.

    ``-sum_i p_i log N(u_i; mu_-i, sigma^2_-i)``: the expected KL divergence of Sec. 2 up to a
    constant, each sample judged by the policy that the *other* samples make.  The density is that
    of a command, so its variance has the noise l once, not the l / w_i of a sample.  Parameters:
    g log lengthscales, log signal variance sf2, log noise l.

    Attributes:
        distances: (g, m, m) squared distances of each factor at lengthscale one.
        targets: (m, da) commanded actions in units of the action scale.
        weights: (m,) the w_i.
        within: (m,) sum of the variances of what a target is the mean of: the expected density of
            all of it takes the place of the density of one action.
    """

    distances: FloatArray
    targets: FloatArray
    weights: FloatArray
    target_variance: FloatArray | float = 0.0

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient (g + 2,)."""
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
    """Independent Gaussians over log parameters, and the box they are searched in.

    ``strength`` is what one unit of ``((x - centre) / spread)^2 / 2`` weighs against the loss.
    """

    centre: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray
    strength: float

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        z = (x - self.centre) / self.spread
        return 0.5 * self.strength * float(z @ z), self.strength * z / self.spread


def factor_distances(factors: tuple[Factor, ...], x: FloatArray) -> FloatArray:
    """Squared distances (g, m, m) of each factor between rows of ``x`` (m, d)."""
    return np.stack([squared_distances(factor, x) for factor in factors])


TOLERANCE = 1e-3
"""Gain of an iteration that ends a fit, as a share of the loss or, if that is below one, of one:
the losses are logarithms, and some hundred samples do not tell less apart."""


def minimise(
    loss: EmbeddingLoss | PolicyLoss,
    prior: Prior,
    *starts: FloatArray,
    max_iterations: int = 30,
) -> FloatArray:
    """Parameters of least loss plus prior within the prior's box (L-BFGS-B).

    Args:
        loss, prior: add up to what is minimised.
        starts: one or more; the search begins at the best of them.  Where all samples are taken to
            be unlike each other nothing is predicted and nothing improves, and a search that has
            once come there would stay.
        max_iterations: of the search.
    """

    def objective(x: Any) -> tuple[float, Any]:
        try:
            value, gradient = loss(x)
        except NumericalError:  # a step too far: tell the line search so
            return 1e10, np.zeros_like(x)
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
        options={"maxiter": max_iterations, "ftol": TOLERANCE},
    )
    return np.asarray(found.x, dtype=np.float64)
