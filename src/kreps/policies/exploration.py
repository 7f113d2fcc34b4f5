"""What a learner explores with before there is a policy, for how long, and what it remembers of it.

White noise averages out: what one step pushes the next one takes back, and a task whose states
change slowly is never seen to change.  Noise with a power spectrum of ``1 / f^beta`` has slow parts
as well: pink noise, beta = 1, as much in every octave, so that it needs no time scale (Eberhard et
al. 2023 explore with it by default); red noise, beta = 2, is the random walk that goes farthest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray

WHITE, PINK, RED = 0.0, 1.0, 2.0
"""Exponents beta of the spectrum."""


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


@dataclass(frozen=True)
class BangBang:
    """Each action at one of its limits, with random sign: what bounded control often is."""

    task: TaskSpec

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.task.action_centre + self.task.action_scale * np.where(noise < 0, -1.0, 1.0)


@dataclass(frozen=True)
class Gaussian:
    """Actions ``N(centre, (spread * scale)^2)``, whatever the state."""

    task: TaskSpec
    spread: float

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.task.action_centre + self.spread * self.task.action_scale * noise
