"""Roll-outs of a policy in the transition model: states that no real one has been in yet.

The weights of the first step say where the new policy will be, but only among the states that old
policies were in.  On its own way, and just beside it, nothing would say what to do.  The dynamics
know where it leads, so a third step imagines actions there.  And what its policy earns can be
foretold before it acts: see `kreps.algorithms.judgement`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil

import numpy as np

from kreps.data.rollout import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray
from kreps.kernels.gram import PANEL
from kreps.kernels.kernel import Kernel
from kreps.models.dynamics import TREND_SAMPLES, Dynamics
from kreps.policies.base import StochasticPolicy

AVERAGED = 2.0
"""Steps that a policy is followed for, in mean lengths of a roll-out: one in seven has not been
restarted by then."""


def can_be_simulated(data: Transitions, task: TaskSpec) -> bool:
    """Whether states that the dynamics predict are states.

    Those of images are none: errors of single pixels add up to what no rod or arm looks like.  And
    with fewer samples than a trend needs, what is predicted of many coordinates is no better.
    """
    coordinates = 1 + task.observation_size + task.action_size
    return task.image_shape is None and len(data) >= TREND_SAMPLES * coordinates


@dataclass(frozen=True)
class Followed:
    """Simulated roll-outs of one policy.

    Attributes:
        rewards: (steps, count) expected, standardised.
        likeness: (steps, count) of each state to the nearest sample: the kernel's value, up to 1.
        ended: (steps, count) whether the task really ended, and the next state is a start.
    """

    rewards: FloatArray
    likeness: FloatArray
    ended: BoolArray

    def feared_rewards(self, least: float, typical: float) -> FloatArray:
        """Rewards (steps, count) if what is not known is the worst.

        The less a state is like any sample, the nearer its reward is taken to be to the least one.

        Args:
            least: of all rewards, standardised.
            typical: likeness from which on a state is known.
        """
        known = np.minimum(self.likeness / typical, 1.0)
        return least + known * (self.rewards - least)


def average_reward(rewards: FloatArray, restart_probability: float) -> FloatArray:
    """Average reward per step (count,) of the restarting process, from each start.

    A step counts by the chance that there has been no restart yet.

    Args:
        rewards: (steps, count) without restarts.
        restart_probability: p.
    """
    share = (1.0 - restart_probability) ** np.arange(len(rewards))
    return share @ rewards / share.sum()


@dataclass(frozen=True)
class Chance:
    """What is drawn for one step of m roll-outs, whatever the policy.

    Attributes:
        noise: (m, da) standard normal, of the actions.
        sides: (m, 1) one or minus one: to which side a residual is added.
        ends: (m,) uniform; the task ends where its chance to is larger.
    """

    noise: FloatArray
    sides: FloatArray
    ends: FloatArray

    @classmethod
    def of(cls, count: int, action_size: int, rng: np.random.Generator) -> Chance:
        noise = rng.standard_normal((count, action_size))
        sides = np.where(rng.integers(2, size=(count, 1)) == 0, 1.0, -1.0)
        return cls(noise, sides, rng.uniform(size=count))

    def repeated(self, times: int) -> Chance:
        """The same for each of so many policies."""
        noise, sides = (np.tile(each, (times, 1)) for each in (self.noise, self.sides))
        return Chance(noise, sides, np.tile(self.ends, times))


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
        states = self._starts(len(left), rng)
        while len(states):
            chance = Chance.of(len(states), self.task.action_size, rng)
            rows, _, _, successors, ended = self._step(policy.act, states, chance)
            visited.append(states)
            nearest.append(rows)
            left = np.where(ended, 0, left - 1)
            states, left = successors[left > 0], left[left > 0]
        return np.concatenate(visited), np.concatenate(nearest)

    def follow(
        self,
        policies: Sequence[StochasticPolicy],
        reward: Callable[[FloatArray], FloatArray],
        count: int,
        rng: np.random.Generator,
    ) -> list[Followed]:
        """Each policy from so many starts, without random restarts.

        They are followed side by side, and meet the same chance: starts, noise and ends.

        Args:
            policies: to be followed, each with its noise.
            reward: of states and scaled, applied actions (m, ds + da).
            count: of the starts.
            rng: of the chance.
        """
        many = len(policies)
        steps = min(ceil(AVERAGED / self.restart_probability), self.longest)

        def act(states: FloatArray, noise: FloatArray) -> FloatArray:
            parts = zip(policies, np.split(states, many), np.split(noise, many), strict=True)
            return np.concatenate([policy.act(*part) for policy, *part in parts])

        asked, likeness, ends = [], [], []
        states = np.tile(self._starts(count, rng), (many, 1))
        for _ in range(steps):
            chance = Chance.of(count, self.task.action_size, rng).repeated(many)
            _, alike, inputs, successors, ended = self._step(act, states, chance)
            asked.append(inputs)
            likeness.append(alike)
            ends.append(ended)
            if ended.any():
                anew = np.tile(self._starts(count, rng), (many, 1))
                successors = np.where(ended[:, None], anew, successors)
            states = successors
        rewards = reward(np.concatenate(asked))
        each = (
            np.split(np.reshape(values, (steps, many * count)), many, axis=1)
            for values in (rewards, likeness, ends)
        )
        return [Followed(*parts) for parts in zip(*each, strict=True)]

    def _step(
        self,
        act: Callable[[FloatArray, FloatArray], FloatArray],
        states: FloatArray,
        chance: Chance,
    ) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, BoolArray]:
        """One step from states (m, ds), real ends and random restarts left to the caller.

        The nearest samples (m,) and their likeness (m,), the states and applied actions
        (m, ds + da), successors (m, ds) within the range of the data, and whether the task ended
        (m,).
        """
        rows, likeness = self.nearest(states)
        actions = self.task.scaled(self.task.clip(act(states, chance.noise)))
        inputs = np.concatenate([states, actions], axis=1)
        successors, ends = self.dynamics.drawn(rows, inputs, chance.sides)
        ended = chance.ends < ends
        return rows, likeness, inputs, np.clip(successors, *self._range), ended

    @cached_property
    def _samples(self) -> tuple[FloatArray, FloatArray]:
        """Mean (e,) of the samples' coordinates, and what `nearest` multiplies by (e + 1, n).

        These are their distances from it, and minus half their squares.
        """
        coordinates = self.kernel.embed(self.data.states)
        mean = coordinates.mean(axis=0)
        centred = coordinates - mean
        half_squares = 0.5 * np.sum(centred * centred, axis=1, keepdims=True)
        return mean, np.ascontiguousarray(np.concatenate([centred, -half_squares], axis=1).T)

    def nearest(self, states: FloatArray) -> tuple[IntArray, FloatArray]:
        """The nearest samples (m,) to states (m, ds), and the kernel's values (m,) with them.

        ``argmin |e_i - f_j|^2`` is ``argmax e_i'f_j - |f_j|^2 / 2``.
        """
        mean, samples = self._samples
        embedded = self.kernel.embed(states) - mean
        extended = np.concatenate([embedded, np.ones((len(embedded), 1))], axis=1)
        tall = max(1, PANEL // samples.shape[1])  # few enough that the products stay in the cache
        rows = np.concatenate(
            [
                np.argmax(extended[i : i + tall] @ samples, axis=1)
                for i in range(0, max(1, len(extended)), tall)
            ]
        )
        apart = embedded - samples[:-1, rows].T
        return rows, np.exp(-0.5 * np.sum(apart * apart, axis=1))

    def _starts(self, count: int, rng: np.random.Generator) -> FloatArray:
        starts = self.data.points[rng.choice(self.data.start, count)]
        if not self.exploring_starts:
            return starts
        anywhere = self.data.points[rng.choice(self.data.state, count)]
        return np.where(rng.uniform(size=(count, 1)) < self.exploring_starts, anywhere, starts)

    @cached_property
    def _range(self) -> tuple[FloatArray, FloatArray]:
        """Least and largest state (ds,) seen: beyond them nothing is known that could stop one.

        Angles have no limits.
        """
        low, high = self.data.points.min(axis=0), self.data.points.max(axis=0)
        angles = list(self.task.periodic)
        low[angles], high[angles] = -np.inf, np.inf
        return low, high
