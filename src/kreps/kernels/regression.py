"""Conditional embeddings (Eq. 4) and other kernel regressions on states and actions.

An embedding maps the features of observed successors to the *expected* features of the successor of
any state and action.  The same machinery regresses changes of state and rewards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.kernels.arrays import Array, FloatArray, IntArray, as_numpy
from kreps.kernels.basis import Basis, KernelExpansion, LinearFunction, RKHSBasis
from kreps.kernels.kernel import Kernel
from kreps.kernels.linalg import Cholesky, cholesky, solve_lower, with_diagonal

MAX_RESIDUAL_RATIO = 1e-4
"""Largest kernel residual of a sample in `PivotedEmbedding`, as a share of the regulariser.

A sample's residual acts like an addition to its regulariser.  At this ratio the sum over all
samples is typically below a hundredth of the regulariser.
"""

MIN_LEVERAGE_GAP = 1e-12
"""Smallest value of one minus the leverage of a sample, by which leave-one-out errors divide.
Rounding could make it zero or negative."""


@dataclass(frozen=True)
class LeaveOneOut:
    """Leave-one-out errors of a regression.

    Attributes:
        targets: (n, r) observed targets.
        errors: (n, r) targets less their predictions from all other samples.
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

    @property
    def relative_to_spread(self) -> float:
        """The same for centred targets: one is no better than their mean; nan if they are equal."""
        spread = float(np.linalg.norm(self.targets - self.targets.mean(axis=0)))
        return float(np.linalg.norm(self.errors)) / spread if spread > 0 else float("nan")


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
        """The embedding of samples at inputs (n, ds + da), at a cost of n^3.

        Raises:
            NumericalError: ``K_sa + lambda I`` cannot be factorised.
        """
        gram = kernel.gram(inputs)
        return cls(kernel, inputs, regulariser, cholesky(with_diagonal(gram, regulariser)))

    def strengths(self, inputs: Array) -> Array:
        """``beta(s, a) = (K_sa + lambda I)^-1 k_sa(s, a)``, (n, m), for inputs (m, ds + da)."""
        return self.factor.solve(self.kernel.gram(self.inputs, inputs))

    def expected_features(self, successor_features: Array) -> Array:
        """``K_sa (K_sa + lambda I)^-1 F'``, (n, r), for the observed features F' (n, r).

        By ``K = (K + lambda I) - lambda I`` this is ``F' - lambda (K_sa + lambda I)^-1 F'``, which
        needs neither K nor beta for all pairs.  A jitter of the factorisation adds to lambda.
        """
        added = self.regulariser + self.factor.jitter
        return successor_features - added * self.factor.solve(successor_features)

    def predictor(self, targets: FloatArray) -> KernelExpansion:
        """The expectation of targets (n, r) as a function of inputs (m, ds + da)."""
        return KernelExpansion(self.kernel, self.inputs, self.factor.solve(targets))

    def leave_one_out(self, targets: FloatArray) -> LeaveOneOut:
        """Errors of targets F' (n, r): ``[C^-1 F']_i / [C^-1]_ii`` with ``C = K_sa + lambda I``."""
        inverse = self.factor.inverse()
        return LeaveOneOut(targets, inverse @ targets / np.diagonal(inverse)[:, None])

    def leave_out_each(self, targets: FloatArray, rows: IntArray) -> LeaveOneOut:
        """`leave_one_out` of some samples (k,) only, at a cost of n^2 k in place of n^3."""
        columns = np.zeros((len(targets), len(rows)))
        columns[rows, np.arange(len(rows))] = 1.0
        whitened = solve_lower(self.factor.lower, columns)
        diagonal = np.einsum("ij,ij->j", whitened, whitened)
        return LeaveOneOut(targets[rows], self.factor.solve(targets)[rows] / diagonal[:, None])


