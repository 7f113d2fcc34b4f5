"""Algorithm 1 of the paper: REPS with RKHS embeddings.

`reps_step` is the algorithm, a line of the paper per line.  How each line is computed on all
samples in memory is in `kreps.algorithms.exact`, on any number of samples in
`kreps.algorithms.low_rank`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from kreps.algorithms.dual import DualSolution, Problem
from kreps.algorithms.ends import AbsorbingEnd
from kreps.algorithms.policy_targets import PolicyFit, PolicyTargets
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.basis import Basis
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import LeaveOneOut
from kreps.models.dynamics import Dynamics
from kreps.models.reward_model import RewardModel
from kreps.models.transition import state_kernel
from kreps.settings import Settings

MIN_RIDGE = 1e-3
"""Smallest ridge where it follows from the model's error.  With a model without error V would fit
the noise of a finite sample, and V must stay finite in directions that no sampled state has."""


def reps_step(
    batch: Batch[Any, Any], state: LearnerState, eta_floor: float, rng: np.random.Generator
) -> Step:
    """One iteration of Algorithm 1 (van Hoof et al. 2015): from samples to a stochastic policy.

    Args:
        batch: the samples.
        state: hyper-parameters from which the fits start.
        eta_floor: smallest temperature, in standard deviations of the reward.
        rng: chooses the samples of the fits.
    """
    kernel = state_kernel(batch.data, batch.task, rng)
    features = batch.value_features(kernel)  # Eq. 3
    model = batch.transition_model(features, kernel, state.embedding_start, rng)  # Eq. 4
    problem, dual, end = batch.solve_dual(features, model, eta_floor)  # Eqs. 2 and 5
    policy = batch.fit_policy_to_data(dual.weights, kernel, state.policy_start, rng)  # Sec. 2
    return Step(kernel, features, model, problem, dual, end, policy)


@dataclass(frozen=True)
class ValueFeatures:
    """Features of V at the m samples in memory.

    Attributes:
        basis: of V.
        own: (m, r) ``phi(s_i)``.
        observed: (m, r) ``phi(s'_i)``, whether or not the task ended there.
        restart: (r,) mean features of the states in which the process restarts; the same follows a
            termination (`kreps.algorithms.ends`).
    """

    basis: Basis
    own: FloatArray
    observed: FloatArray
    restart: FloatArray


@dataclass(frozen=True)
class Expectation:
    """What a transition model predicts for the m samples in memory.

    Attributes:
        expected: (m, r) ``E[phi(s') | s_i, a_i]``.
        errors: of the model by leave-one-out; None without a learnt model.
        for_actions: the same (k, r) for other actions: maps sample numbers (k,), whose states they
            are taken in or nearest to, and inputs (k, ds + da); None without a learnt model.
        parameters: log hyper-parameters that the model was fitted with.
        dynamics: the fitted dynamics, if the model is ``"dynamics"``.
        terminations: (n,) probabilities of a termination of all samples: as observed, or as the
            dynamics predict it.
        terminations_for_actions: the same (k,) of inputs (k, ds + da), where there are no dynamics;
            None without terminations or without a learnt model.
    """

    expected: FloatArray
    errors: LeaveOneOut | None
    for_actions: Callable[[IntArray, FloatArray], FloatArray] | None
    parameters: FloatArray | None
    dynamics: Dynamics | None
    terminations: FloatArray
    terminations_for_actions: Callable[[FloatArray], FloatArray] | None


@dataclass(frozen=True)
class Step:
    """The results of one bounded step, line by line; the reward model where one was fitted."""

    kernel: Kernel
    features: ValueFeatures
    model: Expectation
    problem: Problem
    dual: DualSolution
    end: AbsorbingEnd | None
    policy: PolicyFit
    reward_model: RewardModel | None = None


F = TypeVar("F", bound=ValueFeatures)
M = TypeVar("M", bound=Expectation)


class Batch(Protocol[F, M]):
    """The samples of one update, and how each line of Algorithm 1 is computed on them.

    Attributes:
        task, settings, clock: of the update.
        window: the replay window after the update.
        data: the m samples in memory.
        rewards: (m,) theirs, standardised; ``reward_unit`` is the unit.
        size: number n of all samples, of which those in memory may be a part.
        seen: rollouts and steps that are new in this update.
        actions: commanded actions whose share beyond the limits is reported.
        from_dataset: whether the samples are a `kreps.Dataset`, which the window does not hold.
        jitters: of the factorisations made so far.
    """

    task: TaskSpec
    settings: Settings
    clock: Stopwatch
    window: ReplayWindow
    data: Transitions
    rewards: FloatArray
    reward_unit: float
    size: int
    seen: tuple[int, int]
    actions: FloatArray
    from_dataset: bool
    jitters: list[float]

    def value_features(self, kernel: Kernel) -> F:
        """Eq. 3: a basis of V chosen among the sampled states, and its features."""
        ...

    def transition_model(
        self, features: F, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> M:
        """Eq. 4: expected features of each successor.

        Args:
            features: of V.
            kernel: over states, at median lengthscales.
            start: log hyper-parameters of the last fit, if there was one.
            rng: chooses the samples of the fit.
        """
        ...

    def solve_dual(
        self, features: F, model: M, eta_floor: float
    ) -> tuple[Problem, DualSolution, AbsorbingEnd | None]:
        """Eqs. 2 and 5: minimise the dual; its weights are of all n samples."""
        ...

    def fit_policy_to_data(
        self, p: FloatArray, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> PolicyFit:
        """Sec. 2: the policy from all samples with weights p (n,)."""
        ...

    def fit_policy(
        self,
        targets: PolicyTargets,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
        std_scale: float = 1.0,
    ) -> PolicyFit:
        """The policy from targets in memory, its standard deviation divided by ``std_scale``."""
        ...

    def fit_reward(
        self, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> tuple[RewardModel, FloatArray]:
        """The reward model, and the log hyper-parameters that it was fitted with."""
        ...

    def weights_in_memory(self, p: FloatArray) -> FloatArray:
        """The weights (m,) of the samples in memory, of those p (n,) of all; they sum to one."""
        ...


def stationarity_ridge(settings: Settings, errors: LeaveOneOut | None) -> float:
    """rho times the number of samples: as given, or the model's mean squared error in features."""
    if settings.ridge is not None:
        return settings.ridge
    assert errors is not None  # settings without a learnt model have a ridge
    return max(errors.mean_square, MIN_RIDGE)
