"""Paths on the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer


def _path(given: str | Path) -> Path:
    """A path; an empty one would be the current folder."""
    if given == "":
        raise typer.BadParameter("the path is empty; give its name, or . for the current folder")
    return Path(given)


PATH: dict[str, Any] = {"parser": _path, "metavar": "PATH"}
"""Of options and arguments that are paths."""
