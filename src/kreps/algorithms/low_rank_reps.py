"""Algorithm 1 on any number of samples: the steps of `kreps.algorithms.reps`, in low rank.

Three things take the place of exact ones: bases are chosen from a sample of the data, the embedding
(Eq. 4) is a regression of features on features, and the policy is a Gaussian process on inducing
points.  Every sum over samples is taken chunk by chunk: cost grows linearly with their number, and
memory hardly at all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add

import numpy as np

from kreps.algorithms.boldness import is_judged, least_temperature, widening
from kreps.algorithms.chunk_sums import (
    BellmanRows,
    ChunkPolicySums,
    ChunkRewards,
    EmbeddedSuccessors,
    EmbeddingSums,
    FeatureChanges,
    MotionSums,
    ObservedSuccessors,
    PredictedSuccessors,
    StartFeatures,
    StreamedProblem,
    Successors,
)
from kreps.algorithms.dynamics import Dynamics, Motion, after_ends, observed_expectation
from kreps.algorithms.imagined_step import Outlook, imagine, places
from kreps.algorithms.judgement import refuses
from kreps.algorithms.optimism import optimism_of
from kreps.algorithms.reps import (
    DROPPED_WEIGHT,
    Expectation,
    PolicySamples,
    UpdateInfo,
    drawn_noise,
    imagines,
    policy_hyperparameters,
    share_clipped,
    simulator_of,
    stationarity_ridge,
)
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.algorithms.transition_model import (
    embedding_hyperparameters,
    feature_differences,
    restart_features,
    state_actions,
    state_kernel,
    with_cuts,
)
from kreps.arrays import FloatArray, IntArray, as_float
from kreps.compute import Compute
from kreps.data import Rollout, TaskSpec, Transitions
from kreps.dataset import Chunk, Dataset
from kreps.dual import (
    DualProblem,
    DualSolution,
    effective_sample_size,
    solve_dual,
    standardise,
)
from kreps.embedding import FeatureRegression, LeaveOneOut, RegressionSums
from kreps.exploration import each_tells
from kreps.kernels import Kernel
from kreps.policies import MAX_SUPPORT
from kreps.settings import Settings
from kreps.sparse_gp import PolicySums, SparseGP
from kreps.value import Basis, FourierBasis, RBFGrid, RKHSBasis

EXACT_LIMIT = 3_000
"""Samples up to which ``approximation="auto"`` is exact."""

SAMPLE = 10_000
"""Samples among which bases are chosen and hyper-parameters fitted, where there are more."""

GROWTH = 4
"""How many times more samples each solution of the dual has than the one that it starts from."""


def applies(settings: Settings, samples: int) -> bool:
    """Whether an update from so many samples is of low rank."""
    if settings.approximation == "auto":
        return samples > EXACT_LIMIT
    return settings.approximation != "exact"


def update(
    state: LearnerState,
    rollouts: Sequence[Rollout] | Dataset,
    task: TaskSpec,
    settings: Settings,
    rng: np.random.Generator,
    compute: Compute,
) -> tuple[LearnerState, UpdateInfo]:
    """One iteration of Algorithm 1 from new roll-outs and those kept, or from a data set alone.

    Raises:
        DataError: no roll-outs at all, or some of another width than the task's.
    """
    newest: Sequence[Rollout] = ()
    if isinstance(rollouts, Dataset):
        window, dataset, seen = state.window, rollouts, None
    else:
        newest = rollouts
        seen = len(rollouts), sum(len(rollout) for rollout in rollouts)
        window = state.extended_window(rollouts, task)
        dataset = Dataset.of(window.rollouts)
    clock = Stopwatch()
    n = len(dataset)
    raw = np.concatenate(list(compute.map(ChunkRewards(task), dataset.chunks)))
    rewards, reward_unit = standardise(raw)
    sampled = some(np.arange(n), rng)
    sample = dataset.take(sampled)
    clock.lap("sample")

    # Eq. 3: a basis of V, chosen among the sampled states
    kernel = state_kernel(sample, task, rng)
    cut_kernel = with_cuts(kernel, sample, task, settings)
    if settings.features == "grid":
        basis: Basis = RBFGrid.over(kernel.factors, sample.points, settings.grid_size)[0]
    else:
        basis = choose_basis(cut_kernel, sample.points, settings, settings.max_rank, rng)
    place = compute.to_device
    starts = reduce(add, compute.map(StartFeatures(basis, place), dataset.chunks))
    count = int(starts[-1])
    changes = FeatureChanges(basis, starts[:-1] / count, place)
    own, observed = replace(changes, place=as_float).observed(sample)
    clock.lap("basis")

    # Eq. 4: the expected features of each successor, from features of state and action
    expectation = expected_successors(
        dataset,
        sample,
        changes,
        own,
        observed,
        kernel,
        task,
        settings,
        state.embedding_start,
        compute,
        rng,
        clock,
    )
    errors, embedding_start = expectation.errors, expectation.parameters
    # a data set is not learnt from by imagining
    imagining = seen is not None and imagines(settings, window, task)
    simulator = (
        simulator_of(expectation, sample, kernel, task, settings, window) if imagining else None
    )
    judged = is_judged(simulator, settings)
    clock.lap("embedding")

    # Eqs. 2 and 5: minimise the dual
    ridge = stationarity_ridge(settings, errors)
    restart = restart_features(changes.start, own.mean(axis=0), settings)
    p = settings.restart_probability
    rows = BellmanRows(expectation.successors, restart, p)
    problem = StreamedProblem(
        dataset=dataset,
        rows=rows,
        rewards=rewards,
        kl_bound=settings.kl_bound,
        ridge=ridge / n,
        eta_floor=least_temperature(judged, settings),
        compute=compute,
    )
    dual = solve(
        problem, ridge, feature_differences(own, expectation.expected, restart, p), sampled
    )
    clock.lap("dual")

    # Sec. 2: generalise the weighted samples to a stochastic policy
    weights = np.where(n * dual.weights >= DROPPED_WEIGHT, dual.weights, 0.0)
    weights *= effective_sample_size(dual.weights)
    heard = some(np.flatnonzero(weights), rng)
    among = dataset.take(heard)
    support = PolicySamples(
        among.states,
        task.scaled(among.actions),
        weights[heard],
        float(weights.sum()),
        np.zeros(len(heard)),
    )
    x = policy_hyperparameters(support, kernel, settings, state.policy_start, rng)
    clock.lap("policy fit")
    jitters = [expectation.jitter]
    centres = policy_centres(support, kernel, x, settings, rng)
    bases = [basis, *expectation.bases, centres]
    policy_sums_of = ChunkPolicySums(centres, task, place)
    policy_sums = reduce(add, compute.map(policy_sums_of, dataset.chunks, dataset.split(weights)))
    policy = fit_sparse(task, centres, policy_sums, x, float(np.exp(x[-1])))
    clock.lap("policy")

    # the same once more, for other actions in the sample's states, and again where they lead to
    reward_start, refused = state.reward_start, None
    if imagining and expectation.of_actions is not None:
        inputs = state_actions(sample, task)
        targets = (rewards[sampled] - rewards[sampled].mean())[:, None]
        reward_kernel, regulariser, reward_start = embedding_hyperparameters(
            inputs, targets, cut_kernel, task, reward_start, rng
        )
        embedded = choose_basis(reward_kernel, inputs, settings, settings.rank, rng)
        bases.append(embedded)
        # the sample is to say what all samples would, if they were like it
        reward_sums = RegressionSums.of(embedded.features(inputs), targets)
        regression = FeatureRegression.fit(embedded, reward_sums, regulariser * len(sample) / n)
        jitters.append(regression.jitter)
        share = dual.weights[sampled] / dual.weights[sampled].sum()
        outlook = Outlook(
            states=sample.states,
            features=own,
            features_at=basis.features,
            restart=restart,
            rewards=rewards[sampled],
            expect=expectation.of_actions,
            reward=regression.mean,
            simulator=simulator,
            optimism=optimism_of(simulator, rewards[sampled], share, state.iteration, settings),
        )
        earlier, forgetful = None, not each_tells(window.rollouts, task)
        for led in places(outlook, settings):
            imagined = imagine(outlook, share, policy, task, settings, ridge, rng, led)
            # V is nearly known, the temperature is to be found anew: it may have to rise
            dual = solve_dual(imagined.problem, start=(1.0, dual.theta))
            found = PolicySamples.imagined(imagined, dual.weights, task)
            support = found.beside(earlier) if earlier is not None and forgetful else found
            x = policy_hyperparameters(support, kernel, settings, x, rng)
            bases.append(centres := policy_centres(support, kernel, x, settings, rng))
            weights, noise = drawn_noise(support, float(np.exp(x[-1])))
            policy_sums = PolicySums.of(centres.features(support.states), weights, support.targets)
            policy = fit_sparse(task, centres, policy_sums, x, noise)
            earlier = found
        policy = policy.narrowed(widening(judged, settings))
        clock.lap("imagined step")
        refused = refuses(policy, state.policy, outlook, settings, rng)
        clock.lap("judgement")

    new_state = state.after_data(
        *(seen or (count, n)),
        window=window,
        policy=state.policy if refused else policy,
        value=basis.function(reward_unit * dual.theta),
        embedding_start=embedding_start,
        reward_start=reward_start,
        policy_start=x,
    )
    acted = [r.actions for r in newest or window.rollouts] if seen is not None else [sample.actions]
    info = UpdateInfo(
        samples=n,
        kl_bound=settings.kl_bound,
        eta_floor=problem.eta_floor,
        ridge=ridge,
        model_error=float("nan") if errors is None else errors.relative,
        clipped=share_clipped(np.concatenate(acted), task),
        rank=problem.rank,
        rank_residual=basis.residual,
        dual=dual,
        effective_samples=effective_sample_size(dual.weights),
        support=len(policy.states),
        state_lengthscales=kernel.lengthscales,
        embedding_parameters=None if embedding_start is None else np.exp(embedding_start),
        policy_parameters=np.exp(x),
        noise=policy.noise,
        refused=refused,
        jitter=max(
            dual.jitter,
            *jitters,
            *(chosen.jitter for chosen in bases if isinstance(chosen, RKHSBasis)),
        ),
        seconds=clock.seconds,
    )
    return new_state, info


@dataclass(frozen=True)
class StreamedExpectation(Expectation):
    """The same of any number of samples; all but these two is of the sample in memory.

    Attributes:
        successors: what is expected of the samples of any chunk.
        bases: features of states and actions, if there is a model.
    """

    successors: Successors
    bases: tuple[Basis, ...]


def expected_successors(
    dataset: Dataset,
    sample: Transitions,
    changes: FeatureChanges,
    own: FloatArray,
    observed: FloatArray,
    state_kernel: Kernel,
    task: TaskSpec,
    settings: Settings,
    start: FloatArray | None,
    compute: Compute,
    rng: np.random.Generator,
    clock: Stopwatch,
) -> StreamedExpectation:
    """Fit the transition model that the settings ask for to all samples.

    Args:
        dataset, sample: all samples, and the m of them that are in memory.
        changes: features of V.
        own, observed: (m, r) features of the sample's states and successors.
        state_kernel: its factors are those of the model's kernel.
        task, settings, compute: of the update.
        start: log hyper-parameters where the last fit ended, if there was one.
        rng: chooses the samples of the fit.
        clock: of the stages.
    """
    after = after_ends(observed, sample.terminated[:, None].astype(np.float64), changes.start)
    if settings.model == "sample":
        return StreamedExpectation(
            after, None, None, None, 0.0, None, ObservedSuccessors(changes), ()
        )
    inputs = state_actions(sample, task)

    def regressed(
        targets: FloatArray, sums_in: Callable[[Basis], Callable[[Chunk], RegressionSums]]
    ) -> tuple[FeatureRegression, LeaveOneOut, FloatArray, tuple[Basis]]:
        """A regression of all samples, with hyper-parameters from the targets of the sample."""
        kernel, regulariser, x = embedding_hyperparameters(
            inputs, targets, state_kernel, task, start, rng
        )
        clock.lap("embedding fit")
        embedded = choose_basis(kernel, inputs, settings, settings.rank, rng)
        sums = reduce(add, compute.map(sums_in(embedded), dataset.chunks))
        errors = FeatureRegression.leave_one_out(
            embedded.features(inputs), targets, regulariser, len(dataset) / len(sample)
        )
        return FeatureRegression.fit(embedded, sums, regulariser), errors, x, (embedded,)

    if settings.model == "dynamics":
        motion = Motion.of(sample, task)
        model, missed, x, bases = regressed(
            motion.targets(sample, task),
            lambda embedded: MotionSums(motion, embedded, task, changes.place),
        )
        dynamics = Dynamics(motion, model.mean, missed.errors)
        expected, errors = observed_expectation(
            sample, changes.basis, own, observed, changes.start, dynamics, task
        )
        of_actions = partial(dynamics.expected_features, changes.basis, changes.start)
        successors = PredictedSuccessors(changes, motion, model, task)
        return StreamedExpectation(
            expected, errors, of_actions, x, model.jitter, dynamics, successors, bases
        )
    from_own = settings.model == "change"
    origin = own if from_own else np.zeros_like(own)
    model, errors, x, bases = regressed(
        after - origin, lambda embedded: EmbeddingSums(changes, embedded, task, from_own)
    )
    return StreamedExpectation(
        origin + model.mean(inputs),
        errors,
        lambda rows, asked: origin[rows] + model.mean(asked),
        x,
        model.jitter,
        None,
        EmbeddedSuccessors(changes, model, task, from_own),
        bases,
    )


def some(numbers: IntArray, rng: np.random.Generator) -> IntArray:
    """At most `SAMPLE` of the numbers, in order."""
    if len(numbers) <= SAMPLE:
        return numbers
    return np.sort(rng.choice(numbers, SAMPLE, replace=False))


def choose_basis(
    kernel: Kernel, points: FloatArray, settings: Settings, rank: int, rng: np.random.Generator
) -> Basis:
    """At most ``rank`` features of a kernel over points (m, d), as ``approximation`` asks for."""
    if settings.approximation == "fourier":
        return FourierBasis.draw(kernel, points.shape[1], max_rank=rank, rng=rng)
    return choose_centres(kernel, points, rank, settings, rng)


def choose_centres(
    kernel: Kernel, points: FloatArray, rank: int, settings: Settings, rng: np.random.Generator
) -> RKHSBasis:
    """The same with features that belong to some of the points.

    The policy asks for these in any case: they tell where there are no samples, so that its
    variance there is the prior's, which a process made of random Fourier features underestimates.
    """
    if settings.approximation == "uniform":
        return RKHSBasis.uniform(kernel, points, max_rank=rank, rng=rng)
    return RKHSBasis.fit(kernel, points, tolerance=settings.basis_tolerance, max_rank=rank)[0]


def policy_centres(
    support: PolicySamples,
    kernel: Kernel,
    x: FloatArray,
    settings: Settings,
    rng: np.random.Generator,
) -> RKHSBasis:
    """Inducing points of the policy at log hyper-parameters ``x`` (g + 2,)."""
    policy_kernel = kernel.with_lengthscales(np.exp(x[:-2]))
    rank = min(settings.rank, MAX_SUPPORT)
    return choose_centres(policy_kernel, support.states, rank, settings, rng)


def fit_sparse(
    task: TaskSpec,
    centres: RKHSBasis,
    sums: PolicySums,
    x: FloatArray,
    noise: float,
) -> SparseGP:
    """The policy at log hyper-parameters ``x`` (g + 2,); its actions are drawn with ``noise``."""
    return SparseGP.fit(task, centres, sums, signal=float(np.exp(x[-2])), noise=noise)


def solve(
    problem: StreamedProblem, ridge: float, differences: FloatArray, sampled: IntArray
) -> DualSolution:
    """The dual on the sample, in memory; then on more and more chunks, each from the last solution.

    ``differences`` are the rows of B of the ``sampled`` ones.

    A pass over all samples costs much more than one over a few, so Newton's method is to begin
    there near its end.
    """
    near = DualProblem(
        rewards=problem.rewards[sampled],
        differences=differences,
        kl_bound=problem.kl_bound,
        ridge=ridge / min(GROWTH * len(sampled), len(problem.rewards)),
        eta_floor=problem.eta_floor,
    )
    dual = solve_dual(near)
    if len(sampled) == len(problem.rewards):
        return dual
    stride = 1
    while len(problem.rewards) >= 2 * GROWTH * stride * SAMPLE:
        stride *= GROWTH
    while stride:
        part = problem.part(slice(None, None, stride))
        part = replace(part, ridge=ridge / min(GROWTH * len(part.rewards), len(problem.rewards)))
        dual = solve_dual(part, start=(dual.eta, dual.theta))
        stride //= GROWTH
    return dual
