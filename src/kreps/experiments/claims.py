"""The paper's claims, each tested by a comparison of two groups of seeds.

The effect is a difference of means between two curves, or a gain within one curve, in reward per
step.  Its sign is chosen so that a positive effect supports the paper.  Its 95 % interval is a
percentile bootstrap over seeds, resampled within each curve.

A claim is *confirmed* if the interval lies above a limit, *contradicted* if it lies below, and *not
separated* otherwise.  The limit is zero for "better".  For "as good as" it is minus a margin: a
twentieth of the difference between the first policy and the best known one.  A claim that two
curves end equal, or that one no longer changes, is confirmed if the interval lies within the margin
around zero, and contradicted if it lies outside.

With fewer than `MIN_SEEDS` seeds or `MIN_ITERATIONS` iterations there is no interval, no verdict.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from kreps.errors import StorageError
from kreps.experiments.figures import named_rows
from kreps.experiments.specs import FEATURES, GRID_VI, KERNEL, NPALP, SAMPLE, VALUES
from kreps.experiments.tables import markdown
from kreps.kernels.arrays import FloatArray
from kreps.learning.storage import write_atomically
from kreps.seeding import Purpose, generator

RESAMPLES = 9999

Rows = Sequence[Mapping[str, str]]
Measure = Callable[[Rows], float]
"""Maps the rows of one seed, in the order of their iterations, to a number."""

EARLY = 4
"""Number of iterations at the start over which `early` averages."""

LATE = 5
"""Number of iterations at the end over which `late` averages."""

MIN_SEEDS = 6
"""Seeds of each curve that a verdict needs.

