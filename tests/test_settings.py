"""Recipes, changes to them, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest

from kreps.errors import ConfigurationError
from kreps.settings import Settings, settings_of


def test_the_default_recipe_is_the_defaults() -> None:
    assert settings_of() == settings_of("default") == Settings()


def test_the_paper_recipe_has_a_low_floor_and_hard_ranges() -> None:
    paper = settings_of("paper")
    assert (paper.eta_floor, paper.policy_fit) == (0.02, "bounded")
    assert 0.0 < paper.kl_bound < 1.0  # the paper leaves it open
    assert paper.model == "embedding"
    assert (paper.initial_rollouts, paper.rollouts_per_iteration, paper.window) == (30, 10, 30)
    assert paper.restart_probability == 0.02


def test_a_change_overrides_the_recipe_and_nothing_else() -> None:
    changed = settings_of("paper", kl_bound=0.25, window=12, model="sample")
    assert (changed.kl_bound, changed.window, changed.model) == (0.25, 12, "sample")
    assert (changed.eta_floor, changed.policy_fit) == (0.02, "bounded")
    assert settings_of("paper").kl_bound != 0.25


def test_an_unknown_recipe_is_refused_with_the_choices() -> None:
    with pytest.raises(ConfigurationError, match=r"'papre'.*'default', 'paper'"):
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
        *[
            (name, value)
            for name in ("kl_bound", "ridge", "exploration_scale", "basis_tolerance")
            for value in (0.0, -1.0, float("inf"), float("nan"), "1", True, None)
        ],
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
        ("eta_floor", 0),
        ("eta_floor", 0.0),
        ("kl_bound", 2),
        ("restart_probability", 0.999),
        ("window", 1),
        ("model", "sample"),
        ("features", "grid"),
        ("policy_fit", "bounded"),
        ("exploration", "gaussian"),
    ],
)
def test_a_value_at_the_edge_of_its_range_is_taken(name: str, value: Any) -> None:
    assert getattr(settings_of("default", **{name: value}), name) == value
