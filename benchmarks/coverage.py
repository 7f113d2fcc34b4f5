"""Measures how often intervals of a mean over seeds hold the true value: results/coverage.md.

    python benchmarks/coverage.py

Samples are drawn from known distributions: one of scores, or two independent ones whose difference
is sought.  A seed that fails earns 40 less, as in a local optimum of the swing-up.  Each number is
the share of the samples whose interval holds the true value; 0.95 is asked for, and in the last
column as much as Holm's correction asks of the smallest p-value of 23.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import bootstrap, trim_mean

from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.experiments.statistics import QUARTER, effect_of
from kreps.experiments.tables import markdown
from kreps.kernels.arrays import FloatArray
from kreps.versions import versions

Draw = Callable[[np.random.Generator, tuple[int, ...]], FloatArray]

LEVEL, CORRECTED = 0.95, 1.0 - 0.05 / 23
RESAMPLES = 1999
EXACT = 4_000_000
"""Draws from which the true value is computed."""


def failing(share: float) -> Draw:
    """Normal scores, of which a share is 40 lower."""

    def draw(rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        return np.where(rng.random(shape) < share, -40.0, 0.0) + 0.5 * rng.standard_normal(shape)

    return draw


def skewed(rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
    """Minus log-normal scores: a long tail of bad ones."""
    return -np.exp(rng.standard_normal(shape))


CASES: dict[str, tuple[Draw, ...]] = {
    "normal": (failing(0.0),),
    "skewed (log-normal)": (skewed,),
    "1 in 30 fails": (failing(1 / 30),),
    "1 in 10 fails": (failing(0.1),),
    "1 in 5 fails": (failing(0.2),),
    "3 in 10 fail": (failing(0.3),),
    "half fail": (failing(0.5),),
    "none - 1 in 10 fails": (failing(0.0), failing(0.1)),
    "1 in 10 - 3 in 10 fail": (failing(0.1), failing(0.3)),
    "normal - skewed": (failing(0.0), skewed),
}
"""By name: the distribution of a sample, or of two."""


@cache
def true_value(draws: tuple[Draw, ...], trimmed: float) -> float:
    """The trimmed mean of a distribution, or the difference of two."""
    values = [trim_mean(draw(np.random.default_rng(1), (EXACT,)), trimmed) for draw in draws]
    return float(values[0] if len(values) == 1 else values[0] - values[1])


def usual(
    samples: Sequence[FloatArray], trimmed: float, method: str, seed: int
) -> tuple[float, float]:
    """SciPy's interval by the bootstrap."""

    def statistic(*resampled: FloatArray, axis: int = -1) -> FloatArray:
        values = [trim_mean(each, trimmed, axis=axis) for each in resampled]
        return values[0] if len(values) == 1 else values[0] - values[1]

    found = bootstrap(
        samples,
        statistic,
        n_resamples=RESAMPLES,
        method=method,
        vectorized=True,
        confidence_level=LEVEL,
        random_state=np.random.default_rng(seed),
    ).confidence_interval
    return float(found.low), float(found.high)


def hull(
    samples: Sequence[FloatArray], trimmed: float, level: float, seed: int
) -> tuple[float, float]:
    """The interval of `kreps.experiments.statistics`."""
    rng = np.random.default_rng(seed)
    return effect_of(samples, rng, trimmed=trimmed, resamples=RESAMPLES).interval(level)


Interval = Callable[[Sequence[FloatArray], int], tuple[float, float]]

METHODS: dict[str, tuple[float, Interval]] = {
    "mean, percentile": (0.0, lambda s, i: usual(s, 0.0, "percentile", i)),
    "mean, BCa": (0.0, lambda s, i: usual(s, 0.0, "BCa", i)),
    "mean, hull": (0.0, lambda s, i: hull(s, 0.0, LEVEL, i)),
    "IQM, percentile": (QUARTER, lambda s, i: usual(s, QUARTER, "percentile", i)),
    "IQM, BCa": (QUARTER, lambda s, i: usual(s, QUARTER, "BCa", i)),
    "IQM, hull": (QUARTER, lambda s, i: hull(s, QUARTER, LEVEL, i)),
    "IQM, hull, 23 claims": (QUARTER, lambda s, i: hull(s, QUARTER, CORRECTED, i)),
}
"""By name: the trimmed share, and the interval of some samples with a seed."""


def coverage(
    draws: tuple[Draw, ...], trimmed: float, interval: Interval, seeds: int, samples: int
) -> float:
    """Share of samples of so many seeds whose interval holds the true value."""
    value = true_value(draws, trimmed)
    held = 0
    for number in range(samples):
        rng = np.random.default_rng((2, number))
        low, high = interval([draw(rng, (seeds,)) for draw in draws], number)
        held += low <= value <= high
    return held / samples


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The documentation's table."""
    return markdown(
        ("seeds", "scores", *METHODS),
        [
            (str(row["seeds"]), row["scores"], *(f"{row[name]:.3f}" for name in METHODS))
            for row in rows
        ],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path("results"))
    arguments = parser.parse_args()
    source, code = commit(), script_fingerprint(Path(__file__))
    rows: list[dict[str, Any]] = []
    for seeds in (10, 30):
        for name, draws in CASES.items():
            shares = {
                method: coverage(draws, trimmed, interval, seeds, arguments.samples)
                for method, (trimmed, interval) in METHODS.items()
            }
            rows.append({"seeds": seeds, "scores": name, **shares})
            print(rows[-1], flush=True)
    content = {
        "command": "python benchmarks/coverage.py",
        "commit": source,
        "versions": versions(),
        "samples": arguments.samples,
        "resamples": RESAMPLES,
        "levels": [LEVEL, CORRECTED],
        "rows": rows,
        "code": code,
    }
    (arguments.out / "coverage.json").write_text(json.dumps(content, indent=1) + "\n")
    (arguments.out / "coverage.md").write_text(table(rows) + "\n")


if __name__ == "__main__":
    main()
