"""Functions of one chunk of samples, for the lines of Algorithm 1 that sum over all samples.

Each class is a callable that can be pickled and sent to a worker process (`kreps.Compute`).  Its
results for several chunks add up, or are concatenated.  The dual over chunks is in
`kreps.algorithms.streamed_dual`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from kreps.algorithms.reps import Expectation, ValueFeatures
from kreps.data.dataset import Chunk
from kreps.data.outliers import Outlier, find_outliers
from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.errors import DataError
from kreps.kernels.arrays import Array, BoolArray, FloatArray, as_numpy, like, rows
from kreps.kernels.basis import Basis
from kreps.kernels.regression import FeatureRegression, RegressionSums
from kreps.models.dynamics import DeltaStateTargets, state_changes, with_terminations
from kreps.models.terminations import Terminations
from kreps.models.transition import state_actions
from kreps.policies.sparse_gp import PolicySums

ToDevice = Callable[[FloatArray], Array]
"""Copies an array to the device on which the worker computes."""


class ChunkSummary(NamedTuple):
    """What is needed of a chunk before it is used: rewards and terminations (n,), and outliers."""

    rewards: FloatArray
    terminated: BoolArray
    rollouts: int
    outliers: list[Outlier]


@dataclass(frozen=True)
class ChunkRewards:
    """The `ChunkSummary` of a chunk.

    Raises:
        DataError: the widths of observations or actions are not those of the task.
    """

    task: TaskSpec

    def __call__(self, chunk: Chunk) -> ChunkSummary:
        rollouts = chunk.load()
        data = rollouts.transitions
        found = data.points.shape[1], data.actions.shape[1]
        wanted = self.task.state_size, self.task.action_size
        if found != wanted:
            raise DataError(
                f"{getattr(chunk, 'path', 'a chunk')} has {found[0]} observation and {found[1]} "
                f"action coordinates, but the task has {wanted[0]} and {wanted[1]}; "
                "give rollouts of this task"
            )
        return ChunkSummary(data.rewards, data.terminated, len(rollouts), find_outliers(rollouts))


@dataclass(frozen=True)
class StartFeatures:
    """Sum of the features of a chunk's start states and their number, side by side, (r + 1,)."""

    basis: Basis
    to_device: ToDevice

    def __call__(self, chunk: Chunk) -> FloatArray:
        data = chunk.load().transitions
        phi = as_numpy(self.basis.features(self.to_device(data.points[data.start])))
        return np.append(phi.sum(axis=0), len(phi))


@dataclass(frozen=True)
class StateFeatures:
    """Features of V at the states and successors of a chunk.

    Attributes:
        basis: of V.
        restart: (r,) mean features of the states in which the process restarts, which follow a
            termination.
        to_device: copies arrays to where features are computed.
    """

    basis: Basis
    restart: FloatArray
    to_device: ToDevice

    def own(self, data: Transitions) -> Array:
        """``phi(s_i)``, (n, r)."""
        return self.basis.features(self.to_device(data.states))

    def observed(self, data: Transitions) -> tuple[Array, Array]:
        """``phi(s_i)`` and ``phi(s'_i)``, (n, r) each, also where the task terminated."""
        points = self.basis.features(self.to_device(data.points))
        return rows(points, data.state), rows(points, data.successor)

    def after_restarts(self, data: Transitions) -> tuple[Array, Array]:
        """The same, with the restart features in place of a successor in which the task ended."""
        own, after = self.observed(data)
        terminated = like(data.terminated[:, None].astype(np.float64), after)
        return own, with_terminations(after, terminated, self.restart)


@dataclass(frozen=True)
class EmbeddingSums:
    """Regression sums of a chunk for the embedding (Eq. 4).

    Attributes:
        state_features: of V.
        embedded: features psi of states and applied actions.
        task: limits and scale of the actions.
        relative_to_state: whether the targets are features of the successor less those of the
            state.
    """

    state_features: StateFeatures
    embedded: Basis
    task: TaskSpec
    relative_to_state: bool

    def __call__(self, chunk: Chunk) -> RegressionSums:
        data = chunk.load().transitions
        own, after = self.state_features.after_restarts(data)
        inputs = self.state_features.to_device(state_actions(data, self.task))
        psi = self.embedded.features(inputs)
        return RegressionSums.from_samples(psi, after - own if self.relative_to_state else after)


@dataclass(frozen=True)
class DeltaStateSums:
    """Regression sums of a chunk for the dynamics.

    Attributes:
        delta_targets: scale and linear mean of the targets.
        embedded: features psi of states and applied actions.
        task: limits and scale of the actions, and which coordinates are angles.
        to_device: copies arrays to where features are computed.
    """

    delta_targets: DeltaStateTargets
    embedded: Basis
    task: TaskSpec
    to_device: ToDevice

    def __call__(self, chunk: Chunk) -> RegressionSums:
        data = chunk.load().transitions
        psi = self.embedded.features(self.to_device(state_actions(data, self.task)))
        targets = self.to_device(self.delta_targets.targets(data, self.task))
        return RegressionSums.from_samples(psi, targets)


