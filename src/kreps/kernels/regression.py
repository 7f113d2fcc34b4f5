"""Eq. 4: the conditional embedding of the transition model, and its sample-based special case.

Both answer one question: given the features of the observed successors, what are the *expected*
features of the successor of each sampled state and action?
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kreps.kernels.arrays import Array, FloatArray, as_numpy
from kreps.kernels.basis import Basis, RKHSBasis
from kreps.kernels.gram import gaussian_gram
from kreps.kernels.kernel import Kernel
from kreps.kernels.linalg import Cholesky, cholesky, solve_lower, with_diagonal

ROWS = 2048
"""Inputs predicted at once: their Gram matrix with all samples would be the largest array."""


class TransitionModel(Protocol):
    def expected_features(self, successor_features: Array) -> Array:
        """``E[phi(s') | s_i, a_i]``, (n, r), from the observed ``phi(s'_i)``, (n, r)."""
        ...


@dataclass(frozen=True)
class LeaveOneOut:
    """How far a model is wrong, judged at each sample by what all others say of it.

    Attributes:
        targets: (n, r) what was to be predicted.
        errors: (n, r) targets less their predictions from the other samples.
    """

    targets: FloatArray
    errors: FloatArray

    @property
    def mean_square(self) -> float:
        """``mean_i |e_i|^2``."""
        return float(np.einsum("ij,ij->", self.errors, self.errors)) / len(self.errors)

    @property
    def relative(self) -> float:
        """``sqrt(sum |e_i|^2 / sum |target_i|^2)``: one is no better than predicting zero."""
        size = float(np.linalg.norm(self.targets))
        return float(np.linalg.norm(self.errors)) / size if size > 0 else 0.0


@dataclass(frozen=True)
class KernelEmbedding:
    """The conditional embedding ``mu(s, a) = sum_i beta_i(s, a) phi(s'_i)`` (Eq. 4).

    Attributes:
        kernel: over states and applied actions, side by side.
        inputs: (n, ds + da) sampled states and applied actions.
        regulariser: lambda.
        factor: Cholesky factor of ``K_sa + lambda I``.
    """

    kernel: Kernel
    inputs: Array
    regulariser: float
    factor: Cholesky

    @classmethod
    def fit(cls, kernel: Kernel, inputs: Array, regulariser: float) -> KernelEmbedding:
        gram = kernel.gram(inputs)
        return cls(kernel, inputs, regulariser, cholesky(with_diagonal(gram, regulariser)))

    def strengths(self, inputs: Array) -> Array:
        """``beta(s, a) = (K_sa + lambda I)^-1 k_sa(s, a)``, (n, m), for inputs (m, ds + da)."""
        return self.factor.solve(self.kernel.gram(self.inputs, inputs))

    def expected_features(self, successor_features: Array) -> Array:
        """``K_sa (K_sa + lambda I)^-1 F'``, (n, r), without forming beta for all pairs.

        By ``K = (K + lambda I) - lambda I`` this is ``F' - lambda (K_sa + lambda I)^-1 F'``.
        """
        added = self.regulariser + self.factor.jitter
        return successor_features - added * self.factor.solve(successor_features)

    def predictor(self, targets: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """What is expected of targets (n, r) as a function of inputs (m, ds + da)."""
        solved = self.factor.solve(targets)
        known = self.kernel.embed(self.inputs)

        def predict(inputs: FloatArray) -> FloatArray:
            expected = np.empty((len(inputs), *solved.shape[1:]))
            for first in range(0, len(inputs), ROWS):
                block = slice(first, first + ROWS)
                expected[block] = gaussian_gram(self.kernel.embed(inputs[block]), known) @ solved
            return expected

        return predict

    def leave_one_out(self, targets: FloatArray) -> LeaveOneOut:
        """In closed form, of targets (n, r): ``[C^-1 F']_i / [C^-1]_ii``."""
        inverse = self.factor.inverse()
        return LeaveOneOut(targets, inverse @ targets / np.diagonal(inverse)[:, None])


NEGLIGIBLE = 1e-4
"""Part of its regulariser by which a regression may miss the kernel of a sample with itself: what
is left out in all is then typically below a hundredth of it."""


@dataclass(frozen=True)
class PivotedEmbedding:
    """`KernelEmbedding` in features of a few pivots, which leave next to nothing of its kernel out.

    What is left out of the diagonal of ``K_sa`` is below `NEGLIGIBLE` lambda, so hardly anything
    that the regulariser lets through is lost, at a cost of n r^2 instead of n^3.

    Attributes:
        basis: r features psi of states and applied actions.
        features: (n, r) those of the samples, Psi.
        regulariser: lambda.
        factor: Cholesky factor of ``Psi'Psi + lambda I``.
    """

    basis: RKHSBasis
    features: FloatArray
    regulariser: float
    factor: Cholesky

    @classmethod
    def fit(cls, kernel: Kernel, inputs: FloatArray, regulariser: float) -> PivotedEmbedding | None:
        """None where half as many pivots as samples do not suffice, and nothing would be saved."""
        tolerance = NEGLIGIBLE * regulariser
        basis, features = RKHSBasis.fit(
            kernel, inputs, tolerance=tolerance, max_rank=len(inputs) // 2
        )
        if basis.residual > tolerance:
            return None
        factor = cholesky(with_diagonal(features.T @ features, regulariser))
        return cls(basis, features, regulariser, factor)

    def predictor(self, targets: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """What is expected of targets (n, r) as a function of inputs (m, ds + da)."""
        return self.basis.function(self.factor.solve(self.features.T @ targets))

    def leave_one_out(self, targets: FloatArray) -> LeaveOneOut:
        """In closed form, of targets (n, r)."""
        return feature_leave_one_out(self.factor, self.features, targets)


@dataclass(frozen=True)
class SampleModel:
    """The single observed successor stands for the expectation: ``ksa = identity`` in Eq. 4."""

    def expected_features(self, successor_features: Array) -> Array:
        return successor_features


@dataclass(frozen=True)
class RegressionSums:
    """What samples say of features as linear functions of features; sums over chunks add up.

    Attributes:
        gram: (q, q) ``Psi'Psi``.
        product: (q, r) ``Psi'F'``.
    """

    gram: FloatArray
    product: FloatArray

    @classmethod
    def of(cls, psi: Array, targets: Array) -> RegressionSums:
        """Of features (n, q) of states and actions and their targets (n, r)."""
        return cls(as_numpy(psi.T @ psi), as_numpy(psi.T @ targets))

    def __add__(self, other: RegressionSums) -> RegressionSums:
        return RegressionSums(self.gram + other.gram, self.product + other.product)


@dataclass(frozen=True)
class FeatureRegression:
    """Eq. 4 in q features psi of states and actions: ``mu(s, a) = coefficients' psi(s, a)``.

    With ``coefficients = (Psi'Psi + lambda I)^-1 Psi'F'`` it is the embedding of the kernel
    ``psi'psi`` at a cost of n q^2 instead of n^3.

    Attributes:
        mean: mu (n, r) as a function of states and applied actions (n, ds + da).
        jitter: of the factorisation.
    """

    mean: Callable[[Array], Array]
    jitter: float

    @classmethod
    def fit(cls, basis: Basis, sums: RegressionSums, regulariser: float) -> FeatureRegression:
        factor = cholesky(with_diagonal(sums.gram, regulariser))
        return cls(basis.function(factor.solve(sums.product)), factor.jitter)

    @staticmethod
    def leave_one_out(
        psi: FloatArray,
        targets: FloatArray,
        regulariser: float,
        stands_for: float = 1.0,
    ) -> LeaveOneOut:
        """That of a regression of targets (n, r) on features psi (n, q), in closed form.

        Where these are a part of the samples, each ``stands_for`` as many of them.
        """
        factor = cholesky(with_diagonal(stands_for * (psi.T @ psi), regulariser))
        return feature_leave_one_out(factor, psi, targets, stands_for)


def feature_leave_one_out(
    factor: Cholesky, psi: FloatArray, targets: FloatArray, stands_for: float = 1.0
) -> LeaveOneOut:
    """That of targets (n, r) on features psi (n, q), by the factor of ``Psi'Psi + lambda I``."""
    residuals = targets - psi @ factor.solve(stands_for * (psi.T @ targets))
    whitened = solve_lower(factor.lower, psi.T)
    leverage = np.minimum(np.einsum("ij,ij->j", whitened, whitened), 1.0 - 1e-12)
    return LeaveOneOut(targets, residuals / (1.0 - leverage)[:, None])
