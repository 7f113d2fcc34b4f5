"""The paper's claims, each as a comparison of two curves or the gain of one.

The effect is in reward per step, with a sign such that a positive effect supports the paper.
`kreps.experiments.verdicts` decides on them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kreps.experiments.specs import FEATURES, GRID_VI, KERNEL, NPALP, SAMPLE, VALUES

Rows = Sequence[Mapping[str, str]]
Measure = Callable[[Rows], float]
"""Maps the rows of one seed, in the order of their iterations, to a number."""

EARLY = 4
"""Number of iterations at the start over which `early` averages."""

LATE = 5
"""Number of iterations at the end over which `late` averages."""

MARGINS = {"figure-1a": 0.04, "figure-1b": 4.0, "figure-2b": 4.0}
"""Smallest effects that matter, in reward per step: about a twentieth of the best known policy's
lead over the first one."""


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
    """Minus the sum of all drops between iterations of the second half; a rise counts as zero."""
    values = np.array([float(row["stochastic"]) for row in rows[len(rows) // 2 :]])
    return float(np.sum(np.minimum(np.diff(values), 0.0)))


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
