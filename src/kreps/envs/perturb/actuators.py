"""What actuators and gears do to a signal: lag, dead zone and backlash."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.envs.perturb.perturbation import Generators, Numbers, Perturbation, checked_numbers
from kreps.envs.perturb.signal import Signal
from kreps.kernels.arrays import FloatArray


@dataclass(frozen=True)
class Lag(Perturbation):
    """First-order lag, ``T y' = x - y``, of a value x that is held over the control period.

    The perturbed value of a step is y at the end of its control period, ``y + (1 - exp(-1/T))
    (x - y)`` from y at its beginning.  Actuators start at zero (or the nearest possible action),
    sensors at the first observation.

    Attributes:
        time_constant: T in control periods: seconds divided by ``env.metadata["dt"]``.  After T
            periods the response to a step is at 63 %.
    """

    time_constant: Numbers

    def __post_init__(self) -> None:
        constant = checked_numbers(
            "Lag.time_constant", self.time_constant, "a positive number", lambda v: v > 0.0
        )
        object.__setattr__(self, "time_constant", constant)

    def hidden(self, signal: Signal) -> Signal:
        """y, in the unit of the signal."""
        return signal.renamed("lagged {}")

    def start(self, signal: Signal, values: FloatArray) -> FloatArray:
        return values

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        share = -np.expm1(-1.0 / np.asarray(self.time_constant))
        state = signal.wrap(state + share * signal.difference(values, state))
        return state, state


@dataclass(frozen=True)
class DeadZone(Perturbation):
    """No effect below a threshold: ``sign(x) max(|x| - width, 0)``.

    Attributes:
        width: threshold on either side of zero, in the unit of the signal.
    """

    width: Numbers

    def __post_init__(self) -> None:
        width = checked_numbers("DeadZone.width", self.width, "at least 0", lambda v: v >= 0.0)
        object.__setattr__(self, "width", width)

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        beyond = np.maximum(np.abs(values) - self.width, 0.0)
        return state, signal.clip(np.sign(values) * beyond)


@dataclass(frozen=True)
class Backlash(Perturbation):
    """Play of a gear: the output rests until the input has crossed the gap and pushes it.

    This is the play operator, ``y = min(max(y, x - width / 2), x + width / 2)``.  Of observations
    it is an angle sensor behind a gear with play, which is the meaning of, say, 0.1 rad of backlash
    at a pivot: the plant moves freely and the measured angle has hysteresis.  Of actions it is a
    transmission between the commanded position and the one that acts.

    Attributes:
        width: of the whole gap, in the unit of the signal; 0 for a coordinate without play.
    """

    width: Numbers

    def __post_init__(self) -> None:
        width = checked_numbers("Backlash.width", self.width, "at least 0", lambda v: v >= 0.0)
        object.__setattr__(self, "width", width)

    def hidden(self, signal: Signal) -> Signal:
        """y, in the unit of the signal."""
        return signal.renamed("{} after backlash")

    def start(self, signal: Signal, values: FloatArray) -> FloatArray:
        return values

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        half = 0.5 * np.asarray(self.width)
        gap = signal.difference(values, state)
        pushed = np.where(half > 0.0, signal.wrap(values - np.sign(gap) * half), values)
        state = np.where(np.abs(gap) > half, pushed, state)
        return state, state
