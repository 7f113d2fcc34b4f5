"""Algorithm 1 of the paper: REPS with RKHS embeddings, one update on one screen."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kreps.arrays import FloatArray, IntArray
from kreps.data import Rollout, TaskSpec, Transitions, Window
from kreps.dual import (
    DualProblem,
    DualSolution,
    effective_sample_size,
    solve_dual,
    standardise,
)
from kreps.embedding import KernelEmbedding, SampleModel, TransitionModel
from kreps.errors import ConfigurationError, DataError
from kreps.hyperparameters import (
    EmbeddingLoss,
    PolicyLoss,
    Prior,
    factor_distances,
    minimise,
)
from kreps.kernels import Kernel, SquaredExponential, median_lengthscales
from kreps.policies import MAX_SUPPORT, CostSensitiveGP
from kreps.settings import Settings
from kreps.value import Basis, RBFGrid, RKHSBasis, ValueFunction

FIT_SAMPLE = 400
"""Samples on which hyper-parameters are fitted: the cost is cubic, the estimate hardly better."""

DROPPED_WEIGHT = 0.05
"""Samples with ``n p_i`` below this do not enter the policy: they say next to nothing."""

ETA_LEAST = 1e-6
"""Floor of the temperature where none is asked for: below it there is nothing left to gain."""


@dataclass(frozen=True)
class LearnerState:
    """Everything that is carried from one update to the next: a checkpoint is exactly this.

    Attributes:
        window: the roll-outs kept.
        iteration: updates made.
        rollouts, steps: roll-outs and environment steps seen, forgotten ones included.
        policy, value: of the latest update.
        embedding_start, policy_start: log hyper-parameters to start the next fits from.
    """

    window: Window
    iteration: int = 0
    rollouts: int = 0
    steps: int = 0
    policy: CostSensitiveGP | None = None
    value: ValueFunction | None = None
    embedding_start: FloatArray | None = None
    policy_start: FloatArray | None = None


@dataclass(frozen=True)
class UpdateInfo:
    """What is only reported of an update.

    Attributes:
        samples: n.
        rank: features of V; ``rank_residual`` is the largest squared residual they leave.
        dual: the solution with its certificate.
        effective_samples: effective sample size of the weights.
        support: support points of the policy.
        state_lengthscales: of V's kernel.
        embedding_parameters, policy_parameters: fitted values (not logs): lengthscales, then
            lambda, or sf2 and l.
        jitter: largest jitter that a factorisation of this update needed; trial points of the
            hyper-parameter searches do not count.
        seconds: CPU seconds by stage.
    """

    samples: int
    rank: int
    rank_residual: float
    dual: DualSolution
    effective_samples: float
    support: int
    state_lengthscales: FloatArray
    embedding_parameters: FloatArray | None
    policy_parameters: FloatArray
    jitter: float
    seconds: dict[str, float]


class _Stopwatch:
    """CPU seconds between laps, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.process_time()

    def lap(self, stage: str) -> None:
        now = time.process_time()
        self.seconds[stage] = now - self._last
        self._last = now


def update(
    state: LearnerState,
    rollouts: Sequence[Rollout],
    task: TaskSpec,
    settings: Settings,
    rng: np.random.Generator,
) -> tuple[LearnerState, UpdateInfo]:
    """One iteration of Algorithm 1, from new roll-outs to a new policy; nothing is modified.

    Raises:
        DataError: no roll-outs at all, or some of another width than the task's.
    """
    for rollout in rollouts:
        rollout.check(task)
    window = state.window.extend(rollouts)
    if not window.rollouts:
        raise DataError("there is no roll-out to learn from; give at least one")
    data = window.transitions
    if len(data) > MAX_SUPPORT:
        raise ConfigurationError(
            f"{len(data)} samples are kept, but the exact update takes at most {MAX_SUPPORT}, as "
            f"it costs their cube; keep fewer than {len(window.rollouts)} roll-outs: lower window"
        )
    clock = _Stopwatch()

    # Eq. 3: a basis of V, chosen among the sampled states
    kernel = state_kernel(data, task, rng)
    basis, features = value_basis(data, kernel, settings)
    clock.lap("basis")

    # Eq. 4: expected features of each successor
    successors = successor_features(data, features)
    model, embedding_start = transition_model(
        data, successors, kernel, task, settings, state.embedding_start, rng
    )
    clock.lap("embedding fit")
    expected = model.expected_features(successors)
    clock.lap("embedding")

    # Eqs. 2 and 5: minimise the dual
    rewards, reward_unit = standardise(data.rewards)
    problem = DualProblem(
        rewards=rewards,
        differences=feature_differences(data, features, expected, settings.restart_probability),
        kl_bound=settings.kl_bound,
        ridge=settings.ridge / len(data),
        eta_floor=max(settings.eta_floor, ETA_LEAST),
    )
    dual = solve_dual(problem)
    clock.lap("dual")

    # Sec. 2: generalise the weighted samples to a stochastic policy
    support = PolicySamples.of(data, dual.weights, task)
    policy_x = policy_hyperparameters(support, kernel, settings, state.policy_start, rng)
    clock.lap("policy fit")
    policy = fit_policy(support, kernel, task, policy_x)
    clock.lap("policy")

    new_state = replace(
        state,
        window=window,
        iteration=state.iteration + 1,
        rollouts=state.rollouts + len(rollouts),
        steps=state.steps + sum(len(r) for r in rollouts),
        policy=policy,
        value=basis.value_function(reward_unit * dual.theta),
        embedding_start=embedding_start,
        policy_start=policy_x,
    )
    info = UpdateInfo(
        samples=len(data),
        rank=features.shape[1],
        rank_residual=basis.residual,
        dual=dual,
        effective_samples=effective_sample_size(dual.weights),
        support=len(support.weights),
        state_lengthscales=kernel.lengthscales,
        embedding_parameters=None if embedding_start is None else np.exp(embedding_start),
        policy_parameters=np.exp(policy_x),
        jitter=max(
            dual.jitter,
            policy.factor.jitter,
            model.factor.jitter if isinstance(model, KernelEmbedding) else 0.0,
        ),
        seconds=clock.seconds,
    )
    return new_state, info


