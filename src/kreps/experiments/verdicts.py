"""Verdicts on the paper's claims, from the result files of its figures.

Two curves are paired by seed where they share their first rollouts: then the differences of the
seeds are tested, else the difference of the curves.  The effect is the interquartile mean over
seeds, and the mean is reported beside it.  Its interval has the level that Holm's correction over
all claims gives it, so that with a probability of 95 % no verdict at all is false.

A claim is *confirmed* if the interval lies above a limit, *contradicted* if it lies below, and *not
separated* otherwise.  The limit is zero for "better", and the effect must also be larger than a
margin: an interval on one side of zero with a smaller effect is *within the margin*.  For "as good
as" the limit is minus the margin.  A claim that two curves end equal, or that one no longer
changes, is confirmed if the interval lies within the margin around zero, and contradicted if it
lies outside.  With fewer than `MIN_SEEDS` seeds or `MIN_ITERATIONS` iterations there is no verdict.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kreps.errors import StorageError
from kreps.experiments.claims import CLAIMS, EARLY, LATE, Claim, Kind, Rows
from kreps.experiments.figures import named_rows
from kreps.experiments.statistics import (
    QUARTER,
    Effect,
    effect_of,
    holm_adjusted,
    holm_levels,
    probability_of_superiority,
)
from kreps.experiments.tables import markdown
from kreps.kernels.arrays import FloatArray
from kreps.learning.storage import write_atomically
from kreps.seeding import Purpose, generator

MIN_SEEDS = 6
"""Seeds of each curve that a verdict needs.

