"""The peak of the machine: operations per second of its fastest float64 matrix product."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import flops
import numpy as np

SIZES = (1000, 1500, 2000, 3000)


@dataclass
class Peak:
    """Operations per CPU second.  Measured repeatedly, as the machine may be busy at times.

    Attributes:
        probes: (size, operations per CPU second) of each measurement.
    """

    probes: list[tuple[int, float]] = field(default_factory=list)

    def probe(self) -> None:
        """Time one matrix product of each size."""
        for n in SIZES:
            a, b = np.random.default_rng(n).standard_normal((2, n, n))
            started = time.process_time()
            a @ b
            seconds = time.process_time() - started
            self.probes.append((n, flops.product(n, n, n) / seconds))

    @property
    def best(self) -> float:
        return max(rate for _, rate in self.probes)
