"""The dynamics model: a regression of the change of state, and expected features from it.

Eq. 4 regresses hundreds of features of V separately, although all are functions of one successor.
Here the change of state is regressed instead: its linear mean by ridge regression, then the
remainder with the kernel, the leave-one-out fit and the regulariser of Eq. 4, each coordinate for
itself where that predicts it better (`kreps.models.coordinates`).  The features of V are computed
at the predicted successor.

Features at the mean successor are not yet expected features, as the noise is missing.  The
leave-one-out residual ``e_i`` of a sample is a draw of the noise at its state, so

    ``E[phi(s')] = (phi(s^ + e_i) + phi(s^ - e_i)) / 2``

at the predicted successor ``s^``.  Both have the mean ``s^``, and on average over samples the
variance of the noise; this is exact where V is quadratic within the range of the noise.  For the
action that was taken, the two are the observed successor and its mirror image at ``s^``.

Of a state with earlier changes and actions (`kreps.data.history`) only the newest observation is
regressed.  The others follow from it, from the state and from the action.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kreps.data.history import state_changes_of
from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import Array, FloatArray, IntArray, columns, like
from kreps.kernels.basis import PREDICTION_BATCH, Basis
from kreps.kernels.kernel import Kernel, as_wide_as_spread
from kreps.kernels.regression import LeaveOneOut
from kreps.models.coordinates import Regression, fit_coordinates
from kreps.models.terminations import Terminations, fit_terminations
from kreps.models.transition import state_actions

CONSTANT_RTOL = 1e-12
"""A coordinate whose standard deviation, or root mean square change, is below this share of its
largest absolute value is constant: its changes are rounding errors."""

SAMPLES_PER_COEFFICIENT = 10
"""Smallest number of samples per coefficient of the linear mean; with fewer it is zero.  The slopes
of few samples are uncertain, and predictions far from the data extrapolate them."""

STATE_RIDGE = 1e-6
"""Ridge of the linear mean per sample, for states of unit variance.  It only makes the normal
equations well-conditioned."""

ACTION_RIDGE = 1.0
"""Ridge of the linear mean for actions in units of their scale, for all samples together.  Slopes
of actions that hardly varied in the data are shrunk to zero, as predictions for the whole range of
actions would extrapolate them."""


def state_changes(data: Transitions, task: TaskSpec) -> FloatArray:
    """``s'_i - s_i``, (n, ds); those of angles are wrapped to [-pi, pi)."""
    changes = data.points[data.successor] - data.states
    angles = list(task.periodic)
    changes[:, angles] = (changes[:, angles] + np.pi) % (2.0 * np.pi) - np.pi
    return changes


@dataclass(frozen=True)
class LinearMean:
    """A linear function of few columns of its inputs: images have thousands that it does not use.

    Attributes:
        used: (u,) the columns with a slope.
        slopes: (u, k).
        constants: (k,).
    """

    used: IntArray
    slopes: FloatArray
    constants: FloatArray

    def __call__(self, inputs: Array) -> Array:
        """Its values (n, k) at inputs (n, d)."""
        return columns(inputs, self.used) @ like(self.slopes, inputs) + like(self.constants, inputs)

    def jacobian(self, width: int) -> FloatArray:
        """Derivatives (k, width) of its values by that many inputs."""
        slopes = np.zeros((len(self.constants), width))
        slopes[:, self.used] = self.slopes.T
        return slopes


