"""Errors of cross-validation whose folds are whole rollouts, with analytic gradients.

Steps of one rollout resemble each other, so that a step is easily predicted from its neighbours.
These losses leave out whole rollouts instead, as the authors' scripts do: every second rollout for
V and for the embedding, one at a time for the policy.  `kreps.kernels.hyperparameters` has the
losses that leave out single samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.hyperparameters import MIN_SQUARED_ERROR
from kreps.kernels.linalg import cholesky, with_diagonal


@dataclass(frozen=True)
class HeldOutError:
    """Summed squared error of a ridge regression on held-out samples, and its derivatives.

    The error is ``|Y - G' (C + ridge I)^-1 T|^2`` for targets T (n, r) of n training samples with
    Gram matrix C (n, n), targets Y (m, r) of m held-out samples, and G (n, m) between the two.

    Attributes:
        value: the error.
        by_train: (n, n) derivative with respect to C.
        by_cross: (n, m) derivative with respect to G.
        by_ridge: derivative with respect to the ridge.
    """

    value: float
    by_train: FloatArray
    by_cross: FloatArray
    by_ridge: float

    @classmethod
    def of(
        cls,
        train: FloatArray,
        cross: FloatArray,
        targets: FloatArray,
        held_out: FloatArray,
        ridge: float,
    ) -> HeldOutError:
        factor = cholesky(with_diagonal(train, ridge))
        solved = factor.solve(targets)
        error = held_out - cross.T @ solved
        back = factor.solve(cross @ error)
        return cls(
            value=float(np.einsum("ij,ij->", error, error)),
            by_train=2.0 * back @ solved.T,
            by_cross=-2.0 * solved @ error.T,
            by_ridge=2.0 * float(np.einsum("ij,ij->", back, solved)),
        )


@dataclass(frozen=True)
class Fold:
    """Training samples (n) and held-out samples (m) of one fold.

    Attributes:
        train, cross: (g, n, n) and (g, n, m) squared distances of each factor at lengthscale one.
        train_gram, cross_gram: (n, n) and (n, m) kernel values by which those of the factors are
            multiplied.
        targets, held_out: (n, r) and (m, r).
    """

    train: FloatArray
    cross: FloatArray
    train_gram: FloatArray
    cross_gram: FloatArray
    targets: FloatArray
    held_out: FloatArray


@dataclass(frozen=True)
class EmbeddingFoldLoss:
    """Log of the mean squared error of an embedding on the fold that it is not fitted to.

    The parameters are g log lengthscales, then log lambda.
    """

    folds: Sequence[Fold]

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient (g + 1,) at parameters ``x`` (g + 1,)."""
        inverse_squares, ridge = np.exp(-2.0 * x[:-1]), float(np.exp(x[-1]))
        total, gradient = 0.0, np.zeros_like(x)
        for fold in self.folds:
            train = fold.train_gram * np.exp(-0.5 * np.tensordot(inverse_squares, fold.train, 1))
            cross = fold.cross_gram * np.exp(-0.5 * np.tensordot(inverse_squares, fold.cross, 1))
            error = HeldOutError.of(train, cross, fold.targets, fold.held_out, ridge)
            total += error.value
            by_factor = np.tensordot(fold.train, error.by_train * train, 2)
            by_factor += np.tensordot(fold.cross, error.by_cross * cross, 2)
            gradient += np.append(by_factor * inverse_squares, error.by_ridge * ridge)
        return _logarithm(total, gradient, sum(fold.held_out.size for fold in self.folds))


@dataclass(frozen=True)
class TemporalDifferenceFold:
    """One fold of n training and m held-out steps, with the training successors as centres.

    Attributes:
        distances: (4, g, n, k) squared distances of each factor at lengthscale one, from the
            centres to the training successors and states (k = n), and to the held-out successors
            and states (k = m).
        discounts, held_out_discounts: (n,) and (m,) of V at each successor.
        rewards, held_out_rewards: (n,) and (m,), less the mean of the former.
    """

    distances: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    discounts: FloatArray
    held_out_discounts: FloatArray
    rewards: FloatArray
    held_out_rewards: FloatArray


