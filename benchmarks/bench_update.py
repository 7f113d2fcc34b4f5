"""Complete updates by `learner.update`, fits of hyper-parameters included."""

from __future__ import annotations

import pytest
from criteria import Seconds
from data import next_update
from measuring import Measure


@pytest.mark.parametrize("iterations", [2, 6, 12])
def bench_update(measure: Measure, iterations: int) -> None:
    update = next_update(iterations)
    measured = measure(
        f"whole update after {iterations} iterations",
        f"n = {update.samples()}",
        update.run,
        Seconds(at_most=0.5),
        rounds=5,
    )
    measured.details["stages"] = update.run()
