"""Non-parametric approximate linear programming (Pazis and Parr 2011), for deterministic tasks.

The linear program: minimise ``sum_i V(s_i)`` over functions V of a given Lipschitz constant with
``V(s_i) >= r_i + gamma V(s'_i)`` for each sample.  Feasible functions have a least one, so it
is the solution, and it has the form ``V(s) = max_i (q_i - L |s - s_i|)`` with
``q_i = r_i + gamma V(s'_i)``.  That fixed point is found exactly by policy iteration over which
sample gives which successor its value; a test compares it with the linear program itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import spsolve

from kreps.algorithms.dual import standardise
from kreps.algorithms.state import LearnerState, Stopwatch, exact_transitions
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.models.transition import state_kernel
from kreps.policies.value_based import LipschitzPolicy
from kreps.settings import NPALPSettings

MAX_IMPROVEMENTS = 1000

RESIDUAL = 1e-9
"""Of the fixed point, in standard deviations of the reward: what rounding leaves."""


@dataclass(frozen=True)
class NPALPInfo:
    """What is only reported of an update.

    Attributes:
        samples: n.
        improvements: of policy iteration.
        residual: largest violation of the fixed point, in standard deviations of the reward.
        seconds: CPU seconds by stage.
    """

    samples: int
    improvements: int
    residual: float
    seconds: dict[str, float]

    def numbers(self) -> dict[str, float]:
        """The diagnostics of the method, by name."""
        return {"improvements": self.improvements, "residual": self.residual}

    def shown(self) -> dict[str, str]:
        """What a progress display shows, by column."""
        return {
            "improvements": f"{self.improvements}",
            "residual": f"{self.residual:.0e}",
            "note": "" if self.residual <= RESIDUAL else "NOT CONVERGED",
        }


def update(
    state: LearnerState,
    rollouts: Sequence[Rollout],
    task: TaskSpec,
    settings: NPALPSettings,
    rng: np.random.Generator,
) -> tuple[LearnerState, NPALPInfo]:
    """A policy from the window's transitions; nothing is modified.

    Raises:
        DataError: no roll-outs at all, or some of another width than the task's.
    """
    from scipy.spatial.distance import cdist  # 0.1 s that other methods need not wait

    window = state.append(rollouts)
    data = exact_transitions(window)
    clock = Stopwatch()
    kernel = state_kernel(data, task, rng)
    points = kernel.embed(data.points)
    distances = cdist(points, points[data.state])
    clock.lap("distances")
    rewards, unit = standardise(data.rewards)
    # a step that really ends the task leads to a start state, here to that of its own roll-out
    starts = data.start[data.rollout]
    successor = np.where(data.terminated, starts, data.successor)
    bounds, improvements, residual = sample_bounds(
        rewards,
        1.0 - settings.restart_probability,
        settings.lipschitz * distances[successor],
    )
    clock.lap("fixed point")
    policy = LipschitzPolicy(
        task,
        kernel,
        data.states,
        task.clip(data.actions),
        unit * bounds + float(data.rewards.max()) / settings.restart_probability,
        unit * settings.lipschitz,
        settings.noise_fraction,
        settings.noise_scale,
    )
    new_state = state.after(len(rollouts), sum(map(len, rollouts)), window, policy=policy)
    return new_state, NPALPInfo(len(data), improvements, residual, clock.seconds)


def sample_bounds(
    rewards: FloatArray, gamma: float, costs: FloatArray
) -> tuple[FloatArray, int, float]:
    """The least ``q`` with ``q_i = r_i + gamma max_j (q_j - costs_ij)``, by policy iteration.

    Args:
        rewards: (n,).
        gamma: discount.
        costs: (n, n) Lipschitz constant times the distance from successor i to sample j.

    Returns:
        q (n,), the improvements made, and the largest residual of the equation.
    """
    n = len(rewards)
    rows = np.arange(n)
    giver = costs.argmin(axis=1)  # which sample gives each successor its value
    improvements = 0
    while True:
        improvements += 1
        chain = coo_array((np.full(n, gamma), (rows, giver)), shape=(n, n))
        q = spsolve((eye_array(n) - chain).tocsc(), rewards - gamma * costs[rows, giver])
        worth = q - costs
        better = worth.argmax(axis=1)
        residual = float(np.max(gamma * (worth[rows, better] - worth[rows, giver])))
        if residual <= RESIDUAL or improvements == MAX_IMPROVEMENTS:
            return q, improvements, residual
        giver = better
