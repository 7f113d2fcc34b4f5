"""The interface of a perturbation, and several of them one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from kreps.envs.perturb.signal import NOTHING, Signal
from kreps.errors import ConfigurationError, DataError, SpaceError
from kreps.intake import as_numbers
from kreps.kernels.arrays import FloatArray

Numbers = float | tuple[float, ...]
"""One number for all coordinates, or one for each."""

Generators = Sequence[np.random.Generator]
"""One for each of m copies of an environment."""


class Perturbation:
    """A change of a signal: of the actions on their way in, or of the observations on the way out.

    A subclass is a frozen dataclass of its parameters and computes m copies at once.  What it
    remembers from step to step is a hidden state (m, h) that is given to it and returned.  This
    class has the methods of a perturbation without hidden state that keeps the limits.
    """

    def require(self, signal: Signal) -> None:
        """Raise `SpaceError` unless the parameters fit the coordinates of a signal."""
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if isinstance(value, tuple) and len(value) != len(signal):
                raise SpaceError(
                    f"{self} has {len(value)} values of {field.name}, but the signal has "
                    f"{len(signal)} coordinates; give one number, or one for each coordinate"
                )

    def hidden(self, signal: Signal) -> Signal:
        """What the hidden state (h,) consists of."""
        return NOTHING

    def output(self, signal: Signal) -> Signal:
        """What the perturbed values are."""
        return signal

    def start(self, signal: Signal, values: FloatArray) -> FloatArray:
        """The hidden states (m, h) before the first values (m, d)."""
        return np.empty((len(values), 0))

    def step(
        self, signal: Signal, state: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        """The hidden states after a step, and the perturbed values.

        Args:
            signal: that the values are of.
            state: (m, h) hidden states before it.
            values: (m, d).
            rngs: of the m copies.
        """
        raise NotImplementedError


def checked_numbers(
    name: str, value: Numbers, needed: str, valid: Callable[[FloatArray], Any]
) -> Numbers:
    """A parameter as a number, or as a tuple of one for each coordinate.

    Args:
        name, value: of the parameter.
        needed: what is valid, in words.
        valid: whether numbers are.

    Raises:
        ConfigurationError: it is not valid.
    """
    try:
        numbers = as_numbers(name, value, "give finite numbers")
    except DataError as error:
        raise ConfigurationError(str(error)) from error
    if numbers.ndim > 1 or not np.all(valid(numbers)):
        raise ConfigurationError(f"{name} = {value!r:.60}, but {needed} is needed")
    return tuple(numbers.tolist()) if numbers.ndim else float(numbers)


def checked_steps(name: str, value: int, least: int) -> int:
    """A whole number of control periods.

    Raises:
        ConfigurationError: something else, or fewer than ``least``.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ConfigurationError(
            f"{name} = {value!r:.60}, but a whole number of steps, at least {least}, is needed"
        )
    return int(value)


@dataclass(frozen=True)
class Chain:
    """Perturbations of one signal, each applied to the result of the one before.

    Attributes:
        source: the signal before all of them.
        parts: the perturbations, in order.

    Raises:
        ConfigurationError: something that is no perturbation.
        SpaceError: parameters that do not fit the coordinates.
    """

    source: Signal
    parts: tuple[Perturbation, ...]

    def __post_init__(self) -> None:
        for part in self.parts:
            if not isinstance(part, Perturbation):
                raise ConfigurationError(
                    f"{part!r:.60} is no perturbation; give those of kreps.envs.perturb, such as "
                    "[Delay(3)]"
                )
        _ = self.signals  # checks them

    @cached_property
    def signals(self) -> tuple[Signal, ...]:
        """The signal before each perturbation, and the one after all."""
        signals = [self.source]
        for part in self.parts:
            part.require(signals[-1])
            signals.append(part.output(signals[-1]))
        return tuple(signals)

    @property
    def output(self) -> Signal:
        """The signal after all perturbations."""
        return self.signals[-1]

    @cached_property
    def hidden(self) -> Signal:
        """The hidden states of all, side by side."""
        return Signal.concat(
            [part.hidden(signal) for part, signal in zip(self.parts, self.signals, strict=False)]
        )

    @cached_property
    def _ends(self) -> list[int]:
        """Column of the hidden states at which each perturbation's end."""
        widths = [
            len(part.hidden(signal)) for part, signal in zip(self.parts, self.signals, strict=False)
        ]
        return [int(end) for end in np.cumsum(widths)]

    def start(self, values: FloatArray, rngs: Generators) -> tuple[FloatArray, FloatArray]:
        """The hidden states (m, h) after the first values (m, d), and these values perturbed."""
        states = [np.empty((len(values), 0))]
        for part, signal in zip(self.parts, self.signals, strict=False):
            state, values = part.step(signal, part.start(signal, values), values, rngs)
            states.append(state)
        return np.concatenate(states, axis=1), values

    def step(
        self, states: FloatArray, values: FloatArray, rngs: Generators
    ) -> tuple[FloatArray, FloatArray]:
        """The hidden states (m, h) after a step, and the values (m, d) perturbed."""
        parts = np.split(states, self._ends, axis=1)
        for i, (part, signal) in enumerate(zip(self.parts, self.signals, strict=False)):
            parts[i], values = part.step(signal, parts[i], values, rngs)
        return np.concatenate(parts, axis=1), values