If six seeds all have the same sign, a two-sided sign test gives 2 / 2^6 = 3 %; five give at least
6 %.
"""

MIN_ITERATIONS = EARLY + 2 * LATE
"""Iterations that a verdict needs: first, following and last ones then do not overlap."""

MARGINS = {"figure-1a": 0.04, "figure-1b": 4.0, "figure-2b": 4.0}
"""Margins in reward per step: a twentieth of best known minus first policy, rounded."""


def _mean(rows: Rows, name: str) -> float:
    return float(np.mean([float(row[name]) for row in rows]))


def early(rows: Rows) -> float:
    """Evaluated reward with exploration, mean over the first iterations."""
    return _mean(rows[:EARLY], "stochastic")


def late(rows: Rows) -> float:
    """Evaluated reward with exploration, mean over the last iterations."""
    return _mean(rows[-LATE:], "stochastic")


def late_greedy(rows: Rows) -> float:
    """Evaluated reward without exploration, mean over the last iterations."""
    return _mean(rows[-LATE:], "greedy")


def whole(rows: Rows) -> float:
    """Evaluated reward with exploration, mean over all iterations: measures speed of learning."""
    return _mean(rows, "stochastic")


def later_gain(rows: Rows) -> float:
    """`late` minus the same mean over the `LATE` iterations that follow the first `EARLY` ones."""
    return late(rows) - _mean(rows[EARLY : EARLY + LATE], "stochastic")


def steadiness(rows: Rows) -> float:
    """Minus the mean drop between iterations (a rise counts as zero), over the second half."""
    values = np.array([float(row["stochastic"]) for row in rows[len(rows) // 2 :]])
    return float(np.mean(np.minimum(np.diff(values), 0.0)))


class Kind(StrEnum):
    """The kind of difference that a claim asserts."""

    BETTER = "better"
    AS_GOOD = "at least as good"
    EQUAL = "equal"


@dataclass(frozen=True)
class Claim:
    """One claim of the paper.

    Attributes:
        text: the claim in words.
        figure: key of `FIGURES`; its result file holds the rows.
        better, worse: names of curves in the figure.  The claim is that ``better`` has the larger
            measure.  If ``worse`` is None, the measure of ``better`` is compared with zero.
        measure: is computed for each seed.
        kind: of difference.
    """

    text: str
    figure: str
    better: str
    worse: str | None
    measure: Measure
    kind: Kind = Kind.BETTER


def _on_images(method: str) -> str:
    return f"{method}, images"


_1A, _1B, _2B = "figure-1a", "figure-1b", "figure-2b"

CLAIMS = (
    Claim(
        "Reaching: the sample model is at least as good as the embedding, as the task is "
        "deterministic",
        *(_1A, SAMPLE, KERNEL, late, Kind.AS_GOOD),
    ),
    Claim("Reaching: the embedding learns more slowly", _1A, SAMPLE, KERNEL, whole),
    Claim("Reaching: NPALP is good after a few iterations", _1A, NPALP, KERNEL, early),
    Claim("Reaching: value iteration is good after a few iterations", _1A, VALUES, KERNEL, early),
    Claim("Reaching: NPALP then stops improving", _1A, NPALP, None, later_gain, Kind.EQUAL),
    Claim(
        "Reaching: value iteration then stops improving",
        *(_1A, VALUES, None, later_gain, Kind.EQUAL),
    ),
    Claim("Reaching: kernel REPS goes on improving", _1A, KERNEL, None, later_gain),
    Claim("Reaching: kernel REPS ends better than NPALP", _1A, KERNEL, NPALP, late),
    Claim("Reaching: the same without exploration", _1A, KERNEL, NPALP, late_greedy),
    Claim("Reaching: kernel REPS ends better than value iteration", _1A, KERNEL, VALUES, late),
    Claim("Reaching: the same without exploration", _1A, KERNEL, VALUES, late_greedy),
    Claim(
        "Reaching: value iteration on a grid fails (ends worse than on-policy value iteration)",
        *(_1A, VALUES, GRID_VI, late_greedy),
    ),
    Claim(
        "Swing-up: kernel REPS ends better than on-policy value iteration",
        *(_1B, KERNEL, VALUES, late),
    ),
    Claim("Swing-up: the same without exploration", _1B, KERNEL, VALUES, late_greedy),
    Claim(
        "Swing-up: kernel REPS ends better than REPS on fixed features",
        *(_1B, KERNEL, FEATURES, late),
    ),
    Claim(
        "Swing-up: REPS on fixed features performs well initially (as well as kernel REPS)",
        *(_1B, FEATURES, KERNEL, early, Kind.AS_GOOD),
    ),
    Claim("Swing-up: the sample model ends considerably worse", _1B, KERNEL, SAMPLE, late),
    Claim(
        "Swing-up: on-policy value iteration starts out competitively",
        *(_1B, VALUES, KERNEL, early, Kind.AS_GOOD),
    ),
    Claim(
        "Swing-up: on-policy value iteration is unstable, kernel REPS is smooth",
        *(_1B, KERNEL, VALUES, steadiness),
    ),
    Claim(
        "Swing-up: value iteration on a grid works well (as well as kernel REPS)",
        *(_1B, GRID_VI, KERNEL, late_greedy, Kind.AS_GOOD),
    ),
    Claim(
        "Images: learning is a bit slower than from joint values",
        *(_2B, f"{KERNEL}, swing-up", _on_images(KERNEL), whole),
    ),
    Claim(
        "Images: the final solution is equally good",
        *(_2B, _on_images(KERNEL), f"{KERNEL}, swing-up", late, Kind.EQUAL),
    ),
    Claim(
        "Images: kernel REPS ends better than the sample model (shown, not stated)",
        *(_2B, _on_images(KERNEL), _on_images(SAMPLE), late),
    ),
)


def by_seed(rows: Rows, curve: str, measure: Measure, iterations: int) -> FloatArray:
    """The measure of each seed of a curve, (seeds,), from its first ``iterations`` rows."""
    mine = [r for r in rows if r["method"] == curve and int(r["iteration"]) <= iterations]
    seeds = sorted({int(row["seed"]) for row in mine})
    of_seed = [
        sorted((r for r in mine if int(r["seed"]) == seed), key=lambda r: int(r["iteration"]))
        for seed in seeds
    ]
    return np.array([measure(each) for each in of_seed])


def common_iterations(rows: Rows, curves: Sequence[str]) -> int:
    """The number of iterations that all curves have; curves with one iteration do not count."""
    last = [max((int(r["iteration"]) for r in rows if r["method"] == c), default=0) for c in curves]
    return min((number for number in last if number > 1), default=1)


def verdict(low: float, high: float, kind: Kind, margin: float) -> str:
    """The verdict on a claim.

    Args:
        low, high: ends of the interval of the effect.
        kind: of the claim.
        margin: in the unit of the effect; without influence on ``Kind.BETTER``.
    """
    if kind is Kind.EQUAL:
        if -margin <= low and high <= margin:
            return "confirmed"
        return "contradicted" if low > margin or high < -margin else "not separated"
    limit = 0.0 if kind is Kind.BETTER else -margin
    return "confirmed" if low > limit else "contradicted" if high < limit else "not separated"


def assess(claim: Claim, rows: Rows) -> dict[str, Any] | None:
    """Effect, interval and verdict of a claim.

    Args:
        claim: to be tested.
        rows: of its figure, as ``csv.DictReader`` reads them.

    Returns:
        A row of ``claims.json``.  Without a verdict, which has the reason in its place, its numbers
        are None.  The row itself is None if the rows hold no seed of a curve.
    """
    rows = named_rows(rows)
    curves = [claim.better] if claim.worse is None else [claim.better, claim.worse]
    iterations = common_iterations(rows, curves)
    seeds = [len({row["seed"] for row in rows if row["method"] == curve}) for curve in curves]
    if not all(seeds):
        return None
    numbers: dict[str, float | None] = {"effect": None, "low": None, "high": None}
    judgement = too_few(seeds, iterations)
    if not judgement:
        samples = [by_seed(rows, curve, claim.measure, iterations) for curve in curves]
        effect, low, high = interval(samples)
        numbers = {"effect": round(effect, 4), "low": round(low, 4), "high": round(high, 4)}
        judgement = verdict(low, high, claim.kind, MARGINS[claim.figure])
    return {
        "claim": claim.text,
        "figure": claim.figure,
        "comparison": claim.better if claim.worse is None else f"{claim.better} - {claim.worse}",
        "measure": claim.measure.__name__.replace("_", " "),
        "iterations": iterations,
        "kind": claim.kind.value,
        "margin": 0.0 if claim.kind is Kind.BETTER else MARGINS[claim.figure],
        **numbers,
        "seeds": seeds,
        "verdict": judgement,
    }


def too_few(seeds: Sequence[int], iterations: int) -> str:
    """Why there is no verdict: too few seeds of a curve, or iterations; empty if there is one."""
    if min(seeds) < MIN_SEEDS:
        return f"too few seeds: {min(seeds)}, at least {MIN_SEEDS}"
    if iterations < MIN_ITERATIONS:
        return f"too few iterations: {iterations}, at least {MIN_ITERATIONS}"
    return ""


def interval(samples: Sequence[FloatArray]) -> tuple[float, float, float]:
    """Mean, or difference of two means, and the ends of its 95 % interval.

    Args:
        samples: one or two arrays (seeds,).
    """
    from scipy.stats import bootstrap  # slow to import, and only needed here

    def effect(*resampled: FloatArray, axis: int = -1) -> FloatArray:
        means = [each.mean(axis=axis) for each in resampled]
        return means[0] if len(means) == 1 else means[0] - means[1]

    found = bootstrap(
        samples,
        effect,
        n_resamples=RESAMPLES,
        method="percentile",
        vectorized=True,
        random_state=generator(0, Purpose.BOOTSTRAP),
    ).confidence_interval
    return float(effect(*samples)), float(found.low), float(found.high)


def write_claims(folder: Path) -> list[Path]:
    """Write ``claims.json`` and ``claims.md`` from the result files in a folder.

    Returns:
        Their paths; nothing if the folder holds no result file of a claim.

    Raises:
        StorageError: a result file is damaged, or a file cannot be written.
    """
    assessed = []
    for claim in CLAIMS:
        path = folder / f"{claim.figure}.csv"
        if path.exists():
            try:
                with open(path, newline="") as file:
                    assessed.append(assess(claim, list(csv.DictReader(file))))
            except (KeyError, ValueError, TypeError) as error:
                raise StorageError(
                    f"{path} is damaged or foreign ({error!r}); make it again with "
                    f"`kreps reproduce {claim.figure}`"
                ) from error
    found = [each for each in assessed if each is not None]
    if not found:
        return []
    write_atomically(folder / "claims.json", (json.dumps(found, indent=1) + "\n").encode())
    write_atomically(folder / "claims.md", (claims_table(found) + "\n").encode())
    return [folder / "claims.json", folder / "claims.md"]


def claims_table(assessed: Sequence[Mapping[str, Any]]) -> str:
    """The documentation's table of all claims."""
    rows = []
    for each in assessed:
        effect, range_ = "–", "–"
        if each["effect"] is not None:
            places = 1 if max(abs(each["low"]), abs(each["high"])) >= 1 else 3
            effect, low, high = (f"{each[name]:+.{places}f}" for name in ("effect", "low", "high"))
            range_ = f"{low} to {high}"
        kind = each["kind"] + (f" (margin {each['margin']:g})" if each["margin"] else "")
        rows.append(
            [
                each["claim"],
                f"{each['measure']}: {each['comparison']}",
                effect,
                range_,
                kind,
                f"**{each['verdict']}**",
            ]
        )
    headings = ("claim", "measure", "effect", "95 % interval", "to be confirmed as", "verdict")
    return markdown(headings, rows)
