"""What a learner explores with before there is a policy, for how long, and what it remembers of it.

White noise averages out: what one step pushes the next one takes back, and a task whose states
change slowly is never seen to change.  Noise with a power spectrum of ``1 / f^beta`` has slow parts
as well: pink noise, beta = 1, as much in every octave, so that it needs no time scale (Eberhard et
al. 2023 explore with it by default); red noise, beta = 2, is the random walk that goes farthest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kreps.arrays import FloatArray
from kreps.data import Rollout, TaskSpec, Window

WHITE, PINK, RED = 0.0, 1.0, 2.0
"""Exponents beta of the spectrum."""

UNTOLD = 2e-7
"""Part of the largest reward that is none: what 32-bit numbers lose in a sum or a product."""


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
    """Whether the rewards of some roll-outs depend on more than a price of the actions.

    A goal that was never reached is a constant, and what else there is may be what actions cost,
    quadratic as it mostly is.  Learnt from, it says that to do nothing is best.
    """
    rewards = np.concatenate([rollout.rewards for rollout in rollouts])
    least = UNTOLD * np.abs(rewards).max()
    if np.ptp(rewards) <= least:
        return False
    actions = task.scaled(task.clip(np.concatenate([rollout.actions for rollout in rollouts])))
    idle = task.scaled(task.clip(np.zeros((1, task.action_size))))
    terms, of_idle = quadratic_terms(actions), quadratic_terms(idle)
    if len(terms) <= terms.shape[1]:  # anything can be made of so many
        return True
    price = np.linalg.lstsq(terms, rewards)[0]
    exact = np.abs(rewards - terms @ price).max() <= least
    return not (exact and rewards.max() <= of_idle @ price + least)


def each_tells(rollouts: Sequence[Rollout], task: TaskSpec) -> bool:
    """Whether the rewards of each roll-out tell of its states: if not, a goal is known from others.

    Those too short to know are taken to tell.
    """
    return all(tells_alone(rollout, task) for rollout in rollouts if is_long_enough(rollout, task))


def extended(window: Window, rollouts: Sequence[Rollout], task: TaskSpec) -> Window:
    """The window with new roll-outs: the latest, a third of it kept for those that tell of states.

    Where a goal is seldom reached, the latest roll-outs may hold none, and say that to do nothing
    is best.  Where each roll-out tells of the states, as it mostly does, these are the latest.
    """
    seen = (*window.rollouts, *rollouts)
    kept = len(window.extend(rollouts).rollouts)
    if kept == len(seen):
        return replace(window, rollouts=seen)
    telling = [i for i, rollout in enumerate(seen) if tells_alone(rollout, task)]
    spared = telling[max(len(telling) - _reserved(window), 0) :]
    others = sorted(set(range(len(seen))) - set(spared))
    places = sorted(spared + others[len(spared) - kept :])
    return replace(window, rollouts=tuple(seen[i] for i in places))


def latest(window: Window) -> Sequence[Rollout]:
    """Roll-outs that are in the window for being new."""
    if window.capacity is None:
        return window.rollouts
    return window.rollouts[-(window.capacity - _reserved(window)) :]


def _reserved(window: Window) -> int:
    return 0 if window.capacity is None else window.capacity // 3


def tells_alone(rollout: Rollout, task: TaskSpec) -> bool:
    """Whether the rewards of one roll-out tell of states, and it is long enough to know."""
    return is_long_enough(rollout, task) and tells_of_states([rollout], task)


def is_long_enough(rollout: Rollout, task: TaskSpec) -> bool:
    """Whether a price of the actions cannot explain just any rewards of a roll-out."""
    return len(rollout) > quadratic_terms(np.zeros((1, task.action_size))).shape[1]


def quadratic_terms(actions: FloatArray) -> FloatArray:
    """One, each coordinate of actions (n, da), and each product of two of them."""
    i, j = np.triu_indices(actions.shape[1])
    return np.column_stack([np.ones(len(actions)), actions, actions[:, i] * actions[:, j]])