@dataclass(frozen=True)
class TemporalDifferenceFoldLoss:
    """Log of the mean squared temporal-difference error on the fold that V is not fitted to.

    V is a sum of kernel functions at the training successors.  Its coefficients are those of a
    ridge regression of the rewards on ``V(s) - gamma V(s')``.  The parameters are g log
    lengthscales, then the log of the ridge.
    """

    folds: Sequence[TemporalDifferenceFold]

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient (g + 1,) at parameters ``x`` (g + 1,)."""
        inverse_squares, ridge = np.exp(-2.0 * x[:-1]), float(np.exp(x[-1]))
        total, gradient = 0.0, np.zeros_like(x)
        for fold in self.folds:
            grams = [np.exp(-0.5 * np.tensordot(inverse_squares, d, 1)) for d in fold.distances]
            train = grams[1] - fold.discounts * grams[0]
            held = grams[3] - fold.held_out_discounts * grams[2]
            error = HeldOutError.of(
                train.T @ train,
                train.T @ held,
                fold.rewards[:, None],
                fold.held_out_rewards[:, None],
                ridge,
            )
            total += error.value
            by_train = train @ (error.by_train + error.by_train.T) + held @ error.by_cross.T
            by_held = train @ error.by_cross
            by_grams = (
                -fold.discounts * by_train,
                by_train,
                -fold.held_out_discounts * by_held,
                by_held,
            )
            by_factor = np.zeros_like(inverse_squares)
            for distances, by, gram in zip(fold.distances, by_grams, grams, strict=True):
                by_factor += np.tensordot(distances, by * gram, 2)
            gradient += np.append(by_factor * inverse_squares, error.by_ridge * ridge)
        return _logarithm(total, gradient, sum(len(f.held_out_rewards) for f in self.folds))


def _logarithm(total: float, gradient: FloatArray, count: int) -> tuple[float, FloatArray]:
    """Value and gradient of the log of a mean of squares, from those of their sum."""
    total = max(total, MIN_SQUARED_ERROR)
    return float(np.log(total / count)), gradient / total


@dataclass(frozen=True)
class PolicyFoldLoss:
    """Negative weighted log density of the actions of each rollout under the policy of all others.

    ``-sum_i p_i log N(u_i; mu_-B, sigma^2_-B)`` where B is the rollout of sample i: as
    `kreps.kernels.hyperparameters.PolicyLoss`, with which it agrees if every rollout has one
    sample.  The parameters are g log lengthscales, log signal variance sf2, log noise l.

    Attributes:
        distances: (g, m, m) squared distances of each factor at lengthscale one.
        targets: (m, da) commanded actions in units of the action scale.
        weights: (m,) the w_i; ``p_i = w_i / sum w``.
        rollouts: (m,) number of the rollout of each sample.
    """

    distances: FloatArray
    targets: FloatArray
    weights: FloatArray
    rollouts: IntArray

    def __call__(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient (g + 2,) at parameters ``x`` (g + 2,)."""
        signal, noise = np.exp(x[-2:])
        share = self.weights / self.weights.sum()
        actions = self.targets.shape[1]
        gram = signal * np.exp(-0.5 * np.tensordot(np.exp(-2.0 * x[:-2]), self.distances, 1))
        inverse = cholesky(gram + np.diag(noise / self.weights)).inverse()
        alpha = inverse @ self.targets
        blocks = [np.flatnonzero(self.rollouts == each) for each in np.unique(self.rollouts)]
        e, q, back = np.empty_like(alpha), np.empty_like(inverse), []
        variance = np.empty(len(share))
        for rows in blocks:
            covariance = np.linalg.inv(inverse[np.ix_(rows, rows)])
            e[rows] = covariance @ alpha[rows]
            q[rows] = covariance @ inverse[rows]
            variance[rows] = np.diagonal(covariance)
            back.append(inverse[:, rows] @ e[rows] - alpha)
        variance += noise * (1.0 - 1.0 / self.weights)
        squares = np.einsum("ij,ij->i", e, e)
        value = share @ (0.5 * actions * np.log(2.0 * np.pi * variance) + 0.5 * squares / variance)
        by_variance = 0.5 * share * (actions - squares / variance) / variance
        # de_B = q_B dC (A_B e_B - alpha) and dvar_B = diag(q_B dC q_B') plus the noise's own share
        pull = (share / variance)[:, None] * e
        m = q.T @ (by_variance[:, None] * q)
        for rows, residual in zip(blocks, back, strict=True):
            m += (q[rows].T @ pull[rows]) @ residual.T
        weighted = m * gram
        gradient = [
            np.einsum("ij,ij->", weighted, distance) * np.exp(-2.0 * log_l)
            for distance, log_l in zip(self.distances, x[:-2], strict=True)
        ]
        gradient.append(float(weighted.sum()))
        own = np.diagonal(m) @ (1.0 / self.weights) + by_variance @ (1.0 - 1.0 / self.weights)
        gradient.append(noise * float(own))
        return float(value), np.array(gradient)
