"""One step of control: Runge-Kutta of order four under a held input."""

from __future__ import annotations

from collections.abc import Callable

from kreps.kernels.arrays import FloatArray


def runge_kutta(
    derivative: Callable[[FloatArray], FloatArray], state: FloatArray, time: float, steps: int
) -> FloatArray:
    """``state`` after ``time`` seconds in ``steps`` equal sub-steps; any shape."""
    h = time / steps
    for _ in range(steps):
        k1 = derivative(state)
        k2 = derivative(state + 0.5 * h * k1)
        k3 = derivative(state + 0.5 * h * k2)
        k4 = derivative(state + h * k3)
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return state
