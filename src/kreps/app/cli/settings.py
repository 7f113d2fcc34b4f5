"""Settings on the command line: their syntax, their help, and the command that lists them."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Annotated, Any

import typer

from kreps.app.console import say
from kreps.errors import ConfigurationError
from kreps.presets import PRESETS, flat, settings_of
from kreps.settings import LearnerSettings

SETTINGS_EXAMPLES = ("kreps settings", "kreps settings --preset paper")

INDENT = 4
"""Of the meaning of a setting, below its name."""


def parse_setting(text: str, option: str = "--set") -> tuple[str, Any]:
    """Name and value of ``NAME=VALUE``, given by an option of the command line.

    The value is read as JSON if it is valid JSON, ``none`` as None, and all else as a string.

    Raises:
        ConfigurationError: there is no equals sign.
    """
    name, equals, value = text.partition("=")
    if not equals:
        example = "kl_bound=0.5" if option == "--set" else "speed=0.5"
        raise ConfigurationError(f"{option} {text!r} is not NAME=VALUE, such as {example}")
    if value.lower() == "none":
        return name, None
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def descriptions(settings_type: type[Any]) -> dict[str, str]:
    """The text about each field, from the docstrings of a class and of its bases."""
    found: dict[str, str] = {}
    for each in reversed(settings_type.__mro__):
        found |= dict(_attributes(inspect.getdoc(each) or ""))
    return found


def _attributes(docstring: str) -> Iterator[tuple[str, str]]:
    """Names and texts of the section "Attributes" of a docstring."""
    _, _, attributes = docstring.partition("Attributes:\n")
    for name, text in re.findall(r"^    (\w+): ((?:.+\n?)(?:     +.+\n?)*)", attributes, re.M):
        yield name, " ".join(text.replace("``", "").split())


def settings(
    preset: Annotated[str, typer.Option(help=f"One of: {', '.join(PRESETS)}.")] = next(
        iter(PRESETS)
    ),
) -> None:
    """List all settings with their values in a preset and their meaning."""
    chosen = settings_of(preset)
    values = flat(chosen)
    say(f"Settings of the preset {preset}, for --set NAME=VALUE or flags such as --kl-bound 0.5\n")
    for name, text in _all_descriptions(chosen):
        value = values.get(name, "")
        say(name if value == "" else f"{name} = {'none' if value is None else value}")
        say(f"{'':<{INDENT}}{text}", indent=INDENT)


def _all_descriptions(chosen: LearnerSettings) -> Iterator[tuple[str, str]]:
    """Flat names and texts, each section followed by its fields."""
    for name, text in descriptions(type(chosen)).items():
        yield name, text
        section = getattr(chosen, name, None)
        if is_dataclass(section):
            for part, meaning in descriptions(type(section)).items():
                yield f"{name}.{part}", meaning
