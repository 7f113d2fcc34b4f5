"""What networks and sensors do to a signal: delays, failures, noise and missing coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kreps.envs.perturb.perturbation import (
    Generators,
    Numbers,
    Perturbation,
    checked_numbers,
    checked_steps,
)
from kreps.envs.perturb.signal import Signal
from kreps.errors import ConfigurationError, SpaceError
from kreps.kernels.arrays import FloatArray


@dataclass(frozen=True)
class Delay(Perturbation):
    """Each value arrives some steps later.

    Before the first step, actions are zero (or the nearest possible action), and observations are
    the first one.  With ``least`` the delay of each step is drawn anew, so that values can
    overtake each other: a step may get an older value than the step before.

    Attributes:
        steps: control periods of delay; the largest if it is random.
        least: the smallest delay, from which to ``steps`` all are equally likely; None: always
            ``steps``.
    """

    steps: int
    least: int | None = None

    def __post_init__(self) -> None:
        checked_steps("Delay.steps", self.steps, 1)
        if self.least is not None and checked_steps("Delay.least", self.least, 0) > self.steps:
            raise ConfigurationError(
                f"Delay.least = {self.least}, but at most steps = {self.steps} is possible"
            )

    def hidden(self, signal: Signal) -> Signal:
        """The latest ``steps`` values, newest first: d numbers each."""
        ages = ["{}, 1 step ago", *(f"{{}}, {k} steps ago" for k in range(2, self.steps + 1))]
        return Signal.concat([signal.renamed(age) for age in ages])

    def start(self, signal: Signal, values: FloatArray) -> FloatArray:
        return np.tile(values, (1, self.steps))

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        m, d = values.shape
        queue = np.concatenate([values, state], axis=1)
        delay = np.full(m, self.steps)
        if self.least is not None:
            delay = np.array([rng.integers(self.least, self.steps, endpoint=True) for rng in rngs])
        late = queue.reshape(m, self.steps + 1, d)[np.arange(m), delay]
        return queue[:, : self.steps * d], late


@dataclass(frozen=True)
class Noise(Perturbation):
    """White Gaussian noise.

    Perturbed observations have no limits, except that angles stay in their range; perturbed actions
    are clipped to their limits.

    Attributes:
        std: standard deviation in the unit of the signal.
    """

    std: Numbers

    def __post_init__(self) -> None:
        std = checked_numbers("Noise.std", self.std, "at least 0", lambda v: v >= 0.0)
        object.__setattr__(self, "std", std)

    def output(self, signal: Signal) -> Signal:
        free = np.broadcast_to(np.asarray(self.std) > 0.0, len(signal)) & ~signal.angle
        low, high = np.where(free, -np.inf, signal.low), np.where(free, np.inf, signal.high)
        return replace(signal, low=low, high=high)

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        noise = np.array([rng.standard_normal(len(signal)) for rng in rngs])
        return state, signal.wrap(values + self.std * noise)


@dataclass(frozen=True)
class _Failures(Perturbation):
    """Failures that begin at random in each coordinate apart, and last some steps.

    Attributes:
        probability: that a failure begins, at each step without one.
        steps: control periods that it lasts.
    """

    probability: Numbers
    steps: int = 1

    def __post_init__(self) -> None:
        name = type(self).__name__
        probability = checked_numbers(
            f"{name}.probability", self.probability, "0 to 1", lambda v: (v >= 0.0) & (v <= 1.0)
        )
        object.__setattr__(self, "probability", probability)
        checked_steps(f"{name}.steps", self.steps, 1)

    def _counters(self, signal: Signal) -> Signal:
        """Of each coordinate, for how many steps it fails, this one included."""
        no_angle = np.zeros(len(signal), bool)
        most = np.full(len(signal), float(self.steps))
        return Signal(0.0 * most, most, no_angle, signal.labels).renamed("steps of failure of {}")

    def _count(self, left: FloatArray, rngs: Generators) -> FloatArray:
        """The counters (m, d) of the next step."""
        drawn = np.array([rng.random(left.shape[1]) for rng in rngs])
        left = np.maximum(left - 1.0, 0.0)
        return np.where((left == 0.0) & (drawn < self.probability), float(self.steps), left)


@dataclass(frozen=True)
class Dropped(_Failures):
    """Coordinates that are zero (or the nearest possible value) while they fail.

    Attributes:
        probability: that a failure begins, at each step without one, in each coordinate apart.
        steps: control periods that it lasts.
    """

    def hidden(self, signal: Signal) -> Signal:
        """A counter for each coordinate."""
        return self._counters(signal)

    def start(self, signal: Signal, values: FloatArray) -> FloatArray:
        return np.zeros_like(values)

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        left = self._count(state, rngs)
        return left, np.where(left > 0.0, signal.neutral, values)


@dataclass(frozen=True)
class Stuck(_Failures):
    """Coordinates that keep the value before the failure while they fail.

    Attributes:
        probability: that a failure begins, at each step without one, in each coordinate apart.
        steps: control periods that it lasts.
    """

    def hidden(self, signal: Signal) -> Signal:
        """A counter for each coordinate, then the latest perturbed values."""
        return Signal.concat([self._counters(signal), signal.renamed("latest {}")])

    def start(self, signal: Signal, values: FloatArray) -> FloatArray:
        return np.concatenate([np.zeros_like(values), values], axis=1)

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        left, latest = np.split(state, 2, axis=1)
        left = self._count(left, rngs)
        values = np.where(left > 0.0, latest, values)
        return np.concatenate([left, values], axis=1), values


@dataclass(frozen=True)
class Hidden(Perturbation):
    """Coordinates of the observation that are left out, such as velocities.

    Attributes:
        coordinates: their numbers; those of other perturbations after this one count what is left.
    """

    coordinates: int | tuple[int, ...]

    def require(self, signal: Signal) -> None:
        numbers = np.atleast_1d(np.asarray(self.coordinates))
        within = numbers.dtype.kind == "i" and np.isin(numbers, np.arange(len(signal))).all()
        if not within or len(np.unique(numbers)) >= len(signal):
            raise SpaceError(
                f"{self}, but the signal has coordinates 0 to {len(signal) - 1}, of which one at "
                "least must be left; give the numbers of the others"
            )

    def _kept(self, signal: Signal) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return ~np.isin(np.arange(len(signal)), self.coordinates)

    def output(self, signal: Signal) -> Signal:
        return signal.select(self._kept(signal))

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        return state, values[:, self._kept(signal)]
