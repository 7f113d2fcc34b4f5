"""The conditional embedding, and the fits of its and the policy's hyper-parameters."""

from __future__ import annotations

import flops
import numpy as np
from criteria import Seconds, Share
from data import swing_up
from measuring import Measure

from kreps.algorithms.policy_targets import PolicyTargets, policy_hyperparameters
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.hyperparameters import EmbeddingLoss, PolicyLoss, factor_distances
from kreps.kernels.kernel import Kernel, SquaredExponential, median_lengthscales
from kreps.kernels.regression import KernelEmbedding
from kreps.kernels.sampling import FIT_SAMPLE_SIZE
from kreps.models.transition import fit_embedding, state_kernel, successor_features

N = 1500
RNG = np.random.default_rng


class Prepared:
    """The input of each stage, computed as by the stages before it."""

    def __init__(self) -> None:
        data = swing_up(N)
        self.task = data.learner.task
        self.transitions = data.transitions
        self.kernel = state_kernel(self.transitions, self.task, RNG(0))
        _, features = RKHSBasis.fit(
            self.kernel, self.transitions.points, tolerance=1e-6, max_rank=400
        )
        self.successors = successor_features(self.transitions, features)
        self.changes = self.successors - features[self.transitions.state]
        actions = self.task.scaled_applied(self.transitions.actions)
        self.inputs = np.concatenate([self.transitions.states, actions], axis=1)
        factors = (*self.kernel.factors, SquaredExponential((self.inputs.shape[1] - 1,)))
        self.input_kernel = Kernel(factors, median_lengthscales(factors, self.inputs, RNG(1)))
        p = RNG(2).uniform(0.2, 1.0, N)
        self.samples = PolicyTargets.from_samples(self.transitions, p / p.sum(), self.task)


def bench_embedding(measure: Measure) -> None:
    p = Prepared()
    rank = p.changes.shape[1]
    measure(
        "embedding, fit and expected features",
        f"n = {N}, {rank} features",
        lambda: KernelEmbedding.fit(p.input_kernel, p.inputs, 1e-3).expected_features(p.changes),
        Share(flops.cholesky(N) + flops.solve(N, rank)),
    )


def bench_embedding_loss(measure: Measure) -> None:
    p = Prepared()
    rows = slice(0, FIT_SAMPLE_SIZE)
    rank = p.changes.shape[1]
    distances = factor_distances(p.input_kernel.factors, p.inputs[rows])
    loss = EmbeddingLoss(distances, p.changes[rows], np.ones(FIT_SAMPLE_SIZE))
    x = np.append(np.log(p.input_kernel.lengthscales), np.log(1e-3))
    measure(
        "loss of the embedding, with gradient",
        f"{FIT_SAMPLE_SIZE} samples, {rank} features",
        lambda: loss(x),
        Share(flops.embedding_loss(FIT_SAMPLE_SIZE, rank)),
    )


def bench_policy_loss(measure: Measure) -> None:
    p = Prepared()
    rows = slice(0, FIT_SAMPLE_SIZE)
    loss = PolicyLoss(
        factor_distances(p.kernel.factors, p.samples.states[rows]),
        p.samples.targets[rows],
        p.samples.weights[rows],
        p.samples.target_variance[rows],
    )
    x = np.append(np.log(p.kernel.lengthscales), np.log([1.0, 0.3]))
    measure(
        "loss of the policy, with gradient",
        f"{FIT_SAMPLE_SIZE} samples",
        lambda: loss(x),
        Share(flops.policy_loss(FIT_SAMPLE_SIZE)),
    )


def bench_embedding_fit(measure: Measure) -> None:
    p = Prepared()
    measure(
        "fit of the embedding, cold start",
        f"n = {N}, {FIT_SAMPLE_SIZE} of them in the fit",
        lambda: fit_embedding(p.transitions, p.changes, p.kernel, p.task, None, RNG(3)),
        Seconds(),
    )


def bench_policy_fit(measure: Measure) -> None:
    p = Prepared()
    measure(
        "hyper-parameters of the policy, cold start",
        f"n = {N}, {FIT_SAMPLE_SIZE} of them in the fit",
        lambda: policy_hyperparameters(p.samples, p.kernel, "map", None, RNG(3)),
        Seconds(),
    )
