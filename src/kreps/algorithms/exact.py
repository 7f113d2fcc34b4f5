"""Algorithm 1 on all samples in memory, exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from kreps.algorithms.dual import DualProblem, DualSolution, standardise
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.reps import (
    Expectation,
    PolicyFit,
    PolicySamples,
    ValueFeatures,
    drawn_noise,
    policy_hyperparameters,
    stationarity_ridge,
)
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.data.rollout import Rollout
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RBFGrid, RKHSBasis
from kreps.kernels.kernel import Kernel
from kreps.models.dynamics import fit_dynamics, observed_expectation
from kreps.models.transition import (
    feature_differences,
    fit_embedding,
    fit_regression,
    restart_features,
    with_cuts,
)
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT, CostSensitiveGP
from kreps.settings import Settings


class ExactBatch:
    """Every sample counts by its kernel function: the update costs their cube."""

    def __init__(
        self,
        state: LearnerState,
        rollouts: Sequence[Rollout],
        task: TaskSpec,
        settings: Settings,
        clock: Stopwatch,
    ) -> None:
        self.task, self.settings, self.clock = task, settings, clock
        self.window, self.data = state.extended(rollouts, task)
        self.rewards, self.reward_unit = standardise(self.data.rewards)
        self.size, self.seen = len(self.data), (len(rollouts), sum(map(len, rollouts)))
        self.actions = np.concatenate([r.actions for r in rollouts or self.window.rollouts])
        self.jitters: list[float] = []
        self.from_dataset = False

    def value_features(self, kernel: Kernel, rng: np.random.Generator) -> ValueFeatures:
        data, settings = self.data, self.settings
        if settings.features == "grid":
            basis, phi = RBFGrid.over(kernel.factors, data.points, settings.grid_size)
        else:
            cut = with_cuts(kernel, data, self.task, settings)
            basis, phi = RKHSBasis.fit(
                cut, data.points, tolerance=settings.basis_tolerance, max_rank=settings.max_rank
            )
        self.clock.lap("basis")
        start = phi[data.start].mean(axis=0)
        return ValueFeatures(basis, phi[data.state], phi[data.successor], start)

    def transition_model(
        self,
        features: ValueFeatures,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
    ) -> Expectation:
        data, task, settings = self.data, self.task, self.settings
        basis, own, observed, after_end = vars(features).values()
        if settings.model == "dynamics":
            dynamics, x, jitter = fit_dynamics(data, kernel, task, start, rng)
            self.clock.lap("embedding fit")
            expected, errors = observed_expectation(
                data, basis, own, observed, after_end, dynamics, task
            )
            of_actions = partial(dynamics.expected_features, basis, after_end)
            found = Expectation(expected, errors, of_actions, x, dynamics)
        else:
            origin = np.zeros_like(own) if settings.model == "embedding" else own
            successors = np.where(data.terminated[:, None], after_end, observed) - origin
            if settings.model == "sample":
                self.clock.lap("embedding fit")
                found = Expectation(origin + successors, None, None, None, None)
                jitter = 0.0
            else:
                model, x = fit_embedding(data, successors, kernel, task, start, rng)
                self.clock.lap("embedding fit")
                predict, jitter = model.predictor(successors), model.factor.jitter
                found = Expectation(
                    origin + model.expected_features(successors),
                    model.leave_one_out(successors),
                    lambda rows, inputs: origin[rows] + predict(inputs),
                    x,
                    None,
                )
        self.jitters.append(jitter)
        self.clock.lap("embedding")
        return found

    def solve_dual(
        self, features: ValueFeatures, model: Expectation, eta_floor: float
    ) -> tuple[DualProblem, DualSolution]:
        settings, own = self.settings, features.own
        restart = restart_features(features.start, own.mean(axis=0), settings)
        problem = DualProblem(
            rewards=self.rewards,
            differences=feature_differences(
                own, model.expected, restart, settings.restart_probability
            ),
            kl_bound=settings.kl_bound,
            ridge=stationarity_ridge(settings, model.errors) / self.size,
            eta_floor=eta_floor,
        )
        dual = solve_dual(problem)
        self.clock.lap("dual")
        return problem, dual

    def fit_policy_to_data(
        self, p: FloatArray, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> PolicyFit:
        return self.fit_policy(PolicySamples.of(self.data, p, self.task), kernel, start, rng)

    def fit_policy(
        self,
        samples: PolicySamples,
        kernel: Kernel,
        start: FloatArray | None,
        rng: np.random.Generator,
        narrower: float = 1.0,
    ) -> PolicyFit:
        samples = samples.heaviest(MAX_SUPPORT)
        x = policy_hyperparameters(samples, kernel, self.settings, start, rng)
        self.clock.lap("policy fit")
        weights, noise = drawn_noise(samples, float(np.exp(x[-1])))
        policy = CostSensitiveGP(
            self.task,
            kernel.with_lengthscales(np.exp(x[:-2])),
            samples.states,
            samples.targets,
            weights,
            signal=float(np.exp(x[-2])) / narrower**2,  # of process and noise: the mean stays
            noise=noise / narrower**2,
        )
        self.jitters.append(policy.jitter)
        self.clock.lap("policy")
        return PolicyFit(policy, x, len(samples.weights))

    def fit_reward(
        self, kernel: Kernel, start: FloatArray | None, rng: np.random.Generator
    ) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        # a reward may jump where the dynamics are smooth, so it has lengthscales of its own
        targets = (self.rewards - self.rewards.mean())[:, None]
        cut = with_cuts(kernel, self.data, self.task, self.settings)
        regression, x = fit_regression(self.data, targets, cut, self.task, start, rng)
        self.jitters.append(regression.factor.jitter)
        return regression.predictor(targets), x

    def of_data(self, p: FloatArray) -> FloatArray:
        """Weights of the samples in memory, of those of all."""
        return p