@dataclass(frozen=True)
class DeltaStateTargets:
    """Targets of the regression: scaled changes of state less their linear mean.

    Far from the data a kernel regression predicts zero, and it follows a slope only where samples
    are dense.  In mechanical systems most of the change is linear: a position changes with the
    velocity, a velocity with the force.  So a linear function of all coordinates but angles is
    subtracted first.  It is fitted to all samples once; leave-one-out errors are of the kernel
    regression alone.

    Attributes:
        scale: (do,) root mean square changes of the observation; coordinates that share a
            lengthscale share one.
        linear_mean: (n, do) of states and scaled, applied actions (n, ds + da).
        task: sizes of states and actions.
    """

    scale: FloatArray
    linear_mean: LinearMean
    task: TaskSpec

    @classmethod
    def fit(cls, data: Transitions, task: TaskSpec) -> DeltaStateTargets:
        """Scale and linear mean of n transitions."""
        scale = np.ones(task.observation_size)
        changes = state_changes(data, task)[:, : task.observation_size]
        squares = np.mean(changes**2, axis=0)
        for factor in task.observation_factors:
            dims = list(factor.dims)
            root_mean_square = np.sqrt(np.mean(squares[dims]))
            if root_mean_square > CONSTANT_RTOL * np.abs(data.points[:, dims]).max():
                scale[dims] = root_mean_square
        mean = linear_least_squares(state_actions(data, task), changes / scale, task)
        return cls(scale, mean, task)

    def targets(self, data: Transitions, task: TaskSpec) -> FloatArray:
        """The targets (n, do) of n transitions."""
        changes = state_changes(data, task)[:, : task.observation_size]
        return changes / self.scale - self.linear_mean(state_actions(data, task))

    def changes(self, predictions: Array) -> Array:
        """Changes of the observation (n, do), from targets plus linear mean (n, do)."""
        return predictions * like(self.scale, predictions)

    def state_changes(self, inputs: Array, predictions: Array) -> Array:
        """Changes of the whole state (n, ds).

        Args:
            inputs: (n, ds + da) states and scaled, applied actions.
            predictions: (n, do) targets plus linear mean.
        """
        return state_changes_of(inputs, self.changes(predictions), self.task)

    def jacobian(self, slopes: FloatArray) -> FloatArray:
        """Derivatives (m, ds, ds + da) of the changes of state by states and actions.

        Args:
            slopes: (m, do, ds + da) derivatives of targets plus linear mean.
        """
        of_observation = self.scale[:, None] * slopes
        if self.task.state_size == self.task.observation_size:
            return of_observation
        # `state_changes_of` is linear, so that its columns are its values at unit vectors
        size, width = self.task.observation_size, slopes.shape[2]
        by_inputs = state_changes_of(np.eye(width), np.zeros((width, size)), self.task)
        by_changes = state_changes_of(np.zeros((size, width)), np.eye(size), self.task)
        return by_inputs.T + by_changes.T @ of_observation

    def residuals(self, errors: FloatArray) -> FloatArray:
        """Errors of successors (n, ds), from those of targets (n, do).

        Those of the observation are also those of its latest change; actions have none.
        """
        newest, task = self.changes(errors), self.task
        repeated = [newest] * min(1 + task.history, 2)
        known = np.zeros((len(errors), task.state_size - task.observation_size * len(repeated)))
        return np.concatenate([*repeated, known], axis=1)


def linear_least_squares(inputs: FloatArray, targets: FloatArray, task: TaskSpec) -> LinearMean:
    """Ridge regression of targets (n, k) on inputs (n, d).

    Angles and constant inputs have no slope.  There are neither slopes nor constants with fewer
    than `SAMPLES_PER_COEFFICIENT` samples for the constant and each of the slopes.

    Args:
        inputs: states and scaled, applied actions.
        targets: of the regression.
        task: which inputs are states, and which of these are angles.
    """
    width = targets.shape[1]
    scale = inputs.std(axis=0)
    used = scale > CONSTANT_RTOL * np.abs(inputs).max(axis=0)
    used[list(task.periodic)] = False
    if len(inputs) < SAMPLES_PER_COEFFICIENT * (1 + np.count_nonzero(used)):
        return LinearMean(np.empty(0, np.intp), np.empty((0, width)), np.zeros(width))
    ridge = np.full(inputs.shape[1], STATE_RIDGE * len(inputs))
    scale[task.observed_size :], ridge[task.observed_size :] = 1.0, ACTION_RIDGE
    centre = inputs[:, used].mean(axis=0)
    z = (inputs[:, used] - centre) / scale[used]
    product = z.T @ (targets - targets.mean(axis=0))
    slopes = np.linalg.solve(z.T @ z + np.diag(ridge[used]), product) / scale[used, None]
    constants = targets.mean(axis=0) - centre @ slopes
    sloped = slopes.any(axis=1)
    return LinearMean(np.flatnonzero(used)[sloped], slopes[sloped], constants)


def with_terminations(features: Array, probabilities: Array, restart: FloatArray) -> Array:
    """Expected features of successors, if a restart follows a termination.

    The steps without reward in between are accounted for in the reward (`kreps.algorithms.ends`).

    Args:
        features: (n, r) of the successors without a termination.
        probabilities: (n, 1) of a termination.
        restart: (r,) mean features of the states in which the process restarts.
    """
    return features + probabilities * (like(restart, features) - features)


