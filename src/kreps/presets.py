"""Named settings, and changing some of them by name; the flat form that files hold.

The flat form of settings is one dictionary of plain values.  A field of a section has a dotted
name, such as ``"model_based.actions_per_state"``; an absent section is None; a section with several
kinds, such as ``value``, also has the name of its kind.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from kreps.errors import ConfigurationError
from kreps.legacy import present_name
from kreps.settings import (
    RKHS,
    Exploration,
    Grid,
    LearnerSettings,
    LowRank,
    ModelBased,
    Settings,
)

AnySettings = TypeVar("AnySettings", bound=LearnerSettings)

SINGLE_STEP = Settings(
    rollout_lengths="independent",
    eta_floor=0.1,
    ridge=0.1,
    exploring_starts=0.0,
    model="change",
    value=RKHS(angle_wrap="continuous"),
    model_based=None,
)

PRESETS: dict[str, Settings] = {
    "model_based": Settings(),
    "single_step": SINGLE_STEP,
    "paper": replace(
        SINGLE_STEP, kl_bound=0.5, eta_floor=0.02, model="embedding", policy_fit="bounded"
    ),
}
"""``"paper"`` follows the printed method where it is printed, with a low floor against a vanishing
temperature (``eta_floor=0`` takes it away).  ``"single_step"`` also makes one step on the actions
that were taken, with the changes that were found to learn faster.  ``"model_based"``, the default,
goes past the paper; docs/deviations.md has the changes and what they gain."""

KINDS: dict[str, dict[str, type[Any]]] = {
    "exploration": {"exploration": Exploration},
    "value": {"rkhs": RKHS, "grid": Grid},
    "low_rank": {"low_rank": LowRank},
    "model_based": {"model_based": ModelBased},
}
"""Of each section, the first is the default."""


def settings_of(preset: str | Settings = "model_based", /, **changes: Any) -> Settings:
    """The named (or given) preset with some parameters changed.

    Raises:
        ConfigurationError: unknown preset or parameter, or a value out of range.
    """
    if isinstance(preset, str) and preset in PRESETS:
        preset = PRESETS[preset]
    if not isinstance(preset, Settings):
        raise ConfigurationError(
            f"preset {preset!r} is unknown; choose one of {', '.join(map(repr, PRESETS))}"
        )
    return changed(preset, changes)


def changed(settings: AnySettings, changes: Mapping[str, Any]) -> AnySettings:
    """The settings with some parameters changed.

    Args:
        settings: of any learner.
        changes: new values by name, a whole section or one field of it (``"value.max_rank"``).  A
            section may be given by the name of its kind (``"grid"``), with that kind's defaults;
            a field of an absent section adds the section with its defaults.

    Raises:
        ConfigurationError: unknown parameter, or a value out of range.
    """
    known = [each.name for each in fields(settings)]
    new: dict[str, Any] = {}
    for name, value in changes.items():
        if "." not in name:
            new[name] = _section_named(name, value)
    for name, value in changes.items():
        section, _, part = name.partition(".")
        if part and section in known and section in KINDS:
            new[section] = _with_field(new.get(section, getattr(settings, section)), name, value)
        elif section not in known or part:
            raise ConfigurationError(_unknown(name, list(flat(settings))))
    return replace(settings, **new)


def flat(settings: LearnerSettings) -> dict[str, Any]:
    """The flat form: ``changed(type(settings)(), flat(settings)) == settings``."""
    values: dict[str, Any] = {}
    for each in fields(settings):
        value = getattr(settings, each.name)
        if not is_dataclass(value):
            values[each.name] = value
            continue
        if len(KINDS[each.name]) > 1:
            kinds = {kind: name for name, kind in KINDS[each.name].items()}
            values[each.name] = kinds[type(value)]
        for part in fields(value):
            values[f"{each.name}.{part.name}"] = getattr(value, part.name)
    return values


def _section_named(name: str, value: Any) -> Any:
    """A section by the name of its kind; any other value as it is."""
    if name in KINDS and isinstance(value, str):
        if value.lower() == "none":
            return None
        if value in KINDS[name]:
            return KINDS[name][value]()
    return value


def _with_field(section: Any, name: str, value: Any) -> Any:
    of, part = name.split(".", 1)
    if section is None:
        section = next(iter(KINDS[of].values()))()
    names = [each.name for each in fields(section)] if is_dataclass(section) else []
    if part not in names:
        raise ConfigurationError(_unknown(name, [f"{of}.{each}" for each in names]))
    return replace(section, **{part: value})


def _unknown(name: str, known: list[str]) -> str:
    renamed = present_name(name)
    hint = f" (it is called {renamed} now)" if renamed else ""
    return f"unknown parameter {name}{hint}; the parameters are {', '.join(known)}"
