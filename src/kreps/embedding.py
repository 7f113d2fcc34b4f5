"""Eq. 4: the conditional embedding of the transition model, and its sample-based special case.

Both answer one question: given the features of the observed successors, what are the *expected*
features of the successor of each sampled state and action?
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from kreps.arrays import Array
from kreps.kernels import Kernel
from kreps.linalg import Cholesky, cholesky, with_diagonal


class TransitionModel(Protocol):
    def expected_features(self, successor_features: Array) -> Array:
        """``E[phi(s') | s_i, a_i]``, (n, r), from the observed ``phi(s'_i)``, (n, r)."""
        ...


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


@dataclass(frozen=True)
class SampleModel:
    """The single observed successor stands for the expectation: ``ksa = identity`` in Eq. 4."""

    def expected_features(self, successor_features: Array) -> Array:
        return successor_features
