"""Equations as MathML, which browsers draw by themselves: no script, no font and no network.

`pymdownx.arithmatex` finds ``$...$`` and ``$$...$$``; this turns what it found into MathML.
"""

from __future__ import annotations

import html
import re
from typing import Any
from xml.etree.ElementTree import Element, tostring

from latex2mathml.converter import convert_to_element

FOUND = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*\\[(\[](?P<tex>.*?)\\[)\]]\s*</(?P=tag)>', re.DOTALL
)
PRIME = "&#x02032;"


def place_primes(mathml: Element) -> None:
    """Put primes beside their symbols: as superscripts, without a font for mathematics, they are
    small dots far above the line."""
    for node in list(mathml.iter()):
        if node.tag not in ("msup", "msubsup") or node[-1].text != PRIME:
            continue
        symbol, *subscript, prime = node
        if subscript:
            symbol = Element("msub")
            symbol.extend(node[:2])
        prime.tag = "mo"
        prime.attrib.update(lspace="0", rspace="0")
        node[:] = [symbol, prime]
        node.tag = "mrow"


def mathml_of(tex: str, display: str) -> str:
    mathml = convert_to_element(tex, display=display)
    place_primes(mathml)
    return tostring(mathml, encoding="unicode").replace("&amp;#", "&#")


def on_page_content(content: str, *, page: Any, config: Any, files: Any) -> str:
    """Replace each equation of a page by MathML."""

    def typeset(found: re.Match[str]) -> str:
        tag = found["tag"]
        display = "block" if tag == "div" else "inline"
        mathml = mathml_of(html.unescape(found["tex"]).strip(), display)
        return f'<{tag} class="equation">{mathml}</{tag}>'

    return FOUND.sub(typeset, content)
