"""First roll-outs that go somewhere: rarity of the states reached in place of the reward.

White noise averages out, and what no roll-out came near can neither be valued nor imagined.  The
same bounded update can be asked for what is missing: rewarded by how far the states it reaches lie
from all others, REPS is a learner of policies that spread over the state space (Hazan et al. 2019),
and the distance to the k-th neighbour is the estimate of their entropy that needs no bandwidth
(Kozachenko and Leonenko 1987).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from kreps.algorithms.transition_model import state_kernel
from kreps.arrays import FloatArray
from kreps.data import Rollout, TaskSpec, Window

NEIGHBOURS = 10
"""k: the distance to the nearest one alone is the noise of a single sample."""

CLOSEST = 1e-3
"""Added to distances, in lengthscales: states that agree are not infinitely common."""


def rarity(points: FloatArray) -> FloatArray:
    """``log(d_k + CLOSEST)``, (m,), of points (m, d) and their distances to the k-th neighbour."""
    k = min(NEIGHBOURS, len(points) - 1)
    distances, _ = KDTree(points).query(points, k=[k + 1])  # the first neighbour is the point
    return np.log(np.asarray(distances)[:, 0] + CLOSEST)


def rewarded_by_rarity(window: Window, task: TaskSpec, rng: np.random.Generator) -> list[Rollout]:
    """The roll-outs with the rarity of each successor, among all states of all, as its reward.

    Distances are in the lengthscales of V's kernel: medians over the same states, angles as angles.
    Beyond some twenty coordinates finding neighbours costs the square of the number of states
    (1500 images of 800 pixels: half a second).

    Args:
        window: at least one roll-out.
        task: which coordinates are angles.
        rng: of the median.
    """
    data = window.transitions
    rewards = rarity(state_kernel(data, task, rng).embed(data.points))[data.successor]
    ends = np.cumsum([len(rollout) for rollout in window.rollouts])
    return [
        replace(rollout, rewards=part)
        for rollout, part in zip(window.rollouts, np.split(rewards, ends[:-1]), strict=True)
    ]