@dataclass(frozen=True)
class ChunkPolicySums:
    """Weighted sums of a chunk for the policy.

    Attributes:
        basis: of the policy.
        task: centre and scale of the actions.
        to_device: copies arrays to where features are computed.
    """

    basis: Basis
    task: TaskSpec
    to_device: ToDevice

    def __call__(self, chunk: Chunk, weights: FloatArray) -> PolicySums:
        """Of the samples with a positive weight, from weights (n,)."""
        data = chunk.load().transitions
        kept = np.flatnonzero(weights)
        z = self.basis.features(self.to_device(data.states[kept]))
        targets = self.task.scaled(data.actions[kept])
        return PolicySums.from_samples(z, like(weights[kept], z), like(targets, z))


@dataclass(frozen=True)
class StreamedFeatures(ValueFeatures):
    """Features of V at the samples in memory, and the function that computes those of a chunk."""

    state_features: StateFeatures


class ExpectedSuccessors(Protocol):
    """A transition model: features of each state and expected features of its successor."""

    def __call__(self, data: Transitions) -> tuple[Array, Array]:
        """``phi(s_i)`` and ``E[phi(s') | s_i, a_i]``, (n, r) each."""
        ...


@dataclass(frozen=True)
class StreamedExpectation(Expectation):
    """Predictions for the samples in memory, and the model that computes those of a chunk."""

    successors: ExpectedSuccessors


@dataclass(frozen=True)
class ObservedSuccessors:
    """The sample-based model: the observed successor in place of the expectation."""

    state_features: StateFeatures

    def __call__(self, data: Transitions) -> tuple[Array, Array]:
        return self.state_features.after_restarts(data)


@dataclass(frozen=True)
class EmbeddedSuccessors:
    """The embedding (Eq. 4).

    Attributes:
        state_features: of V.
        model: the fitted embedding.
        task: limits and scale of the actions.
        relative_to_state: whether the model predicts features of the successor less those of the
            state.
    """

    state_features: StateFeatures
    model: FeatureRegression
    task: TaskSpec
    relative_to_state: bool

    def __call__(self, data: Transitions) -> tuple[Array, Array]:
        own = self.state_features.own(data)
        expected = self.model.mean(self.state_features.to_device(state_actions(data, self.task)))
        if self.relative_to_state:
            expected += own
        return own, expected


@dataclass(frozen=True)
class PredictedSuccessors:
    """The dynamics model: the mean over the observed successor and its mirror image.

    The mirror centre is the predicted successor (`kreps.models.dynamics`).  Residuals are those of
    the fit to all samples and not leave-one-out.  The difference vanishes with the number of
    samples, which is large where they are streamed.

    Attributes:
        state_features: of V.
        delta_targets: scale and linear mean of the targets.
        model: their fitted regression.
        task: limits and scale of the actions, and which coordinates are angles.
        terminations: the termination model; None if no episode terminated.
    """

    state_features: StateFeatures
    delta_targets: DeltaStateTargets
    model: FeatureRegression
    task: TaskSpec
    terminations: Terminations | None

    def __call__(self, data: Transitions) -> tuple[Array, Array]:
        to_device, restart = self.state_features.to_device, self.state_features.restart
        own, observed = self.state_features.observed(data)
        inputs = to_device(state_actions(data, self.task))
        predictions = self.delta_targets.linear_mean(inputs) + self.model.mean(inputs)
        # 2 (s + predicted change) - (s + observed change)
        rest = to_device(data.states - state_changes(data, self.task))
        mirrored = 2.0 * self.delta_targets.state_changes(inputs, predictions) + rest
        averaged = 0.5 * (observed + self.state_features.basis.features(mirrored))
        if self.terminations is not None:
            successors = to_device(data.points[data.successor])
            probabilities = self.terminations.probabilities(successors)[:, None]
            averaged = with_terminations(averaged, probabilities, restart)
        return own, averaged


@dataclass(frozen=True)
class ChunkTerminations:
    """Probabilities (n,) that the steps of a chunk terminate, as predicted from the successors.

    Attributes:
        model: the termination model.
        to_device: copies arrays to where features are computed.
    """

    model: Terminations
    to_device: ToDevice

    def __call__(self, chunk: Chunk) -> FloatArray:
        data = chunk.load().transitions
        return as_numpy(self.model.probabilities(self.to_device(data.points[data.successor])))


@dataclass(frozen=True)
class BellmanRows:
    """Rows ``B = (1 - p) E[phi(s') | s_i, a_i] + p phi_restart - phi(s_i)`` (n, r) of a chunk.

    Attributes:
        successors: the transition model.
        restart: (r,) mean features after a restart.
        restart_probability: p.
    """

    successors: ExpectedSuccessors
    restart: FloatArray
    restart_probability: float

    def __call__(self, data: Transitions) -> Array:
        p = self.restart_probability
        own, expected = self.successors(data)
        expected *= 1.0 - p
        expected += p * like(self.restart, own)
        expected -= own
        return expected
