"""Non-parametric approximate linear programming (Pazis and Parr 2011), for deterministic tasks.

The linear program: minimise ``sum_i V(s_i)`` over functions V with Lipschitz constant L and
``V(s_i) >= r_i + gamma V(s'_i)`` for each sample.  The pointwise minimum of all feasible functions
is feasible, so it is the solution.  It has the form ``V(s) = max_i (q_i - L |s - s_i|)`` with
``q_i = r_i + gamma V(s'_i)``.  This fixed point is computed exactly by policy iteration over which
sample attains the maximum at each successor; a test compares it with the linear program.
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
"""Largest number of policy improvements.  In tests there are fewer than fifty."""

RESIDUAL_TOLERANCE = 1e-9
"""Largest residual of the fixed point that counts as rounding, in standard deviations of the
reward."""


@dataclass(frozen=True)
class NPALPInfo:
    """Diagnostics of an update.

    Attributes:
        samples: n.
        improvements: number of policy improvements.
        residual: largest violation of the fixed point, in standard deviations of the reward.
        seconds: CPU seconds by stage.
    """

    samples: int
    improvements: int
    residual: float
    seconds: dict[str, float]

    @property
    def converged(self) -> bool:
        """Whether the fixed point is exact up to rounding."""
        return self.residual <= RESIDUAL_TOLERANCE

    def numbers(self) -> dict[str, float]:
        """The diagnostics of the method, by name."""
        return {"improvements": self.improvements, "residual": self.residual}

    def shown(self) -> dict[str, str]:
        """The columns of a progress display."""
        return {
            "improvements": f"{self.improvements}",
            "residual": f"{self.residual:.0e}",
            "note": "" if self.converged else "NOT CONVERGED",
        }


def update(
    state: LearnerState,
    rollouts: Sequence[Rollout],
    task: TaskSpec,
    settings: NPALPSettings,
    rng: np.random.Generator,
) -> tuple[LearnerState, NPALPInfo]:
    """A policy from all transitions of the replay window, new rollouts included.

    Args:
        state: of the learner before the update; it is not modified.
        rollouts: the new ones.
        task: limits and scale of the actions, and which coordinates are angles.
        settings: of the method.
        rng: draws the points of which median distances are computed.

    Raises:
        DataError: no rollout at all, or one of another width than the task's.
        ConfigurationError: more samples than an exact update can take.
    """
    from scipy.spatial.distance import cdist  # takes 0.1 s to import, which only NPALP needs

    window = state.append(rollouts)
    data = exact_transitions(window)
    clock = Stopwatch()
    kernel = state_kernel(data, task, rng)
    rewards, unit = standardise(data.rewards)
    lipschitz = settings.lipschitz
    if settings.lipschitz_unit == "raw":
        kernel = kernel.with_lengthscales(np.ones(len(kernel.factors)))
        lipschitz /= unit
    points = kernel.embed(data.points)
    distances = cdist(points, points[data.state])
    clock.lap("distances")
    gamma = 1.0 - settings.p
    # V after a termination: reward zero, standardised, in each step
    after_end = -float(data.rewards.max()) / unit / (1.0 - gamma)
    bounds, improvements, residual = sample_bounds(
        rewards + np.where(data.terminated, gamma * after_end, 0.0),
        np.where(data.terminated, 0.0, gamma),
        lipschitz * distances[data.successor],
    )
    clock.lap("fixed point")
    policy = LipschitzPolicy(
        task,
        kernel,
        data.states,
        task.clip(data.actions),
        unit * bounds + float(data.rewards.max()) / settings.p,
        unit * lipschitz,
        settings.noise_fraction,
        settings.noise_scale,
    )
    new_state = state.after(len(rollouts), sum(map(len, rollouts)), window, policy=policy)
    return new_state, NPALPInfo(len(data), improvements, residual, clock.seconds)


def sample_bounds(
    rewards: FloatArray,
    gamma: FloatArray,
    costs: FloatArray,
    max_improvements: int = MAX_IMPROVEMENTS,
) -> tuple[FloatArray, int, float]:
    """The smallest q with ``q_i = r_i + gamma_i max_j (q_j - costs_ij)``, by policy iteration.

    Args:
        rewards: (n,).
        gamma: (n,) discounts; zero where nothing follows.
        costs: (n, n) Lipschitz constant times the distance from successor i to sample j.
        max_improvements: largest number of policy improvements.

    Returns:
        q (n,), the number of improvements, and the largest residual of the equation.
    """
    n = len(rewards)
    rows = np.arange(n)
    maximiser = costs.argmin(axis=1)  # the sample j that attains the maximum for each i
    improvements = 0
    while True:
        improvements += 1
        chain = coo_array((gamma, (rows, maximiser)), shape=(n, n))
        q = spsolve((eye_array(n) - chain).tocsc(), rewards - gamma * costs[rows, maximiser])
        values = q - costs
        improved = values.argmax(axis=1)
        gains = values[rows, improved] - values[rows, maximiser]
        residual = float(np.max(gamma * gains))
        if residual <= RESIDUAL_TOLERANCE or improvements == max_improvements:
            return q, improvements, residual
        maximiser = improved
