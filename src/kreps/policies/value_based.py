"""Policies that act on values: softmax over Q (value iteration), maximum over samples (NPALP)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri, softmax

from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.gram import gaussian_gram
from kreps.kernels.kernel import Kernel

STATE_BATCH = 2048
"""States that are evaluated at once: bounds the memory of a large batch."""


def _batches(states: FloatArray) -> list[FloatArray]:
    """Batches of at most `STATE_BATCH` states; one empty batch if there are no states."""
    return [states[i : i + STATE_BATCH] for i in range(0, max(len(states), 1), STATE_BATCH)]


@dataclass(frozen=True)
class SoftmaxPolicy:
    """Draws a candidate action with probability proportional to ``exp(Q / temperature)``.

    ``Q(s, a_k) = offset + sum_i k_s(s_i, s) table_ik`` for samples i and candidates k.

    Attributes:
        task: gives centre, scale and limits of the actions.
        kernel: over states.
        states: (n, ds) sampled states.
        table: (n, k) weights, in units of the reward.
        offset: constant part of Q, in units of the reward.
        candidates: (k, da) actions, in units of the action scale around the centre.
        temperature: in units of the reward; zero for the maximum.
    """

    task: TaskSpec
    kernel: Kernel
    states: FloatArray
    table: FloatArray
    offset: float
    candidates: FloatArray
    temperature: float

    @cached_property
    def _coordinates(self) -> FloatArray:
        return self.kernel.embed(self.states)

    def q_values(self, states: FloatArray) -> FloatArray:
        """Q (m, k) at states (m, ds)."""
        grams = (gaussian_gram(self._coordinates, self.kernel.embed(s)) for s in _batches(states))
        return np.concatenate([k.T @ self.table + self.offset for k in grams])

    def value(self, states: FloatArray) -> FloatArray:
        """V (m,) at states (m, ds): the soft maximum of Q."""
        return soft_maximum(self.q_values(states), self.temperature)

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        if self.temperature == 0.0:
            return self.greedy(states)
        probabilities = softmax(self.logits(states), axis=1)
        # one draw per state: the noise becomes a uniform number, which inverts the cumulated
        # probabilities
        uniform = ndtr(noise[:, :1])
        chosen = (np.cumsum(probabilities, axis=1) < uniform).sum(axis=1)
        return self._actions(np.minimum(chosen, len(self.candidates) - 1))

    def logits(self, states: FloatArray) -> FloatArray:
        """Log probabilities (m, k) of the candidates, up to a constant for each state."""
        return self.q_values(states) / self.temperature

    def greedy(self, states: FloatArray) -> FloatArray:
        return self._actions(self.q_values(states).argmax(axis=1))

    def _actions(self, chosen: IntArray) -> FloatArray:
        return self.task.unscaled(self.candidates[chosen])


def soft_maximum(q: FloatArray, temperature: float) -> FloatArray:
    """``T log mean_k exp(q_k / T)`` of each row (m,); the maximum at temperature zero."""
    if temperature == 0.0:
        return q.max(axis=1)
    log_sum = logsumexp(q / temperature, axis=1)
    return temperature * np.asarray(log_sum - np.log(q.shape[1]))


@dataclass(frozen=True)
class LipschitzPolicy:
    """Takes the action of the sample whose bound on a state's value is largest.

    ``V(s) = max_i (q_i - slope |e(s) - e(s_i)|)`` is the smallest function with this Lipschitz
    constant that satisfies the bounds of all samples (Pazis and Parr 2011).  A share of the actions
    gets Gaussian noise.

    Attributes:
        task: gives centre, scale and limits of the actions.
        kernel: over states; its embedding e gives the distance.
        states: (n, ds) sampled states.
        actions: (n, da) their applied actions, in the task's units.
        bounds: (n,) the q_i, in units of the reward.
        slope: Lipschitz constant, reward per unit of distance.
        noise_fraction: share of the actions that gets Gaussian noise.
        noise_scale: standard deviation of this noise, in units of the action scale.
    """

    task: TaskSpec
    kernel: Kernel
    states: FloatArray
    actions: FloatArray
    bounds: FloatArray
    slope: float
    noise_fraction: float
    noise_scale: float

    @cached_property
    def _coordinates(self) -> FloatArray:
        return self.kernel.embed(self.states)

    def _bounds_at(self, states: FloatArray) -> FloatArray:
        """``q_i - slope |e(s) - e(s_i)|``, (m, n), of m states and n samples."""
        from scipy.spatial.distance import cdist  # loaded here, as it takes 0.1 s

        return self.bounds - self.slope * cdist(self.kernel.embed(states), self._coordinates)

    def value(self, states: FloatArray) -> FloatArray:
        """V (m,) at states (m, ds)."""
        return np.concatenate([self._bounds_at(s).max(axis=1) for s in _batches(states)])

    def greedy(self, states: FloatArray) -> FloatArray:
        chosen = [self._bounds_at(s).argmax(axis=1) for s in _batches(states)]
        return self.actions[np.concatenate(chosen)]

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        # The first normal number decides whether there is noise.  If so, its rank among those that
        # do is a uniform number, which becomes the normal noise of the first coordinate.
        uniform = ndtr(noise[:, 0])
        noisy = uniform < self.noise_fraction
        added = np.where(noisy[:, None], noise, 0.0)
        added[noisy, 0] = ndtri(uniform[noisy] / self.noise_fraction)
        return self.greedy(states) + self.noise_scale * self.task.action_scale * added
