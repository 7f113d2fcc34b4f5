"""Subsampling: uniform, with probability proportional to size (PPS), and systematic resampling."""

from __future__ import annotations

import numpy as np

from kreps.kernels.arrays import FloatArray, IntArray

FIT_SAMPLE_SIZE = 200
"""Samples on which hyper-parameters are fitted.  The cost of a fit is cubic in it.  More samples
did not improve the learnt policies: 300 and 400 were tried before."""

UNIFORM_SHARE = 0.5
"""Share of the inclusion probability that is equal for all rows in `pps_subsample`.  It bounds the
weight of any row by twice that of a uniform draw, so that the weighted error stays precise where
targets are small."""


def uniform_subsample(n: int, rng: np.random.Generator, size: int = FIT_SAMPLE_SIZE) -> IntArray:
    """At most ``size`` row numbers out of n, in ascending order, without replacement."""
    if n <= size:
        return np.arange(n)
    return np.sort(rng.choice(n, size, replace=False))


def pps_subsample(
    squares: FloatArray, rng: np.random.Generator, size: int = FIT_SAMPLE_SIZE
) -> tuple[IntArray, FloatArray]:
    """At most ``size`` row numbers in ascending order, and their inverse inclusion probabilities.

    A uniform draw misses rare large targets, such as a goal that few rollouts reach, and a fit
    without them predicts that the goal does not exist.  So the inclusion probability is half
    uniform and half proportional to the squared target.  Weighted by its inverse, the mean of any
    function of the rows is an unbiased estimate of that over all rows (Horvitz and Thompson 1952).

    Args:
        squares: (n,) squared norms of the targets.
        rng: draws the rows.
        size: number of rows, up to one less where rounding makes two draws meet.

    Returns:
        The rows (m,), and how many of all rows each stands for, (m,).
    """
    n = len(squares)
    if n <= size:
        return np.arange(n), np.ones(n)
    uniform = np.full(n, 1.0 / n)
    total = float(squares.sum())
    proportional = squares / total if total > 0.0 else uniform
    share = UNIFORM_SHARE * uniform + (1.0 - UNIFORM_SHARE) * proportional
    probabilities = inclusion_probabilities(share, size)
    # Systematic sampling in random order: one row in each unit of the cumulated probabilities, of
    # which none exceeds one.
    order = rng.permutation(n)
    points = rng.uniform() + np.arange(size)
    positions = np.searchsorted(np.cumsum(probabilities[order]), points)
    rows = np.sort(order[np.unique(np.minimum(positions, n - 1))])
    return rows, 1.0 / probabilities[rows]


def inclusion_probabilities(share: FloatArray, count: int) -> FloatArray:
    """Probabilities (n,) that sum to ``count`` < n: proportional to ``share``, but at most one."""
    probabilities = count * share
    certain = np.zeros(len(share), dtype=bool)
    while (probabilities > 1.0).any():
        certain |= probabilities > 1.0
        left = count - np.count_nonzero(certain)
        probabilities = np.where(certain, 1.0, left * share / share[~certain].sum())
    return probabilities


def effective_target_count(squares: FloatArray, weights: FloatArray) -> float:
    """``(sum w q)^2 / sum w q^2``: the number of equal errors that determine a fit as well.

    Errors are taken to be as large as the targets.  If one goal stands among rows of zeros, the
    count is one: the data hardly constrain the hyper-parameters and their prior should decide.
    Rows outside the subsample count through the weights of those that represent them.

    Args:
        squares: (m,) squared norms q of the targets.
        weights: (m,) how many rows w each stands for.
    """
    largest = float(squares.max(initial=0.0))
    if largest == 0.0:
        return float(weights.sum())
    relative = squares / largest
    mass = weights * relative
    return float(mass.sum()) ** 2 / float(mass @ relative)


def systematic_resampling(p: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """``count`` row numbers in ascending order, row i at least ``floor(count p_i)`` times.

    Args:
        p: (n,) probabilities, up to a common factor.
        count: number of draws.
        rng: draws the one offset that all draws share.
    """
    points = (np.arange(count) + rng.uniform()) / count
    return np.minimum(np.searchsorted(np.cumsum(p), points * p.sum()), len(p) - 1)
