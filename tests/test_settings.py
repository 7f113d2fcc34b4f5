"""Recipes, changes to them, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest

from kreps.errors import ConfigurationError
from kreps.settings import Settings, settings_of


def test_the_default_recipe_is_the_defaults() -> None:
    assert settings_of() == settings_of("default") == Settings()


def test_the_observed_recipe_is_one_step_with_the_numbers_of_old() -> None:
    observed = settings_of("observed")
    assert (observed.kl_bound, observed.eta_floor, observed.ridge) == (1.0, 0.1, 0.1)
    assert (observed.imagined, observed.exploring_starts) == (0, 0.0)
    assert (observed.model, observed.features, observed.policy_fit) == ("change", "rkhs", "map")


def test_the_default_recipe_asks_the_model_for_more_than_the_observed_one() -> None:
    default = settings_of()
    assert default.ridge is None and default.eta_floor is None
    assert default.imagined > 0
    assert 0.0 < default.exploring_starts < 1.0
    own = {
        "ridge": 0.1,
        "imagined": 0,
        "eta_floor": 0.1,
        "exploring_starts": 0.0,
        "model": "change",
        "restarts": "independent",
        "angles": "round",
    }
    assert settings_of("default", **own) == settings_of("observed")


@pytest.mark.parametrize("changes", [{}, {"imagined": 0}, {"ridge": 0.1}])
def test_without_a_model_nothing_can_be_imagined(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match=r'recipe="observed".*imagined=0.*ridge=0.1'):
        settings_of("default", model="sample", **changes)
    without = settings_of("default", model="sample", imagined=0, ridge=0.1)
    assert (without.model, without.imagined, without.ridge) == ("sample", 0, 0.1)
    for recipe in ("observed", "paper"):
        assert settings_of(recipe, model="sample").model == "sample"
        with pytest.raises(ConfigurationError, match="imagined = 2"):
            settings_of(recipe, model="sample", imagined=2)
        with pytest.raises(ConfigurationError, match="ridge = None"):
            settings_of(recipe, model="sample", ridge=None)


def test_the_paper_recipe_has_a_low_floor_and_hard_ranges() -> None:
    paper = settings_of("paper")
    assert (paper.eta_floor, paper.policy_fit) == (0.02, "bounded")
    assert 0.0 < paper.kl_bound < 1.0  # the paper leaves it open
    assert paper.model == "embedding"
    assert (paper.ridge, paper.imagined, paper.exploring_starts) == (0.1, 0, 0.0)
    assert (paper.initial_rollouts, paper.rollouts_per_iteration, paper.window) == (30, 10, 30)
    assert paper.restart_probability == 0.02
    assert paper.restarts == "independent"


def test_a_change_overrides_the_recipe_and_nothing_else() -> None:
    changed = settings_of("paper", kl_bound=0.25, window=12, model="sample")
    assert (changed.kl_bound, changed.window, changed.model) == (0.25, 12, "sample")
    assert (changed.eta_floor, changed.policy_fit) == (0.02, "bounded")
    assert settings_of("paper").kl_bound != 0.25


def test_an_unknown_recipe_is_refused_with_the_choices() -> None:
    with pytest.raises(ConfigurationError, match=r"'papre'.*'default', 'observed', 'paper'"):
        settings_of("papre")


def test_an_unknown_parameter_is_refused_with_the_choices() -> None:
    with pytest.raises(ConfigurationError, match=r"kl_buond.*kl_bound"):
        settings_of("default", kl_buond=1.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("model", "exact"),
        ("features", "RKHS"),
        ("policy_fit", "mle"),
        ("exploration", None),
        ("restarts", "both"),
        *[
            (name, value)
            for name in ("kl_bound", "exploration_scale", "basis_tolerance")
            for value in (0.0, -1.0, float("inf"), float("nan"), "1", True, None)
        ],
        *[
            ("imagined_noise", value)
            for value in (0.99, 0.0, -1.0, float("inf"), float("nan"), "1", True, None)
        ],
        *[("ridge", value) for value in (0.0, -1.0, float("inf"), float("nan"), "1", True)],
        *[("imagined", value) for value in (-1, 2.5, 4.0, "4", True, None)],
        *[("judging_rollouts", value) for value in (-1, 1, 2.5, 4.0, "4", True, None)],
        *[
            (name, value)
            for name in ("exploring_starts", "imagined_rollouts")
            for value in (-0.1, 1.1, float("nan"), "1", True, None)
        ],
        *[("optimism", value) for value in (-0.1, float("inf"), float("nan"), "1", True, None)],
        *[("eta_floor", value) for value in (-1e-9, float("inf"), float("nan"), "0", False)],
        *[("restart_probability", value) for value in (0.0, 1.0, -0.1, 1.5, float("nan"), "0.1")],
        *[
            (name, value)
            for name in (
                "initial_rollouts",
                "rollouts_per_iteration",
                "window",
                "max_rank",
                "grid_size",
            )
            for value in (0, -3, 2.5, 10.0, "10", True)
        ],
    ],
)
def test_a_value_out_of_range_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ConfigurationError, match=name):
        settings_of("default", **{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("eta_floor", None),
        ("eta_floor", 0),
        ("eta_floor", 0.0),
        ("kl_bound", 2),
        ("restart_probability", 0.999),
        ("window", 1),
        ("ridge", None),
        ("ridge", 1e-9),
        ("imagined", 0),
        ("exploring_starts", 0.0),
        ("exploring_starts", 1.0),
        ("imagined_noise", 1),
        ("imagined_noise", 2.5),
        ("imagined_rollouts", 0),
        ("imagined_rollouts", 1.0),
        ("judging_rollouts", 0),
        ("judging_rollouts", 2),
        ("optimism", 0),
        ("optimism", 10.0),
        ("imagined", 1),
        ("model", "embedding"),
        ("features", "grid"),
        ("policy_fit", "bounded"),
        ("exploration", "gaussian"),
    ],
)
def test_a_value_at_the_edge_of_its_range_is_taken(name: str, value: Any) -> None:
    assert getattr(settings_of("default", **{name: value}), name) == value
