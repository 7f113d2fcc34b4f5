"""The sums of Algorithm 1 over chunks of samples: what an executor's workers compute.

Every class is a function of one chunk that can be sent to another process; what comes back adds up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Protocol, TypeVar

import numpy as np

from kreps.algorithms.dual import Moments
from kreps.data.compute import Compute
from kreps.data.dataset import Chunk, Dataset
from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.errors import DataError
from kreps.kernels.arrays import Array, FloatArray, as_numpy, like, namespace, rows
from kreps.kernels.basis import Basis
from kreps.kernels.regression import FeatureRegression, RegressionSums
from kreps.models.dynamics import DeltaStateTargets, after_ends, state_changes
from kreps.models.transition import state_actions
from kreps.policies.sparse_gp import PolicySums

Result = TypeVar("Result")

ToDevice = Callable[[FloatArray], Array]
"""Puts an array where the work is done."""


@dataclass(frozen=True)
class ChunkRewards:
    """Rewards (n,) of a chunk and its number of rollouts, once its widths are those of the task."""

    task: TaskSpec

    def __call__(self, chunk: Chunk) -> tuple[FloatArray, int]:
        data = chunk.load().transitions
        found = data.points.shape[1], data.actions.shape[1]
        wanted = self.task.observation_size, self.task.action_size
        if found != wanted:
            raise DataError(
                f"{getattr(chunk, 'path', 'a chunk')} has {found[0]} observation and {found[1]} "
                f"action coordinates, the task {wanted[0]} and {wanted[1]}"
            )
        return data.rewards, len(data.start)


@dataclass(frozen=True)
class StartFeatures:
    """Sum of the features of a chunk's start states, (r,), and their number."""

    basis: Basis
    to_device: ToDevice

    def __call__(self, chunk: Chunk) -> FloatArray:
        """Both in one, (r + 1,)."""
        data = chunk.load().transitions
        phi = as_numpy(self.basis.features(self.to_device(data.points[data.start])))
        return np.append(phi.sum(axis=0), len(phi))


@dataclass(frozen=True)
class FeatureChanges:
    """Features of V before and after each step of a chunk.

    Attributes:
        basis: of V.
        start: (r,) mean features of the start states: the successor of a step that really ends.
        place: where the arrays are to be.
    """

    basis: Basis
    start: FloatArray
    to_device: ToDevice

    def own(self, data: Transitions) -> Array:
        """``phi(s_i)``, (n, r)."""
        return self.basis.features(self.to_device(data.states))

    def observed(self, data: Transitions) -> tuple[Array, Array]:
        """``phi(s_i)`` and ``phi(s'_i)``, (n, r) each, whether or not the task ended there."""
        points = self.basis.features(self.to_device(data.points))
        return rows(points, data.state), rows(points, data.successor)

    def both(self, data: Transitions) -> tuple[Array, Array]:
        """The same with the start in place of a successor that the task ended in."""
        own, after = self.observed(data)
        ended = like(data.terminated[:, None].astype(np.float64), after)
        return own, after_ends(after, ended, self.start)


@dataclass(frozen=True)
class EmbeddingSums:
    """What a chunk says of the embedding (Eq. 4).

    Attributes:
        changes: features of V.
        embedded: features psi of states and applied actions.
        task: limits and scale of the actions.
        relative_to_state: whether successors are counted from the features of the state itself.
    """

    changes: FeatureChanges
    embedded: Basis
    task: TaskSpec
    relative_to_state: bool

    def __call__(self, chunk: Chunk) -> RegressionSums:
        data = chunk.load().transitions
        own, after = self.changes.both(data)
        psi = self.embedded.features(self.changes.to_device(state_actions(data, self.task)))
        return RegressionSums.from_samples(psi, after - own if self.relative_to_state else after)


@dataclass(frozen=True)
class DeltaStateSums:
    """What a chunk says of the regression of the dynamics."""

    delta_targets: DeltaStateTargets
    embedded: Basis
    task: TaskSpec
    to_device: ToDevice

    def __call__(self, chunk: Chunk) -> RegressionSums:
        data = chunk.load().transitions
        psi = self.embedded.features(self.to_device(state_actions(data, self.task)))
        targets = self.to_device(self.delta_targets.targets(data, self.task))
        return RegressionSums.from_samples(psi, targets)


class Successors(Protocol):
    """Features of V before each step of a chunk, and what they are expected to become."""

    def __call__(self, data: Transitions) -> tuple[Array, Array]:
        """``phi(s_i)`` and ``E[phi(s') | s_i, a_i]``, (n, r) each."""
        ...


@dataclass(frozen=True)
class ObservedSuccessors:
    """Those of a sample-based model."""

    changes: FeatureChanges

    def __call__(self, data: Transitions) -> tuple[Array, Array]:
        return self.changes.both(data)


