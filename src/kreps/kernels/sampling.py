"""The conditional embedding fitted to a window of transitions, as several methods need it.

And what every step of REPS makes of it: the differences of features, restarts included.
"""

from __future__ import annotations

import numpy as np

from kreps.kernels.arrays import FloatArray, IntArray

FIT_SAMPLE = 200
"""Samples on which hyper-parameters are fitted: the cost is cubic, the estimate no better."""


def uniform_subsample(n: int, rng: np.random.Generator) -> IntArray:
    """At most `FIT_SAMPLE` row numbers out of n, in order."""
    if n <= FIT_SAMPLE:
        return np.arange(n)
    return np.sort(rng.choice(n, FIT_SAMPLE, replace=False))


def pps_subsample(squares: FloatArray, rng: np.random.Generator) -> tuple[IntArray, FloatArray]:
    """At most `FIT_SAMPLE` row numbers, in order, and how many of all rows each stands for, (m,).

    A goal that is seldom reached, or an end, is in a handful of many samples, and a fit that sees
    none of them makes a model without it.  So half of the chance to be chosen is equal for all and
    half goes by the square of what is to be predicted; each row then counts by the inverse of its
    chance (importance sampling), so that the mean error is that of all rows, only less noisy.

    Args:
        squares: (n,) of what is to be predicted.
        rng: of the choice.
    """
    n = len(squares)
    if n <= FIT_SAMPLE:
        return np.arange(n), np.ones(n)
    equal = np.full(n, 1.0 / n)
    total = float(squares.sum())
    share = 0.5 * equal + 0.5 * (squares / total if total > 0.0 else equal)
    chance = inclusion_probabilities(share, FIT_SAMPLE)
    # systematic, in random order: one in each unit of the summed chances, none of which exceeds one
    order = rng.permutation(n)
    marks = rng.uniform() + np.arange(FIT_SAMPLE)
    places = np.unique(np.minimum(np.searchsorted(np.cumsum(chance[order]), marks), n - 1))
    rows = np.sort(order[places])
    return rows, 1.0 / chance[rows]


def effective_target_count(squares: FloatArray, weights: FloatArray) -> float:
    """How many errors of equal size those of all rows are worth: an effective sample size.

    Errors are taken to be as large as what is to be predicted.  If that is one goal among rows of
    nothing, most hyper-parameters are as good as others, and a prior has to choose.  Rows that the
    fit only has an estimate of count like those it sees: they would say the same.

    Args:
        squares: (m,) of what is to be predicted.
        weights: (m,) how many rows each stands for.
    """
    most = float(squares.max(initial=0.0))
    if most == 0.0:
        return float(weights.sum())
    mass = weights * (squares / most)
    return float(mass.sum()) ** 2 / float(mass @ (squares / most))


def inclusion_probabilities(share: FloatArray, count: int) -> FloatArray:
    """Chances (n,) that add up to ``count`` < n: ``share`` times a number, but none above one."""
    chance = count * share
    certain = np.zeros(len(share), dtype=bool)
    while (chance > 1.0).any():
        certain |= chance > 1.0
        left = count - np.count_nonzero(certain)
        chance = np.where(certain, 1.0, left * share / share[~certain].sum())
    return chance


def systematic_resampling(p: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """``count`` sample numbers in order, i at least ``floor(count p_i)`` times (systematic)."""
    places = (np.arange(count) + rng.uniform()) / count
    return np.minimum(np.searchsorted(np.cumsum(p), places * p.sum()), len(p) - 1)