@dataclass(frozen=True)
class PivotedEmbedding:
    """`KernelEmbedding` in the features of r pivots, at a cost of n r^2 instead of n^3.

    The pivots leave a residual below `MAX_RESIDUAL_RATIO` lambda on the diagonal of ``K_sa``.
    Directions in which the kernel is smaller are suppressed by the regulariser anyway.

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
        """The embedding of samples at inputs (n, ds + da).

        None if more than n / 2 pivots would be needed, which would save little.

        Raises:
            NumericalError: ``Psi'Psi + lambda I`` cannot be factorised.
        """
        tolerance = MAX_RESIDUAL_RATIO * regulariser
        basis, features = RKHSBasis.fit(
            kernel, inputs, tolerance=tolerance, max_rank=len(inputs) // 2
        )
        if basis.residual > tolerance:
            return None
        factor = cholesky(with_diagonal(features.T @ features, regulariser))
        return cls(basis, features, regulariser, factor)

    def predictor(self, targets: FloatArray) -> KernelExpansion:
        """The expectation of targets (n, r) as a function of inputs (m, ds + da)."""
        return self.basis.function(self.factor.solve(self.features.T @ targets))

    def leave_one_out(self, targets: FloatArray) -> LeaveOneOut:
        """Errors of targets (n, r) in closed form."""
        return feature_leave_one_out(self.factor, self.features, targets)

    def leave_out_each(self, targets: FloatArray, rows: IntArray) -> LeaveOneOut:
        """`leave_one_out` of some samples (k,) only."""
        errors = self.leave_one_out(targets).errors
        return LeaveOneOut(targets[rows], errors[rows])


def embedding_of(
    kernel: Kernel, inputs: FloatArray, regulariser: float
) -> PivotedEmbedding | KernelEmbedding:
    """The embedding of samples at inputs (n, ds + da), in few pivots where these suffice."""
    pivoted = PivotedEmbedding.fit(kernel, inputs, regulariser)
    return pivoted or KernelEmbedding.fit(kernel, inputs, regulariser)


@dataclass(frozen=True)
class RegressionSums:
    """Sums over samples that determine a linear regression; those of chunks add up.

    Attributes:
        gram: (q, q) ``Psi'Psi`` of the regressors psi.
        product: (q, r) ``Psi'F'`` of regressors and targets.
    """

    gram: FloatArray
    product: FloatArray

    @classmethod
    def from_samples(cls, psi: Array, targets: Array) -> RegressionSums:
        """Sums over n samples.

        Args:
            psi: (n, q) features of states and actions.
            targets: (n, r).
        """
        return cls(as_numpy(psi.T @ psi), as_numpy(psi.T @ targets))

    def __add__(self, other: RegressionSums) -> RegressionSums:
        return RegressionSums(self.gram + other.gram, self.product + other.product)


@dataclass(frozen=True)
class FeatureRegression:
    """Eq. 4 in q features psi of states and actions: ``mu(s, a) = coefficients' psi(s, a)``.

    With ``coefficients = (Psi'Psi + lambda I)^-1 Psi'F'`` it is the embedding with the kernel
    ``psi'psi``, at a cost of n q^2 instead of n^3.

    Attributes:
        mean: mu (n, r) as a function of states and applied actions (n, ds + da).
        jitter: of the factorisation of ``Psi'Psi + lambda I``.
    """

    mean: LinearFunction
    jitter: float

    @classmethod
    def fit(cls, basis: Basis, sums: RegressionSums, regulariser: float) -> FeatureRegression:
        """The regression of samples with these sums.

        Raises:
            NumericalError: ``Psi'Psi + lambda I`` cannot be factorised.
        """
        factor = cholesky(with_diagonal(sums.gram, regulariser))
        return cls(basis.function(factor.solve(sums.product)), factor.jitter)

    @staticmethod
    def leave_one_out(
        psi: FloatArray, targets: FloatArray, regulariser: float, multiplicity: float = 1.0
    ) -> LeaveOneOut:
        """Errors in closed form of a regression of targets (n, r) on features psi (n, q).

        Args:
            psi, targets: a subsample.
            regulariser: lambda.
            multiplicity: number of samples that each row of the subsample stands for.
        """
        factor = cholesky(with_diagonal(multiplicity * (psi.T @ psi), regulariser))
        return feature_leave_one_out(factor, psi, targets, multiplicity)


def feature_leave_one_out(
    factor: Cholesky, psi: FloatArray, targets: FloatArray, multiplicity: float = 1.0
) -> LeaveOneOut:
    """Errors of targets (n, r) when one of the ``multiplicity`` copies of a row is left out.

    Args:
        factor: of ``multiplicity Psi'Psi + lambda I``.
        psi: (n, q) features.
        targets: (n, r).
        multiplicity: number of samples that each row stands for.
    """
    residuals = targets - psi @ factor.solve(multiplicity * (psi.T @ targets))
    whitened = solve_lower(factor.lower, psi.T)
    leverage = np.einsum("ij,ij->j", whitened, whitened)
    leverage = np.minimum(leverage, 1.0 - MIN_LEVERAGE_GAP)
    return LeaveOneOut(targets, residuals / (1.0 - leverage)[:, None])
