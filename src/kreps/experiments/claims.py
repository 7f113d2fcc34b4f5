"""The paper's claims, each as a comparison of two curves or the gain of one.

Each is asked of two columns of the figures: as the authors' scripts, and as printed.  The default
of this library is none of the paper's methods, so the paper claims nothing about it.

The effect is in reward per step, with a sign such that a positive effect supports the paper.
`kreps.experiments.verdicts` decides on them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from kreps.experiments.specs import (
    AS_PRINTED,
    AS_SCRIPTS,
    FEATURES,
    GRID_VI,
    KERNEL,
    NPALP,
    SAMPLE,
    VALUES,
    with_preset,
)

Rows = Sequence[Mapping[str, str]]
Measure = Callable[[Rows], float]
"""Maps the rows of one seed, in the order of their iterations, to a number."""

EARLY = 4
"""Number of iterations at the start over which `early` averages."""

LATE = 5
"""Number of iterations at the end over which `late` averages."""

MARGINS = {
    AS_SCRIPTS: {"figure-1a": 0.1, "figure-1b": 3.0, "figure-2b": 3.0},
    AS_PRINTED: {"figure-1a": 0.04, "figure-1b": 4.0, "figure-2b": 4.0},
}
"""Smallest effects that matter, in reward per step, by column and figure: about a twentieth of the
best known policy's lead over the first one; on the authors' tasks, of the lead of the best policy
that was learnt over that of the first update."""


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
        column: of the figure that the curves are in.
    """

    text: str
    figure: str
    better: str
    worse: str | None
    measure: Measure
    kind: Kind = Kind.BETTER
    column: str = AS_PRINTED

    @property
    def margin(self) -> float:
        """The smallest effect that matters, in reward per step."""
        return MARGINS[self.column][self.figure]


_1A, _1B, _2B = "figure-1a", "figure-1b", "figure-2b"


def _claims(column: str, reps: str, rivals: str, tasks: str) -> tuple[Claim, ...]:
    """The claims about a column, which shows these presets on tasks with this prefix."""
    kernel, sample, features = (with_preset(m, reps) for m in (KERNEL, SAMPLE, FEATURES))
    values, grid, npalp = (with_preset(m, rivals) for m in (VALUES, GRID_VI, NPALP))
    images, joints = f"{kernel}, {tasks}images", f"{kernel}, {tasks}swing-up"
    claims = (
        Claim(
            "Reaching: the sample model is at least as good as the embedding, as the task is "
            "deterministic",
            *(_1A, sample, kernel, late, Kind.AS_GOOD),
        ),
        Claim("Reaching: the embedding learns more slowly", _1A, sample, kernel, whole),
        Claim("Reaching: NPALP is good after a few iterations", _1A, npalp, kernel, early),
        Claim(
            "Reaching: value iteration is good after a few iterations", _1A, values, kernel, early
        ),
        Claim("Reaching: NPALP then stops improving", _1A, npalp, None, later_gain, Kind.EQUAL),
        Claim(
            "Reaching: value iteration then stops improving",
            *(_1A, values, None, later_gain, Kind.EQUAL),
        ),
        Claim("Reaching: kernel REPS goes on improving", _1A, kernel, None, later_gain),
        Claim("Reaching: kernel REPS ends better than NPALP", _1A, kernel, npalp, late),
        Claim("Reaching: the same without exploration", _1A, kernel, npalp, late_greedy),
        Claim("Reaching: kernel REPS ends better than value iteration", _1A, kernel, values, late),
        Claim("Reaching: the same without exploration", _1A, kernel, values, late_greedy),
        Claim(
            "Reaching: value iteration on a grid fails (ends worse than on-policy value iteration)",
            *(_1A, values, grid, late_greedy),
        ),
        Claim(
            "Swing-up: kernel REPS ends better than on-policy value iteration",
            *(_1B, kernel, values, late),
        ),
        Claim("Swing-up: the same without exploration", _1B, kernel, values, late_greedy),
        Claim(
            "Swing-up: kernel REPS ends better than REPS on fixed features",
            *(_1B, kernel, features, late),
        ),
        Claim(
            "Swing-up: REPS on fixed features performs well initially (as well as kernel REPS)",
            *(_1B, features, kernel, early, Kind.AS_GOOD),
        ),
        Claim("Swing-up: the sample model ends considerably worse", _1B, kernel, sample, late),
        Claim(
            "Swing-up: on-policy value iteration starts out competitively",
            *(_1B, values, kernel, early, Kind.AS_GOOD),
        ),
        Claim(
            "Swing-up: on-policy value iteration is unstable, kernel REPS is smooth",
            *(_1B, kernel, values, steadiness),
        ),
        Claim(
            "Swing-up: value iteration on a grid works well (as well as kernel REPS)",
            *(_1B, grid, kernel, late_greedy, Kind.AS_GOOD),
        ),
        Claim(
            "Images: learning is a bit slower than from joint values",
            *(_2B, joints, images, whole),
        ),
        Claim(
            "Images: the final solution is equally good",
            *(_2B, images, joints, late, Kind.EQUAL),
        ),
        Claim(
            "Images: kernel REPS ends better than the sample model (shown, not stated)",
            *(_2B, images, f"{sample}, {tasks}images", late),
        ),
    )
    return tuple(replace(claim, column=column) for claim in claims)


CLAIMS = (
    *_claims(AS_SCRIPTS, "authors", "authors", "authors-"),
    *_claims(AS_PRINTED, "paper", "default", ""),
)
