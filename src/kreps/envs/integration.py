"""Integration of the equations of motion over one control period."""

from __future__ import annotations

from collections.abc import Callable

from kreps.kernels.arrays import FloatArray


def runge_kutta(
    derivative: Callable[[FloatArray], FloatArray], state: FloatArray, time: float, steps: int
) -> FloatArray:
    """The state after ``time`` seconds, by the Runge-Kutta method of order four.

    Args:
        derivative: time derivative of a state, with the input held constant.
        state: at the beginning; of any shape.
        time: in seconds.
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