@dataclass(frozen=True)
class EmbeddedSuccessors:
    """Those of the embedding (Eq. 4).

    Attributes:
        changes: features of V.
        model: the fitted embedding.
        task: limits and scale of the actions.
        relative_to_state: whether the model's successors are counted from the state's own features.
    """

    changes: FeatureChanges
    model: FeatureRegression
    task: TaskSpec
    relative_to_state: bool

    def __call__(self, data: Transitions) -> tuple[Array, Array]:
        own = self.changes.own(data)
        expected = self.model.mean(self.changes.to_device(state_actions(data, self.task)))
        if self.relative_to_state:
            expected += own
        return own, expected


@dataclass(frozen=True)
class PredictedSuccessors:
    """Those of the dynamics: the observed one and its mirror image in the predicted one.

    Residuals are those of the fit to all samples, not of one without the sample: where there are
    more samples than fit in memory one of them hardly counts.
    """

    changes: FeatureChanges
    delta_targets: DeltaStateTargets
    model: FeatureRegression
    task: TaskSpec

    def __call__(self, data: Transitions) -> tuple[Array, Array]:
        to_device = self.changes.to_device
        own, observed = self.changes.observed(data)
        inputs = to_device(state_actions(data, self.task))
        targets = self.delta_targets.linear_mean(inputs) + self.model.mean(inputs)
        away = to_device(data.states - state_changes(data, self.task))
        mirrored = self.changes.basis.features(2.0 * self.delta_targets.changes(targets) + away)
        ends = namespace(targets).clip(targets[:, -1:], 0.0, 1.0)
        return own, after_ends(0.5 * (observed + mirrored), ends, self.changes.start)


@dataclass(frozen=True)
class BellmanRows:
    """Rows ``B = (1 - p) E[phi(s') | s_i, a_i] + p phi_restart - phi(s_i)`` of a chunk.

    Attributes:
        successors: what is expected.
        restart: (r,) mean features of the states that the process restarts in.
        restart_probability: p.
    """

    successors: Successors
    restart: FloatArray
    restart_probability: float

    def __call__(self, data: Transitions) -> Array:
        p = self.restart_probability
        own, expected = self.successors(data)
        expected *= 1.0 - p
        expected += p * like(self.restart, own)
        expected -= own
        return expected


@dataclass(frozen=True)
class ChunkMoments:
    """`Moments` of a chunk at one point of the dual."""

    rows: BellmanRows
    eta: float
    theta: FloatArray
    with_covariance: bool

    def __call__(self, chunk: Chunk, rewards: FloatArray) -> Moments:
        b = self.rows(chunk.load().transitions)
        delta = like(rewards, b) + b @ like(self.theta, b)
        return Moments.from_rows(delta, b, self.eta, with_covariance=self.with_covariance)


@dataclass(frozen=True)
class ChunkErrors:
    """Bellman errors (Eq. 5) of a chunk, (n,)."""

    rows: BellmanRows
    theta: FloatArray

    def __call__(self, chunk: Chunk, rewards: FloatArray) -> FloatArray:
        b = self.rows(chunk.load().transitions)
        return rewards + as_numpy(b @ like(self.theta, b))


@dataclass(frozen=True)
class StreamedProblem:
    """A `kreps.dual.Problem` whose rows of B are made anew, chunk by chunk, whenever asked for.

    Attributes:
        dataset: n samples.
        rows: makes the rows of B.
        rewards: (n,) in units of their standard deviation, largest one zero.
        kl_bound, ridge, eta_floor: as of `kreps.dual.DualProblem`.
        compute: who works on the chunks.
    """

    dataset: Dataset
    rows: BellmanRows
    rewards: FloatArray
    kl_bound: float
    ridge: float
    eta_floor: float
    compute: Compute

    @property
    def rank(self) -> int:
        return len(self.rows.restart)

    def part(self, chosen: slice) -> StreamedProblem:
        """That of some of the chunks."""
        rewards = self.dataset.split(self.rewards)[chosen]
        return replace(
            self, dataset=Dataset(self.dataset.chunks[chosen]), rewards=np.concatenate(rewards)
        )

    def bellman_errors(self, theta: FloatArray) -> FloatArray:
        return np.concatenate(list(self._map(ChunkErrors(self.rows, theta))))

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        return reduce(add, self._map(ChunkMoments(self.rows, eta, theta, with_covariance)))

    def _map(self, function: Callable[[Chunk, FloatArray], Result]) -> Iterator[Result]:
        return self.compute.map(function, self.dataset.chunks, self.dataset.split(self.rewards))


@dataclass(frozen=True)
class ChunkPolicySums:
    """What a chunk's weighted samples say of the policy."""

    basis: Basis
    task: TaskSpec
    to_device: ToDevice

    def __call__(self, chunk: Chunk, weights: FloatArray) -> PolicySums:
        data = chunk.load().transitions
        kept = np.flatnonzero(weights)
        z = self.basis.features(self.to_device(data.states[kept]))
        targets = self.task.scaled(data.actions[kept])
        return PolicySums.from_samples(z, like(weights[kept], z), like(targets, z))
