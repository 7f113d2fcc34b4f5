"""What the reference pages take from the code: the settings, and the help of the command line.

A page has the line ``<!-- generated: NAME -->`` where the text of a function below belongs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import typer.main
from rich.text import Text

from kreps.app.cli import app
from kreps.app.cli.settings import descriptions
from kreps.presets import PRESETS, PRESETS_OF, flat
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

MARK = re.compile(r"^<!-- generated: (.+?) -->$", re.MULTILINE)


def cell(text: str) -> str:
    """Text for a cell of a table, without line ends and bars."""
    return " ".join(text.split()).replace("|", "\\|")


def values_of(name: str, default: Any, presets: dict[str, dict[str, Any]]) -> str:
    """The default of a setting, and below it the presets in which it has another value."""
    others: dict[str, list[str]] = {}
    for preset, values in presets.items():
        if name in values and values[name] != default:
            others.setdefault(f"`{values[name]!r}`", []).append(preset)
    return "<br>".join([f"`{default!r}`", *(f"{', '.join(o)}: {v}" for v, o in others.items())])


def type_of(hint: Any) -> str:
    """A type in words: the alternatives of a union, the values of a choice."""
    if get_origin(hint) is Literal:
        return " or ".join(map(repr, get_args(hint)))
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(map(type_of, get_args(hint)))
    if isinstance(hint, type):
        return hint.__name__.replace("NoneType", "None")
    return str(hint)


def rows_of(kind: type[Any], prefix: str = "") -> Iterator[str]:
    """A table of the fields of a class of settings that are no sections."""
    yield "| setting | default | type | meaning |\n|---|---|---|---|"
    defaults, meaning, hints = flat(kind()), descriptions(kind), get_type_hints(kind)
    presets = {name: flat(preset) for name, preset in PRESETS_OF.get(kind, PRESETS).items()}
    for each in fields(kind):
        if each.name in defaults and each.name in meaning:
            name = prefix + each.name
            values = values_of(name, defaults[each.name], presets)
            cells = [f"`{name}`", values, type_of(hints[each.name]), meaning[each.name]]
            yield f"| {' | '.join(map(cell, cells))} |"


def settings() -> str:
    """The settings of each method and of each section."""
    parts = [
        ("KREPS", Settings, ""),
        ("Exploration", Exploration, "exploration."),
        ("RKHS: V in an RKHS", RKHS, "value."),
        ("Grid: V on a grid", Grid, "value."),
        ("LowRank", LowRank, "low_rank."),
        ("ModelBased", ModelBased, "model_based."),
        ("ValueIteration", ValueIterationSettings, ""),
        ("GridValueIteration", GridValueIterationSettings, ""),
        ("NPALP", NPALPSettings, ""),
    ]
    lines = []
    for heading, kind, prefix in parts:
        table = rows_of(kind, prefix)
        lines += [
            f"## {heading}",
            "",
            '<div class="settings" markdown>',
            "",
            *table,
            "",
            "</div>",
            "",
        ]
    return "\n".join(lines)


def plain(text: str | None) -> str:
    """Help without the markup of a terminal; the indented lines are examples or lists."""
    return Text.from_markup(text or "").plain


def command_line() -> str:
    """What ``--help`` says of each command, as Markdown."""
    group = typer.main.get_command(app)
    assert isinstance(group, typer.main.TyperGroup)
    lines = []
    for name, command in group.commands.items():
        context = command.make_context(name, [], resilient_parsing=True)
        lines += [f"## kreps {name}", "", plain(command.help), ""]
        pieces = " ".join(command.collect_usage_pieces(context))
        lines += ["```", f"kreps {name} {pieces}", "```", ""]
        records = [each.get_help_record(context) for each in command.get_params(context)]
        lines += ["| option | meaning |", "|---|---|"]
        lines += [f"| `{cell(names)}` | {cell(text)} |" for names, text in filter(None, records)]
        examples = [line.strip() for line in plain(command.epilog).split("\n\n")[1:]]
        lines += ["", "```", *examples, "```", ""]
    return "\n".join(lines)


GENERATED: dict[str, Callable[[], str]] = {"settings": settings, "command line": command_line}


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Any) -> str:
    return MARK.sub(lambda found: GENERATED[found[1]](), markdown)