@dataclass(frozen=True)
class Dynamics:
    """The dynamics model of n samples.

    Attributes:
        delta_targets: scale and linear mean of the targets.
        regression: of targets (m, do) on states and scaled, applied actions (m, ds + da).
        loo_residuals: (n, do) leave-one-out errors of the targets.
        terminations: the termination model; None if no episode terminated.
    """

    delta_targets: DeltaStateTargets
    regression: Regression
    loo_residuals: FloatArray
    terminations: Terminations | None = None

    @cached_property
    def residuals(self) -> FloatArray:
        """Leave-one-out errors (n, ds) of the changes of state, in units of the state."""
        return self.delta_targets.residuals(self.loo_residuals)

    def predict(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean successors (m, ds) and probabilities of a termination there (m,).

        Args:
            inputs: (m, ds + da) states and scaled, applied actions.
        """
        successors = self._mean_successors(inputs)
        return successors, self.termination_probabilities(successors)

    def jacobian(self, inputs: FloatArray) -> FloatArray:
        """Derivatives (m, ds, ds + da) of mean successors by inputs (m, ds + da)."""
        slopes = self.regression.jacobian(inputs)
        slopes += self.delta_targets.linear_mean.jacobian(inputs.shape[1])
        by_inputs = self.delta_targets.jacobian(slopes)
        states = np.arange(by_inputs.shape[1])
        by_inputs[:, states, states] += 1.0
        return by_inputs

    def termination_probabilities(self, successors: FloatArray) -> FloatArray:
        """Probabilities (m,) that an episode ends in successors (m, ds)."""
        if self.terminations is None:
            return np.zeros(len(successors))
        return self.terminations.probabilities(successors)

    def sample(
        self, rows: IntArray, inputs: FloatArray, residual_signs: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Successors (m, ds) with noise, and probabilities of termination (m,).

        The noise is a residual of a sample with a random sign (wild bootstrap).

        Args:
            rows: (m,) samples whose residuals are taken.
            inputs: (m, ds + da) states and scaled, applied actions.
            residual_signs: (m, 1) one or minus one, drawn by the caller.
        """
        successors = self._mean_successors(inputs) + residual_signs * self.residuals[rows]
        return successors, self.termination_probabilities(successors)

    def _mean_successors(self, inputs: FloatArray) -> FloatArray:
        predictions = self.delta_targets.linear_mean(inputs) + self.regression(inputs)
        states = inputs[:, : self.delta_targets.task.state_size]
        return states + self.delta_targets.state_changes(inputs, predictions)

    def expected_features(
        self, basis: Basis, restart: FloatArray, rows: IntArray, inputs: FloatArray
    ) -> FloatArray:
        """``E[phi(s')]``, (m, r).

        Args:
            basis: of V.
            restart: (r,) mean features of the states in which the process restarts, which follow a
                termination.
            rows: (m,) samples whose states the actions are taken in or nearest to; the noise is
                that of these samples.
            inputs: (m, ds + da) states and scaled, applied actions.
        """
        expected = np.empty((len(rows), len(restart)))
        for first in range(0, len(rows), PREDICTION_BATCH):
            batch = slice(first, first + PREDICTION_BATCH)
            successors, terminations = self.predict(inputs[batch])
            residuals = self.residuals[rows[batch]]
            averaged = basis.mean_features(successors + residuals, successors - residuals)
            if self.terminations is not None:
                averaged = with_terminations(averaged, terminations[:, None], restart)
            expected[batch] = averaged
        return expected


def expected_features_of_samples(
    data: Transitions,
    basis: Basis,
    own: FloatArray,
    observed: FloatArray,
    restart: FloatArray,
    dynamics: Dynamics,
    task: TaskSpec,
) -> tuple[FloatArray, LeaveOneOut]:
    """``E[phi(s') | s_i, a_i]`` (n, r) of the actions that were taken, and the model's errors.

    Args:
        data: n transitions.
        basis: of V.
        own: (n, r) features of each state.
        observed: (n, r) features of each successor, also where the task terminated.
        restart: (r,) mean features of the states in which the process restarts, which follow a
            termination.
        dynamics: of these transitions.
        task: which coordinates are angles.

    Returns:
        The expected features, and the errors of the features at the mean successor that the other
        samples predict, relative to the features of the state.
    """
    terminated = data.terminated[:, None].astype(np.float64)
    probabilities = termination_probabilities_of_samples(data, dynamics)[:, None]
    predicted = data.states + state_changes(data, task) - dynamics.residuals
    averaged = 0.5 * (observed + basis.features(predicted - dynamics.residuals))
    targets = with_terminations(observed, terminated, restart)
    predictions = with_terminations(basis.features(predicted), probabilities, restart)
    errors = LeaveOneOut(targets - own, targets - predictions)
    return with_terminations(averaged, probabilities, restart), errors


def termination_probabilities_of_samples(data: Transitions, dynamics: Dynamics) -> FloatArray:
    """Probabilities (n,) that the steps terminate, as predicted from all other samples."""
    if dynamics.terminations is None:
        return np.zeros(len(data))
    return np.clip(data.terminated - dynamics.terminations.loo_residuals, 0.0, 1.0)


def fit_dynamics(
    data: Transitions,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> tuple[Dynamics, FloatArray, float]:
    """The dynamics of n transitions, at a cost of n^3 or less (`fit_coordinates`).

    Args:
        data: n transitions.
        state_kernel: over states, at median lengthscales.
        task: limits and scale of the actions, and which coordinates are angles.
        start: log hyper-parameters (g + da + 1,) of the last fit, if there was one.
        rng: draws the samples of the fit.

    Returns:
        The dynamics, the log hyper-parameters of the fit, and the largest jitter.
    """
    state_kernel = as_wide_as_spread(state_kernel, data.states)
    delta_targets = DeltaStateTargets.fit(data, task)
    targets = delta_targets.targets(data, task)
    regression, loo_residuals, x, jitter = fit_coordinates(
        data, targets, state_kernel, task, start, rng
    )
    terminations = fit_terminations(data, state_kernel, rng)
    dynamics = Dynamics(delta_targets, regression, loo_residuals, terminations)
    return dynamics, x, max(jitter, 0.0 if terminations is None else terminations.jitter)
