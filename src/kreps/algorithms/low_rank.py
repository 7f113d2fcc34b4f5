"""The lines of Algorithm 1 on any number of samples, in features in place of kernels.

Centres are chosen by pivoted Cholesky, and hyper-parameters fitted, on a subsample in memory.  Sums
over all samples are computed chunk by chunk, by the workers and on the device of `kreps.Compute`.
The cost is linear in the number of samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import add

import numpy as np

from kreps.algorithms.dual import DualSolution, effective_sample_size
from kreps.algorithms.ends import AbsorbingEnd, Start, solve_with_end, standardise_with_end
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.policy_targets import (
    MIN_RELATIVE_WEIGHT,
    PolicyFit,
    PolicyTargets,
    exploration_noise,
    policy_hyperparameters,
)
from kreps.algorithms.reps import stationarity_ridge
from kreps.algorithms.state import Stopwatch
from kreps.algorithms.streamed_dual import StreamedProblem, coarse_to_fine
from kreps.algorithms.streaming import (
    BellmanRows,
    ChunkPolicySums,
    ChunkRewards,
    ChunkTerminations,
    DeltaStateSums,
    EmbeddedSuccessors,
    EmbeddingSums,
    ObservedSuccessors,
    PredictedSuccessors,
    StartFeatures,
    StateFeatures,
    StreamedExpectation,
    StreamedFeatures,
)
from kreps.data.compute import Compute
from kreps.data.dataset import Chunk, Dataset
from kreps.data.outliers import in_data_set, warn_of_outliers
from kreps.data.rollouts import Rollout
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray, as_float
from kreps.kernels.basis import Basis, RBFGrid, RKHSBasis
from kreps.kernels.kernel import Kernel, as_wide_as_spread
from kreps.kernels.regression import FeatureRegression, LeaveOneOut, RegressionSums
from kreps.kernels.sampling import uniform_subsample
from kreps.models.coordinates import wide_hyperparameters
from kreps.models.dynamics import (
    DeltaStateTargets,
    Dynamics,
    expected_features_of_samples,
    termination_probabilities_of_samples,
    with_terminations,
)
from kreps.models.reward_model import RewardModel, regressed_steps, reward_model
from kreps.models.terminations import as_probabilities, fit_terminations_in_features, targets_of
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

Regressed = tuple[FeatureRegression, LeaveOneOut, FloatArray, Basis]
"""A regression of all samples, its errors on those in memory, log hyper-parameters and features."""


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
            self.dataset = samples.with_states(self.task)
        else:
            self.dataset = Dataset.from_rollouts(window.states, chunk_size=compute.chunk_size)
        self.size = len(self.dataset)
        read = list(compute.map(ChunkRewards(self.task), self.dataset.chunks))
        self.terminated = np.concatenate([chunk.terminated for chunk in read])
        self.all_rewards, self.reward_unit, self.end = standardise_with_end(
            np.concatenate([chunk.rewards for chunk in read]),
            self.terminated,
            settings.p,
        )
        self.in_memory = uniform_subsample(self.size, rng, low_rank.subsample)
        self.all_in_memory = len(self.in_memory) == self.size
        self.data = self.dataset.take(self.in_memory)
        self.rewards = self.all_rewards[self.in_memory]
        if isinstance(samples, Dataset):
            warn_of_outliers(in_data_set((chunk.rollouts, chunk.outliers) for chunk in read))
            self.seen = sum(chunk.rollouts for chunk in read), self.size
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
        starts = sums[:-1] / int(sums[-1])
        own, observed = StateFeatures(basis, starts, as_float).observed(data)
        restart = restart_features(starts, own.mean(axis=0), self.settings.exploring_starts)
        self.clock.lap("basis")
        streamed = StateFeatures(basis, restart, to_device)
        return StreamedFeatures(basis, own, observed, restart, streamed)

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
        kernel = as_wide_as_spread(kernel, data.states)
        targets = DeltaStateTargets.fit(data, task)
        model, errors, x, _ = self._regressed(
            targets.targets(data, task),
            lambda basis: DeltaStateSums(targets, basis, task, state_features.to_device),
            kernel,
            start,
            rng,
        )
        centres = partial(self._centres, rank=self.low_rank.rank)
        terminations = fit_terminations_in_features(data, kernel, rng, centres)
        self.jitters += [] if terminations is None else [terminations.jitter]
        dynamics = Dynamics(targets, model.mean, errors.errors, terminations)
        expected, errors = expected_features_of_samples(
            data, features.basis, features.own, features.observed, features.restart, dynamics, task
        )
        for_actions = partial(dynamics.expected_features, features.basis, features.restart)
        successors = PredictedSuccessors(state_features, targets, model, task, terminations)
        probabilities = self._termination_probabilities(dynamics)
        return StreamedExpectation(
            expected, errors, for_actions, x, dynamics, probabilities, None, successors
        )

    def _termination_probabilities(self, dynamics: Dynamics) -> FloatArray:
        """Of all samples (n,), as the rows of the dual have them."""
        model = dynamics.terminations
        if model is None or self.all_in_memory:
            return termination_probabilities_of_samples(self.data, dynamics)
        of_chunk = ChunkTerminations(model, self.compute.to_device)
        return np.concatenate(list(self.compute.map(of_chunk, self.dataset.chunks)))

    def _embedding(
        self,
        features: StreamedFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> StreamedExpectation:
        """Eq. 4 on the features of successors, as printed or less those of the state."""
        data, task, own, state_features = (
            self.data,
            self.task,
            features.own,
            features.state_features,
        )
        terminated, probabilities = targets_of(data), self.terminated.astype(np.float64)
        after = with_terminations(features.observed, terminated, features.restart)
        if self.settings.model == "sample":
            successors = ObservedSuccessors(state_features)
            return StreamedExpectation(
                after, None, None, None, None, probabilities, None, successors
            )
        relative = self.settings.model == "change"
        origin = embedding_origin(own, self.settings.model)
        model, errors, x, basis = self._regressed(
            after - origin,
            lambda basis: EmbeddingSums(state_features, basis, task, relative),
            kernel,
            start,
            rng,
        )
        inputs, terminations = state_actions(data, task), None
        if terminated.any():  # regularised like the embedding of all samples
            regulariser = float(np.exp(x[-1])) * len(data) / self.size
            sums = RegressionSums.from_samples(basis.features(inputs), terminated)
            terminations = as_probabilities(self._regression(basis, sums, regulariser).mean)
        return StreamedExpectation(
            origin + model.mean(inputs),
            errors,
            lambda rows, inputs: origin[rows] + model.mean(inputs),
            x,
            None,
            probabilities,
            terminations,
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
        dynamics = self.settings.model == "dynamics"
        hyperparameters = wide_hyperparameters if dynamics else embedding_hyperparameters
        inputs = state_actions(self.data, self.task)
        fitted, regulariser, x = hyperparameters(inputs, targets, kernel, self.task, start, rng)
        self.clock.lap("embedding fit")
        basis = self._centres(fitted, inputs, self.low_rank.rank)
        sums = reduce(add, self.compute.map(sums_in(basis), self.dataset.chunks))
        errors = FeatureRegression.leave_one_out(
            basis.features(inputs), targets, regulariser, self.size / len(self.data)
        )
        return self._regression(basis, sums, regulariser), errors, x, basis

    def solve_dual(
        self, features: StreamedFeatures, model: StreamedExpectation, eta_floor: float
    ) -> tuple[StreamedProblem, DualSolution, AbsorbingEnd | None]:
        settings, restart, p = self.settings, features.restart, self.settings.p
        ridge = stationarity_ridge(settings, model.errors)
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
        problem = problem if self.all_in_memory else problem.keeping_rows()

        def solve(problem: StreamedProblem, start: Start) -> DualSolution:
            if start is not None and not self.all_in_memory:
                return solve_dual(problem, start=start)
            size = self.low_rank.subsample
            return coarse_to_fine(problem, ridge, differences, self.in_memory, size, start)

        problem, dual, end = solve_with_end(problem, model.terminations, self.end, solve=solve)
        self.clock.lap("dual")
        return problem.releasing_rows(), dual, end

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
    ) -> tuple[RewardModel, FloatArray]:
        all_inputs, rows = state_actions(self.data, self.task), regressed_steps(self.data)
        inputs, targets = all_inputs[rows], (self.rewards - self.rewards.mean())[rows, None]
        kernel = with_wrap_discontinuity(kernel, self.data, self.task, self.settings.value)
        fitted, regulariser, x = embedding_hyperparameters(
            inputs, targets, kernel, self.task, start, rng
        )
        basis = self._centres(fitted, inputs, self.low_rank.rank)
        sums = RegressionSums.from_samples(basis.features(inputs), targets)
        # scaled by the subsampling fraction, so that the subsample regularises like the full data
        scaled = regulariser * len(self.data) / self.size
        model = self._regression(basis, sums, scaled)
        loo = FeatureRegression.leave_one_out(basis.features(inputs), targets, scaled)
        return reward_model(model.mean, self.rewards, self.data, all_inputs, loo), x

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
