"""A flag for each setting, made from the settings' own fields and docstrings."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache, wraps
from types import NoneType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import typer

from kreps.app.cli.settings import descriptions
from kreps.presets import SECTIONS, flat
from kreps.settings import Settings

Command = TypeVar("Command", bound=Callable[..., Any])

PANEL = "Settings, with the defaults of the preset model_based"

TYPES = {int: "INTEGER", float: "FLOAT"}


def with_settings(command: Command) -> Command:
    """The command with a flag for each setting.

    ``--kl-bound 0.5`` is ``--set kl_bound=0.5``: it is appended to the command's argument ``set_``,
    so names and values are checked in one place.
    """
    names = all_settings()

    @wraps(command)
    def run(**given: Any) -> Any:
        values = {name: given.pop(_identifier(name)) for name in names}
        given["set_"] = [
            *given["set_"],
            *(f"{name}={value}" for name, value in values.items() if value is not None),
        ]
        return command(**given)

    signature = inspect.signature(command, eval_str=True)
    added = [
        inspect.Parameter(
            _identifier(name),
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=_option(name, setting),
        )
        for name, setting in names.items()
    ]
    run.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[*signature.parameters.values(), *added]
    )
    return run  # type: ignore[return-value]


def _identifier(name: str) -> str:
    return f"setting_{name.replace('.', '_')}"


@dataclass(frozen=True)
class Setting:
    """A setting as a flag shows it.

    Attributes:
        panel: heading of its group.
        text: its description.
        choices: words, and names of types in capitals.
        default: of the preset model_based, or of its section.
    """

    panel: str
    text: str
    choices: list[str]
    default: Any


@cache
def all_settings() -> dict[str, Setting]:
    """All settings by their dotted names."""
    found: dict[str, Setting] = {}
    hints, texts, defaults = get_type_hints(Settings), descriptions(Settings), flat(Settings())
    for field in fields(Settings):
        name, hint = field.name, hints[field.name]
        kinds = list(SECTIONS.get(name, ()))
        choices = kinds + ["none"] * (NoneType in get_args(hint)) if kinds else _choices(hint)
        default = kinds[0] if kinds else defaults[name]
        found[name] = Setting(PANEL, texts[name], choices, default)
    for section, kinds_of in SECTIONS.items():
        types = {type(default): kind for kind, default in kinds_of.items()}
        for section_type, kind in types.items():
            hints, texts = get_type_hints(section_type), descriptions(section_type)
            panel = f"Settings of {section}" + (f"={kind}" if len(types) > 1 else "")
            for field in fields(section_type):
                choices = _choices(hints[field.name])
                setting = Setting(panel, texts[field.name], choices, field.default)
                found[f"{section}.{field.name}"] = setting
    return found


def _choices(hint: Any) -> list[str]:
    """What a setting of this type may be: words, and names of types in capitals."""
    if get_origin(hint) is Literal:
        return [str(each) for each in get_args(hint)]
    if hint in TYPES or hint is NoneType:
        return [TYPES.get(hint, "none")]
    return [word for part in get_args(hint) for word in _choices(part)]


def _option(name: str, setting: Setting) -> Any:
    """The annotation of a flag, with the first sentence about the setting as its help."""
    sentence = re.split(r"(?<=\.)\s(?=[A-Z])", setting.text)[0]
    if sentence[1].isalpha():
        sentence = sentence[0].upper() + sentence[1:]
    default = "none" if setting.default is None else setting.default
    option = typer.Option(
        f"--{name.replace('_', '-')}",
        help=f"{sentence} (default: {default})",
        metavar="|".join(setting.choices),
        show_default=False,
        rich_help_panel=setting.panel,
        autocompletion=_completion([w for w in setting.choices if w not in TYPES.values()]),
    )
    return Annotated[str | None, option]


def _completion(words: list[str]) -> Callable[[str], list[str]]:
    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete
