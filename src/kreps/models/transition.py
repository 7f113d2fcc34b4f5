"""The conditional embedding fitted to a window of transitions, as several methods need it.

And what every step of REPS makes of it: the differences of features, restarts included.
"""

from __future__ import annotations

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.hyperparameters import EmbeddingLoss, Prior, factor_distances, minimise
from kreps.kernels.kernel import Kernel, SquaredExponential, median_lengthscales, wrap_factors
from kreps.kernels.regression import KernelEmbedding, PivotedEmbedding
from kreps.kernels.sampling import effective_target_count, pps_subsample
from kreps.settings import RKHS, Grid

WRAP_LENGTHSCALE = np.pi
"""Of the numbers of angles in V's kernel, rad: a turn apart, states are ``exp(-2)`` alike, so that
V can jump there, and little is lost where it need not."""

UNWRAPPED_LENGTHSCALE = 1e6
"""The same, rad, where angles count their turns: all of one turn are alike."""


def state_kernel(data: Transitions, task: TaskSpec, rng: np.random.Generator) -> Kernel:
    """The kernel over states at the median lengthscales."""
    factors = task.state_factors
    return Kernel(factors, median_lengthscales(factors, data.points, rng))


def with_wrap_discontinuity(
    kernel: Kernel, data: Transitions, task: TaskSpec, value: RKHS | Grid
) -> Kernel:
    """The kernel over states of V and of the reward model, which may jump where an angle wraps.

    A reward is often a function of the angle's number, such as ``-theta^2``, and jumps from one end
    of the turn to the other.  So does V.  Dynamics and good actions are periodic.

    Args:
        kernel: over states, at V's lengthscales.
        data: its angles leave a gap of the turn, in whose middle the numbers wrap.  An angle that
            counts its turns leaves none and gets no discontinuity.
        task: which coordinates are angles.
        value: ``angle_wrap``; without effect where that is continuous, and on a grid.
    """
    if isinstance(value, Grid) or value.angle_wrap == "continuous":
        return kernel
    angles = data.points[:, list(task.periodic)]
    low, high = angles.min(axis=0), angles.max(axis=0)
    wraps_at = 0.5 * (low + high) - np.pi
    within_a_turn = high - low <= 2.0 * np.pi
    lengthscales = np.where(within_a_turn, WRAP_LENGTHSCALE, UNWRAPPED_LENGTHSCALE)
    factors = wrap_factors(task.periodic, wraps_at)
    return Kernel((*kernel.factors, *factors), np.append(kernel.lengthscales, lengthscales))


def successor_features(data: Transitions, features: FloatArray) -> FloatArray:
    """Observed ``phi(s'_i)``, (n, r) or (n,); after a real end the start states are the successor.

    Args:
        data: n transitions.
        features: (m, r) or (m,) of all points.
    """
    successors = features[data.successor]
    successors[data.terminated] = features[data.start].mean(axis=0)
    return successors


def restart_features(starts: FloatArray, states: FloatArray, exploring_starts: float) -> FloatArray:
    """Mean features (r,) of the states that the process restarts in, as the update plans.

    A restart with probability p acts as a discount 1 - p.  Under a discount one policy is optimal
    from every state, so other restart states leave it optimal.  But the dual hardly determines V
    where its weights vanish, and noise leads there; exploring starts spread the weights.

    Args:
        starts, states: (r,) means over the start states and over the sampled states (in low rank:
            over those in memory).
        exploring_starts: share of the latter.
    """
    return (1.0 - exploring_starts) * starts + exploring_starts * states


def feature_differences(
    own: FloatArray, expected: FloatArray, restart: FloatArray, restart_probability: float
) -> FloatArray:
    """``B = (1 - p) E[phi(s') | s_i, a_i] + p phi_restart - phi(s_i)``, (n, r).

    The process restarts with the known probability p, so that part of the dynamics needs no model.

    Args:
        own, expected: (n, r) features of each state, and what they are expected to become.
        restart: (r,) of `restart_features`.
        restart_probability: p.
    """
    return (1.0 - restart_probability) * expected + restart_probability * restart - own


def state_actions(data: Transitions, task: TaskSpec) -> FloatArray:
    """States and applied actions side by side, (n, ds + da), actions in units of their scale."""
    return np.concatenate([data.states, task.scaled_applied(data.actions)], axis=1)


def embedding_hyperparameters(
    inputs: FloatArray,
    targets: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> tuple[Kernel, float, FloatArray]:
    """Kernel and regulariser of the embedding by leave-one-out error (Eq. 4), and their logs.

    And of any other regression on states and applied actions: it is the same.

    Args:
        inputs: (n, ds + da) states and applied actions.
        targets: (n, r) what is to be predicted, such as features of the observed successors.
        state_kernel: its factors are those of the embedding's kernel, with other lengthscales, of
            which these are the typical ones.
        task: number of action coordinates.
        start: log hyper-parameters (g + da + 1,) where the last fit ended, if there was one.
        rng: chooses the samples of the fit.
    """
    action_factors = tuple(
        SquaredExponential((task.observation_size + i,)) for i in range(task.action_size)
    )
    factors = (*state_kernel.factors, *action_factors)
    squares = np.sum((targets - targets.mean(axis=0)) ** 2, axis=1)
    sample, weights = pps_subsample(squares, rng)
    for_actions = median_lengthscales(action_factors, inputs, rng)
    typical = np.log(np.append(state_kernel.lengthscales, for_actions))
    prior = Prior(
        centre=np.append(typical, np.log(1e-3)),
        std=np.append(np.ones(len(factors)), 3.0),
        low=np.append(typical - 3.0, np.log(1e-6)),
        high=np.append(typical + 3.0, 0.0),
        # the loss is twice minus the log density of one Gaussian error whose variance is fitted
        strength=2.0 / effective_target_count(squares[sample], weights),
    )
    loss = EmbeddingLoss(
        factor_distances(factors, inputs[sample]), targets[sample], weights / weights.mean()
    )
    noisy = np.append(typical, np.log(0.1))
    starts = (prior.centre, noisy) if start is None else (start, prior.centre, noisy)
    x = minimise(loss, prior, *starts)
    return Kernel(factors, np.exp(x[:-1])), float(np.exp(x[-1])), x


def fit_embedding(
    data: Transitions,
    targets: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> tuple[KernelEmbedding, FloatArray]:
    """The embedding (Eq. 4) of n transitions on states and applied actions, and its log parameters.

    Arguments are those of `embedding_hyperparameters`, with (n, r) ``targets``: features of
    successors, or anything else that is to be regressed.
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
    """The same where only predictions are asked for: in few features, where these are enough."""
    inputs = state_actions(data, task)
    kernel, regulariser, x = embedding_hyperparameters(
        inputs, targets, state_kernel, task, start, rng
    )
    few = PivotedEmbedding.fit(kernel, inputs, regulariser)
    return few or KernelEmbedding.fit(kernel, inputs, regulariser), x
