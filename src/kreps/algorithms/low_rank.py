"""Algorithm 1 on any number of samples: bases from a sub-sample, sums over chunks of all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add

import numpy as np

from kreps.algorithms.dual import DualProblem, DualSolution, effective_sample_size, standardise
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.reps import (
    DROPPED_WEIGHT,
    Expectation,
    PolicyFit,
    PolicySamples,
    ValueFeatures,
    drawn_noise,
    policy_hyperparameters,
    stationarity_ridge,
)
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.algorithms.streaming import (
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
from kreps.data.compute import Compute
from kreps.data.dataset import Chunk, Dataset
from kreps.data.rollout import Rollout
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, IntArray, as_float
from kreps.kernels.basis import Basis, FourierBasis, RBFGrid, RKHSBasis
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import FeatureRegression, LeaveOneOut, RegressionSums
from kreps.models.dynamics import Dynamics, Motion, after_ends, observed_expectation
from kreps.models.transition import (
    embedding_hyperparameters,
    feature_differences,
    restart_features,
    state_actions,
    with_cuts,
)
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT
from kreps.policies.sparse_gp import PolicySums, SparseGP
from kreps.settings import Settings

SAMPLE = 10_000
GROWTH = 4


def some(numbers: IntArray, rng: np.random.Generator) -> IntArray:
    """At most `SAMPLE` of the numbers, in order."""
    if len(numbers) <= SAMPLE:
        return numbers
    return np.sort(rng.choice(numbers, SAMPLE, replace=False))


@dataclass(frozen=True)
class StreamedFeatures(ValueFeatures):
    changes: FeatureChanges


@dataclass(frozen=True)
class StreamedExpectation(Expectation):
    successors: Successors


class LowRankBatch:
    """Features in place of kernels, and every sum over samples taken chunk by chunk."""

    def __init__(
        self,
        state: LearnerState,
        rollouts: Sequence[Rollout] | Dataset,
        task: TaskSpec,
        settings: Settings,
        clock: Stopwatch,
        compute: Compute,
        rng: np.random.Generator,
    ) -> None:
        self.task, self.settings, self.clock, self.compute = task, settings, clock, compute
        self.jitters: list[float] = []
        self.from_dataset = isinstance(rollouts, Dataset)
        if isinstance(rollouts, Dataset):
            self.window, self.dataset, seen = state.window, rollouts, None
        else:
            self.window = state.extended_window(rollouts, task)
            self.dataset = Dataset.of(self.window.rollouts)
            seen = len(rollouts), sum(map(len, rollouts))
        self.size = len(self.dataset)
        raw = np.concatenate(list(compute.map(ChunkRewards(task), self.dataset.chunks)))
        self.all_rewards, self.reward_unit = standardise(raw)
        self.sampled = some(np.arange(self.size), rng)
        self.data = self.dataset.take(self.sampled)
        self.rewards = self.all_rewards[self.sampled]
        self.starts: FloatArray | None = None
        if seen is None:
            self.seen, self.actions = None, self.data.actions
        else:
            acted = rollouts or self.window.rollouts
            self.seen, self.actions = seen, np.concatenate([r.actions for r in acted])
        clock.lap("sample")

    def value_features(self, kernel: Kernel, rng: np.random.Generator) -> StreamedFeatures:
        settings, data, place = self.settings, self.data, self.compute.to_device
        if settings.features == "grid":
            basis: Basis = RBFGrid.over(kernel.factors, data.points, settings.grid_size)[0]
        else:
            cut = with_cuts(kernel, data, self.task, settings)
            basis = self._basis(cut, data.points, settings.max_rank, rng)
        sums = reduce(add, self.compute.map(StartFeatures(basis, place), self.dataset.chunks))
        if self.seen is None:
            self.seen = int(sums[-1]), self.size
        changes = FeatureChanges(basis, sums[:-1] / int(sums[-1]), place)
        own, observed = replace(changes, place=as_float).observed(data)
        self.clock.lap("basis")
        return StreamedFeatures(basis, own, observed, changes.start, changes)

    def transition_model(
        self,
        features: StreamedFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> StreamedExpectation:
        found = self._transition_model(features, kernel, start, rng)
        self.clock.lap("embedding")
        return found

    def _transition_model(
        self,
        features: StreamedFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> StreamedExpectation:
        data, task, changes = self.data, self.task, features.changes
        own, observed = features.own, features.observed
        after = after_ends(observed, data.terminated[:, None].astype(np.float64), changes.start)
        if self.settings.model == "sample":
            return StreamedExpectation(after, None, None, None, None, ObservedSuccessors(changes))
        inputs = state_actions(data, task)

        def regressed(
            targets: FloatArray, sums_in: Callable[[Basis], Callable[[Chunk], RegressionSums]]
        ) -> tuple[FeatureRegression, LeaveOneOut, FloatArray]:
            """A regression of all samples, with hyper-parameters from those in memory."""
            fitted, regulariser, x = embedding_hyperparameters(
                inputs, targets, kernel, task, start, rng
            )
            self.clock.lap("embedding fit")
            basis = self._basis(fitted, inputs, self.settings.rank, rng)
            sums = reduce(add, self.compute.map(sums_in(basis), self.dataset.chunks))
            errors = FeatureRegression.leave_one_out(
                basis.features(inputs), targets, regulariser, self.size / len(data)
            )
            return self._regression(basis, sums, regulariser), errors, x

        if self.settings.model == "dynamics":
            motion = Motion.of(data, task)
            model, missed, x = regressed(
                motion.targets(data, task),
                lambda basis: MotionSums(motion, basis, task, changes.place),
            )
            dynamics = Dynamics(motion, model.mean, missed.errors)
            expected, errors = observed_expectation(
                data, features.basis, own, observed, changes.start, dynamics, task
            )
            of_actions = partial(dynamics.expected_features, features.basis, changes.start)
            successors = PredictedSuccessors(changes, motion, model, task)
            return StreamedExpectation(expected, errors, of_actions, x, dynamics, successors)
        from_own = self.settings.model == "change"
        origin = own if from_own else np.zeros_like(own)
        model, errors, x = regressed(
            after - origin, lambda basis: EmbeddingSums(changes, basis, task, from_own)
        )
        return StreamedExpectation(
            origin + model.mean(inputs),
            errors,
            lambda rows, asked: origin[rows] + model.mean(asked),
            x,
            None,
            EmbeddedSuccessors(changes, model, task, from_own),
        )

    def solve_dual(
        self, features: StreamedFeatures, model: StreamedExpectation, eta_floor: float
    ) -> tuple[StreamedProblem, DualSolution]:
        ridge, p = (
            stationarity_ridge(self.settings, model.errors),
            self.settings.restart_probability,
        )
        restart = restart_features(features.start, features.own.mean(axis=0), self.settings)
        problem = StreamedProblem(
            dataset=self.dataset,
            rows=BellmanRows(model.successors, restart, p),
            rewards=self.all_rewards,
            kl_bound=self.settings.kl_bound,
            ridge=ridge / self.size,
            eta_floor=eta_floor,
            compute=self.compute,
        )
        differences = feature_differences(features.own, model.expected, restart, p)
        dual = coarse_to_fine(problem, ridge, differences, self.sampled)
        self.clock.lap("dual")
        return problem, dual

    def fit_policy_to_data(
        self, p: FloatArray, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> PolicyFit:
        weights = np.where(self.size * p >= DROPPED_WEIGHT, p, 0.0) * effective_sample_size(p)
        heard = some(np.flatnonzero(weights), rng)
        part = self.dataset.take(heard)
        samples = PolicySamples(
            part.states,
            self.task.scaled(part.actions),
            weights[heard],
            float(weights.sum()),
            np.zeros(len(heard)),
        )
        x = policy_hyperparameters(samples, kernel, self.settings, start, rng)
        self.clock.lap("policy fit")
        centres = self._policy_centres(samples, kernel, x, rng)
        sums_of = ChunkPolicySums(centres, self.task, self.compute.to_device)
        sums = reduce(
            add, self.compute.map(sums_of, self.dataset.chunks, self.dataset.split(weights))
        )
        return self._sparse(centres, sums, x, float(np.exp(x[-1])))

    def fit_policy(
        self,
        samples: PolicySamples,
        kernel: Kernel,
        start: FloatArray,
        rng: np.random.Generator,
        narrower: float = 1.0,
    ) -> PolicyFit:
        x = policy_hyperparameters(samples, kernel, self.settings, start, rng)
        centres = self._policy_centres(samples, kernel, x, rng)
        weights, noise = drawn_noise(samples, float(np.exp(x[-1])))
        sums = PolicySums.of(centres.features(samples.states), weights, samples.targets)
        return self._sparse(centres, sums, x, noise, narrower)

    def fit_reward(
        self, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        inputs, targets = (
            state_actions(self.data, self.task),
            (self.rewards - self.rewards.mean())[:, None],
        )
        cut = with_cuts(kernel, self.data, self.task, self.settings)
        fitted, regulariser, x = embedding_hyperparameters(
            inputs, targets, cut, self.task, start, rng
        )
        basis = self._basis(fitted, inputs, self.settings.rank, rng)
        sums = RegressionSums.of(basis.features(inputs), targets)
        # scaled as if all samples were like those in memory
        model = self._regression(basis, sums, regulariser * len(self.data) / self.size)
        return model.mean, x

    def of_data(self, p: FloatArray) -> FloatArray:
        return p[self.sampled] / p[self.sampled].sum()

    def _regression(
        self, basis: Basis, sums: RegressionSums, regulariser: float
    ) -> FeatureRegression:
        model = FeatureRegression.fit(basis, sums, regulariser)
        self.jitters.append(model.jitter)
        return model

    def _sparse(
        self,
        centres: RKHSBasis,
        sums: PolicySums,
        x: FloatArray,
        noise: float,
        narrower: float = 1.0,
    ) -> PolicyFit:
        policy = SparseGP.fit(self.task, centres, sums, signal=float(np.exp(x[-2])), noise=noise)
        self.clock.lap("policy")
        return PolicyFit(policy.narrowed(narrower), x, len(policy.states))

    def _policy_centres(
        self, samples: PolicySamples, kernel: Kernel, x: FloatArray, rng: np.random.Generator
    ) -> RKHSBasis:
        rank = min(self.settings.rank, MAX_SUPPORT)
        return self._centres(kernel.with_lengthscales(np.exp(x[:-2])), samples.states, rank, rng)

    def _basis(
        self, kernel: Kernel, points: FloatArray, rank: int, rng: np.random.Generator
    ) -> Basis:
        """At most ``rank`` features of a kernel over points (m, d), as ``approximation`` asks."""
        if self.settings.approximation == "fourier":
            return FourierBasis.draw(kernel, points.shape[1], max_rank=rank, rng=rng)
        return self._centres(kernel, points, rank, rng)

    def _centres(
        self, kernel: Kernel, points: FloatArray, rank: int, rng: np.random.Generator
    ) -> RKHSBasis:
        """The same with features that belong to some of the points."""
        if self.settings.approximation == "uniform":
            basis = RKHSBasis.uniform(kernel, points, max_rank=rank, rng=rng)
        else:
            tolerance = self.settings.basis_tolerance
            basis, _ = RKHSBasis.fit(kernel, points, tolerance=tolerance, max_rank=rank)
        self.jitters.append(basis.jitter)
        return basis


def coarse_to_fine(
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
