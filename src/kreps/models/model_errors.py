"""Leave-one-out errors of each part of the learnt model: dynamics, terminations and reward.

Each is a root mean square error relative to what has to be predicted, so that one is no better than
a constant.  They are only reported.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.regression import LeaveOneOut
from kreps.models.dynamics import CONSTANT_RTOL, Dynamics, state_changes
from kreps.models.reward_model import RewardModel

NONE = float("nan")


@dataclass(frozen=True)
class ModelErrors:
    """Relative leave-one-out errors; nan where there is no such model, or nothing to predict.

    Attributes:
        dynamics: of the changes of state, the root mean square over the coordinates that change, of
            which each counts in units of its root mean square change.
        worst: the same of the coordinate that is predicted worst.
        worst_coordinate: its number (the first of a group that shares a lengthscale), or None.
        terminations: relative to the standard deviation of their indicator.
        reward: relative to the standard deviation of the rewards, of the steps that are regressed
            (`kreps.models.reward_model.regressed_steps`).
    """

    dynamics: float = NONE
    worst: float = NONE
    worst_coordinate: int | None = None
    terminations: float = NONE
    reward: float = NONE


def model_errors(
    data: Transitions, task: TaskSpec, dynamics: Dynamics | None, reward: RewardModel | None
) -> ModelErrors:
    """The errors of models that were fitted to n transitions.

    Args:
        data: n transitions.
        task: which coordinates share a lengthscale.
        dynamics, reward: None where there is no such model.
    """
    known = NONE if reward is None or reward.loo is None else reward.loo.relative_to_spread
    if dynamics is None:
        return ModelErrors(reward=known)
    coordinates, errors = dynamics_errors(data, task, dynamics.residuals)
    terminations = NONE
    if dynamics.terminations is not None:
        residuals = dynamics.terminations.loo_residuals[:, None]
        terminated = data.terminated[:, None].astype(np.float64)
        terminations = LeaveOneOut(terminated, residuals).relative_to_spread
    if not len(errors):
        return ModelErrors(terminations=terminations, reward=known)
    worst = int(errors.argmax())
    return ModelErrors(
        dynamics=float(np.sqrt(np.mean(errors**2))),
        worst=float(errors[worst]),
        worst_coordinate=coordinates[worst],
        terminations=terminations,
        reward=known,
    )


def dynamics_errors(
    data: Transitions, task: TaskSpec, residuals: FloatArray
) -> tuple[list[int], FloatArray]:
    """Coordinates that change, and the relative error (k,) of each.

    Coordinates that share a lengthscale, as those of an image, count as one.

    Args:
        data: n transitions.
        task: which coordinates share a lengthscale.
        residuals: (n, ds) leave-one-out errors of the changes of state, in units of the state.
    """
    changes, size = state_changes(data, task), np.abs(data.points).max(axis=0)
    coordinates, errors = [], []
    for factor in task.observation_factors:
        dims = list(factor.dims)
        change = np.sqrt(np.mean(changes[:, dims] ** 2))
        if change > CONSTANT_RTOL * size[dims].max():
            coordinates.append(dims[0])
            errors.append(np.sqrt(np.mean(residuals[:, dims] ** 2)) / change)
    return coordinates, np.array(errors)
