"""First policies, and temporally correlated exploration noise.

White noise averages out: each push is undone by later ones, and the states of a slow system hardly
change.  Noise with a power spectrum of ``1 / f^beta`` also has slow components.  Pink noise, with
beta = 1, has the same power in every octave and so needs no time scale (Eberhard et al. 2023).  Red
noise, with beta = 2, is a random walk and moves the states farthest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray

WHITE, PINK, RED = 0.0, 1.0, 2.0
"""Exponents beta of power spectra ``1 / f^beta``."""

NOISE_BLOCK = 65_536
"""Steps for which noise is drawn at once."""


def coloured_noise(
    exponent: float, length: int, width: int, rng: np.random.Generator
) -> FloatArray:
    """Standard normal numbers (length, width), each column with a spectrum of ``1 / f^exponent``.

    White noise is filtered in the frequency domain (Timmer and Koenig 1995).  That makes it
    periodic; twice the length is generated and half of it returned, so that the last numbers are
    not correlated with the first.

    Args:
        exponent: beta, for example `WHITE`, `PINK` or `RED`.
        length: number of steps.
        width: number of action coordinates.
        rng: draws the white noise.
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


def noise_rows(
    exponent: float, length: int, width: int, rng: np.random.Generator
) -> Iterator[FloatArray]:
    """The rows (width,) of `coloured_noise`, drawn when they are needed.

    A rollout may end long before ``length`` steps.  Noise of more than `NOISE_BLOCK` steps is made
    in independent blocks.
    """
    for first in range(0, length, NOISE_BLOCK):
        yield from coloured_noise(exponent, min(length - first, NOISE_BLOCK), width, rng)


@dataclass(frozen=True)
class BangBang:
    """Each action at one of its limits, chosen by the sign of the noise, whatever the state.

    Time-optimal control of bounded actions is often of this kind.
    """

    task: TaskSpec

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.task.action_centre + self.task.action_scale * np.where(noise < 0, -1.0, 1.0)


@dataclass(frozen=True)
class Gaussian:
    """Actions ``N(centre, (scale * action_scale)^2)``, whatever the state.

    Attributes:
        task: gives centre and scale of the actions.
        scale: standard deviation, in units of the action scale.
    """

    task: TaskSpec
    scale: float

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.task.action_centre + self.scale * self.task.action_scale * noise
