"""Equations as MathML, which browsers draw by themselves: no script, no font and no network.

`pymdownx.arithmatex` finds ``$...$`` and ``$$...$$``; this turns what it found into MathML.
"""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

FOUND = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*\\[(\[](?P<tex>.*?)\\[)\]]\s*</(?P=tag)>', re.DOTALL
)


def on_page_content(content: str, *, page: Any, config: Any, files: Any) -> str:
    """Replace each equation of a page by MathML."""

    def typeset(found: re.Match[str]) -> str:
        tag = found["tag"]
        display = "block" if tag == "div" else "inline"
        mathml = convert(html.unescape(found["tex"]).strip(), display=display)
        return f'<{tag} class="equation">{mathml}</{tag}>'

    return FOUND.sub(typeset, content)
