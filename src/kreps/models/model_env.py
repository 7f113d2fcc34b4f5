"""The learnt dynamics as an environment: rollouts of policies in the model.

The weights of the first step only weigh states that old policies visited.  Model rollouts reach the
states that the new policy visits, and they predict its return before it acts (see
`kreps.algorithms.acceptance`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import ceil

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray
from kreps.kernels.gram import BLOCK_ENTRIES
from kreps.kernels.kernel import Kernel
from kreps.models.dynamics import SAMPLES_PER_COEFFICIENT, Dynamics
from kreps.policies.base import StochasticPolicy

EVALUATION_LENGTHS = 2.0
"""Steps over which a policy is evaluated, in mean lengths of a rollout: by then a share of
exp(-2) of the rollouts would not have been restarted."""


MAX_EVALUATION_STEPS = 200
"""Largest number of steps of a rollout in which a policy is evaluated."""


def supports_model_rollouts(data: Transitions, task: TaskSpec) -> bool:
    """Whether predictions of the dynamics can be fed back into them.

    Not in images, where errors of single pixels add up to what no image of the task looks like; nor
    with fewer samples than the linear mean of the dynamics needs.
    """
    coefficients = 1 + task.state_size + task.action_size
    return task.image_shape is None and len(data) >= SAMPLES_PER_COEFFICIENT * coefficients


@dataclass(frozen=True)
class ModelRollouts:
    """Rollouts of one policy in the model.

    Attributes:
        rewards: (steps, count) expected, standardised; after a termination that of no reward.
        similarity: (steps, count) of each state to its nearest sample: the kernel's value, up to 1.
        ended: (steps, count) whether the episode had terminated at an earlier step.
    """

    rewards: FloatArray
    similarity: FloatArray
    ended: BoolArray


def average_reward(rewards: FloatArray, restart_probability: float) -> FloatArray:
    """Average reward per step (count,) of the restarting process, from each start.

    Step t counts by the probability ``(1 - p)^t`` that there has been no restart yet.

    Args:
        rewards: (steps, count) without restarts.
        restart_probability: p.
    """
    return step_shares(len(rewards), restart_probability) @ rewards


def step_shares(steps: int, restart_probability: float) -> FloatArray:
    """Shares (steps,) of the steps in the average reward of a rollout."""
    share = (1.0 - restart_probability) ** np.arange(steps)
    return share / share.sum()


@dataclass(frozen=True)
class RolloutNoise:
    """The random numbers of one step of m rollouts.

    Attributes:
        action_noise: (m, da) standard normal.
        residual_signs: (m, 1) one or minus one: the sign with which a residual is added.
        end_uniforms: (m,) in [0, 1); the episode ends where its probability to end is larger.
    """

    action_noise: FloatArray
    residual_signs: FloatArray
    end_uniforms: FloatArray

    @classmethod
    def sample(cls, count: int, action_size: int, rng: np.random.Generator) -> RolloutNoise:
        action_noise = rng.standard_normal((count, action_size))
        residual_signs = np.where(rng.integers(2, size=(count, 1)) == 0, 1.0, -1.0)
        return cls(action_noise, residual_signs, rng.uniform(size=count))

    def of(self, rows: IntArray) -> RolloutNoise:
        """That of some of the rollouts."""
        return RolloutNoise(
            self.action_noise[rows], self.residual_signs[rows], self.end_uniforms[rows]
        )


@dataclass(frozen=True)
class ModelStep:
    """One step of m rollouts.

    Attributes:
        nearest: (m,) the sample nearest to each state.
        similarity: (m,) to it.
        inputs: (m, ds + da) states and scaled, applied actions.
        successors: (m, ds) within the range of the data.
        terminations: (m,) probabilities of a termination.
        terminated: (m,) whether the episode ended.
    """

    nearest: IntArray
    similarity: FloatArray
    inputs: FloatArray
    successors: FloatArray
    terminations: FloatArray
    terminated: BoolArray


@dataclass(frozen=True)
class ModelEnv:
    """The restarting process as learnt from n samples.

    Attributes:
        dynamics: of the samples.
        data: the samples.
        kernel: over states, for the nearest sample of a state.
        task: limits and scale of the actions, and which coordinates are angles.
        restart_probability: p.
        exploring_starts: share of the rollouts that begin in any sampled state, the others in
            start states.
        max_steps: largest number of steps of a rollout.
        end_reward: reward zero, standardised: per step after a termination.
    """

    dynamics: Dynamics
    data: Transitions
    kernel: Kernel
    task: TaskSpec
    restart_probability: float
    exploring_starts: float
    max_steps: int
    end_reward: float

    def visited_states(
        self, policy: StochasticPolicy, count: int, rng: np.random.Generator
    ) -> tuple[FloatArray, IntArray]:
        """States (m, ds) visited in rollouts of a policy, and the sample (m,) nearest to each.

        Args:
            policy: with its exploration noise.
            count: m, unless episodes end earlier.
            rng: of lengths, starts and noise.
        """
        left = np.minimum(rng.geometric(self.restart_probability, size=count), self.max_steps)
        left = left[: 1 + np.searchsorted(np.cumsum(left), count)]
        left[-1] -= left.sum() - count
        visited, nearest = [], []
        states = self.starts(len(left), rng)
        while len(states):
            noise = RolloutNoise.sample(len(states), self.task.action_size, rng)
            step = self.step(policy.act, states, noise)
            visited.append(states)
            nearest.append(step.nearest)
            left = np.where(step.terminated, 0, left - 1)
            states, left = step.successors[left > 0], left[left > 0]
        return np.concatenate(visited), np.concatenate(nearest)

    def evaluate(
        self,
        policy: StochasticPolicy,
        reward: Callable[[FloatArray, FloatArray], FloatArray],
        count: int,
        rng: np.random.Generator,
        copies: int = 1,
    ) -> ModelRollouts:
        """Rollouts of a policy without random restarts.

        Args:
            policy: with its exploration noise.
            reward: expected reward (m,) of states and scaled, applied actions (m, ds + da), and of
                probabilities of a termination (m,).
            count: number of starts.
            rng: of starts and noise.
            copies: how often there are rollouts with the same starts and noise, all first ones
                first, for a policy that acts in each in another way.

        Returns:
            The rollouts (steps, copies * count).
        """
        steps, size = self.evaluation_steps, self.task.state_size + self.task.action_size
        every = np.tile(np.arange(count), copies)
        inputs = np.zeros((steps, len(every), size))
        similarity, terminations = np.ones((steps, len(every))), np.zeros((steps, len(every)))
        ended = np.ones((steps, len(every)), dtype=bool)
        states = self.starts(count, rng)[every]
        going = np.arange(len(every))  # the others have ended
        for t in range(steps):
            noise = RolloutNoise.sample(count, self.task.action_size, rng).of(every)
            commanded = policy.act(states, noise.action_noise)
            step = self.step_with(commanded[going], states[going], noise.of(going))
            inputs[t, going], similarity[t, going] = step.inputs, step.similarity
            terminations[t, going], ended[t, going] = step.terminations, False
            states = states.copy()  # a policy may keep those that it was given
            states[going] = step.successors
            going = going[~step.terminated]
            if not len(going):
                break
        rewards = np.full((steps, len(every)), self.end_reward)
        rewards[~ended] = reward(inputs[~ended], terminations[~ended])
        return ModelRollouts(rewards, similarity, ended)

    @property
    def evaluation_steps(self) -> int:
        """Steps of a rollout in which a policy is evaluated."""
        steps = min(ceil(EVALUATION_LENGTHS / self.restart_probability), self.max_steps)
        return min(steps, MAX_EVALUATION_STEPS)

    def trajectories(
        self, policy: StochasticPolicy, starts: FloatArray, steps: int, rng: np.random.Generator
    ) -> FloatArray:
        """States (steps + 1, m, ds) of rollouts without restarts, NaN after the end of an episode.

        Angles count whole turns.

        Args:
            policy: that acts.
            starts: (m, ds) first states.
            steps: of each rollout.
            rng: of the noise of policy and dynamics, and of ends.
        """
        visited = np.full((steps + 1, *starts.shape), np.nan)
        visited[0] = starts
        going = np.arange(len(starts))
        for t in range(steps):
            noise = RolloutNoise.sample(len(going), self.task.action_size, rng)
            step = self.step(policy.act, visited[t, going], noise)
            going, successors = going[~step.terminated], step.successors[~step.terminated]
            if not len(going):
                break
            visited[t + 1, going] = successors
        return visited

    def step(
        self,
        act: Callable[[FloatArray, FloatArray], FloatArray],
        states: FloatArray,
        noise: RolloutNoise,
    ) -> ModelStep:
        """One step from states (m, ds); starts after ends and restarts are left to the caller."""
        return self.step_with(act(states, noise.action_noise), states, noise)

    def step_with(
        self, commanded: FloatArray, states: FloatArray, noise: RolloutNoise
    ) -> ModelStep:
        """`step` by commanded actions (m, da)."""
        nearest, similarity = self.nearest(states)
        actions = self.task.scaled_applied(commanded)
        inputs = np.concatenate([states, actions], axis=1)
        successors, terminations = self.dynamics.sample(nearest, inputs, noise.residual_signs)
        successors = self.within_range(successors)
        terminated = noise.end_uniforms < terminations
        return ModelStep(nearest, similarity, inputs, successors, terminations, terminated)

    @cached_property
    def _samples(self) -> tuple[FloatArray, FloatArray]:
        """Mean (e,) of the samples' embedded coordinates, and the factor (e + 1, n) of `nearest`.

        The factor's columns are the centred coordinates and minus half their squared norm.
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
        height = max(1, BLOCK_ENTRIES // samples.shape[1])  # so that products stay in the cache
        rows = np.concatenate(
            [
                np.argmax(extended[i : i + height] @ samples, axis=1)
                for i in range(0, max(1, len(extended)), height)
            ]
        )
        apart = embedded - samples[:-1, rows].T
        return rows, np.exp(-0.5 * np.sum(apart * apart, axis=1))

    def starts(self, count: int, rng: np.random.Generator) -> FloatArray:
        """First states (count, ds) of rollouts."""
        starts = self.data.points[rng.choice(self.data.start, count)]
        if not self.exploring_starts:
            return starts
        anywhere = self.data.points[rng.choice(self.data.state, count)]
        return np.where(rng.uniform(size=(count, 1)) < self.exploring_starts, anywhere, starts)

    def within_range(self, states: FloatArray) -> FloatArray:
        """States clipped to the range of the data."""
        return np.clip(states, *self._range)

    def is_within_range(self, states: FloatArray) -> BoolArray:
        """Where the coordinates of states would not be clipped."""
        low, high = self._range
        return (states > low) & (states < high)

    @cached_property
    def _range(self) -> tuple[FloatArray, FloatArray]:
        """Smallest and largest state (ds,) observed, to which predictions are clipped.

        Angles are not clipped.
        """
        low, high = self.data.points.min(axis=0), self.data.points.max(axis=0)
        angles = list(self.task.periodic)
        low[angles], high[angles] = -np.inf, np.inf
        return low, high
