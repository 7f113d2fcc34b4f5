"""Gram matrices, which cost one thin matrix product and one exponential."""

from __future__ import annotations

import flops
import numpy as np
import pytest
from criteria import Share, TimesAsLong, TimesFaster
from measuring import Measure

from kreps.envs.image_swing_up import image
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel, Periodic, SquaredExponential, factors_of

RNG = np.random.default_rng(0)


def as_printed(x: FloatArray) -> FloatArray:
    """The printed formula: product of the kernels of an angle and two inputs, lengthscales 1."""
    angle, speed, action = (x[:, i, None] - x[:, i] for i in range(3))
    return (
        np.exp(-2.0 * np.sin(0.5 * angle) ** 2) * np.exp(-0.5 * speed**2) * np.exp(-0.5 * action**2)
    )


@pytest.mark.parametrize("n", [500, 1500, 3000, 6000])
def bench_gram_of_three_inputs(measure: Measure, n: int) -> None:
    x = RNG.standard_normal((n, 3))
    factors = (Periodic((0,)), SquaredExponential((1,)), SquaredExponential((2,)))
    kernel = Kernel(factors, np.ones(3))
    exponents = np.log(as_printed(x))
    limited = n >= 1500
    measure(
        "Gram matrix of angle, speed and action",
        f"n = {n}",
        lambda: kernel.gram(x),
        TimesAsLong("numpy.exp", lambda: np.exp(exponents), at_most=1.5 if limited else None),
        TimesFaster("the formula", lambda: as_printed(x), at_least=8.0 if limited else None),
    )


@pytest.mark.parametrize("n", [1500, 3000])
def bench_gram_of_images(measure: Measure, n: int) -> None:
    """800 unsmoothed pixel values; the kernel of the image swing-up smooths to far fewer."""
    angles = RNG.uniform(-np.pi, np.pi, n)
    x = np.concatenate([image(angles), image(angles) - image(angles + 0.1)], axis=1)
    groups = (tuple(range(400)), tuple(range(400, 800)))
    sharp = Kernel(factors_of(800, groups=groups), np.array([10.0, 3.0]))
    smooth = Kernel(factors_of(800, groups=groups, image_shape=(20, 20)), np.array([20.0, 6.0]))
    nominal = flops.product(n, n, 800)
    measure(
        "Gram matrix of images",
        f"n = {n}",
        lambda: sharp.gram(x),
        Share(nominal, nominal=True, at_least=1.1),
        TimesAsLong("smoothed images", lambda: smooth.gram(x)),
    )
