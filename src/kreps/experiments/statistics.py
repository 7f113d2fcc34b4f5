"""Means over seeds: intervals that hold for few and uneven seeds, tests, and Holm's correction.

The location of a sample is its trimmed mean.  With a quarter trimmed at each end it is the
interquartile mean (IQM), with nothing trimmed the mean.

An interval is the hull of two: the percentile bootstrap over seeds, and the t interval from the
winsorised variance (Tukey and McLaughlin 1963; Yuen 1974 for differences).  The bootstrap is too
narrow for ten seeds of any distribution.  The t interval is too narrow where about as many seeds
fail as are trimmed.  ``benchmarks/coverage.py`` measures how often the hull holds the true value.

No interval can hold the mean of a distribution whose rare failures are not in the sample: if one
seed in ten fails, a third of all samples of ten seeds have no failure.  So verdicts are about the
IQM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

from kreps.kernels.arrays import FloatArray

QUARTER = 0.25
"""Share of the seeds that the interquartile mean leaves out at each end."""

RESAMPLES = 9999


@dataclass(frozen=True)
class Effect:
    """A location, or a difference of two.

    Attributes:
        estimate: from the seeds at hand.
        error: its standard error.
        freedom: degrees of freedom of the error.
        resampled: (RESAMPLES,) estimates from seeds drawn with replacement, sorted.
    """

    estimate: float
    error: float
    freedom: float
    resampled: FloatArray

    def interval(self, level: float) -> tuple[float, float]:
        """The ends of the interval that holds the true value with this probability."""
        half = float(stdtrit(self.freedom, (1.0 + level) / 2.0)) * self.error
        cut = max(int((1.0 - level) / 2.0 * (len(self.resampled) + 1) + 1e-9), 1)
        low = min(self.estimate - half, float(self.resampled[cut - 1]))
        high = max(self.estimate + half, float(self.resampled[-cut]))
        return low, high

    def p_value(self, value: float) -> float:
        """Two-sided: one minus the level of the largest interval that leaves the value out."""
        away = abs(self.estimate - value)
        by_t = (
            2.0 * float(stdtr(self.freedom, -away / self.error)) if self.error else float(not away)
        )
        beyond = min(np.sum(self.resampled <= value), np.sum(self.resampled >= value))
        by_bootstrap = 2.0 * (float(beyond) + 1.0) / (len(self.resampled) + 1)
        return min(max(by_t, by_bootstrap), 1.0)


def effect_of(
    samples: Sequence[FloatArray],
    rng: np.random.Generator,
    *,
    trimmed: float = QUARTER,
    resamples: int = RESAMPLES,
) -> Effect:
    """The location of one sample, or of the first less that of the second.

    Args:
        samples: one array (seeds,), or two independent ones.  Pairs are one array of differences.
        rng: draws the seeds of each resample.
        trimmed: share left out at each end; 0 gives the mean.
        resamples: of the bootstrap.
    """
    found, resampled = [], []
    for sample in samples:
        found.append(_location(sample, trimmed))
        drawn = sample[rng.integers(0, len(sample), (resamples, len(sample)))]
        resampled.append(_location(drawn, trimmed)[0])
    variances = [float(variance) for _, variance, _ in found]
    freedom = found[0][2]
    if len(found) == 2 and sum(variances) > 0.0:  # Welch
        parts = (v**2 / f for v, (_, _, f) in zip(variances, found, strict=True))
        freedom = sum(variances) ** 2 / sum(parts)
    return Effect(
        float(_difference([location for location, _, _ in found])),
        float(np.sqrt(sum(variances))),
        freedom,
        np.sort(_difference(resampled)),
    )


def _difference(values: Sequence[FloatArray]) -> FloatArray:
    return values[0] if len(values) == 1 else values[0] - values[1]


def _location(sample: FloatArray, trimmed: float) -> tuple[FloatArray, FloatArray, float]:
    """Trimmed mean along the last axis, its squared standard error, and degrees of freedom."""
    number = sample.shape[-1]
    cut = int(trimmed * number)
    kept = number - 2 * cut
    values = np.sort(sample, axis=-1)
    inner = values[..., cut : number - cut]
    winsorised = np.clip(values, inner[..., :1], inner[..., -1:])
    # not by the mean: equal values have a variance of exactly zero then
    centred = winsorised - inner[..., :1]
    variance = (number - 1) * centred.var(axis=-1, ddof=1) / (kept * (kept - 1))
    return inner.mean(axis=-1), variance, float(kept - 1)


def probability_of_superiority(samples: Sequence[FloatArray]) -> float:
    """Effect size between 0 and 1: how often the first is larger, equal ones counted half.

    Args:
        samples: one array of differences, compared with zero; or two arrays, of which all pairs
            are compared (the statistic of Mann and Whitney).
    """
    first = samples[0]
    second = samples[1] if len(samples) == 2 else np.zeros(1)
    return float(np.mean((np.sign(first[:, None] - second) + 1.0) / 2.0))


def holm_levels(p_values: Sequence[float], error: float = 0.05) -> list[float]:
    """Levels at which intervals are drawn so that all hold together (Holm 1979).

    The smallest of m p-values is compared with ``error / m``, the next one with
    ``error / (m - 1)``, and so on.  From the first that is larger than its share on, that share is
    the one of all that follow, and none of them is significant.

    Args:
        p_values: of all tests.
        error: probability of any false verdict.

    Returns:
        For each test one minus its share.
    """
    levels = [0.0] * len(p_values)
    share, passed = 0.0, True
    for rank, index in enumerate(np.argsort(p_values, kind="stable")):
        if passed:
            share = error / (len(p_values) - rank)
            passed = p_values[index] <= share
        levels[index] = 1.0 - share
    return levels


def holm_adjusted(p_values: Sequence[float]) -> list[float]:
    """Holm's p-values: at most the error that is accepted means significant."""
    adjusted = [0.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(np.argsort(p_values, kind="stable")):
        largest = max(largest, min((len(p_values) - rank) * p_values[index], 1.0))
        adjusted[index] = largest
    return adjusted
