"""Algorithm 1 of the paper: REPS with RKHS embeddings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import Protocol

import numpy as np

from kreps.algorithms.dual import DualSolution, Problem, effective_sample_size
from kreps.algorithms.generated import ImaginedSamples
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.data.rollout import Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import Window
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.basis import Basis
from kreps.kernels.hyperparameters import PolicyLoss, Prior, factor_distances, minimise
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import LeaveOneOut
from kreps.kernels.sampling import random_rows
from kreps.models.dynamics import Dynamics
from kreps.models.transition import state_kernel
from kreps.policies.base import LearntPolicy
from kreps.settings import Settings

DROPPED_WEIGHT = 0.05
"""Samples with ``n p_i`` below this do not enter the policy: they say next to nothing."""

LEAST_NOISE = 1e-4
"""Least variance that actions are taken to spread with, in units of the action scale squared."""

RIDGE_LEAST = 1e-3
"""Least ridge where the model asks for less: with a model without error V would follow the chance
of a finite sample, and V must stay finite in directions that no state has."""


def reps_step(
    batch: Batch, state: LearnerState, eta_floor: float, rng: np.random.Generator
) -> Step:
    """One iteration of Algorithm 1 (van Hoof et al. 2015): from samples to a stochastic policy."""
    kernel = state_kernel(batch.data, batch.task, rng)
    features = batch.value_features(kernel, rng)  # Eq. 3
    model = batch.transition_model(features, kernel, state.embedding_start, rng)  # Eq. 4
    problem, dual = batch.solve_dual(features, model, eta_floor)  # Eqs. 2 and 5
    policy = batch.fit_policy_to_data(dual.weights, kernel, state.policy_start, rng)  # Sec. 2
    return Step(kernel, features, model, problem, dual, policy)


class Batch(Protocol):
    """The samples of one update, and how each line of Algorithm 1 is computed on them."""

    task: TaskSpec
    settings: Settings
    window: Window
    data: Transitions
    rewards: FloatArray
    reward_unit: float
    size: int
    seen: tuple[int, int] | None
    actions: FloatArray
    from_dataset: bool
    jitters: list[float]
    clock: Stopwatch

    def of_data(self, p: FloatArray) -> FloatArray: ...

    def value_features(self, kernel: Kernel, rng: np.random.Generator) -> ValueFeatures: ...

    def transition_model(
        self,
        features: ValueFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> Expectation: ...

    def solve_dual(
        self, features: ValueFeatures, model: Expectation, eta_floor: float
    ) -> tuple[Problem, DualSolution]: ...

    def fit_policy_to_data(
        self, p: FloatArray, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> PolicyFit: ...

    def fit_policy(
        self,
        samples: PolicySamples,
        kernel: Kernel,
        start: FloatArray,
        rng: np.random.Generator,
        narrower: float = 1.0,
    ) -> PolicyFit: ...

    def fit_reward(
        self, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]: ...


@dataclass(frozen=True)
class ValueFeatures:
    """Features of V in the samples in memory: own states, successors, mean of the start states."""

    basis: Basis
    own: FloatArray
    observed: FloatArray
    start: FloatArray


@dataclass(frozen=True)
class PolicyFit:
    """A fitted policy, its log hyper-parameters and how many support points it has."""

    policy: LearntPolicy
    x: FloatArray
    support: int


@dataclass(frozen=True)
class Step:
    """What one bounded step found, line by line."""

    kernel: Kernel
    features: ValueFeatures
    model: Expectation
    problem: Problem
    dual: DualSolution
    policy: PolicyFit


@dataclass(frozen=True)
class Expectation:
    """What a transition model says of V's features in the successors of the samples in memory.

    Attributes:
        expected: (n, r) ``E[phi(s') | s_i, a_i]``.
        errors: of the model; None without one.
        of_actions: the same (m, r) for sample numbers (m,) and other actions; None without a model.
        parameters: log hyper-parameters that the model was fitted with.
        dynamics: if it is these that were fitted.
    """

    expected: FloatArray
    errors: LeaveOneOut | None
    of_actions: Callable[[IntArray, FloatArray], FloatArray] | None
    parameters: FloatArray | None
    dynamics: Dynamics | None


def stationarity_ridge(settings: Settings, errors: LeaveOneOut | None) -> float:
    """rho times the number of samples: as given, or the model's mean squared error in features."""
    if settings.ridge is not None:
        return settings.ridge
    assert errors is not None  # settings without a model name a ridge
    return max(errors.mean_square, RIDGE_LEAST)


@dataclass(frozen=True)
class PolicySamples:
    """The weighted samples that the policy is fitted to.

    Attributes:
        states: (m, ds).
        targets: (m, da) commanded actions around their centre, in units of the action scale.
        weights: (m,) ``p_i / sum p^2``: over all samples they add up to the effective sample size.
        evidence: sum of the weights of all samples kept, whether or not they are among these.
        within: (m,) variance of what each target is the mean of, summed over its coordinates.
        spread: variance of a coordinate of the weighted actions within a state, on average;
            infinite where there is one action in each.
    """

    states: FloatArray
    targets: FloatArray
    weights: FloatArray
    evidence: float
    within: FloatArray
    spread: float = inf

    @classmethod
    def of(cls, data: Transitions, p: FloatArray, task: TaskSpec) -> PolicySamples:
        kept = len(p) * p >= DROPPED_WEIGHT
        targets = task.scaled(data.actions[kept])
        weights = p[kept] * effective_sample_size(p)
        nothing = np.zeros(len(weights))
        return cls(data.states[kept], targets, weights, float(weights.sum()), nothing)

    @classmethod
    def imagined(cls, samples: ImaginedSamples, p: FloatArray, task: TaskSpec) -> PolicySamples:
        """One for each state: the weighted mean of the actions that were imagined there.

        It leaves the process as many support points as there are states, and a target that several
        actions agree on is worth more than one of them.
        """
        kept = len(p) * p >= DROPPED_WEIGHT
        each = p[kept] * effective_sample_size(p)
        actions = task.scaled(samples.actions[kept])
        rows, group = np.unique(samples.of[kept], return_inverse=True)
        weights = np.zeros(len(rows))
        targets = np.zeros((len(rows), task.action_size))
        within = np.zeros(len(rows))
        np.add.at(weights, group, each)
        np.add.at(targets, group, (each / weights[group])[:, None] * actions)
        squares = np.sum((actions - targets[group]) ** 2, axis=1)
        share = each / weights[group]
        np.add.at(within, group, share * squares)
        # a mean of few is nearer to them than the one of all: Bessel's correction, with weights
        freedom = float(weights.sum() - each @ share) * task.action_size
        spread = float(weights @ within) / freedom if freedom > 1e-9 * weights.sum() else inf
        evidence = float(weights.sum())
        return cls(samples.states[rows], targets, weights, evidence, within, spread)

    def beside(self, earlier: PolicySamples) -> PolicySamples:
        """These and those of an earlier step."""
        told = np.array([self.weights.sum(), earlier.weights.sum()])
        return PolicySamples(
            np.concatenate([self.states, earlier.states]),
            np.concatenate([self.targets, earlier.targets]),
            np.concatenate([self.weights, earlier.weights]),
            self.evidence + earlier.evidence,
            np.concatenate([self.within, earlier.within]),
            float(told @ [self.spread, earlier.spread] / told.sum()),
        )

    def heaviest(self, most: int) -> PolicySamples:
        """At most so many of them, in order."""
        if len(self.weights) <= most:
            return self
        kept = np.sort(np.argsort(-self.weights, kind="stable")[:most])
        return replace(
            self,
            states=self.states[kept],
            targets=self.targets[kept],
            weights=self.weights[kept],
            within=self.within[kept],
        )


def policy_hyperparameters(
    samples: PolicySamples,
    state_kernel: Kernel,
    settings: Settings,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> FloatArray:
    """Log lengthscales (g,), log sf2 and log l of the policy, by weighted leave-one-out density.

    Args:
        samples: those that the policy is fitted to, or some of them.
        state_kernel: its factors are those of the policy's kernel, with other lengthscales.
        settings: priors or hard ranges.
        start: log hyper-parameters (g + 2,) to start the fit from; None for the priors' centre.
        rng: chooses the samples of the fit.
    """
    median = np.log(state_kernel.lengthscales)
    g = len(median)
    share = samples.weights / samples.weights.sum()
    centred = samples.targets - share @ samples.targets
    spread = float(np.mean(share @ centred**2)) + float(share @ samples.within) / centred.shape[1]
    log_spread = np.log(max(spread, 1e-4))
    centre = np.concatenate([median - 0.5, [log_spread - 0.3, log_spread - 1.0]])
    if settings.policy_fit == "map":
        prior = Prior(
            centre=centre,
            spread=np.concatenate([np.full(g, 0.7), [1.0, 1.0]]),
            low=np.concatenate([median - 4.0, np.log([1e-4, 1e-4])]),
            high=np.concatenate([median + 3.0, np.log([1e2, 1e2])]),
            strength=1.0 / samples.evidence,
        )
    else:
        prior = Prior(
            centre=centre,
            spread=np.ones(g + 2),
            low=np.concatenate([median + np.log(0.3), np.log([0.01, 1e-4])]),
            high=np.concatenate([median, np.log([3.0, 4.0])]),
            strength=0.0,
        )
    rows = random_rows(len(share), rng)
    loss = PolicyLoss(
        factor_distances(state_kernel.factors, samples.states[rows]),
        samples.targets[rows],
        samples.weights[rows],
        samples.within[rows],
    )
    return minimise(loss, prior, centre if start is None else start)


def drawn_noise(samples: PolicySamples, fitted: float) -> tuple[FloatArray, float]:
    """Weights (m,) and noise that the policy has, of a fitted noise l.

    The fitted noise has in it what the mean misses of its targets, which is much where these jump.
    Actions are drawn with no more than the weighted actions spread within a state.  Weights shrink
    along with the noise, so that ``l / w_i``, and with it the mean, stays as fitted.
    """
    drawn = min(fitted, max(samples.spread, LEAST_NOISE))
    return samples.weights * (drawn / fitted), drawn
