"""Named settings, and changing some of them by name; the flat form that files hold.

The flat form of settings is one dictionary of plain values.  A field of a section has a dotted
name, such as ``"model_based.actions_per_state"``; an absent section is None; a section with several
kinds, such as ``value``, also has the name of its kind.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, get_args

from kreps.errors import ConfigurationError
from kreps.legacy import present_name, present_preset, present_settings
from kreps.settings import (
    RKHS,
    Exploration,
    Grid,
    GridValueIterationSettings,
    LearnerSettings,
    LowRank,
    ModelBased,
    Noise,
    NPALPSettings,
    Settings,
    ValueIterationSettings,
)

AnySettings = TypeVar("AnySettings", bound=LearnerSettings)

SINGLE_STEP = Settings(
    initial_rollouts=30,
    growth=0.0,
    restart_probability=0.02,
    action_repeat=1,
    window_steps=0,
    rollout_lengths="independent",
    eta_floor=0.1,
    ridge=0.1,
    exploring_starts=0.0,
    model="change",
    value=RKHS(angle_wrap="continuous"),
    model_based=None,
)

GAUSSIAN_START = Exploration(noise="gaussian")
"""The authors' first policy, with a standard deviation of half the action range."""

PRESETS: dict[str, Settings] = {
    "model_based": Settings(),
    "single_step": SINGLE_STEP,
    "paper": replace(
        SINGLE_STEP, kl_bound=0.5, eta_floor=0.02, model="embedding", policy_fit="bounded"
    ),
    "authors": replace(
        SINGLE_STEP,
        exploration=GAUSSIAN_START,
        kl_bound=0.5,
        eta_floor=0.0,
        ridge=1e-6,
        model="embedding",
        policy_fit="free",
        cross_validation="rollouts",
        value=RKHS(max_rank=3000, angle_wrap="continuous"),
        low_rank=None,
    ),
}
"""``"paper"`` follows the printed method where it is printed, with a low floor against a vanishing
temperature (``eta_floor=0`` takes it away).  ``"single_step"`` also makes one step on the actions
that were taken, with the changes that were found to learn faster.  ``"authors"`` follows what the
authors' experiment scripts say (docs/deviations.md).  ``"model_based"``, the default,
goes past the paper; docs/deviations.md has the changes and what they gain."""

PRESETS_OF: dict[type[Any], Mapping[str, Any]] = {
    Settings: PRESETS,
    ValueIterationSettings: {
        "default": ValueIterationSettings(),
        "authors": ValueIterationSettings(
            exploration=GAUSSIAN_START,
            temperature=1.0 / 3.0,
            temperature_unit="q",
            known_reward=True,
            cross_validation="rollouts",
        ),
    },
    GridValueIterationSettings: {
        "default": GridValueIterationSettings(),
        "authors": GridValueIterationSettings(
            grid_states=(19, 11),
            grid_actions=11,
            temperature=0.05,
            temperature_unit="q",
            known_reward=True,
            cross_validation="rollouts",
        ),
    },
    NPALPSettings: {
        "default": NPALPSettings(),
        "authors": NPALPSettings(
            exploration=GAUSSIAN_START,
            lipschitz=1.0,
            lipschitz_unit="raw",
            noise_fraction=0.1,
            noise_scale=0.6,
        ),
    },
}
"""The presets of each learner by the type of its settings."""

SECTIONS: dict[str, dict[str, Any]] = {
    "exploration": {noise: Exploration(noise=noise) for noise in get_args(Noise)},
    "value": {"rkhs": RKHS(), "grid": Grid()},
    "low_rank": {"low_rank": LowRank()},
    "model_based": {"model_based": ModelBased()},
}
"""The kinds of each section by name, with their defaults; the first one is the default."""


def settings_of(preset: str | Settings = "model_based", /, **changes: Any) -> Settings:
    """The named (or given) preset of `KREPS` with some parameters changed.

    Raises:
        ConfigurationError: unknown preset or parameter, or a value out of range.
    """
    return preset_of(Settings, preset, changes)


