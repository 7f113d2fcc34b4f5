"""A finding of the diagnosis: one cause, its severity and a remedy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["limit", "note", "fine"]
"""From most to least severe."""


@dataclass(frozen=True)
class Finding:
    """The assessment of one cause.

    Attributes:
        name: of the cause.
        severity: ``"limit"``: it limits the run; ``"note"``: it may or may not; ``"fine"``: it was
            measured and does not.
        value: the measurement.
        limit: the threshold that it was compared with; NaN where there was no single one.
        sentence: the finding in words, with its numbers.
        remedy: what to try, as a phrase that follows "Try:"; settings are those of a new run, and
            RUN stands for the run's folder.  Empty for ``"fine"``.
    """

    name: str
    severity: Severity
    value: float
    limit: float
    sentence: str
    remedy: str = ""


def counted(number: int, noun: str) -> str:
    """The number and the noun, in the plural where that is due."""
    return f"{number} {noun}" + ("" if number == 1 else "s")
