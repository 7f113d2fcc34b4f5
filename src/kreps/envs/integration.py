"""Integration of the equations of motion over one control period, and how long it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray


def runge_kutta(
    derivative: Callable[[FloatArray], FloatArray],
    state: FloatArray,
    time: float | FloatArray,
    steps: int,
) -> FloatArray:
    """The state after ``time`` seconds, by the Runge-Kutta method of order four.

    Args:
        derivative: time derivative of a state, with the input held constant.
        state: at the beginning; of any shape.
        time: in seconds; an array broadcasts with the state.
        steps: number of equal steps.
    """
    h = time / steps
    for _ in range(steps):
        k1 = derivative(state)
        k2 = derivative(state + 0.5 * h * k1)
        k3 = derivative(state + 0.5 * h * k2)
        k4 = derivative(state + h * k3)
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return state


def control_periods(
    nominal: float, jitter: float, rngs: Sequence[np.random.Generator]
) -> FloatArray:
    """Lengths (m,) in s of the next control periods of m copies of an environment.

    They are independent and uniform in ``nominal * (1 - jitter)`` to ``nominal * (1 + jitter)``.
    """
    return nominal * (1.0 + jitter * np.array([rng.uniform(-1.0, 1.0) for rng in rngs]))


def checked_jitter(jitter: float) -> None:
    """Check the relative half width of the range of control periods.

    Raises:
        ConfigurationError: outside [0, 1).
    """
    if not 0.0 <= jitter < 1.0:
        raise ConfigurationError(
            f"jitter = {jitter!r:.60}, but it must lie in [0, 1): control periods are "
            "dt (1 - jitter) to dt (1 + jitter)"
        )
