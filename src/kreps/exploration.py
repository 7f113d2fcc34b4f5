"""What a learner explores with before there is a policy, and for how long.

White noise averages out: what one step pushes the next one takes back, and a task whose states
change slowly is never seen to change.  Noise with a power spectrum of ``1 / f^beta`` has slow parts
as well: pink noise, beta = 1, as much in every octave, so that it needs no time scale (Eberhard et
al. 2023 explore with it by default); red noise, beta = 2, is the random walk that goes farthest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kreps.arrays import FloatArray
from kreps.data import Rollout, TaskSpec

WHITE, PINK, RED = 0.0, 1.0, 2.0
"""Exponents beta of the spectrum."""

UNTOLD = 1e-6
"""Largest part of the largest reward that rounding leaves where the reward is of actions alone."""


def coloured_noise(
    exponent: float, length: int, width: int, rng: np.random.Generator
) -> FloatArray:
    """Standard normal numbers (length, width), each column with a spectrum of ``1 / f^exponent``.

    They are the first half of a period, so that the last ones are no neighbours of the first.
    """
    if exponent == WHITE:
        return rng.standard_normal((length, width))
    frequencies = np.fft.rfftfreq(2 * length)
    frequencies[0] = frequencies[1]
    amplitudes = frequencies ** (-0.5 * exponent)
    both_sides = np.concatenate([amplitudes, amplitudes[1:-1]])
    spectrum = np.fft.rfft(rng.standard_normal((2 * length, width)), axis=0)
    noise = np.fft.irfft(amplitudes[:, None] * spectrum, n=2 * length, axis=0)
    return noise[:length] / np.sqrt(np.mean(both_sides**2))


def tells_of_states(rollouts: Sequence[Rollout], task: TaskSpec) -> bool:
    """Whether the rewards of some roll-outs depend on more than the actions.

    A goal that was never reached is a constant, and what else there is may be a price of the
    actions, quadratic as it mostly is.  Learnt from, it says that standing still is best.
    """
    rewards = np.concatenate([rollout.rewards for rollout in rollouts])
    actions = task.scaled(task.clip(np.concatenate([rollout.actions for rollout in rollouts])))
    i, j = np.triu_indices(task.action_size)
    terms = np.column_stack([np.ones(len(actions)), actions, actions[:, i] * actions[:, j]])
    if len(terms) <= terms.shape[1]:  # anything can be made of so many actions
        terms = terms[:, :1]
    missed = rewards - terms @ np.linalg.lstsq(terms, rewards)[0]
    return bool(np.abs(missed).max() > UNTOLD * np.abs(rewards).max())
