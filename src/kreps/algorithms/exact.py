"""The lines of Algorithm 1 on all samples in memory, exactly: the cost is cubic in their number."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from kreps.algorithms.dual import DualProblem, DualSolution
from kreps.algorithms.ends import AbsorbingEnd, solve_with_end, standardise_with_end
from kreps.algorithms.policy_targets import (
    PolicyFit,
    PolicyTargets,
    exploration_noise,
    policy_hyperparameters,
)
from kreps.algorithms.reps import Expectation, ValueFeatures, stationarity_ridge
from kreps.algorithms.state import Stopwatch, exact_transitions
from kreps.data.rollouts import Rollout
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import Basis, RBFGrid, RKHSBasis
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import KernelEmbedding
from kreps.models.dynamics import (
    expected_features_of_samples,
    fit_dynamics,
    termination_probabilities_of_samples,
)
from kreps.models.reward_model import (
    RewardModel,
    held_out_steps,
    regressed_steps,
    reward_model,
)
from kreps.models.terminations import as_probabilities
from kreps.models.transition import (
    embedding_origin,
    feature_differences,
    fit_embedding,
    fit_regression,
    restart_features,
    state_actions,
    with_wrap_discontinuity,
)
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT, CostSensitiveGP
from kreps.settings import Grid, Settings


class ExactBatch:
    """All samples of the replay window.

    Raises:
        ConfigurationError: more samples than an exact update can serve.
    """

    def __init__(
        self,
        window: ReplayWindow,
        rollouts: Sequence[Rollout],
        settings: Settings,
        clock: Stopwatch,
    ) -> None:
        self.window, self.task, self.settings, self.clock = window, window.task, settings, clock
        self.data = exact_transitions(window)
        self.rewards, self.reward_unit, self.end = standardise_with_end(
            self.data.rewards, self.data.terminated, settings.p
        )
        self.size, self.seen = len(self.data), (len(rollouts), sum(map(len, rollouts)))
        self.actions = np.concatenate([r.actions for r in rollouts or window.rollouts])
        self.jitters: list[float] = []
        self.from_dataset = False

    def value_features(self, kernel: Kernel) -> ValueFeatures:
        data, value = self.data, self.settings.value
        basis: Basis
        if isinstance(value, Grid):
            basis, phi = RBFGrid.from_points(kernel.factors, data.points, value.size)
        else:
            kernel = with_wrap_discontinuity(kernel, data, self.task, value)
            basis, phi = RKHSBasis.fit(
                kernel, data.points, tolerance=value.tolerance, max_rank=value.max_rank
            )
        self.clock.lap("basis")
        own = phi[data.state]
        restart = restart_features(
            phi[data.start].mean(axis=0), own.mean(axis=0), self.settings.exploring_starts
        )
        return ValueFeatures(basis, own, phi[data.successor], restart)

    def transition_model(
        self,
        features: ValueFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> Expectation:
        if self.settings.model == "dynamics":
            found = self._dynamics(features, kernel, start, rng)
        else:
            found = self._embedding(features, kernel, start, rng)
        self.clock.lap("embedding")
        return found

    def _dynamics(
        self,
        features: ValueFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> Expectation:
        """Features of V at the successor that a regression of the state's change predicts."""
        dynamics, x, jitter = fit_dynamics(self.data, kernel, self.task, start, rng)
        self.jitters.append(jitter)
        self.clock.lap("embedding fit")
        basis, restart = features.basis, features.restart
        expected, errors = expected_features_of_samples(
            self.data, basis, features.own, features.observed, restart, dynamics, self.task
        )
        for_actions = partial(dynamics.expected_features, basis, restart)
        terminations = termination_probabilities_of_samples(self.data, dynamics)
        return Expectation(expected, errors, for_actions, x, dynamics, terminations, None)

    def _embedding(
        self,
        features: ValueFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> Expectation:
        """Eq. 4 on the features of successors, as printed or less those of the state."""
        data, model = self.data, self.settings.model
        origin = embedding_origin(features.own, model)
        terminated = data.terminated.astype(np.float64)
        observed = np.where(data.terminated[:, None], features.restart, features.observed)
        targets = observed - origin
        if model == "sample":
            self.clock.lap("embedding fit")
            return Expectation(origin + targets, None, None, None, None, terminated, None)
        embedding, x = self._fitted_embedding(features, targets, kernel, start, rng)
        self.jitters.append(embedding.factor.jitter)
        self.clock.lap("embedding fit")
        predict = embedding.predictor(targets)
        return Expectation(
            origin + embedding.expected_features(targets),
            embedding.leave_one_out(targets),
            lambda rows, inputs: origin[rows] + predict(inputs),
            x,
            None,
            terminated,
            as_probabilities(embedding.predictor(terminated[:, None])) if self.end else None,
        )

    def _fitted_embedding(
        self,
        features: ValueFeatures,
        targets: FloatArray,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> tuple[KernelEmbedding, FloatArray]:
        return fit_embedding(self.data, targets, kernel, self.task, start, rng)

    def solve_dual(
        self, features: ValueFeatures, model: Expectation, eta_floor: float
    ) -> tuple[DualProblem, DualSolution, AbsorbingEnd | None]:
        settings, own = self.settings, features.own
        problem = DualProblem(
            rewards=self.rewards,
            differences=feature_differences(own, model.expected, features.restart, settings.p),
            kl_bound=settings.kl_bound,
            ridge=stationarity_ridge(settings, model.errors) / self.size,
            eta_floor=eta_floor,
        )
        problem, dual, end = solve_with_end(problem, model.terminations, self.end)
        self.clock.lap("dual")
        return problem, dual, end

    def fit_policy_to_data(
        self, p: FloatArray, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> PolicyFit:
        targets = PolicyTargets.from_samples(self.data, p, self.task)
        return self.fit_policy(targets, kernel, start, rng)

    def fit_policy(
        self,
        targets: PolicyTargets,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
        std_scale: float = 1.0,
    ) -> PolicyFit:
        targets = targets.top_by_weight(MAX_SUPPORT)
        x = policy_hyperparameters(targets, kernel, self.settings.policy_fit, start, rng)
        return self._policy_with(x, targets, kernel, std_scale)

    def _policy_with(
        self, x: FloatArray, targets: PolicyTargets, kernel: Kernel, std_scale: float = 1.0
    ) -> PolicyFit:
        """The policy with log hyper-parameters x (g + 2,)."""
        self.clock.lap("policy fit")
        weights, noise = exploration_noise(targets, float(np.exp(x[-1])))
        policy = CostSensitiveGP(
            self.task,
            kernel.with_lengthscales(np.exp(x[:-2])),
            targets.states,
            targets.targets,
            weights,
            signal=float(np.exp(x[-2])) / std_scale**2,  # as the noise, so that the mean stays
            noise=noise / std_scale**2,
        )
        self.jitters.append(policy.jitter)
        self.clock.lap("policy")
        return PolicyFit(policy, x, len(targets.weights), policy.noise)

    def fit_reward(
        self, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> tuple[RewardModel, FloatArray]:
        # a reward may jump where the dynamics are smooth, so it has lengthscales of its own
        data, rows = self.data, regressed_steps(self.data)
        targets = (self.rewards - self.rewards.mean())[rows, None]
        kernel = with_wrap_discontinuity(kernel, data, self.task, self.settings.value)
        regression, x = fit_regression(data.rows(rows), targets, kernel, self.task, start, rng)
        self.jitters.append(regression.factor.jitter)
        predict, inputs = regression.predictor(targets), state_actions(data, self.task)
        loo = regression.leave_out_each(targets, held_out_steps(len(targets)))
        return reward_model(predict, self.rewards, data, inputs, loo), x

    def weights_in_memory(self, p: FloatArray) -> FloatArray:
        return p
