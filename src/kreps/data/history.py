"""States that have earlier changes and actions beside the newest observation.

Where an action takes effect later, or a part of the state is not observed, the newest observation
alone does not determine what follows.  With the observations and the applied actions of the last
steps it does (a delay embedding; Takens 1981).  The state of step t is

    ``(o_t, o_t - o_{t-1}, ..., o_{t-h+1} - o_{t-h}, a_{t-1}, ..., a_{t-k})``

with h = ``TaskSpec.history`` and k = ``TaskSpec.action_lags``.  Earlier observations are given by
their changes, those of angles wrapped to [-pi, pi): observations of neighbouring steps are nearly
equal, and what they say beyond the newest one, such as a velocity, is in their difference.  A
kernel with a lengthscale for the difference resolves it; one with the same lengthscale for both
observations does not.

Actions are as applied and in units of their scale.  Before the first step of a rollout the
observation was the first one, and the action the middle of its range, which is zero in these units.
With h = k = 0 a state is an observation.

Who acts keeps the *lags*: the last h observations and then the last k actions, the newest first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kreps.data.rollouts import Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import Array, FloatArray, namespace


def first_lags(observations: FloatArray, task: TaskSpec) -> FloatArray:
    """The lags (m, h do + k da) at the start of rollouts.

    Args:
        observations: (m, do) the first ones.
        task: h and k.
    """
    actions = np.zeros((len(observations), task.action_size * task.action_lags))
    return np.concatenate([*[observations] * task.history, actions], axis=1)


def next_lags(
    observations: FloatArray, lags: FloatArray, actions: FloatArray, task: TaskSpec
) -> FloatArray:
    """The lags (m, h do + k da) of the next step.

    Args:
        observations: (m, do) newest ones.
        lags: (m, h do + k da) with them.
        actions: (m, da) taken then, as applied and in units of their scale.
        task: h and k.
    """
    if not lags.shape[1]:
        return lags
    observed = task.observation_size * task.history
    earlier = np.concatenate([observations, lags[:, :observed]], axis=1)[:, :observed]
    taken = np.concatenate([actions, lags[:, observed:]], axis=1)
    return np.concatenate([earlier, taken[:, : lags.shape[1] - observed]], axis=1)


def states_of(observations: FloatArray, lags: FloatArray, task: TaskSpec) -> FloatArray:
    """States (m, ds) of observations (m, do) and lags (m, h do + k da)."""
    if not lags.shape[1]:
        return observations
    observed = task.observation_size * task.history
    earlier = np.concatenate([observations, lags[:, :observed]], axis=1)
    changes = earlier[:, :observed] - earlier[:, task.observation_size :]
    if task.history and task.periodic:
        angles = [
            first + i for first in range(0, observed, task.observation_size) for i in task.periodic
        ]
        changes[:, angles] = (changes[:, angles] + np.pi) % (2.0 * np.pi) - np.pi
    return np.concatenate([observations, changes, lags[:, observed:]], axis=1)


def state_changes_of(inputs: Array, changes: Array, task: TaskSpec) -> Array:
    """Changes of states (m, ds), from those of the observation (m, do).

    Args:
        inputs: (m, ds + da) states and scaled, applied actions.
        changes: of the observation.
        task: h and k.
    """
    if task.state_size == task.observation_size:
        return changes
    size, observed, count = task.observation_size, task.observed_size, task.state_size
    earlier, actions = inputs[:, size:observed], inputs[:, observed:count]
    parts = [changes]
    if task.history:
        parts += [changes, earlier[:, : observed - 2 * size]]
    if task.action_lags:
        parts += [inputs[:, count:], actions[:, : actions.shape[1] - task.action_size]]
    concat = namespace(inputs).concat
    return concat([changes, concat(parts[1:], axis=1) - inputs[:, size:count]], axis=1)


def stacked(rollouts: Rollouts, task: TaskSpec) -> Rollouts:
    """The same rollouts with their states (n + R, ds) as points, from observations (n + R, do)."""
    if task.state_size == task.observation_size or not len(rollouts):
        return rollouts
    lengths = rollouts.lengths + 1
    start = np.repeat(np.cumsum(lengths) - lengths, lengths)  # row of the first point of each
    row = np.arange(len(start))
    applied = np.zeros((len(row), task.action_size))
    applied[rollouts.transitions.state] = task.scaled_applied(rollouts.actions)
    lags = [rollouts.points[np.maximum(row - lag, start)] for lag in range(1, task.history + 1)]
    for lag in range(1, task.action_lags + 1):
        known = (row - lag >= start)[:, None]
        lags.append(np.where(known, applied[row - lag], 0.0))
    points = states_of(rollouts.points, np.concatenate(lags, axis=1), task)
    return replace(rollouts, points=points)
