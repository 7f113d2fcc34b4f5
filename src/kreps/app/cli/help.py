"""The help of commands in narrow terminals."""

from __future__ import annotations

from typing import Any

from rich.text import Text
from typer.core import TyperCommand

from kreps.app.console import console, say

TABLE_WIDTH = 72
"""Columns of a terminal that the tables of options need; narrower ones cut the names."""

LONG_NAME, LONG_TABLE_WIDTH = 24, 110
"""Letters of a name above which a table needs more columns, and how many: flags of settings."""

INDENT = 4


class Command(TyperCommand):
    """A command whose help is a list where the terminal is too narrow for tables."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        parameters = self.get_params(ctx)
        longest = max(len(name) for parameter in parameters for name in parameter.opts)
        if console().width >= (LONG_TABLE_WIDTH if longest > LONG_NAME else TABLE_WIDTH):
            super().format_help(ctx, formatter)
            return
        say(f"{self.get_usage(ctx)}\n\n{_plain(self.help)}\n")
        for parameter in parameters:
            record = parameter.get_help_record(ctx)
            if record is not None:
                names, text = record
                say(names, indent=INDENT)
                say(f"{'':<{INDENT}}{text}", indent=INDENT)
        say(f"\n{_plain(self.epilog)}")


def _plain(text: str | None) -> str:
    """Text without markup."""
    return Text.from_markup(text or "").plain
