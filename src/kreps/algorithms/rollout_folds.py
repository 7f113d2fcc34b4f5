"""The lines of Algorithm 1 with hyper-parameters by cross-validation over rollouts.

This is how the authors' scripts choose them (`kreps.models.rollout_folds`); all else is as in
`kreps.algorithms.exact`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kreps.algorithms.exact import ExactBatch
from kreps.algorithms.policy_targets import (
    MIN_RELATIVE_WEIGHT,
    PolicyFit,
    PolicyTargets,
    policy_prior,
)
from kreps.algorithms.reps import ValueFeatures
from kreps.kernels.arrays import FloatArray
from kreps.kernels.folds import PolicyFoldLoss
from kreps.kernels.hyperparameters import factor_distances, minimise
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import KernelEmbedding
from kreps.kernels.sampling import uniform_subsample
from kreps.models.rollout_folds import fit_embedding_by_folds, fitted_state_kernel
from kreps.settings import RKHS

FIRST_SHARE = 0.5**0.5
"""First values of sf2 and l of the policy, as a share of the variance of the actions."""


class RolloutFolds(ExactBatch):
    """All samples of the replay window; fits leave out whole rollouts."""

    def value_features(self, kernel: Kernel) -> ValueFeatures:
        if isinstance(self.settings.value, RKHS):
            kernel = fitted_state_kernel(self.data, self.rewards, kernel, self.settings.p)
        return super().value_features(kernel)

    def _fitted_embedding(
        self,
        features: ValueFeatures,
        targets: FloatArray,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> tuple[KernelEmbedding, FloatArray]:
        # Eq. 4 is printed with the kernel of V, here without its factors of wrapped angles
        state_kernel = features.basis.kernel.part(slice(len(kernel.factors)))
        return fit_embedding_by_folds(self.data, targets, state_kernel, self.task)

    def fit_policy_to_data(
        self, p: FloatArray, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> PolicyFit:
        kept = len(p) * p >= MIN_RELATIVE_WEIGHT
        weights = p / p.max()
        targets = replace(
            PolicyTargets.from_samples(self.data, p, self.task),
            weights=weights[kept],
            total_weight=float(weights.sum()),
        )
        rows = uniform_subsample(len(targets.weights), rng)
        loss = PolicyFoldLoss(
            factor_distances(kernel.factors, targets.states[rows]),
            targets.targets[rows],
            targets.weights[rows],
            self.data.rollout[kept][rows],
        )
        prior = policy_prior(targets, kernel, self.settings.policy_fit)
        variance = np.log(FIRST_SHARE * max(float(targets.targets.var(axis=0).mean()), 1e-4))
        first = np.append(np.log(kernel.lengthscales), [variance, variance])
        return self._policy_with(minimise(loss, prior, first), targets, kernel)
