"""Sections of README.md on pages of the site, so that each text is written once.

A page has the line ``<!-- section of README.md: HEADING -->`` where it belongs.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

README = Path(__file__).resolve().parents[2] / "README.md"
MARK = re.compile(r"^<!-- section of README\.md: (.+?) -->$", re.MULTILINE)
LINK = re.compile(r"(\]\()([^)#\s]+)([^)\s]*\))")


def section(heading: str) -> str:
    """The text below a heading of README.md, with its links as from the folder docs/."""
    _, found, rest = README.read_text().partition(f"\n## {heading}\n")
    if not found:
        raise ValueError(f"README.md has no section {heading!r}")
    text = rest.partition("\n## ")[0]
    return LINK.sub(
        lambda link: (
            link[0] if "://" in link[2] else link[1] + posixpath.relpath(link[2], "docs") + link[3]
        ),
        text,
    )


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Any) -> str:
    return MARK.sub(lambda found: section(found[1]), markdown)
