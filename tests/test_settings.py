"""Presets, sections, changes by name, and what is refused."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.errors import ConfigurationError
from kreps.presets import PRESETS, changed, flat, preset_of, settings_of
from kreps.settings import (
    RKHS,
    Exploration,
    Grid,
    GridValueIterationSettings,
    LowRank,
    ModelBased,
    NPALPSettings,
    Settings,
    ValueIterationSettings,
)

# ---- presets ----------------------------------------------------------------------------------

MODEL_BASED: dict[str, Any] = {
    "restart_probability": None,
    "window": 30,
    "window_steps": 2500,
    "exploration.noise": "bang-bang",
    "exploration.scale": 1.0,
    "initial_rollouts": None,
    "rollouts_per_iteration": 10,
    "growth": None,
    "rollout_lengths": "stratified",
    "action_repeat": None,
    "delay": 0,
    "history": 0,
    "kl_bound": 1.0,
    "eta_floor": None,
    "ridge": None,
    "exploring_starts": 0.25,
    "model": "dynamics",
    "policy_fit": "map",
    "cross_validation": "samples",
    "value": "rkhs",
    "value.max_rank": 400,
    "value.tolerance": 1e-6,
    "value.angle_wrap": "discontinuous",
    "low_rank.rank": 1000,
    "low_rank.above": 3000,
    "low_rank.subsample": 10_000,
    "model_based.actions_per_state": 4,
    "model_based.proposal_std_scale": 1.2,
    "model_based.model_rollout_fraction": 0.5,
    "model_based.acceptance_rollouts": 50,
    "model_based.exploration_bonus": 0.1,
    "model_based.improvement_steps": 20,
    "model_based.random_policies": 20,
    "model_based.regulators": 4,
    "model_based.gradient_steps": 40,
    "model_based.max_samples": 20_000,
}
SINGLE_STEP: dict[str, Any] = {
    **{name: v for name, v in MODEL_BASED.items() if not name.startswith("model_based.")},
    "model_based": None,
    "restart_probability": 0.02,
    "action_repeat": 1,
    "initial_rollouts": 30,
    "growth": 0.0,
    "window_steps": 0,
    "rollout_lengths": "independent",
    "eta_floor": 0.1,
    "ridge": 0.1,
    "exploring_starts": 0.0,
    "model": "change",
    "value.angle_wrap": "continuous",
}
PAPER: dict[str, Any] = {
    **SINGLE_STEP,
    "kl_bound": 0.5,
    "eta_floor": 0.02,
    "model": "embedding",
    "policy_fit": "bounded",
}
AUTHORS: dict[str, Any] = {
    **{name: v for name, v in SINGLE_STEP.items() if not name.startswith("low_rank.")},
    "exploration.noise": "gaussian",
    "kl_bound": 0.5,
    "eta_floor": 0.0,
    "ridge": 1e-6,
    "model": "embedding",
    "policy_fit": "free",
    "cross_validation": "rollouts",
    "value.max_rank": 3000,
    "low_rank": None,
}


@pytest.mark.parametrize(
    ("preset", "values"),
    [
        ("model_based", MODEL_BASED),
        ("single_step", SINGLE_STEP),
        ("paper", PAPER),
        ("authors", AUTHORS),
    ],
)
def test_presets_have_these_values(preset: str, values: dict[str, Any]) -> None:
    assert flat(settings_of(preset)) == values
    assert settings_of(preset) is PRESETS[preset] or settings_of(preset) == PRESETS[preset]


def test_the_default_preset_is_the_defaults() -> None:
    assert settings_of() == settings_of("model_based") == Settings()


def test_other_learners_have_these_defaults() -> None:
    common = {name: SINGLE_STEP[name] for name in ("restart_probability", "window", "window_steps")}
    on_policy = {
        **common,
        "exploration.noise": "bang-bang",
        "exploration.scale": 1.0,
        "initial_rollouts": 30,
        "rollouts_per_iteration": 10,
        "growth": 0.0,
        "rollout_lengths": "independent",
    }
    values = {"temperature_unit": "reward", "known_reward": False, "cross_validation": "samples"}
    assert flat(ValueIterationSettings()) == {
        **on_policy,
        "temperature": 1.0,
        "actions": 25,
        **values,
    }
    assert flat(NPALPSettings()) == {
        **on_policy,
        "lipschitz": 10.0,
        "lipschitz_unit": "standardised",
        "noise_fraction": 0.3,
        "noise_scale": 0.3,
    }
    assert flat(GridValueIterationSettings()) == {
        **common,
        "window": 6000,
        "ranges": None,
        "actions": 25,
        "grid_states": 15,
        "grid_actions": 7,
        "temperature": 0.0,
        **values,
    }


def test_the_presets_of_the_other_learners_are_these() -> None:
    values = {"temperature_unit": "q", "known_reward": True, "cross_validation": "rollouts"}
    first = {"exploration.noise": "gaussian"}
    changed_by: dict[type[Any], dict[str, Any]] = {
        ValueIterationSettings: {**first, "temperature": 1.0 / 3.0, **values},
        GridValueIterationSettings: {
            "grid_states": (19, 11),
            "grid_actions": 11,
            "temperature": 0.05,
            **values,
        },
        NPALPSettings: {
            **first,
            "lipschitz": 1.0,
            "lipschitz_unit": "raw",
            "noise_fraction": 0.1,
            "noise_scale": 0.6,
        },
    }
    for kind, changes in changed_by.items():
        assert flat(preset_of(kind, "default", {})) == flat(kind())
        assert flat(preset_of(kind, "authors", {})) == {**flat(kind()), **changes}
        with pytest.raises(ConfigurationError, match=rf"'default', 'authors', .*{kind.__name__}"):
            preset_of(kind, "paper", {})
    assert kreps.NPALP(kreps.TaskSpec(1, [-1.0], [1.0]), preset="authors").settings.lipschitz == 1.0


@pytest.mark.parametrize("kind", [ValueIterationSettings, GridValueIterationSettings])
def test_a_known_reward_is_of_the_authors_value_iteration(kind: Any) -> None:
    with pytest.raises(ConfigurationError, match=r'known_reward = True.*preset="authors"'):
        kind(known_reward=True)
    with pytest.raises(ConfigurationError, match=r"known_reward = 1,.*True or False"):
        kind(known_reward=1, temperature_unit="q", temperature=1.0)
    with pytest.raises(ConfigurationError, match="temperature = 0"):
        kind(temperature=0.0, temperature_unit="q")


def test_a_grid_may_have_a_size_for_each_coordinate() -> None:
    assert GridValueIterationSettings(grid_states=[3, 4]).grid_states == (3, 4)  # type: ignore[arg-type]
    for wrong in ((), (3, 0), (3, 2.0), (True, 2)):
        with pytest.raises(ConfigurationError, match=r"grid_states = .*whole numbers"):
            GridValueIterationSettings(grid_states=wrong)  # type: ignore[arg-type]


def test_an_unknown_preset_is_refused_with_the_choices() -> None:
    choices = r"'model_based', 'single_step', 'paper', 'authors'"
    with pytest.raises(ConfigurationError, match=rf"'papre' is unknown; .*{choices}"):
        settings_of("papre")
    with pytest.raises(ConfigurationError, match=r"called 'single_step' now"):
        settings_of("observed")
    with pytest.raises(ConfigurationError, match=r"called 'model_based' now"):
        settings_of("default")
    wrong: Any
    for wrong in (None, 7, [], NPALPSettings()):
        with pytest.raises(ConfigurationError, match=r"kreps\.Settings"):
            settings_of(wrong)


def test_settings_may_take_the_place_of_a_preset() -> None:
    own = Settings(kl_bound=0.3)
    assert settings_of(own) == own
    assert settings_of(own, window=5) == Settings(kl_bound=0.3, window=5)


# ---- changes by name --------------------------------------------------------------------------


def test_a_change_overrides_the_preset_and_nothing_else() -> None:
    settings = settings_of("paper", kl_bound=0.25, window=12, model="sample")
    expected = {**PAPER, "kl_bound": 0.25, "window": 12, "model": "sample"}
    assert flat(settings) == expected
    assert flat(settings_of("paper")) == PAPER


def test_a_section_is_changed_as_a_whole() -> None:
    assert settings_of(value=Grid(5)).value == Grid(size=5)
    assert settings_of(model_based=None).model_based is None
    assert settings_of(low_rank=None).low_rank is None
    assert settings_of(low_rank=LowRank(above=0)).low_rank == LowRank(1000, 0, 10_000)
    exploration = Exploration(noise="pink", scale=0.5)
    assert settings_of(exploration=exploration).exploration == exploration


def test_a_field_of_a_section_is_changed_by_its_dotted_name() -> None:
    settings = settings_of(**{"value.max_rank": 50, "value.tolerance": 1e-3})
    assert settings.value == RKHS(max_rank=50, tolerance=1e-3, angle_wrap="discontinuous")
    settings = settings_of("paper", **{"value.max_rank": 50})
    assert settings.value == RKHS(max_rank=50, angle_wrap="continuous")
    settings = settings_of(**{"model_based.acceptance_rollouts": 0})
    assert settings.model_based == ModelBased(acceptance_rollouts=0)


def test_a_field_of_an_absent_section_adds_the_section() -> None:
    settings = settings_of("paper", **{"model_based.actions_per_state": 2})
    assert settings.model_based == ModelBased(actions_per_state=2)
    settings = changed(Settings(low_rank=None), {"low_rank.rank": 7})
    assert settings.low_rank == LowRank(rank=7)


def test_a_section_is_not_left_out_and_changed_at_once() -> None:
    for changes in (
        {"model_based": None, "model_based.max_samples": 9},
        {"model_based.max_samples": 9, "model_based": "none"},
    ):
        with pytest.raises(ConfigurationError, match=r"max_samples.*one of the two"):
            changed(Settings(), changes)


def test_a_section_is_given_by_the_name_of_its_kind() -> None:
    assert settings_of(value="grid").value == Grid(size=10)
    assert settings_of("paper", value="rkhs").value == RKHS()
    assert settings_of("paper", model_based="model_based").model_based == ModelBased()
    assert settings_of(model_based="none").model_based is None
    assert settings_of(low_rank="None").low_rank is None
    for noise in ("bang-bang", "gaussian", "pink"):
        assert settings_of(exploration=noise).exploration == Exploration(noise=noise, scale=1.0)


def test_fields_are_changed_after_their_section_whatever_the_order() -> None:
    for names in (("value", "value.size"), ("value.size", "value")):
        values = {"value": "grid", "value.size": 3}
        assert settings_of(**{name: values[name] for name in names}).value == Grid(size=3)
    settings = settings_of(**{"exploration.scale": 0.5, "exploration": "pink"})
    assert settings.exploration == Exploration("pink", 0.5)


@pytest.mark.parametrize(
    "settings",
    [
        *PRESETS.values(),
        Settings(value=Grid(3)),
        Settings(low_rank=None, model_based=None),
        Settings(exploration=Exploration("pink", 0.1), window=None),
        ValueIterationSettings(actions=3),
        GridValueIterationSettings(ranges=((0, 1), (2, 3))),
        NPALPSettings(exploration=Exploration("gaussian")),
    ],
)
def test_the_flat_form_has_everything(settings: Any) -> None:
    assert changed(type(settings)(), flat(settings)) == settings
    plain = (str, int, float, bool, tuple, type(None))
    assert all(isinstance(value, plain) for value in flat(settings).values())


def test_a_learner_takes_changes_by_keyword() -> None:
    task = kreps.TaskSpec(2, [-1.0], [1.0])
    learner = kreps.KREPS(task, exploration="pink", model_based=None, value=kreps.Grid(5))
    assert learner.settings.exploration == Exploration("pink")
    assert learner.settings.value == Grid(5)
    assert learner.settings.model_based is None
    learner = kreps.KREPS(task, preset="paper", **{"value.max_rank": 9})
    assert learner.settings == settings_of("paper", **{"value.max_rank": 9})


# ---- names that are refused -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("kl_buond", "kl_bound"),
        ("value.size", "value.max_rank, value.tolerance, value.angle_wrap"),
        ("value.", "value.max_rank"),
        ("model_based.kl_bound", "model_based.actions_per_state"),
        ("kl_bound.x", "kl_bound"),
        ("colour.red", "kl_bound"),
        ("low_rank.rank.x", "low_rank.above"),
        ("", "kl_bound"),
    ],
)
def test_an_unknown_parameter_is_refused_with_the_choices(name: str, parameters: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        settings_of("model_based", **{name: 1.0})
    assert f"unknown parameter {name}; the parameters are" in str(caught.value)
    assert parameters in str(caught.value)


@pytest.mark.parametrize(
    ("old", "hint"),
    [
        ({"recipe": "observed"}, "(it is called preset now: write preset='single_step')"),
        ({"recipe": "paper"}, "write preset='paper')"),
        ({"recipe": 7}, "write preset=7)"),
        ({"imagined": 0}, "write model_based=None)"),
        ({"imagined": 3}, 'write **{"model_based.actions_per_state": 3})'),
        ({"imagined_noise": 2.0}, 'write **{"model_based.proposal_std_scale": 2.0})'),
        ({"imagined_rollouts": 0.1}, 'write **{"model_based.model_rollout_fraction": 0.1})'),
        ({"judging_rollouts": 0}, 'write **{"model_based.acceptance_rollouts": 0})'),
        ({"optimism": 0.2}, 'write **{"model_based.exploration_bonus": 0.2})'),
        ({"features": "grid"}, "write value='grid')"),
        ({"features": "rkhs"}, "write value='rkhs')"),
        ({"grid_size": 4}, 'write **{"value.size": 4})'),
        ({"max_rank": 4}, 'write **{"value.max_rank": 4})'),
        ({"basis_tolerance": 0.1}, 'write **{"value.tolerance": 0.1})'),
        ({"angles": "round"}, "write **{\"value.angle_wrap\": 'continuous'})"),
        ({"approximation": "exact"}, "write low_rank=None)"),
        ({"approximation": "fourier"}, 'write **{"low_rank.above": 0})'),
        ({"rank": 4}, 'write **{"low_rank.rank": 4})'),
        ({"restarts": "stratified"}, "write rollout_lengths='stratified')"),
        ({"exploration_scale": 0.5}, 'write **{"exploration.scale": 0.5})'),
    ],
)
def test_a_name_of_version_0_1_is_refused_with_what_to_write_now(
    old: dict[str, Any], hint: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        kreps.KREPS(kreps.TaskSpec(2, [-1.0], [1.0]), **old)
    (name,) = old
    assert f"unknown parameter {name} (it is called" in str(caught.value)
    assert hint in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("value", "RKHS", r"'rkhs', 'grid', or give kreps\.RKHS\(\.\.\.\) or kreps\.Grid"),
        ("value", None, r"kreps\.RKHS\(\.\.\.\) or kreps\.Grid"),
        ("value", 7, r"kreps\.RKHS"),
        ("value", RKHS, r"kreps\.RKHS"),
        ("exploration", "brown", r"'bang-bang', 'gaussian', 'pink', or give kreps\.Exploration"),
        ("exploration", None, r"kreps\.Exploration"),
        ("exploration", "none", r"kreps\.Exploration"),
        ("low_rank", "exact", r"kreps\.LowRank"),
        ("low_rank", 1000, r"kreps\.LowRank\(\.\.\.\) or None"),
        ("low_rank", RKHS(), r"kreps\.LowRank"),
        ("model_based", 4, r"kreps\.ModelBased\(\.\.\.\) or None"),
        ("model_based", False, r"kreps\.ModelBased"),
    ],
)
def test_what_is_no_section_is_refused_with_what_is(name: str, value: Any, said: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"{name} = .*{said}"):
        settings_of(**{name: value})


# ---- ranges -----------------------------------------------------------------------------------

NOT_FINITE = [float("inf"), float("-inf"), float("nan")]
NO_NUMBERS = ["1", None, True, [1], 1j]
NO_COUNTS = [0, -3, 2.5, 10.0, "10", None, True, np.float64(3)]
OUT_OF_RANGE: dict[str, list[Any]] = {
    "restart_probability": [0.0, 1.0, -0.1, 1.5, *NOT_FINITE, "1", True, [1], 1j],
    "window": [value for value in NO_COUNTS if value is not None],
    "window_steps": [value for value in NO_COUNTS if value is not None and value != 0],
    "initial_rollouts": [value for value in NO_COUNTS if value is not None],
    "rollouts_per_iteration": NO_COUNTS,
    "growth": [-0.1, *NOT_FINITE, *(value for value in NO_NUMBERS if value is not None)],
    "rollout_lengths": ["both", "", None, 1, ["stratified"]],
    "exploration.noise": ["brown", "", None, 1],
    "exploration.scale": [0.0, -1.0, *NOT_FINITE, *NO_NUMBERS],
    "action_repeat": [value for value in (*NO_COUNTS, 10_001) if value is not None],
    "delay": [-1, 101, 1.5, None, True],
    "history": [-1, 101, 1.5, None, "all"],
    "kl_bound": [0.0, -1.0, *NOT_FINITE, *NO_NUMBERS],
    "eta_floor": [-1e-9, *NOT_FINITE, "0", False],
    "ridge": [0.0, -1.0, *NOT_FINITE, "1", True],
    "exploring_starts": [-0.1, 1.1, *NOT_FINITE, *NO_NUMBERS],
    "model": ["exact", "", None, ["change"]],
    "policy_fit": ["mle", "", None],
    "cross_validation": ["loo", "", None],
    "value.max_rank": NO_COUNTS,
    "value.tolerance": [0.0, -1.0, *NOT_FINITE, *NO_NUMBERS],
    "value.angle_wrap": ["cut", "round", "", None],
    "low_rank.rank": NO_COUNTS,
    "low_rank.above": [-1, 2.5, 10.0, "10", None, True],
    "low_rank.subsample": NO_COUNTS,
    "model_based.actions_per_state": NO_COUNTS,
    "model_based.proposal_std_scale": [0.99, 0.0, -1.0, *NOT_FINITE, *NO_NUMBERS],
    "model_based.model_rollout_fraction": [-0.1, 1.1, *NOT_FINITE, *NO_NUMBERS],
    "model_based.acceptance_rollouts": [-1, 1, 2.5, 4.0, "4", None, True],
    "model_based.exploration_bonus": [-0.1, *NOT_FINITE, *NO_NUMBERS],
    "model_based.improvement_steps": [value for value in NO_COUNTS if value != 0],
    "model_based.random_policies": [value for value in NO_COUNTS if value != 0],
    "model_based.regulators": [value for value in NO_COUNTS if value != 0],
    "model_based.gradient_steps": [value for value in NO_COUNTS if value != 0],
    "model_based.max_samples": NO_COUNTS,
}


def test_the_table_of_ranges_has_every_setting() -> None:
    assert OUT_OF_RANGE.keys() == MODEL_BASED.keys() - {"value"}
    assert {each.name for each in fields(Settings)} == {
        name.partition(".")[0] for name in MODEL_BASED
    }


@pytest.mark.parametrize("name", OUT_OF_RANGE)
def test_a_value_out_of_range_is_refused_by_name(name: str) -> None:
    for value in OUT_OF_RANGE[name]:
        with pytest.raises(ConfigurationError) as caught:
            settings_of("model_based", **{name: value})
        assert str(caught.value).startswith(f"{name} = {value!r}")
        assert "must be" in str(caught.value) or "choose one of" in str(caught.value)


TOO_FAR: dict[str, list[Any]] = {
    "restart_probability": [1e-300, 1e-12, 9e-10],
    "window": [10**15 + 1],
    "window_steps": [10**15 + 1],
    "initial_rollouts": [100_001],
    "rollouts_per_iteration": [100_001],
    "growth": [],
    "kl_bound": [],
    "ridge": [],
    "eta_floor": [],
    "exploration.scale": [],
    "value.max_rank": [10**15 + 1],
    "value.tolerance": [1.0, 1, 1e300],
    "low_rank.rank": [10**15 + 1],
    "low_rank.above": [10**15 + 1],
    "low_rank.subsample": [10**15 + 1],
    "model_based.actions_per_state": [10_000_001],
    "model_based.proposal_std_scale": [1000.1, 1e300],
    "model_based.acceptance_rollouts": [100_001, 10**9],
    "model_based.exploration_bonus": [],
    "model_based.improvement_steps": [100_001],
    "model_based.random_policies": [100_001],
    "model_based.regulators": [100_001],
    "model_based.gradient_steps": [100_001],
    "model_based.max_samples": [10_000_001],
}
"""Besides whole numbers of 400 and of 5000 digits."""


@pytest.mark.parametrize("name", TOO_FAR)
def test_what_no_computer_could_compute_is_refused_by_name(name: str) -> None:
    for value in (*TOO_FAR[name], 10**400, 10**5000):
        with pytest.raises(ConfigurationError) as caught:
            settings_of("model_based", **{name: value})
        assert str(caught.value).startswith(f"{name} = ")
        assert len(str(caught.value)) < 200


@pytest.mark.parametrize("name", ["seed", "threads"])
def test_numbers_of_learners_have_at_most_128_bits(name: str) -> None:
    task = kreps.TaskSpec(1, [-1.0], [1.0])
    assert getattr(kreps.KREPS(task, **{name: 2**128 - 1}), name) == 2**128 - 1
    for value in (2**128, 10**400, 10**5000):
        with pytest.raises(ConfigurationError, match=f"{name} = .*128 bits"):
            kreps.KREPS(task, **{name: value})


def test_a_seed_of_128_bits_survives_a_checkpoint(tmp_path: Path) -> None:
    kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0]), seed=2**128 - 1).save(tmp_path / "x")
    assert kreps.KREPS.resume(tmp_path / "x").seed == 2**128 - 1


def test_an_update_without_enough_memory_is_an_error_of_the_library(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def too_large(*_: Any) -> Any:
        raise MemoryError("Unable to allocate 14.6 TiB")

    learner = kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0]))
    monkeypatch.setattr(learner, "_updated", too_large)
    with pytest.raises(ConfigurationError, match=r"needs more memory than there is .*lower"):
        learner.update([kreps.Rollout(np.zeros((3, 1)), np.zeros((2, 1)), np.zeros(2))])


@pytest.mark.parametrize("value", NO_COUNTS)
def test_the_size_of_a_grid_is_a_count(value: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"value\.size = "):
        settings_of(**{"value": "grid", "value.size": value})


AT_THE_EDGE: dict[str, list[Any]] = {
    "restart_probability": [1e-9, 0.999],
    "window": [None, 1, 10**15],
    "initial_rollouts": [1, 100_000],
    "exploration.scale": [1e-9],
    "kl_bound": [2, 1e-9],
    "eta_floor": [None, 0, 0.0],
    "ridge": [None, 1e-9],
    "exploring_starts": [0, 0.0, 1.0],
    "model": ["change", "embedding"],
    "policy_fit": ["bounded", "free"],
    "cross_validation": ["samples"],
    "value.max_rank": [1],
    "low_rank.above": [0],
    "model_based.actions_per_state": [1],
    "model_based.proposal_std_scale": [1, 2.5, 1000],
    "model_based.model_rollout_fraction": [0, 1.0],
    "model_based.acceptance_rollouts": [0, 2],
    "model_based.exploration_bonus": [0, 10.0],
    "model_based.improvement_steps": [0, 1],
    "model_based.random_policies": [0, 1],
    "model_based.regulators": [0, 1],
    "model_based.gradient_steps": [0, 1],
    "growth": [0, 0.5],
}


@pytest.mark.parametrize("name", AT_THE_EDGE)
def test_a_value_at_the_edge_of_its_range_is_taken(name: str) -> None:
    for value in AT_THE_EDGE[name]:
        assert flat(settings_of("model_based", **{name: value}))[name] == value


def test_numbers_of_numpy_are_stored_as_those_of_python() -> None:
    settings = settings_of(window=np.int64(3), kl_bound=np.float32(0.5), ridge=1)
    assert type(settings.window) is int and settings.window == 3
    assert type(settings.kl_bound) is float and settings.kl_bound == 0.5
    assert type(settings.ridge) is float


@pytest.mark.parametrize("changes", [{}, {"model_based": None}, {"ridge": 0.1}])
def test_without_a_learnt_model_there_are_no_generated_samples(changes: dict[str, Any]) -> None:
    remedy = r'preset="single_step".*model_based=None.*ridge=0.1'
    with pytest.raises(ConfigurationError, match=remedy):
        settings_of("model_based", model="sample", **changes)
    without = settings_of("model_based", model="sample", model_based=None, ridge=0.1)
    assert (without.model, without.model_based, without.ridge) == ("sample", None, 0.1)
    for preset in ("single_step", "paper"):
        assert settings_of(preset, model="sample").model == "sample"
        with pytest.raises(ConfigurationError, match="model_based = ModelBased"):
            settings_of(preset, model="sample", model_based=ModelBased())
        with pytest.raises(ConfigurationError, match="ridge = None"):
            settings_of(preset, model="sample", ridge=None)


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"temperature": value}, "temperature")
        for value in (0.0, -1.0, *NOT_FINITE, "1", None, 10**400)
    ]
    + [({"actions": value}, "actions") for value in (*NO_COUNTS, 100_001, 2**63)],
)
def test_value_iteration_refuses_values_out_of_range(changes: dict[str, Any], names: str) -> None:
    with pytest.raises(ConfigurationError, match=f"{names} = "):
        changed(ValueIterationSettings(), changes)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("lipschitz", [0, -1.0, *NOT_FINITE, None]),
        ("noise_scale", [0, -1.0, *NOT_FINITE, None]),
        ("noise_fraction", [-0.1, 1.1, *NOT_FINITE, None]),
    ],
)
def test_npalp_refuses_values_out_of_range(name: str, values: list[Any]) -> None:
    for value in values:
        with pytest.raises(ConfigurationError, match=f"{name} = "):
            changed(NPALPSettings(), {name: value})


@pytest.mark.parametrize(
    "ranges", ["ab", 7, [[1, 0]], [[0, 1, 2]], [[float("nan"), 1]], [[0, float("inf")]], [1, 2]]
)
def test_ranges_of_a_grid_are_pairs_of_finite_numbers(ranges: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"ranges = .*finite"):
        GridValueIterationSettings(ranges=ranges)
    assert GridValueIterationSettings(ranges=[[0, 1]]).ranges == ((0.0, 1.0),)  # type: ignore


@pytest.mark.parametrize("kind", [ValueIterationSettings, GridValueIterationSettings])
def test_there_are_at_most_as_many_candidate_actions_as_a_file_holds(kind: Any) -> None:
    assert kind(actions=6000).actions == 6000
    with pytest.raises(ConfigurationError, match=r"actions = 6001, .* from 1 to 6000"):
        kind(actions=6001)
