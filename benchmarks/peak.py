"""The machine's own peak: the best float64 matrix product of this run."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import flops
import numpy as np

SIZES = (1000, 1500, 2000, 3000)


@dataclass
class Peak:
    """Operations per CPU second; probed again and again, as the machine may be busy at times.

    Attributes:
        probes: what each probe reached, (size, operations per second).
    """

    probes: list[tuple[int, float]] = field(default_factory=list)

    def probe(self) -> None:
        for n in SIZES:
            a, b = np.random.default_rng(n).standard_normal((2, n, n))
            started = time.process_time()
            a @ b
            seconds = time.process_time() - started
            self.probes.append((n, flops.product(n, n, n) / seconds))

    @property
    def best(self) -> float:
        return max(rate for _, rate in self.probes)
