"""How bold an update may be, by whether its policy is judged and by what was asked for."""

from __future__ import annotations

from typing import cast

import pytest

from kreps.algorithms.acceptance import (
    ETA_FLOOR_JUDGED,
    ETA_FLOOR_NOT_JUDGED,
    is_judged,
    least_temperature,
    widening,
)
from kreps.algorithms.dual import ETA_LEAST
from kreps.models.model_env import Simulator
from kreps.settings import settings_of

SIMULATOR = cast(Simulator, object())  # only whether there is one counts


@pytest.mark.parametrize(
    ("simulator", "rollouts", "judged"),
    [(SIMULATOR, 50, True), (SIMULATOR, 0, False), (None, 50, False), (None, 0, False)],
)
def test_policies_are_judged_by_a_simulator_if_they_are_to_be(
    simulator: Simulator | None, rollouts: int, judged: bool
) -> None:
    assert is_judged(simulator, settings_of(judging_rollouts=rollouts)) == judged


def test_only_what_is_judged_is_bold() -> None:
    assert least_temperature(True, settings_of()) == ETA_FLOOR_JUDGED
    assert least_temperature(False, settings_of()) == ETA_FLOOR_NOT_JUDGED > ETA_FLOOR_JUDGED
    assert widening(True, settings_of(imagined_noise=1.7)) == 1.7
    assert widening(False, settings_of(imagined_noise=1.7)) == 1.0


@pytest.mark.parametrize("judged", [True, False])
def test_a_floor_that_was_asked_for_holds_everywhere(judged: bool) -> None:
    assert least_temperature(judged, settings_of(eta_floor=0.3)) == 0.3
    assert least_temperature(judged, settings_of(eta_floor=0.0)) == ETA_LEAST
