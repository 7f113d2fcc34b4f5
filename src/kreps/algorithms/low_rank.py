"""The lines of Algorithm 1 on any number of samples, in features in place of kernels.

Centres are chosen by pivoted Cholesky, and hyper-parameters fitted, on a subsample in memory.  Sums
over all samples are computed chunk by chunk, by the workers and on the device of `kreps.Compute`.
The cost is linear in the number of samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add

import numpy as np

from kreps.algorithms.dual import DualSolution, effective_sample_size, standardise
from kreps.algorithms.policy_targets import (
    MIN_RELATIVE_WEIGHT,
    PolicyFit,
    PolicyTargets,
    exploration_noise,
    policy_hyperparameters,
)
from kreps.algorithms.reps import Expectation, ValueFeatures, stationarity_ridge
from kreps.algorithms.state import Stopwatch
from kreps.algorithms.streamed_dual import StreamedProblem, coarse_to_fine
from kreps.algorithms.streaming import (
    BellmanRows,
    ChunkPolicySums,
    ChunkRewards,
    DeltaStateSums,
    EmbeddedSuccessors,
    EmbeddingSums,
    ExpectedSuccessors,
    ObservedSuccessors,
    PredictedSuccessors,
    StartFeatures,
    StateFeatures,
)
from kreps.data.compute import Compute
from kreps.data.dataset import Chunk, Dataset
from kreps.data.rollouts import Rollout
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray, as_float
from kreps.kernels.basis import Basis, RBFGrid, RKHSBasis
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import FeatureRegression, LeaveOneOut, RegressionSums
from kreps.kernels.sampling import uniform_subsample
from kreps.models.dynamics import (
    DeltaStateTargets,
    Dynamics,
    expected_features_of_samples,
    with_terminations,
)
from kreps.models.transition import (
    embedding_hyperparameters,
    embedding_origin,
    feature_differences,
    restart_features,
    state_actions,
    with_wrap_discontinuity,
)
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT
from kreps.policies.sparse_gp import PolicySums, SparseGP
from kreps.settings import Grid, LowRank, Settings

RESIDUAL_TOLERANCE = 1e-6
"""Bases of state-actions and of the policy are complete if the squared residual of every input in
memory is at most this; the kernels are at most one."""


@dataclass(frozen=True)
class StreamedFeatures(ValueFeatures):
    """Features of V at the samples in memory, and the function that computes those of a chunk."""

    state_features: StateFeatures


@dataclass(frozen=True)
class StreamedExpectation(Expectation):
    """Predictions for the samples in memory, and the model that computes those of a chunk."""

    successors: ExpectedSuccessors


Regressed = tuple[FeatureRegression, LeaveOneOut, FloatArray]
"""A regression of all samples, its errors on those in memory, and its log hyper-parameters."""


class LowRankBatch:
    """All samples of the replay window or of a data set, of which a subsample is in memory.

    Args:
        window: with the new rollouts.
        samples: the new rollouts, or a data set to learn from instead of the window.
        settings, low_rank: of the learner.
        clock: of the update.
        compute: workers and device.
        rng: draws the subsample.
        tolerance: largest squared residual in the bases of state-actions and of the policy.

    Raises:
        DataError: a chunk with observations or actions of another width than the task's.
    """

    def __init__(
        self,
        window: ReplayWindow,
        samples: Sequence[Rollout] | Dataset,
        settings: Settings,
        low_rank: LowRank,
        clock: Stopwatch,
        compute: Compute,
        rng: np.random.Generator,
        tolerance: float = RESIDUAL_TOLERANCE,
    ) -> None:
        self.window, self.task, self.settings, self.clock = window, window.task, settings, clock
        self.low_rank, self.compute, self.tolerance = low_rank, compute, tolerance
        self.jitters: list[float] = []
        self.from_dataset = isinstance(samples, Dataset)
        if isinstance(samples, Dataset):
            self.dataset = samples
        else:
            self.dataset = Dataset.from_rollouts(window.rollouts, chunk_size=compute.chunk_size)
        self.size = len(self.dataset)
        read = list(compute.map(ChunkRewards(self.task), self.dataset.chunks))
        self.all_rewards, self.reward_unit = standardise(
            np.concatenate([rewards for rewards, _ in read])
        )
        self.in_memory = uniform_subsample(self.size, rng, low_rank.subsample)
        self.data = self.dataset.take(self.in_memory)
        self.rewards = self.all_rewards[self.in_memory]
        if isinstance(samples, Dataset):
            self.seen = sum(rollouts for _, rollouts in read), self.size
            self.actions = self.data.actions
        else:
            self.seen = len(samples), sum(map(len, samples))
            self.actions = np.concatenate([r.actions for r in samples or window.rollouts])
        clock.lap("sample")

    def value_features(self, kernel: Kernel) -> StreamedFeatures:
        value, data, to_device = self.settings.value, self.data, self.compute.to_device
        if isinstance(value, Grid):
            basis: Basis = RBFGrid.from_points(kernel.factors, data.points, value.size)[0]
        else:
            kernel = with_wrap_discontinuity(kernel, data, self.task, value)
            basis = self._centres(kernel, data.points, value.max_rank, value.tolerance)
        sums = reduce(add, self.compute.map(StartFeatures(basis, to_device), self.dataset.chunks))
        state_features = StateFeatures(basis, sums[:-1] / int(sums[-1]), to_device)
        own, observed = replace(state_features, to_device=as_float).observed(data)
        self.clock.lap("basis")
        return StreamedFeatures(basis, own, observed, state_features.start, state_features)

    def transition_model(
        self,
        features: StreamedFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> StreamedExpectation:
        if self.settings.model == "dynamics":
            found = self._dynamics(features, kernel, start, rng)
        else:
            found = self._embedding(features, kernel, start, rng)
        self.clock.lap("embedding")
        return found

    def _dynamics(
        self,
        features: StreamedFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> StreamedExpectation:
        """Features of V at the successor that a regression of the state's change predicts."""
        data, task, state_features = self.data, self.task, features.state_features
        targets = DeltaStateTargets.fit(data, task)
        model, errors, x = self._regressed(
            targets.targets(data, task),
            lambda basis: DeltaStateSums(targets, basis, task, state_features.to_device),
            kernel,
            start,
            rng,
        )
        dynamics = Dynamics(targets, model.mean, errors.errors)
        expected, errors = expected_features_of_samples(
            data, features.basis, features.own, features.observed, features.start, dynamics, task
        )
        for_actions = partial(dynamics.expected_features, features.basis, features.start)
        successors = PredictedSuccessors(state_features, targets, model, task)
        return StreamedExpectation(expected, errors, for_actions, x, dynamics, successors)

    def _embedding(
        self,
        features: StreamedFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> StreamedExpectation:
        """Eq. 4 on the features of successors, as printed or less those of the state."""
        data, task, own = self.data, self.task, features.own
        state_features = features.state_features
        terminated = data.terminated[:, None].astype(np.float64)
        after = with_terminations(features.observed, terminated, features.start)
        if self.settings.model == "sample":
            successors = ObservedSuccessors(state_features)
            return StreamedExpectation(after, None, None, None, None, successors)
        relative = self.settings.model == "change"
        origin = embedding_origin(own, self.settings.model)
        model, errors, x = self._regressed(
            after - origin,
            lambda basis: EmbeddingSums(state_features, basis, task, relative),
            kernel,
            start,
            rng,
        )
        return StreamedExpectation(
            origin + model.mean(state_actions(data, task)),
            errors,
            lambda rows, inputs: origin[rows] + model.mean(inputs),
            x,
            None,
            EmbeddedSuccessors(state_features, model, task, relative),
        )

    def _regressed(
        self,
        targets: FloatArray,
        sums_in: Callable[[Basis], Callable[[Chunk], RegressionSums]],
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> Regressed:
        """A regression on states and actions, with hyper-parameters from the samples in memory.

        Args:
            targets: (m, r) of the samples in memory.
            sums_in: maps features of states and actions to the function of a chunk that computes
                its sums.
            kernel, start, rng: as of `transition_model`.
        """
        inputs = state_actions(self.data, self.task)
        fitted, regulariser, x = embedding_hyperparameters(
            inputs, targets, kernel, self.task, start, rng
        )
        self.clock.lap("embedding fit")
        basis = self._centres(fitted, inputs, self.low_rank.rank)
        sums = reduce(add, self.compute.map(sums_in(basis), self.dataset.chunks))
        errors = FeatureRegression.leave_one_out(
            basis.features(inputs), targets, regulariser, self.size / len(self.data)
        )
        return self._regression(basis, sums, regulariser), errors, x

    def solve_dual(
        self, features: StreamedFeatures, model: StreamedExpectation, eta_floor: float
    ) -> tuple[StreamedProblem, DualSolution]:
        settings, p = self.settings, self.settings.restart_probability
        ridge = stationarity_ridge(settings, model.errors)
        restart = restart_features(
            features.start, features.own.mean(axis=0), settings.exploring_starts
        )
        problem = StreamedProblem(
            dataset=self.dataset,
            rows=BellmanRows(model.successors, restart, p),
            rewards=self.all_rewards,
            kl_bound=settings.kl_bound,
            ridge=ridge / self.size,
            eta_floor=eta_floor,
            compute=self.compute,
        )
        differences = feature_differences(features.own, model.expected, restart, p)
        dual = coarse_to_fine(problem, ridge, differences, self.in_memory, self.low_rank.subsample)
        self.clock.lap("dual")
        return problem, dual

    def fit_policy_to_data(
        self, p: FloatArray, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> PolicyFit:
        weights = np.where(self.size * p >= MIN_RELATIVE_WEIGHT, p, 0.0)
        weights = weights * effective_sample_size(p)
        positive = np.flatnonzero(weights)
        rows = positive[uniform_subsample(len(positive), rng, self.low_rank.subsample)]
        part = self.dataset.take(rows)
        targets = PolicyTargets(
            part.states,
            self.task.scaled(part.actions),
            weights[rows],
            float(weights.sum()),
            np.zeros(len(rows)),
        )
        x = policy_hyperparameters(targets, kernel, self.settings.policy_fit, start, rng)
        self.clock.lap("policy fit")
        centres = self._policy_centres(targets, kernel, x)
        sums_of = ChunkPolicySums(centres, self.task, self.compute.to_device)
        sums = reduce(
            add, self.compute.map(sums_of, self.dataset.chunks, self.dataset.split(weights))
        )
        return self._sparse_policy(centres, sums, x, float(np.exp(x[-1])))

    def fit_policy(
        self,
        targets: PolicyTargets,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
        std_scale: float = 1.0,
    ) -> PolicyFit:
        x = policy_hyperparameters(targets, kernel, self.settings.policy_fit, start, rng)
        centres = self._policy_centres(targets, kernel, x)
        weights, noise = exploration_noise(targets, float(np.exp(x[-1])))
        sums = PolicySums.from_samples(centres.features(targets.states), weights, targets.targets)
        return self._sparse_policy(centres, sums, x, noise, std_scale)

    def fit_reward(
        self, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        inputs = state_actions(self.data, self.task)
        targets = (self.rewards - self.rewards.mean())[:, None]
        kernel = with_wrap_discontinuity(kernel, self.data, self.task, self.settings.value)
        fitted, regulariser, x = embedding_hyperparameters(
            inputs, targets, kernel, self.task, start, rng
        )
        basis = self._centres(fitted, inputs, self.low_rank.rank)
        sums = RegressionSums.from_samples(basis.features(inputs), targets)
        # scaled by the subsampling fraction, so that the subsample regularises like the full data
        model = self._regression(basis, sums, regulariser * len(self.data) / self.size)
        return model.mean, x

    def weights_in_memory(self, p: FloatArray) -> FloatArray:
        return p[self.in_memory] / p[self.in_memory].sum()

    def _regression(
        self, basis: Basis, sums: RegressionSums, regulariser: float
    ) -> FeatureRegression:
        model = FeatureRegression.fit(basis, sums, regulariser)
        self.jitters.append(model.jitter)
        return model

    def _sparse_policy(
        self,
        centres: RKHSBasis,
        sums: PolicySums,
        x: FloatArray,
        noise: float,
        std_scale: float = 1.0,
    ) -> PolicyFit:
        policy = SparseGP.fit(self.task, centres, sums, signal=float(np.exp(x[-2])), noise=noise)
        policy = policy.deflated(std_scale)
        self.clock.lap("policy")
        return PolicyFit(policy, x, len(policy.states), policy.noise)

    def _policy_centres(self, targets: PolicyTargets, kernel: Kernel, x: FloatArray) -> RKHSBasis:
        rank = min(self.low_rank.rank, MAX_SUPPORT)
        return self._centres(kernel.with_lengthscales(np.exp(x[:-2])), targets.states, rank)

    def _centres(
        self, kernel: Kernel, points: FloatArray, rank: int, tolerance: float | None = None
    ) -> RKHSBasis:
        """At most ``rank`` features of a kernel, whose centres are pivots among points (m, d)."""
        tolerance = self.tolerance if tolerance is None else tolerance
        return RKHSBasis.fit(kernel, points, tolerance=tolerance, max_rank=rank)[0]
