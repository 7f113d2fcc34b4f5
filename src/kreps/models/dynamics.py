"""The transition model of the default recipe: where a state moves to, and how far that may be off.

Eq. 4 learns what becomes of each feature of V by itself, hundreds of them, though all are functions
of one successor.  Here the change of the state is what is regressed: a linear trend first, then
what it leaves (with the machinery of Eq. 4: the same kernel over states and actions, the same
leave-one-out fit).  V's features are taken at the successor that both predict.

Features at a predicted successor are not yet expected features: noise is missing, and a V that
knows nothing of noise will be fitted to it.  What the regression of all other samples misses of a
sample is a draw of that noise, in that very state.  So successors are spread to both sides by it,

    ``E[phi(s')] = (phi(s^ + e_i) + phi(s^ - e_i)) / 2``,

which has the right mean and, on average over samples, the right variance: all that counts while V
is nearly quadratic over the reach of the noise.  For the action that was taken these two are the
observed successor and its mirror image in the predicted one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import Array, FloatArray, IntArray, columns, like
from kreps.kernels.basis import Basis
from kreps.kernels.kernel import Kernel
from kreps.kernels.regression import PREDICTION_BATCH, LeaveOneOut
from kreps.models.transition import fit_regression, state_actions


def state_changes(data: Transitions, task: TaskSpec) -> FloatArray:
    """``s'_i - s_i``, (n, ds); angles go the short way round."""
    changes = data.points[data.successor] - data.states
    angles = list(task.periodic)
    changes[:, angles] = (changes[:, angles] + np.pi) % (2.0 * np.pi) - np.pi
    return changes


ROUNDING = 1e-12
"""Changes below this share of a coordinate's size are none: its rounding is not to be learnt."""

SAMPLES_PER_COEFFICIENT = 10
"""Least number of samples for each coefficient of a trend; with fewer there is none."""

LINEAR_RIDGE = 1e-6
"""Of a trend's least squares, a sample, for states of unit variance: as good as none."""

ACTION_RIDGE = 1.0
"""The same in all, for actions in units of their scale: those that hardly differed in the data say
nothing of how a whole range of them would act, which is what will be asked."""


@dataclass(frozen=True)
class DeltaStateTargets:
    """What is regressed: changes of state as numbers of order one, less a trend; and real ends.

    A kernel regression fades to nothing far from the data and follows a slope only where samples
    are dense.  But most of what moves a mechanism is a slope: a position changes with the velocity,
    a velocity with the force.  So a straight line in all coordinates but angles goes first; it is
    of all samples, the one that is left out elsewhere among them.

    Attributes:
        unit: (ds,) root mean square change, one for all coordinates that share a lengthscale.
        slopes: (1 + ds + da, ds + 1) of the trend: its constant, then those of states and actions.
    """

    scale: FloatArray
    slopes: FloatArray

    @classmethod
    def of(cls, data: Transitions, task: TaskSpec) -> DeltaStateTargets:
        scale = np.ones(task.observation_size)
        changes = state_changes(data, task)
        squares = np.mean(changes**2, axis=0)
        for factor in task.state_factors:
            dims = list(factor.dims)
            size = np.sqrt(np.mean(squares[dims]))
            if size > ROUNDING * np.abs(data.points[:, dims]).max():
                scale[dims] = size
        slopes = linear_least_squares(state_actions(data, task), changes / scale, task)
        return cls(scale, np.column_stack([slopes, np.zeros(len(slopes))]))

    def targets(self, data: Transitions, task: TaskSpec) -> FloatArray:
        """What is regressed of n transitions, (n, ds + 1)."""
        whole = np.column_stack([state_changes(data, task) / self.scale, data.terminated])
        return whole - self.linear_mean(state_actions(data, task))

    def linear_mean(self, inputs: Array) -> Array:
        """What is not regressed, (n, ds + 1), of states and applied actions (n, ds + da)."""
        used = np.flatnonzero(self.slopes[1:].any(axis=1))  # of 800 pixels mostly none
        slopes = self.slopes[1:][used]
        return columns(inputs, used) @ like(slopes, inputs) + like(self.slopes[0], inputs)

    def changes(self, targets: Array) -> Array:
        """Changes of state (n, ds) of targets and trend together (n, ds + 1)."""
        return targets[:, :-1] * like(self.scale, targets)


