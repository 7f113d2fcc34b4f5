"""How bold an update may be, by whether its policy is judged and by what was asked for."""

from __future__ import annotations

from typing import cast

import pytest

from kreps.algorithms.acceptance import (
    ETA_FLOOR_WITH_ACCEPTANCE_TEST,
    ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST,
    has_acceptance_test,
    proposal_std_scale,
    temperature_floor,
)
from kreps.algorithms.dual import MIN_ETA
from kreps.models.model_env import ModelEnv
from kreps.settings import settings_of

SIMULATOR = cast(ModelEnv, object())  # only whether there is one counts


@pytest.mark.parametrize(
    ("simulator", "rollouts", "judged"),
    [(SIMULATOR, 50, True), (SIMULATOR, 0, False), (None, 50, False), (None, 0, False)],
)
def test_policies_are_judged_by_a_simulator_if_they_are_to_be(
    model_env: ModelEnv | None, rollouts: int, tested: bool
) -> None:
    assert has_acceptance_test(model_env, settings_of(judging_rollouts=rollouts)) == tested


def test_only_what_is_judged_is_bold() -> None:
    assert temperature_floor(True, settings_of()) == ETA_FLOOR_WITH_ACCEPTANCE_TEST
    assert (
        temperature_floor(False, settings_of())
        == ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST
        > ETA_FLOOR_WITH_ACCEPTANCE_TEST
    )
    assert proposal_std_scale(True, settings_of(imagined_noise=1.7)) == 1.7
    assert proposal_std_scale(False, settings_of(imagined_noise=1.7)) == 1.0


@pytest.mark.parametrize("judged", [True, False])
def test_a_floor_that_was_asked_for_holds_everywhere(tested: bool) -> None:
    assert temperature_floor(tested, settings_of(eta_floor=0.3)) == 0.3
    assert temperature_floor(tested, settings_of(eta_floor=0.0)) == MIN_ETA
