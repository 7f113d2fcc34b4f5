"""What the reference pages take from the code: the settings, and the help of the command line.

A page has the line ``<!-- generated: NAME -->`` where the text of a function below belongs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any

import typer.main
from rich.text import Text

from kreps.app.cli import app
from kreps.app.cli.settings import descriptions
from kreps.presets import PRESETS, flat
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
    """Text for a cell of a table: types and names of sections as code, no line ends, no bars."""
    return " ".join(text.split()).replace("|", "\\|")


def shown(value: Any) -> str:
    return f"`{value!r}`"


def rows_of(kind: type[Any], prefix: str = "") -> Iterator[str]:
    """A table of the fields of a class of settings that are no sections."""
    presets = PRESETS if kind is Settings or prefix else {}
    heads = ["setting", "type", *(presets or ["default"]), "meaning"]
    yield "| " + " | ".join(heads) + " |"
    yield "|---" * len(heads) + "|"
    default = flat(kind())
    values = {name: flat(preset) for name, preset in presets.items()}
    meaning = descriptions(kind)
    for each in fields(kind):
        name = prefix + each.name
        if each.name not in default:
            continue
        columns = [of.get(name, "-") for of in values.values()] if values else [default[each.name]]
        cells = [shown(value) if value != "-" else "-" for value in columns]
        text = [f"`{name}`", f"`{cell(str(each.type))}`", *cells, cell(meaning[each.name])]
        yield "| " + " | ".join(text) + " |"


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
        lines += [f"## {heading}", "", *rows_of(kind, prefix), ""]
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
