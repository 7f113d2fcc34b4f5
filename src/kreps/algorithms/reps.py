"""Algorithm 1 of the paper: REPS with RKHS embeddings, one update on one screen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf

import numpy as np

from kreps.algorithms.boldness import is_judged, least_temperature, widening
from kreps.algorithms.dynamics import Dynamics, fit_dynamics, observed_expectation
from kreps.algorithms.imagined_rollouts import Simulator, can_be_simulated
from kreps.algorithms.imagined_step import ImaginedSamples, Outlook, imagine, places
from kreps.algorithms.judgement import refuses
from kreps.algorithms.optimism import optimism_of
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.algorithms.transition_model import (
    feature_differences,
    fit_embedding,
    fit_regression,
    random_rows,
    restart_features,
    state_kernel,
    successor_features,
    with_cuts,
)
from kreps.arrays import FloatArray, IntArray
from kreps.data import Rollout, TaskSpec, Transitions, Window
from kreps.dual import (
    DualProblem,
    DualSolution,
    Outcome,
    effective_sample_size,
    solve_dual,
    standardise,
)
from kreps.embedding import KernelEmbedding, LeaveOneOut, SampleModel, TransitionModel
from kreps.exploration import each_tells, tells_of_states
from kreps.hyperparameters import PolicyLoss, Prior, factor_distances, minimise
from kreps.kernels import Kernel
from kreps.policies import MAX_SUPPORT, CostSensitiveGP
from kreps.settings import Settings
from kreps.value import Basis, RBFGrid, RKHSBasis

DROPPED_WEIGHT = 0.05
"""Samples with ``n p_i`` below this do not enter the policy: they say next to nothing."""

LEAST_NOISE = 1e-4
"""Least variance that actions are taken to spread with, in units of the action scale squared."""

RIDGE_LEAST = 1e-3
"""Least ridge where the model asks for less: with a model without error V would follow the chance
of a finite sample, and V must stay finite in directions that no state has."""

_NOTES = {
    Outcome.AT_FLOOR: "eta at its floor",
    Outcome.FALLBACK: "by bisection",
    Outcome.NOT_CONVERGED: "NOT CONVERGED",
}


@dataclass(frozen=True)
class UpdateInfo:
    """What is only reported of an update.

    Attributes:
        samples: n.
        kl_bound: epsilon.
        eta_floor: least temperature as taken, in standard deviations of the reward.
        ridge: rho times the number of samples.
        model_error: of the transition model by leave-one-out, relative (`LeaveOneOut.relative`);
            nan without a model.
        clipped: share of the commanded actions that lie beyond the limits: those of the new
            roll-outs, of all kept ones if there are none, or of a data set's sample.
        rank: features of V; ``rank_residual`` is the largest squared residual they leave.
        dual: the last step's solution with its certificate.
        effective_samples: effective sample size of the weights.
        support: support points of the policy.
        state_lengthscales: of V's kernel, but for cuts of angles.
        embedding_parameters, policy_parameters: fitted values (not logs): lengthscales, then
            lambda, or sf2 and l.  The former are those of the transition model, whichever it is.
            After widened imagined steps the policy has its sf2 and noise divided.
        noise: variance that actions are drawn with, in units of the action scale squared, by the
            fitted policy.
        refused: whether the model found the fitted policy worse than the one before, which then
            acts on; None where nothing was judged.
        jitter: largest jitter that a factorisation of this update needed; trial points of the
            hyper-parameter searches do not count.
        seconds: CPU seconds of this process by stage.
    """

    samples: int
    kl_bound: float
    eta_floor: float
    ridge: float
    model_error: float
    clipped: float
    rank: int
    rank_residual: float
    dual: DualSolution
    effective_samples: float
    support: int
    state_lengthscales: FloatArray
    embedding_parameters: FloatArray | None
    policy_parameters: FloatArray
    noise: float
    refused: bool | None
    jitter: float
    seconds: dict[str, float]

    def numbers(self) -> dict[str, float]:
        """The diagnostics of the method, by name."""
        return {
            "kl": self.dual.kl,
            "eta": self.dual.eta,
            "gap": self.dual.gap,
            "effective_samples": self.effective_samples,
        }

    def shown(self) -> dict[str, str]:
        """What a progress display shows, by column."""
        return {
            "KL / bound": f"{self.dual.kl:.3f} / {self.kl_bound:g}",
            "eta": f"{self.dual.eta:.3g}",
            "ESS": f"{self.effective_samples:.0f}",
            "gap": f"{self.dual.gap:.0e}",
            "note": f"{_NOTES.get(self.dual.outcome, '')}"
            + ("  refused: the policy before acts" if self.refused else "")
            + (f"  jitter {self.jitter:.0e}" if self.jitter else ""),
        }


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
    window, data = state.extended(rollouts, task)
    clock = Stopwatch()

    # Eq. 3: a basis of V, chosen among the sampled states
    kernel = state_kernel(data, task, rng)
    cut_kernel = with_cuts(kernel, data, task, settings)
    basis, features = value_basis(data, cut_kernel, settings)
    clock.lap("basis")

    # Eq. 4: expected features of each successor
    expectation = expected_successors(
        data, basis, features, kernel, task, settings, state.embedding_start, rng, clock
    )
    errors = expectation.errors
    rewards, reward_unit = standardise(data.rewards)
    jitters = [expectation.jitter]
    imagining = imagines(settings, window, task)
    simulator = (
        simulator_of(expectation, data, kernel, task, settings, window) if imagining else None
    )
    judged = is_judged(simulator, settings)
    clock.lap("embedding")

    # Eqs. 2 and 5: minimise the dual
    own = features[data.state]
    restart = restart_features(features[data.start].mean(axis=0), own.mean(axis=0), settings)
    ridge = stationarity_ridge(settings, errors)
    problem = DualProblem(
        rewards=rewards,
        differences=feature_differences(
            own, expectation.expected, restart, settings.restart_probability
        ),
        kl_bound=settings.kl_bound,
        ridge=ridge / len(data),
        eta_floor=least_temperature(judged, settings),
    )
    dual = solve_dual(problem)
    clock.lap("dual")

    # Sec. 2: generalise the weighted samples to a stochastic policy
    support = PolicySamples.of(data, dual.weights, task)
    policy_x = policy_hyperparameters(support, kernel, settings, state.policy_start, rng)
    clock.lap("policy fit")
    policy = fit_policy(support, kernel, task, policy_x)
    clock.lap("policy")

    # the same once more, for other actions in these states, and again in those they lead to
    reward_start, refused = state.reward_start, None
    if imagining and expectation.of_actions is not None:
        # a reward may jump where the dynamics are smooth, so it has lengthscales of its own
        targets = (rewards - rewards.mean())[:, None]
        regression, reward_start = fit_regression(
            data, targets, cut_kernel, task, reward_start, rng
        )
        jitters.append(regression.factor.jitter)
        outlook = Outlook(
            states=data.states,
            features=own,
            features_at=basis.features,
            restart=restart,
            rewards=rewards,
            expect=expectation.of_actions,
            reward=regression.predictor(targets),
            simulator=simulator,
            optimism=optimism_of(simulator, rewards, dual.weights, state.iteration, settings),
        )
        first, earlier, steps = dual, None, places(outlook, settings)
        # a goal that some roll-outs have not reached is known from few samples, and a policy that
        # the model does not lead there would forget it
        forgetful = not each_tells(window.rollouts, task)
        for led in steps:
            imagined = imagine(outlook, first.weights, policy, task, settings, ridge, rng, led)
            # V is nearly known, the temperature is to be found anew: it may have to rise
            dual = solve_dual(imagined.problem, start=(1.0, dual.theta))
            found = PolicySamples.imagined(imagined, dual.weights, task)
            support = found.beside(earlier) if earlier is not None and forgetful else found
            support = support.heaviest(MAX_SUPPORT)
            policy_x = policy_hyperparameters(support, kernel, settings, policy_x, rng)
            narrower = widening(judged, settings) if led == steps[-1] else 1.0
            policy = fit_policy(support, kernel, task, policy_x, narrower)
            earlier = found
        clock.lap("imagined step")
        refused = refuses(policy, state.policy, outlook, settings, rng)
        clock.lap("judgement")

    new_state = state.after(
        rollouts,
        window,
        policy=state.policy if refused else policy,
        value=basis.function(reward_unit * dual.theta),
        embedding_start=expectation.parameters,
        reward_start=reward_start,
        policy_start=policy_x,
    )
    info = UpdateInfo(
        samples=len(data),
        kl_bound=settings.kl_bound,
        eta_floor=problem.eta_floor,
        ridge=ridge,
        model_error=float("nan") if errors is None else errors.relative,
        clipped=share_clipped(
            np.concatenate([r.actions for r in rollouts or window.rollouts]), task
        ),
        rank=features.shape[1],
        rank_residual=basis.residual,
        dual=dual,
        effective_samples=effective_sample_size(dual.weights),
        support=len(support.weights),
        state_lengthscales=kernel.lengthscales,
        embedding_parameters=(
            None if expectation.parameters is None else np.exp(expectation.parameters)
        ),
        policy_parameters=np.exp(policy_x),
        noise=policy.noise,
        refused=refused,
        jitter=max(dual.jitter, policy.jitter, *jitters),
        seconds=clock.seconds,
    )
    return new_state, info


def imagines(settings: Settings, window: Window, task: TaskSpec) -> bool:
    """Whether other actions are: where no reward tells of the states, they have nothing to gain.

    The next roll-outs then explore, whatever is learnt (`OnPolicyLearner.exploring`).
    """
    return settings.imagined > 0 and tells_of_states(window.rollouts, task)


def value_basis(data: Transitions, kernel: Kernel, settings: Settings) -> tuple[Basis, FloatArray]:
    """The basis of V, and the features (m, r) of all points."""
    if settings.features == "grid":
        return RBFGrid.over(kernel.factors, data.points, settings.grid_size)
    return RKHSBasis.fit(
        kernel, data.points, tolerance=settings.basis_tolerance, max_rank=settings.max_rank
    )


@dataclass(frozen=True)
class Expectation:
    """What a transition model says of V's features in the successors of n samples.

    Attributes:
        expected: (n, r) ``E[phi(s') | s_i, a_i]``.
        errors: of the model; None without one.
        of_actions: the same (m, r) for sample numbers (m,) and other actions in their states, or
            in states that they are nearest to, side by side (m, ds + da); None without a model.
        parameters: log hyper-parameters that the model was fitted with.
        jitter: of its factorisation.
        dynamics: if it is these that were fitted.
    """

    expected: FloatArray
    errors: LeaveOneOut | None
    of_actions: Callable[[IntArray, FloatArray], FloatArray] | None
    parameters: FloatArray | None
    jitter: float
    dynamics: Dynamics | None


def simulator_of(
    expectation: Expectation,
    data: Transitions,
    kernel: Kernel,
    task: TaskSpec,
    settings: Settings,
    window: Window,
) -> Simulator | None:
    """What simulates the process for an imagined step, if there is one and the model can.

    Args:
        expectation: of the samples.
        data: in memory, of the window.
        kernel: over states.
        task, settings, window: of the update.
    """
    dynamics = expectation.dynamics
    if dynamics is None or not can_be_simulated(data, task):
        return None
    return Simulator(
        dynamics=dynamics,
        data=data,
        kernel=kernel,
        task=task,
        restart_probability=settings.restart_probability,
        exploring_starts=settings.exploring_starts,
        longest=max(map(len, window.rollouts)),
    )


def expected_successors(
    data: Transitions,
    basis: Basis,
    features: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    settings: Settings,
    start: FloatArray | None,
    rng: np.random.Generator,
    clock: Stopwatch,
) -> Expectation:
    """Fit the transition model that the settings ask for, and ask it about the samples.

    Args:
        data: n transitions.
        basis, features: of V, and its features (m, r) of all points.
        state_kernel: its factors are those of the model's kernel.
        task, settings: limits of the actions, and which model.
        start: log hyper-parameters where the last fit ended, if there was one.
        rng: chooses the samples of the fit.
        clock: of the stages.
    """
    if settings.model == "dynamics":
        dynamics, x, jitter = fit_dynamics(data, state_kernel, task, start, rng)
        clock.lap("embedding fit")
        own, observed = features[data.state], features[data.successor]
        after_end = features[data.start].mean(axis=0)
        expected, errors = observed_expectation(
            data, basis, own, observed, after_end, dynamics, task
        )
        of_actions = partial(dynamics.expected_features, basis, after_end)
        return Expectation(expected, errors, of_actions, x, jitter, dynamics)
    origin = embedding_origin(data, features, settings)
    successors = successor_features(data, features) - origin
    model, parameters = transition_model(data, successors, state_kernel, task, settings, start, rng)
    clock.lap("embedding fit")
    expected = origin + model.expected_features(successors)
    if not isinstance(model, KernelEmbedding):
        return Expectation(expected, None, None, parameters, 0.0, None)
    predict = model.predictor(successors)
    return Expectation(
        expected,
        model.leave_one_out(successors),
        lambda rows, inputs: origin[rows] + predict(inputs),
        parameters,
        model.factor.jitter,
        None,
    )


def embedding_origin(data: Transitions, features: FloatArray, settings: Settings) -> FloatArray:
    """What embedded features are counted from, (n, r): those of the state itself, or zero.

    An embedding fades to its origin far from the data.  That the state stays is a better guess
    there than that its features vanish, and a better one to learn corrections of.
    """
    own = features[data.state]
    return np.zeros_like(own) if settings.model == "embedding" else own


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
    return fit_embedding(data, successors, state_kernel, task, start, rng)


def stationarity_ridge(settings: Settings, errors: LeaveOneOut | None) -> float:
    """rho times the number of samples: as given, or the model's mean squared error in features."""
    if settings.ridge is not None:
        return settings.ridge
    assert errors is not None  # settings without a model name a ridge
    return max(errors.mean_square, RIDGE_LEAST)


def share_clipped(actions: FloatArray, task: TaskSpec) -> float:
    """Share of commanded action coordinates (n, da) that lie beyond the limits."""
    return float(np.mean((actions < task.action_low) | (actions > task.action_high)))


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


def fit_policy(
    samples: PolicySamples,
    state_kernel: Kernel,
    task: TaskSpec,
    x: FloatArray,
    narrower: float = 1.0,
) -> CostSensitiveGP:
    """The policy at log hyper-parameters ``x`` (g + 2,), its deviation so many times smaller."""
    weights, noise = drawn_noise(samples, float(np.exp(x[-1])))
    return CostSensitiveGP(
        task,
        state_kernel.with_lengthscales(np.exp(x[:-2])),
        samples.states,
        samples.targets,
        weights,
        signal=float(np.exp(x[-2])) / narrower**2,  # of process and noise, so that the mean stays
        noise=noise / narrower**2,
    )
