"""How bold an update may be, by whether its policy is judged and by what was asked for."""

from __future__ import annotations

from typing import cast

import pytest

from kreps.algorithms.boldness import (
    ETA_FLOOR_JUDGED,
    ETA_FLOOR_NOT_JUDGED,
    is_judged,
    least_temperature,
    widening,
)
from kreps.algorithms.imagined_rollouts import Simulator
from kreps.dual import ETA_LEAST
from kreps.settings import settings_of

SIMULATOR = cast(Simulator, object())  # only whether there is one counts


@pytest.mark.parametrize(
    ("simulator", "rollouts", "judged"),
    [(SIMULATOR, 50, True), (SIMULATOR, 0, False), (None, 50, False), (None, 0, False)],
)
def test_only_what_is_simulated_and_to_be_judged_is_bold(
    simulator: Simulator | None, rollouts: int, judged: bool
) -> None:
    settings = settings_of(judging_rollouts=rollouts)
    assert is_judged(simulator, settings) == judged
    floor = ETA_FLOOR_JUDGED if judged else ETA_FLOOR_NOT_JUDGED
    assert least_temperature(simulator, settings) == floor
    assert widening(simulator, settings) == (settings.imagined_noise if judged else 1.0)
    assert ETA_FLOOR_JUDGED < ETA_FLOOR_NOT_JUDGED and settings.imagined_noise > 1.0


@pytest.mark.parametrize("simulator", [SIMULATOR, None])
def test_a_floor_that_was_asked_for_holds_everywhere(simulator: Simulator | None) -> None:
    assert least_temperature(simulator, settings_of(eta_floor=0.3)) == 0.3
    assert least_temperature(simulator, settings_of(eta_floor=0.0)) == ETA_LEAST