def preset_of(
    kind: type[AnySettings], preset: str | AnySettings, changes: Mapping[str, Any]
) -> AnySettings:
    """The named (or given) preset of a learner with some parameters changed.

    Args:
        kind: of the learner's settings.
        preset: one of ``PRESETS_OF[kind]``, or settings of this kind.
        changes: as of `changed`.

    Raises:
        ConfigurationError: unknown preset or parameter, or a value out of range.
    """
    presets = PRESETS_OF[kind]
    named = presets.get(preset) if isinstance(preset, str) else preset
    if not isinstance(named, kind):
        renamed = present_preset(preset) if isinstance(preset, str) else preset
        hint = f" (it is called {renamed!r} now)" if renamed != preset else ""
        owner = "kreps" if kind is Settings else "kreps.settings"
        raise ConfigurationError(
            f"preset {preset!r:.60} is unknown{hint}; choose one of "
            f"{', '.join(map(repr, presets))}, or give a {owner}.{kind.__name__}"
        )
    return changed(named, changes)


def changed(settings: AnySettings, changes: Mapping[str, Any]) -> AnySettings:
    """The settings with some parameters changed.

    Args:
        settings: of any learner.
        changes: new values by name, a whole section or one field of it (``"value.max_rank"``).  A
            section may be given by the name of its kind (``"grid"``, or ``"pink"`` for the noise of
            ``exploration``), with the defaults of that kind, or as ``"none"``.  A field of an
            absent section adds the section with its defaults.

    Raises:
        ConfigurationError: unknown parameter, a value out of range, or a field of a section that
            the same changes leave out.
    """
    known = [each.name for each in fields(settings)]
    new: dict[str, Any] = {}
    for name, value in changes.items():
        if "." not in name:
            if name not in known:
                raise ConfigurationError(_unknown(name, value, list(flat(settings))))
            new[name] = _section_named(name, value)
    for name, value in changes.items():
        section, dot, part = name.partition(".")
        if not dot:
            continue
        if section not in known or section not in SECTIONS:
            raise ConfigurationError(_unknown(name, value, list(flat(settings))))
        if section in new and new[section] is None:
            raise ConfigurationError(
                f"{name} = {value!r}, but {section} = None leaves that section out; "
                "give one of the two"
            )
        new[section] = _with_field(new.get(section, getattr(settings, section)), name, part, value)
    return replace(settings, **new)


def flat(settings: LearnerSettings) -> dict[str, Any]:
    """The flat form: ``changed(type(settings)(), flat(settings)) == settings``."""
    values: dict[str, Any] = {}
    for each in fields(settings):
        value = getattr(settings, each.name)
        if not is_dataclass(value):
            values[each.name] = value
            continue
        kinds = {type(default): kind for kind, default in SECTIONS[each.name].items()}
        if len(kinds) > 1:
            values[each.name] = kinds[type(value)]
        for part in fields(value):
            values[f"{each.name}.{part.name}"] = getattr(value, part.name)
    return values


def _section_named(name: str, value: Any) -> Any:
    """A section by the name of its kind; any other value as it is."""
    if name not in SECTIONS or not isinstance(value, str):
        return value
    kinds = SECTIONS[name]
    if value.lower() == "none":
        return None
    if value not in kinds:
        owners = dict.fromkeys(f"kreps.{type(kind).__name__}(...)" for kind in kinds.values())
        raise ConfigurationError(
            f"{name} = {value!r:.60} is unknown; choose one of {', '.join(map(repr, kinds))}, or "
            f"give {' or '.join(owners)}"
        )
    return kinds[value]


def _with_field(section: Any, name: str, part: str, value: Any) -> Any:
    """A section with one field changed; None stands for the default kind of the section."""
    owner = name.partition(".")[0]
    if section is None:
        section = next(iter(SECTIONS[owner].values()))
    names = [each.name for each in fields(section)] if is_dataclass(section) else []
    if part not in names:
        raise ConfigurationError(_unknown(name, value, [f"{owner}.{each}" for each in names]))
    try:
        return replace(section, **{part: value})
    except ConfigurationError as error:  # begins with the name of the field
        raise ConfigurationError(f"{owner}.{error}") from error


def _unknown(name: str, value: Any, known: list[str]) -> str:
    """The message about an unknown parameter, with its present name if it is one of version 0.1."""
    return f"unknown parameter {name}{_hint(name, value)}; the parameters are {', '.join(known)}"


def _hint(name: str, value: Any) -> str:
    renamed = present_name(name)
    if renamed is None:
        return ""
    if name == "recipe":
        preset = present_preset(value) if isinstance(value, str) else value
        return f" (it is called preset now: write preset={preset!r:.40})"
    translated = present_settings({name: value}) or {renamed: value}
    written = ", ".join(
        f'**{{"{new}": {v!r:.40}}}' if "." in new else f"{new}={v!r:.40}"
        for new, v in translated.items()
    )
    return f" (it is called {renamed} now: write {written})"