If six seeds all have the same sign, a two-sided sign test gives 2 / 2^6 = 3 %; five give at least
6 %.
"""

MIN_ITERATIONS = EARLY + 2 * LATE
"""Iterations that a verdict needs: first, following and last ones then do not overlap."""


@dataclass(frozen=True)
class Comparison:
    """What the seeds say about a claim.

    Attributes:
        claim: that is tested.
        iterations: that are compared.
        seeds: number of each curve.
        paired: whether the sample is of differences of seeds.
        samples: one or two arrays (seeds,) of the measure; none if there are too few seeds or
            iterations.
    """

    claim: Claim
    iterations: int
    seeds: tuple[int, ...]
    paired: bool
    samples: tuple[FloatArray, ...]

    def effect(self, trimmed: float = QUARTER) -> Effect:
        """The interquartile mean over seeds, or with ``trimmed=0`` the mean."""
        return effect_of(self.samples, generator(0, Purpose.BOOTSTRAP), trimmed=trimmed)


def by_seed(rows: Rows, curve: str, iterations: int) -> dict[int, Rows]:
    """The first ``iterations`` rows of each seed of a curve, in their order."""
    grouped: dict[int, list[Mapping[str, str]]] = {}
    for row in rows:
        if row["method"] == curve and int(row["iteration"]) <= iterations:
            grouped.setdefault(int(row["seed"]), []).append(row)
    return {
        seed: sorted(grouped[seed], key=lambda row: int(row["iteration"]))
        for seed in sorted(grouped)
    }


def share_first_rollouts(rows: Rows, curves: Sequence[str]) -> bool:
    """Whether the curves have the same seeds, each with the same rollouts before the first update.

    These are the same if their steps and their average reward are.
    """
    first = [
        {
            row["seed"]: (row["steps"], row["training_reward"])
            for row in rows
            if row["method"] == curve and int(row["iteration"]) == 1
        }
        for curve in curves
    ]
    return all(each == first[0] for each in first)


def common_iterations(rows: Rows, curves: Sequence[str]) -> int:
    """The number of iterations that all curves have; curves with one iteration do not count."""
    last = [max((int(r["iteration"]) for r in rows if r["method"] == c), default=0) for c in curves]
    return min((number for number in last if number > 1), default=1)


def compare(claim: Claim, rows: Rows) -> Comparison | None:
    """What the rows of its figure, as ``csv.DictReader`` reads them, say about a claim.

    None if they hold no seed of a curve.
    """
    rows = named_rows(rows)
    curves = [claim.better] if claim.worse is None else [claim.better, claim.worse]
    iterations = common_iterations(rows, curves)
    of_curves = [by_seed(rows, curve, iterations) for curve in curves]
    seeds = tuple(map(len, of_curves))
    if not all(seeds):
        return None
    paired = len(curves) == 2 and share_first_rollouts(rows, curves)
    samples: list[FloatArray] = []
    if not too_few(seeds, iterations):
        samples = [np.array(list(map(claim.measure, each.values()))) for each in of_curves]
        if paired:
            samples = [samples[0] - samples[1]]
    return Comparison(claim, iterations, seeds, paired, tuple(samples))


def too_few(seeds: Sequence[int], iterations: int) -> str:
    """Why there is no verdict: too few seeds of a curve, or iterations; empty if there is one."""
    if min(seeds) < MIN_SEEDS:
        return f"too few seeds: {min(seeds)}, at least {MIN_SEEDS}"
    if iterations < MIN_ITERATIONS:
        return f"too few iterations: {iterations}, at least {MIN_ITERATIONS}"
    return ""


def p_value(effect: Effect, kind: Kind, margin: float) -> float:
    """One minus the level of the largest interval that decides the claim."""
    if kind is Kind.BETTER:
        return effect.p_value(0.0)
    if kind is Kind.AS_GOOD:
        return effect.p_value(-margin)
    ends = (effect.p_value(-margin), effect.p_value(margin))
    if abs(effect.estimate) <= margin:  # both ends must lie outside the interval
        return max(ends)
    return ends[effect.estimate > 0.0]


def verdict(estimate: float, low: float, high: float, kind: Kind, margin: float) -> str:
    """The verdict on a claim.

    Args:
        estimate: of the effect.
        low, high: ends of its interval.
        kind: of the claim.
        margin: in the unit of the effect.
    """
    if kind is Kind.EQUAL:
        if -margin <= low and high <= margin:
            return "confirmed"
        return "contradicted" if low > margin or high < -margin else "not separated"
    limit = 0.0 if kind is Kind.BETTER else -margin
    if low <= limit <= high:
        return "not separated"
    if kind is Kind.BETTER and abs(estimate) < margin:
        return "within the margin"
    return "confirmed" if low > limit else "contradicted"


def assess(comparisons: Sequence[Comparison]) -> list[dict[str, Any]]:
    """Effects, intervals and verdicts: one row of ``claims.json`` per comparison.

    Without a verdict, which has the reason in its place, the numbers are None.
    """
    tested = [each for each in comparisons if each.samples]
    effects = [each.effect() for each in tested]
    p_values = [
        p_value(effect, each.claim.kind, each.claim.margin)
        for effect, each in zip(effects, tested, strict=True)
    ]
    found = {
        id(each): _numbers(each, effect, p, adjusted, level)
        for each, effect, p, adjusted, level in zip(
            tested, effects, p_values, holm_adjusted(p_values), holm_levels(p_values), strict=True
        )
    }
    return [{**_description(each), **found.get(id(each), _unknown(each))} for each in comparisons]


NUMBERS = ("effect", "low", "high", "level", "p", "p_holm", "superiority", "mean")


def _unknown(each: Comparison) -> dict[str, Any]:
    return {**dict.fromkeys(NUMBERS), "verdict": too_few(each.seeds, each.iterations)}


def _description(each: Comparison) -> dict[str, Any]:
    claim = each.claim
    return {
        "claim": claim.text,
        "figure": claim.figure,
        "column": claim.column,
        "comparison": claim.better if claim.worse is None else f"{claim.better} - {claim.worse}",
        "measure": claim.measure.__name__.replace("_", " "),
        "iterations": each.iterations,
        "kind": claim.kind.value,
        "margin": claim.margin,
        "seeds": list(each.seeds),
        "paired": each.paired,
    }


def _numbers(
    each: Comparison, effect: Effect, p: float, adjusted: float, level: float
) -> dict[str, Any]:
    low, high = effect.interval(level)
    mean = each.effect(trimmed=0.0)
    kind, margin = each.claim.kind, each.claim.margin
    return {
        "effect": round(effect.estimate, 4),
        "low": round(low, 4),
        "high": round(high, 4),
        "level": round(level, 5),
        "interval_95": [round(end, 4) for end in effect.interval(0.95)],
        "p": float(f"{p:.2g}"),
        "p_holm": float(f"{adjusted:.2g}"),
        "superiority": round(probability_of_superiority(each.samples), 3),
        "mean": round(mean.estimate, 4),
        "mean_interval_95": [round(end, 4) for end in mean.interval(0.95)],
        "verdict": verdict(effect.estimate, low, high, kind, margin),
    }


def write_claims(folder: Path) -> list[Path]:
    """Write ``claims.json`` and ``claims.md`` from the result files in a folder.

    Returns:
        Their paths; nothing if the folder holds no result file of a claim.

    Raises:
        StorageError: a result file is damaged, or a file cannot be written.
    """
    compared = []
    for claim in CLAIMS:
        path = folder / f"{claim.figure}.csv"
        if path.exists():
            try:
                with open(path, newline="") as file:
                    compared.append(compare(claim, list(csv.DictReader(file))))
            except (KeyError, ValueError, TypeError) as error:
                raise StorageError(
                    f"{path} is damaged or foreign ({error!r}); make it again with "
                    f"`kreps reproduce {claim.figure}`"
                ) from error
    found = assess([each for each in compared if each is not None])
    if not found:
        return []
    write_atomically(folder / "claims.json", (json.dumps(found, indent=1) + "\n").encode())
    write_atomically(folder / "claims.md", (claims_table(found) + "\n").encode())
    return [folder / "claims.json", folder / "claims.md"]


HEADINGS = (
    "column",
    "claim",
    "measure",
    "to be confirmed as",
    "IQM",
    "corrected interval",
    "mean",
    "superiority",
    "p (Holm)",
    "verdict",
)


def claims_table(assessed: Sequence[Mapping[str, Any]]) -> str:
    """The documentation's table of all claims."""
    rows = []
    for each in assessed:
        numbers = ["–"] * 5
        if each["effect"] is not None:
            ends = [each[name] for name in ("effect", "low", "high", "mean")]
            places = 1 if max(map(abs, ends)) >= 1 else 3
            effect, low, high, mean = (f"{end:+.{places}f}" for end in ends)
            p = "< 0.001" if each["p_holm"] < 0.001 else f"{each['p_holm']:.2g}"
            numbers = [effect, f"{low} to {high}", mean, f"{each['superiority']:.2f}", p]
        rows.append(
            [
                each["column"],
                each["claim"],
                f"{each['measure']}: {each['comparison']}" + (", paired" if each["paired"] else ""),
                f"{each['kind']} (margin {each['margin']:g})",
                *numbers,
                f"**{each['verdict']}**",
            ]
        )
    return markdown(HEADINGS, rows)