def linear_least_squares(inputs: FloatArray, targets: FloatArray, task: TaskSpec) -> FloatArray:
    """Constant and slopes (1 + d, k) of targets (n, k) as linear functions of inputs (n, d).

    Zero for angles and for what never changes, and all of them where there are too few samples.
    """
    slopes = np.zeros((1 + inputs.shape[1], targets.shape[1]))
    scale = inputs.std(axis=0)
    used = scale > ROUNDING * np.abs(inputs).max(axis=0)
    used[list(task.periodic)] = False
    if len(inputs) < SAMPLES_PER_COEFFICIENT * (1 + np.count_nonzero(used)):
        return slopes
    ridge = np.full(inputs.shape[1], LINEAR_RIDGE * len(inputs))
    scale[task.observation_size :], ridge[task.observation_size :] = 1.0, ACTION_RIDGE
    centre = inputs[:, used].mean(axis=0)
    z = (inputs[:, used] - centre) / scale[used]
    product = z.T @ (targets - targets.mean(axis=0))
    slopes[1:][used] = np.linalg.solve(z.T @ z + np.diag(ridge[used]), product) / scale[used, None]
    slopes[0] = targets.mean(axis=0) - centre @ slopes[1:][used]
    return slopes


def after_ends(features: Array, ends: Array, start: FloatArray) -> Array:
    """Features (n, r) of successors, replaced by those of the start in a share of ends (n, 1)."""
    return features + ends * (like(start, features) - features)


@dataclass(frozen=True)
class Dynamics:
    """A regression of the change of state, and what it misses.

    Attributes:
        motion: units of what is regressed.
        predict: its targets (m, ds + 1) of states and scaled, applied actions (m, ds + da), but for
            the trend.
        missed: (n, ds + 1) targets of n samples less what all others predict of them.
    """

    delta_targets: DeltaStateTargets
    regression: Callable[[FloatArray], FloatArray]
    loo_residuals: FloatArray

    @cached_property
    def residuals(self) -> FloatArray:
        """Changes of state (n, ds) less what all other samples predict of them."""
        return self.delta_targets.changes(self.loo_residuals)

    def predict(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Successors (m, ds) and shares of real ends (m, 1) of inputs (m, ds + da), on average."""
        targets = self.delta_targets.linear_mean(inputs) + self.regression(inputs)
        states = inputs[:, : self.residuals.shape[1]]
        return states + self.delta_targets.changes(targets), np.clip(targets[:, -1:], 0.0, 1.0)

    def sample(
        self, rows: IntArray, inputs: FloatArray, residual_signs: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """One successor (m, ds) each, with the noise of samples (m,); and shares of ends (m,).

        To which sides (m, 1), plus or minus one, is for the caller to draw.
        """
        successors, ends = self.predict(inputs)
        return successors + residual_signs * self.residuals[rows], ends[:, 0]

    def expected_features(
        self, basis: Basis, start: FloatArray, rows: IntArray, inputs: FloatArray
    ) -> FloatArray:
        """``E[phi(s')]``, (m, r).

        Args:
            basis: of V.
            start: (r,) mean features of the start states: what follows a real end.
            rows: (m,) the samples whose states the actions are taken in, or that are nearest.
            inputs: (m, ds + da) states and scaled, applied actions.
        """
        expected = np.empty((len(rows), len(start)))
        for first in range(0, len(rows), PREDICTION_BATCH):
            block = slice(first, first + PREDICTION_BATCH)
            successors, ends = self.predict(inputs[block])
            residuals = self.residuals[rows[block]]
            spread = 0.5 * basis.features(successors + residuals)
            spread += 0.5 * basis.features(successors - residuals)
            expected[block] = after_ends(spread, ends, start)
        return expected


def expected_features_of_samples(
    data: Transitions,
    basis: Basis,
    own: FloatArray,
    observed: FloatArray,
    start: FloatArray,
    dynamics: Dynamics,
    task: TaskSpec,
) -> tuple[FloatArray, LeaveOneOut]:
    """``E[phi(s') | s_i, a_i]`` (n, r) of the actions that were taken, and the model's errors.

    Args:
        data: n transitions.
        basis: of V.
        own, observed: (n, r) features of each state and of its successor, whether or not the task
            ended there.
        start: (r,) mean features of the start states: what follows a real end.
        dynamics: of these transitions.
        task: which coordinates are angles.
    """
    terminated = data.terminated[:, None].astype(np.float64)
    ends = np.clip(terminated - dynamics.loo_residuals[:, -1:], 0.0, 1.0)
    predict = data.states + state_changes(data, task) - dynamics.residuals
    spread = 0.5 * (observed + basis.features(predict - dynamics.residuals))
    after = after_ends(observed, terminated, start)
    foreseen = after_ends(basis.features(predict), ends, start)
    return after_ends(spread, ends, start), LeaveOneOut(after - own, after - foreseen)


def fit_dynamics(
    data: Transitions,
    state_kernel: Kernel,
    task: TaskSpec,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> tuple[Dynamics, FloatArray, float]:
    """The regression of n transitions, its log parameters, and the jitter of its factorisation.

    Arguments are those of `kreps.algorithms.transition_model.fit_regression`, but for the targets.
    """
    delta_targets = DeltaStateTargets.of(data, task)
    targets = delta_targets.targets(data, task)
    model, x = fit_regression(data, targets, state_kernel, task, start, rng)
    loo_residuals = model.leave_one_out(targets).errors
    return Dynamics(delta_targets, model.predictor(targets), loo_residuals), x, model.factor.jitter
