"""Kernels over states and actions, and regressions on them: the transition model of Eq. 4.

These are shared by REPS, value iteration and the dynamics model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.hyperparameters import EmbeddingLoss, Prior, factor_distances, minimise
from kreps.kernels.kernel import Kernel, SquaredExponential, median_lengthscales, wrap_factors
from kreps.kernels.regression import KernelEmbedding, PivotedEmbedding, embedding_of
from kreps.kernels.sampling import effective_target_count, pps_subsample
from kreps.settings import RKHS, Grid

WRAP_LENGTHSCALE = np.pi
"""Lengthscale, rad, of the distance between wrapped angles in V's kernel.  States on either side of
the discontinuity, 2 pi apart, have a similarity of ``exp(-2)``: V can jump there.  Where it does
not jump, little resolution is lost."""

UNWRAPPED_LENGTHSCALE = 1e6
"""The same where angles are not wrapped but count whole turns: all angles are similar."""

REGULARISER = 1e-3
"""Prior mean of the regulariser lambda, for a kernel of at most one."""

REGULARISER_OF_NOISY_DATA = 0.1
"""Lambda of a second start point, from which the search begins if the loss is smaller there: that
of noisy targets."""

REGULARISER_RANGE = (1e-6, 1.0)
"""Limits of lambda: the smallest one keeps the Gram matrix of repeated samples well-conditioned,
the largest one predicts half of a target at its own isolated sample."""

MIN_STEP = 0.05
"""Smallest change in a step, in lengthscales, by which those of earlier actions are multiplied."""

LOG_LENGTHSCALE_RANGE = 3.0
"""Largest distance of a log lengthscale from that of the median distance."""

LOG_LENGTHSCALE_STD = 1.0
LOG_REGULARISER_STD = 3.0
"""Prior standard deviations.  That of the regulariser is large, as noise levels differ by orders of
magnitude between tasks."""


def state_kernel(data: Transitions, task: TaskSpec, rng: np.random.Generator) -> Kernel:
    """The kernel over states at median lengthscales.

    An earlier action changes the state by what one step does, which is a part of the range of
    states.  The lengthscales of earlier actions are larger than their median by the inverse of this
    part, so that states are as different as their consequences.
    """
    factors = task.state_factors
    kernel = Kernel(factors, median_lengthscales(factors, data.points, rng))
    if not task.action_lags:
        return kernel
    observed, scale = task.observed_factors, np.ones(len(factors))
    scale[observed:] = 1.0 / _step_size(data, kernel.part(slice(0, observed)))
    return kernel.with_lengthscales(scale * kernel.lengthscales)


def _step_size(data: Transitions, kernel: Kernel) -> float:
    """Root mean square change in a step, in lengthscales, of the factor that changes most.

    It is one at most.
    """
    states, successors = data.states, data.points[data.successor]
    moved = [
        np.mean(np.sum((part.embed(successors) - part.embed(states)) ** 2, axis=1))
        for part in (kernel.part(slice(i, i + 1)) for i in range(len(kernel.factors)))
    ]
    return min(max(float(np.sqrt(max(moved))), MIN_STEP), 1.0)


def with_wrap_discontinuity(
    kernel: Kernel, data: Transitions, task: TaskSpec, value: RKHS | Grid
) -> Kernel:
    """The kernel over states of V and of the reward model, which may jump where an angle wraps.

    A reward is often a function of the wrapped angle, such as ``-theta^2``, and jumps where the
    angle does.  So does V.  Dynamics and policies are periodic and keep the periodic kernel.

    The wrap point is in the middle of the gap that the observed angles leave in the circle.  Angles
    that count whole turns leave no gap, and they get no discontinuity.

    Args:
        kernel: over states, at V's lengthscales.
        data: its angles.
        task: which coordinates are angles.
        value: ``angle_wrap``; a continuous one returns the kernel as it is, and so does a grid.
    """
    if isinstance(value, Grid) or value.angle_wrap == "continuous":
        return kernel
    angles = data.points[:, list(task.periodic)]
    low, high = angles.min(axis=0), angles.max(axis=0)
    wraps_at = 0.5 * (low + high) - np.pi
    wrapped = high - low <= 2.0 * np.pi
    lengthscales = np.where(wrapped, WRAP_LENGTHSCALE, UNWRAPPED_LENGTHSCALE)
    factors = wrap_factors(task.periodic, wraps_at)
    return Kernel((*kernel.factors, *factors), np.append(kernel.lengthscales, lengthscales))


def successor_features(data: Transitions, features: FloatArray) -> FloatArray:
    """Features ``phi(s'_i)`` of successors, (n, r) or (n,); a termination leads to a start state.

    Args:
        data: n transitions.
        features: (m, r) or (m,) of all points.
    """
    successors = features[data.successor]
    successors[data.terminated] = features[data.start].mean(axis=0)
    return successors


def embedding_origin(own: FloatArray, model: str) -> FloatArray:
    """Features (n, r) that are subtracted from the targets of the embedding and added again.

    Far from the data an embedding predicts zero.  Relative to the features of the state, this means
    that the state stays, which is a better guess than that its features vanish.

    Args:
        own: (n, r) features of each state.
        model: ``"embedding"`` has zeros, as printed (Eq. 4); other models have ``own``.
    """
    return np.zeros_like(own) if model == "embedding" else own


def restart_features(starts: FloatArray, states: FloatArray, exploring_starts: float) -> FloatArray:
    """Mean features (r,) of the states in which the process restarts, as assumed by the update.

    A restart with probability p acts as a discount 1 - p.  Under a discount one policy is optimal
    from every state, so other restart states leave it optimal.  But the dual hardly determines V
    where its weights vanish, and noise can lead there; exploring starts spread the weights.

    Args:
        starts: (r,) mean over the start states.
        states: (r,) mean over the sampled states (in low rank: over those in memory).
        exploring_starts: share of restarts in sampled states.
    """
    return (1.0 - exploring_starts) * starts + exploring_starts * states


def feature_differences(
    own: FloatArray, expected: FloatArray, restart: FloatArray, restart_probability: float
) -> FloatArray:
    """``B = (1 - p) E[phi(s') | s_i, a_i] + p phi_restart - phi(s_i)``, (n, r).

    The restart probability p is known, so that this part of the dynamics needs no model.

    Args:
        own: (n, r) features of each state.
        expected: (n, r) expected features of its successor.
        restart: (r,) mean features after a restart (`restart_features`).
        restart_probability: p.
    """
    return (1.0 - restart_probability) * expected + restart_probability * restart - own


def state_actions(data: Transitions, task: TaskSpec) -> FloatArray:
    """States and applied actions side by side, (n, ds + da), actions in units of their scale."""
    return np.concatenate([data.states, task.scaled_applied(data.actions)], axis=1)


@dataclass(frozen=True)
class HyperparameterFit:
    """The problem whose solution are the hyper-parameters of a regression on states and actions.

    The parameters are g + da log lengthscales, then log lambda.

    Attributes:
        kernel: over states and actions, at median lengthscales.
        loss: leave-one-out error on a subsample.
        prior: over the parameters.
        starts: at which the loss is evaluated; the search begins at the best of them.
    """

    kernel: Kernel
    loss: EmbeddingLoss
    prior: Prior
    starts: tuple[FloatArray, ...]

    @classmethod
    def from_samples(
        cls,
        inputs: FloatArray,
        targets: FloatArray,
        state_kernel: Kernel,
        task: TaskSpec,
        start: FloatArray | None,
        rng: np.random.Generator,
        log_lengthscale_std: float = LOG_LENGTHSCALE_STD,
    ) -> HyperparameterFit:
        """The problem for n samples; arguments as of `embedding_hyperparameters`."""
        action_factors = tuple(
            SquaredExponential((task.state_size + i,)) for i in range(task.action_size)
        )
        factors = (*state_kernel.factors, *action_factors)
        squares = np.sum((targets - targets.mean(axis=0)) ** 2, axis=1)
        rows, weights = pps_subsample(squares, rng)
        action_lengthscales = median_lengthscales(action_factors, inputs, rng)
        median = np.log(np.append(state_kernel.lengthscales, action_lengthscales))
        prior = Prior(
            centre=np.append(median, np.log(REGULARISER)),
            std=np.append(np.full(len(factors), log_lengthscale_std), LOG_REGULARISER_STD),
            low=np.append(median - LOG_LENGTHSCALE_RANGE, np.log(REGULARISER_RANGE[0])),
            high=np.append(median + LOG_LENGTHSCALE_RANGE, np.log(REGULARISER_RANGE[1])),
            # the loss is 2 / n times the negative log likelihood of Gaussian errors of fitted
            # variance, up to a constant
            strength=2.0 / effective_target_count(squares[rows], weights),
        )
        distances = factor_distances(factors, inputs[rows])
        loss = EmbeddingLoss(distances, targets[rows], weights / weights.mean())
        noisy = np.append(median, np.log(REGULARISER_OF_NOISY_DATA))
        starts = (prior.centre, noisy) if start is None else (start, prior.centre, noisy)
        return cls(Kernel(factors, np.exp(median)), loss, prior, starts)

    def solve(self) -> FloatArray:
        """Log hyper-parameters (g + da + 1,) with the smallest loss plus prior."""
        return minimise(self.loss, self.prior, *self.starts)


def embedding_hyperparameters(
    inputs: FloatArray,
    targets: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
    log_lengthscale_std: float = LOG_LENGTHSCALE_STD,
) -> tuple[Kernel, float, FloatArray]:
    """Kernel and regulariser of a regression, by leave-one-out error (Eq. 4), and their logs.

    Args:
        inputs: (n, ds + da) states and applied actions.
        targets: (n, r) such as features of the observed successors.
        state_kernel: over states, with g factors.  The kernel of the regression has these factors,
            one per action coordinate, and other lengthscales; these are the prior mean.
        task: number of action coordinates.
        start: log hyper-parameters (g + da + 1,) of the last fit, if there was one.
        rng: draws the samples of the fit.
        log_lengthscale_std: prior standard deviation of a log lengthscale.
    """
    fit = HyperparameterFit.from_samples(
        inputs, targets, state_kernel, task, start, rng, log_lengthscale_std
    )
    x = fit.solve()
    return fit.kernel.with_lengthscales(np.exp(x[:-1])), float(np.exp(x[-1])), x


def fit_embedding(
    data: Transitions,
    targets: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> tuple[KernelEmbedding, FloatArray]:
    """The embedding (Eq. 4) of n transitions and its log hyper-parameters, at a cost of n^3.

    Args:
        data: n transitions.
        targets: (n, r) such as features of the observed successors.
        state_kernel, task, start, rng: as of `embedding_hyperparameters`.

    Raises:
        NumericalError: the Gram matrix cannot be factorised.
    """
    inputs = state_actions(data, task)
    kernel, regulariser, x = embedding_hyperparameters(
        inputs, targets, state_kernel, task, start, rng
    )
    return KernelEmbedding.fit(kernel, inputs, regulariser), x


def fit_regression(
    data: Transitions,
    targets: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> tuple[KernelEmbedding | PivotedEmbedding, FloatArray]:
    """`fit_embedding` in few pivots where these suffice, for predictions rather than strengths."""
    inputs = state_actions(data, task)
    kernel, regulariser, x = embedding_hyperparameters(
        inputs, targets, state_kernel, task, start, rng
    )
    return embedding_of(kernel, inputs, regulariser), x