def state_kernel(data: Transitions, task: TaskSpec, rng: np.random.Generator) -> Kernel:
    """The kernel over states at the median lengthscales."""
    factors = task.state_factors
    return Kernel(factors, median_lengthscales(factors, data.points, rng))


def value_basis(data: Transitions, kernel: Kernel, settings: Settings) -> tuple[Basis, FloatArray]:
    """The basis of V, and the features (m, r) of all points."""
    if settings.features == "grid":
        return RBFGrid.over(kernel.factors, data.points, settings.grid_size)
    return RKHSBasis.fit(
        kernel, data.points, tolerance=settings.basis_tolerance, max_rank=settings.max_rank
    )


def successor_features(data: Transitions, features: FloatArray) -> FloatArray:
    """Observed ``phi(s'_i)``, (n, r); after a real end the start states are the successor."""
    successors = features[data.successor]
    successors[data.terminated] = features[data.start].mean(axis=0)
    return successors


def transition_model(
    data: Transitions,
    successors: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    settings: Settings,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> tuple[TransitionModel, FloatArray | None]:
    """The transition model, and the log hyper-parameters it was fitted with."""
    if settings.model == "sample":
        return SampleModel(), None
    actions = (task.clip(data.actions) - task.action_centre) / task.action_scale
    inputs = np.concatenate([data.states, actions], axis=1)
    action_factors = tuple(
        SquaredExponential((task.observation_size + i,)) for i in range(task.action_size)
    )
    factors = (*state_kernel.factors, *action_factors)
    sample = random_rows(len(inputs), rng)
    median = np.log(median_lengthscales(factors, inputs, rng))
    prior = Prior(
        centre=np.append(median, 0.0),
        spread=np.ones(len(factors) + 1),
        low=np.append(median - 3.0, np.log(1e-6)),
        high=np.append(median + 3.0, 0.0),
        strength=0.0,
    )
    loss = EmbeddingLoss(factor_distances(factors, inputs[sample]), successors[sample])
    x = minimise(loss, prior, np.append(median, np.log(1e-3)) if start is None else start)
    return KernelEmbedding.fit(Kernel(factors, np.exp(x[:-1])), inputs, float(np.exp(x[-1]))), x


def feature_differences(
    data: Transitions, features: FloatArray, expected: FloatArray, restart_probability: float
) -> FloatArray:
    """``B = (1 - p) E[phi(s') | s_i, a_i] + p mean_k phi(s0_k) - phi(s_i)``, (n, r).

    The process restarts with the known probability p, so that part of the dynamics needs no model.
    """
    start = features[data.start].mean(axis=0)
    return (
        (1.0 - restart_probability) * expected + restart_probability * start - features[data.state]
    )


@dataclass(frozen=True)
class PolicySamples:
    """The weighted samples that the policy is fitted to.

    Attributes:
        states: (m, ds).
        targets: (m, da) commanded actions around their centre, in units of the action scale.
        weights: (m,) ``p_i / sum p^2``: over all samples they add up to the effective sample size.
    """

    states: FloatArray
    targets: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, data: Transitions, p: FloatArray, task: TaskSpec) -> PolicySamples:
        kept = len(p) * p >= DROPPED_WEIGHT
        targets = (data.actions[kept] - task.action_centre) / task.action_scale
        return cls(data.states[kept], targets, p[kept] * effective_sample_size(p))


def policy_hyperparameters(
    samples: PolicySamples,
    state_kernel: Kernel,
    settings: Settings,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> FloatArray:
    """Log lengthscales (g,), log sf2 and log l of the policy, by weighted leave-one-out density."""
    median = np.log(state_kernel.lengthscales)
    g = len(median)
    share = samples.weights / samples.weights.sum()
    centred = samples.targets - share @ samples.targets
    spread = float(np.mean(share @ centred**2))
    log_spread = np.log(max(spread, 1e-4))
    centre = np.concatenate([median - 0.5, [log_spread - 0.3, log_spread - 1.0]])
    if settings.policy_fit == "map":
        prior = Prior(
            centre=centre,
            spread=np.concatenate([np.full(g, 0.7), [1.0, 1.0]]),
            low=np.concatenate([median - 4.0, np.log([1e-4, 1e-4])]),
            high=np.concatenate([median + 3.0, np.log([1e2, 1e2])]),
            strength=1.0 / float(samples.weights.sum()),
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
    )
    return minimise(loss, prior, centre if start is None else start)


def fit_policy(
    samples: PolicySamples, state_kernel: Kernel, task: TaskSpec, x: FloatArray
) -> CostSensitiveGP:
    """The policy at log hyper-parameters ``x`` (g + 2,)."""
    return CostSensitiveGP(
        task,
        state_kernel.with_lengthscales(np.exp(x[:-2])),
        samples.states,
        samples.targets,
        samples.weights,
        signal=float(np.exp(x[-2])),
        noise=float(np.exp(x[-1])),
    )


def random_rows(n: int, rng: np.random.Generator) -> IntArray:
    """At most `FIT_SAMPLE` row numbers out of n, in order."""
    if n <= FIT_SAMPLE:
        return np.arange(n)
    return np.sort(rng.choice(n, FIT_SAMPLE, replace=False))
