"""Hyper-parameters of V and of the embedding by two-fold cross-validation over rollouts.

As in the authors' scripts: odd rollouts against even ones.  The lengthscales of V have the smallest
temporal-difference error of a ridge regression of V.  The embedding has the same kernel over
states, as Eq. 4 is printed, and the lengthscales of the actions and lambda that predict the
successors' kernel values best.
"""

from __future__ import annotations

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.folds import (
    EmbeddingFoldLoss,
    Fold,
    TemporalDifferenceFold,
    TemporalDifferenceFoldLoss,
)
from kreps.kernels.hyperparameters import Prior, factor_distances, minimise
from kreps.kernels.kernel import Factor, Kernel, SquaredExponential
from kreps.kernels.regression import KernelEmbedding
from kreps.models.transition import LOG_LENGTHSCALE_RANGE, state_actions

FIT_STEPS = 500
"""Steps of both folds together, evenly spaced.  The cost of a fit is cubic in them."""

FIRST_RIDGE = 1e-2
"""Ridge and lambda from which the fits start, as in the scripts."""

FIRST_ACTION_LENGTHSCALE = 1.0
"""Lengthscale of the actions from which the fit starts, in units of half their range: the 50 N m of
the scripts."""

RIDGE_RANGE = (1e-6, 1e4)
"""Limits of ridge and lambda.  The scripts have none; these keep the matrices well-conditioned."""


def folds_of(data: Transitions) -> list[tuple[IntArray, IntArray]]:
    """Rows of training and held-out steps of both folds: even and odd rollouts, then odd and even.

    Of a single rollout these are every second step; of a single step there are no folds, and the
    hyper-parameters stay those from which a fit would start.
    """
    rows = np.unique(np.linspace(0, len(data) - 1, min(FIT_STEPS, len(data))).astype(np.intp))
    odd = data.rollout[rows] % 2 == 1
    if odd.all() or not odd.any():
        odd = np.arange(len(rows)) % 2 == 1
    return [(rows[~odd], rows[odd]), (rows[odd], rows[~odd])] if odd.any() else []


def fitted_state_kernel(
    data: Transitions, rewards: FloatArray, kernel: Kernel, restart_probability: float
) -> Kernel:
    """The kernel over states with the smallest cross-validated temporal-difference error.

    Args:
        data: n transitions.
        rewards: (n,), in any unit.
        kernel: over states, with the lengthscales from which the search starts.
        restart_probability: p.  The value after a termination is zero.
    """
    states, successors = data.points[data.state], data.points[data.successor]
    discounts = np.where(data.terminated, 0.0, 1.0 - restart_probability)
    folds = []
    for train, held in folds_of(data):
        ends = [successors[train], states[train], successors[held], states[held]]
        first, second, third, fourth = _distances(kernel.factors, ends)
        mean = float(rewards[train].mean())
        folds.append(
            TemporalDifferenceFold(
                (first, second, third, fourth),
                discounts[train],
                discounts[held],
                rewards[train] - mean,
                rewards[held] - mean,
            )
        )
    start = np.append(np.log(kernel.lengthscales), np.log(FIRST_RIDGE))
    x = minimise(TemporalDifferenceFoldLoss(folds), _around(start), start) if folds else start
    return kernel.with_lengthscales(np.exp(x[:-1]))


def fit_embedding_by_folds(
    data: Transitions, targets: FloatArray, state_kernel: Kernel, task: TaskSpec
) -> tuple[KernelEmbedding, FloatArray]:
    """The embedding (Eq. 4) of n transitions and its log hyper-parameters (g + da + 1,).

    Args:
        data: n transitions.
        targets: (n, r) features of the observed successors.
        state_kernel: over states, with g factors; it is that of the embedding.
        task: number of action coordinates.

    Raises:
        NumericalError: the Gram matrix cannot be factorised.
    """
    inputs = state_actions(data, task)
    actions = tuple(SquaredExponential((task.state_size + i,)) for i in range(task.action_size))
    folds = []
    for train, held in folds_of(data):
        parts = [inputs[train], inputs[held]]
        within, across = _distances(actions, parts)
        grams = state_kernel.gram(parts[0]), state_kernel.gram(*parts)
        successors = targets[train] @ targets[train].T, targets[held] @ targets[train].T
        folds.append(Fold(within, across, *grams, *successors))
    first = np.log([*[FIRST_ACTION_LENGTHSCALE] * len(actions), FIRST_RIDGE])
    x = minimise(EmbeddingFoldLoss(folds), _around(first), first) if folds else first
    x = np.concatenate([np.log(state_kernel.lengthscales), x])
    kernel = Kernel((*state_kernel.factors, *actions), np.exp(x[:-1]))
    return KernelEmbedding.fit(kernel, inputs, float(np.exp(x[-1]))), x


def _distances(factors: tuple[Factor, ...], parts: list[FloatArray]) -> list[FloatArray]:
    """Squared distances (g, n, k) of g factors at lengthscale one, from the first part (n, d).

    They are to each of the parts (k, d), the first one included.
    """
    distances = factor_distances(factors, np.concatenate(parts))[:, : len(parts[0])]
    return np.split(distances, np.cumsum([len(part) for part in parts[:-1]]), axis=2)


def _around(start: FloatArray) -> Prior:
    """No prior, only the limits of a search over log lengthscales and then the log of a ridge."""
    low, high = np.log(RIDGE_RANGE)
    return Prior(
        centre=start,
        std=np.ones_like(start),
        low=np.append(start[:-1] - LOG_LENGTHSCALE_RANGE, low),
        high=np.append(start[:-1] + LOG_LENGTHSCALE_RANGE, high),
        strength=0.0,
    )
