"""Roll-outs of a policy in the transition model: states that no real one has been in yet.

The weights of the first step say where the new policy will be, but only among the states that old
policies were in.  On its own way, and just beside it, nothing would say what to do.  The dynamics
know where it leads, so a part of the second step's actions is imagined there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.algorithms.dynamics import TREND_SAMPLES, Dynamics
from kreps.arrays import FloatArray, IntArray
from kreps.data import TaskSpec, Transitions
from kreps.kernels import Kernel
from kreps.policies import StochasticPolicy


def can_be_simulated(data: Transitions, task: TaskSpec) -> bool:
    """Whether states that the dynamics predict are states.

    Those of images are none: errors of single pixels add up to what no rod or arm looks like.  And
    with fewer samples than a trend needs, what is predicted of many coordinates is no better.
    """
    coordinates = 1 + task.observation_size + task.action_size
    return task.image_shape is None and len(data) >= TREND_SAMPLES * coordinates


@dataclass(frozen=True)
class Simulator:
    """The restarting process, as learnt from n samples.

    Attributes:
        dynamics: of the samples.
        data: the samples.
        kernel: over states; it tells which sample a state is nearest to.
        task: limits and scale of the actions, and which coordinates are angles.
        restart_probability: p.
        exploring_starts: share of the roll-outs that begin in any sampled state, the others in
            start states.
        longest: steps that a roll-out has at most.
    """

    dynamics: Dynamics
    data: Transitions
    kernel: Kernel
    task: TaskSpec
    restart_probability: float
    exploring_starts: float
    longest: int

    def rollouts(
        self, policy: StochasticPolicy, count: int, rng: np.random.Generator
    ) -> tuple[FloatArray, IntArray]:
        """States (m, ds) that a policy is led to, and the sample (m,) that each is nearest to.

        Args:
            policy: to be followed, with its noise.
            count: m, unless roll-outs come to a real end.
            rng: of lengths, starts, noise and ends.
        """
        left = np.minimum(rng.geometric(self.restart_probability, size=count), self.longest)
        left = left[: 1 + np.searchsorted(np.cumsum(left), count)]
        left[-1] -= left.sum() - count
        visited, nearest = [], []
        sampled, (low, high) = self.data.states, self._range
        states = self._starts(len(left), rng)
        while len(states):
            rows = np.argmax(self.kernel.gram(states, sampled), axis=1)
            visited.append(states)
            nearest.append(rows)
            noise = rng.standard_normal((len(states), self.task.action_size))
            actions = self.task.scaled(self.task.clip(policy.act(states, noise)))
            inputs = np.concatenate([states, actions], axis=1)
            successors, ends = self.dynamics.draw(rows, inputs, rng)
            left = np.where(rng.uniform(size=len(ends)) < ends, 0, left - 1)
            states, left = np.clip(successors, low, high)[left > 0], left[left > 0]
        return np.concatenate(visited), np.concatenate(nearest)

    def _starts(self, count: int, rng: np.random.Generator) -> FloatArray:
        starts = self.data.points[rng.choice(self.data.start, count)]
        anywhere = self.data.states[rng.choice(len(self.data), count)]
        return np.where(rng.uniform(size=(count, 1)) < self.exploring_starts, anywhere, starts)

    @property
    def _range(self) -> tuple[FloatArray, FloatArray]:
        """Least and largest state (ds,) seen: beyond them nothing is known that could stop one.

        Angles have no limits.
        """
        low, high = self.data.points.min(axis=0), self.data.points.max(axis=0)
        angles = list(self.task.periodic)
        low[angles], high[angles] = -np.inf, np.inf
        return low, high
