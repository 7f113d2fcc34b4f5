"""The paper's claims, each as a comparison of two groups of seeds with an interval and a verdict.

A claim is a difference of means between two curves, in reward per step and so that a positive
one supports the paper.  Its 95 % interval is a percentile bootstrap over seeds, resampled
within each curve.  *Confirmed*: the interval lies above zero; *contradicted*: below; otherwise
*not separated*.  A claim that two curves end equal is confirmed where the interval lies
within a margin around zero, and contradicted where it lies outside.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from kreps.arrays import FloatArray
from kreps.seeding import Purpose, generator
from kreps.storage import write_atomically

RESAMPLES = 9999

Rows = Sequence[Mapping[str, str]]
Measure = Callable[[Rows], float]
"""Of the rows of one seed, in the order of their iterations."""

EARLY = 4
"""Iterations that count as the first ones."""

LATE = 5
"""Iterations, from the last one back, that count as the end."""


def early(rows: Rows) -> float:
    """Evaluated reward with exploration, mean over the first iterations."""
    return float(np.mean([float(row["stochastic"]) for row in rows[:EARLY]]))


def late(rows: Rows) -> float:
    """Evaluated reward with exploration, mean over the last iterations."""
    return float(np.mean([float(row["stochastic"]) for row in rows[-LATE:]]))


def late_greedy(rows: Rows) -> float:
    """Evaluated reward without exploration, mean over the last iterations."""
    return float(np.mean([float(row["greedy"]) for row in rows[-LATE:]]))


def whole(rows: Rows) -> float:
    """Evaluated reward with exploration, mean over all iterations: how fast it learnt."""
    return float(np.mean([float(row["stochastic"]) for row in rows]))


def progress(rows: Rows) -> float:
    """Gain from the first iterations to the last ones."""
    return late(rows) - early(rows)


def steadiness(rows: Rows) -> float:
    """Minus the mean loss of an iteration that loses, over the second half of learning."""
    values = np.array([float(row["stochastic"]) for row in rows[len(rows) // 2 :]])
    return float(np.mean(np.minimum(np.diff(values), 0.0)))


@dataclass(frozen=True)
class Claim:
    """One claim of the paper.

    Attributes:
        text: what the paper says.
        figure: whose result file holds the rows.
        better, worse: curves as the figure names them; ``better`` should have the larger measure.
        measure: of one seed.
        margin: for a claim of equality, the largest difference that still counts as equal.
    """

    text: str
    figure: str
    better: str
    worse: str
    measure: Measure
    margin: float | None = None


_KERNEL, _SAMPLE, _GRID = "kernel REPS", "REPS, sample model", "REPS, RBF grid"
_VALUES, _NPALP = "value iteration", "NPALP"
_ANY_STATE = "value iteration on a grid (simulator set to any state)"
_LOW, _IMAGES = "kernel REPS, swing-up", "kernel REPS, images"

CLAIMS = (
    Claim(
        "Reaching: the sample model is at least as good as the embedding, as the task is "
        "deterministic",
        "figure-1a",
        _SAMPLE,
        _KERNEL,
        late,
    ),
    Claim("Reaching: the embedding learns more slowly", "figure-1a", _SAMPLE, _KERNEL, whole),
    Claim("Reaching: NPALP is good after a few iterations", "figure-1a", _NPALP, _KERNEL, early),
    Claim(
        "Reaching: value iteration is good after a few iterations",
        "figure-1a",
        _VALUES,
        _KERNEL,
        early,
    ),
    Claim("Reaching: NPALP stops improving, REPS does not", "figure-1a", _KERNEL, _NPALP, progress),
    Claim(
        "Reaching: value iteration stops improving, REPS does not",
        "figure-1a",
        _KERNEL,
        _VALUES,
        progress,
    ),
    Claim("Reaching: REPS ends better than NPALP", "figure-1a", _KERNEL, _NPALP, late),
    Claim("Reaching: REPS ends better than value iteration", "figure-1a", _KERNEL, _VALUES, late),
    Claim("Reaching: value iteration on a grid fails", "figure-1a", _KERNEL, _ANY_STATE, late),
    Claim(
        "Swing-up: kernel REPS ends better than on-policy value iteration",
        "figure-1b",
        _KERNEL,
        _VALUES,
        late,
    ),
    Claim(
        "Swing-up: the same without exploration noise",
        "figure-1b",
        _KERNEL,
        _VALUES,
        late_greedy,
    ),
    Claim(
        "Swing-up: kernel REPS ends better than REPS on fixed features",
        "figure-1b",
        _KERNEL,
        _GRID,
        late,
    ),
    Claim(
        "Swing-up: REPS on fixed features is better at first", "figure-1b", _GRID, _KERNEL, early
    ),
    Claim(
        "Swing-up: the sample model ends considerably worse", "figure-1b", _KERNEL, _SAMPLE, late
    ),
    Claim(
        "Swing-up: on-policy value iteration is competitive at first",
        "figure-1b",
        _VALUES,
        _KERNEL,
        early,
    ),
    Claim(
        "Swing-up: on-policy value iteration is unstable, REPS is smooth",
        "figure-1b",
        _KERNEL,
        _VALUES,
        steadiness,
    ),
    Claim(
        "Swing-up: value iteration on a grid works well (at least as well as kernel REPS)",
        "figure-1b",
        _ANY_STATE,
        _KERNEL,
        late,
    ),
    Claim("Images: learning is a bit slower", "figure-2b", _LOW, _IMAGES, whole),
    Claim(
        "Images: the final solution is equally good (within 2 points)",
        "figure-2b",
        _IMAGES,
        _LOW,
        late,
        margin=2.0,
    ),
    Claim(
        "Images: kernel REPS ends better than the sample model",
        "figure-2b",
        _IMAGES,
        "REPS, sample model, images",
        late,
    ),
)


def by_seed(rows: Rows, curve: str, measure: Measure) -> FloatArray:
    """The measure of each seed of a curve."""
    from kreps.experiments.figures import named_rows

    mine = [row for row in named_rows(rows) if row["method"] == curve]
    seeds = sorted({int(row["seed"]) for row in mine})
    of_seed = [
        sorted((r for r in mine if int(r["seed"]) == seed), key=lambda r: int(r["iteration"]))
        for seed in seeds
    ]
    return np.array([measure(each) for each in of_seed])


def verdict(low: float, high: float, margin: float | None) -> str:
    """What an interval says of a claim."""
    if margin is None:
        return "confirmed" if low > 0 else "contradicted" if high < 0 else "not separated"
    if -margin <= low and high <= margin:
        return "confirmed"
    return "contradicted" if low > margin or high < -margin else "not separated"


def judge(claim: Claim, rows: Rows) -> dict[str, Any] | None:
    """Effect, interval and verdict; None if the rows hold fewer than two seeds of either curve."""
    a = by_seed(rows, claim.better, claim.measure)
    b = by_seed(rows, claim.worse, claim.measure)
    if min(len(a), len(b)) < 2:
        return None
    found = bootstrap(
        (a, b),
        lambda x, y, axis: x.mean(axis=axis) - y.mean(axis=axis),
        n_resamples=RESAMPLES,
        method="percentile",
        vectorized=True,
        random_state=generator(0, Purpose.BOOTSTRAP),
    ).confidence_interval
    low, high = float(found.low), float(found.high)
    return {
        "claim": claim.text,
        "figure": claim.figure,
        "comparison": f"{claim.better} less {claim.worse}",
        "measure": claim.measure.__name__.replace("_", ", "),
        "effect": round(float(a.mean() - b.mean()), 4),
        "low": round(low, 4),
        "high": round(high, 4),
        "seeds": [len(a), len(b)],
        "verdict": verdict(low, high, claim.margin),
    }


def write_claims(folder: Path) -> list[Path]:
    """``claims.json`` and ``claims.md`` from the result files that the folder holds."""
    judged = []
    for claim in CLAIMS:
        path = folder / f"{claim.figure}.csv"
        if path.exists():
            with open(path, newline="") as file:
                judged.append(judge(claim, list(csv.DictReader(file))))
    found = [each for each in judged if each is not None]
    if not found:
        return []
    write_atomically(folder / "claims.json", (json.dumps(found, indent=1) + "\n").encode())
    write_atomically(folder / "claims.md", (claims_table(found) + "\n").encode())
    return [folder / "claims.json", folder / "claims.md"]


def claims_table(judged: Sequence[Mapping[str, Any]]) -> str:
    """The claims as the documentation shows them."""
    lines = ["| claim | measure | difference | 95 % interval | verdict |", "|---|---|---|---|---|"]
    for each in judged:
        places = 1 if max(abs(each["low"]), abs(each["high"])) >= 1 else 3
        numbers = [f"{each[name]:+.{places}f}" for name in ("effect", "low", "high")]
        lines.append(
            f"| {each['claim']} | {each['measure']} | {numbers[0]} | {numbers[1]} to {numbers[2]} "
            f"| **{each['verdict']}** |"
        )
    return "\n".join(lines)
