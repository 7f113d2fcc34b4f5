"""Output that never ends a computation: any encoding, closed pipes, full disks, foreign text.

What a command learns or measures is worth more than the lines about it.  So a stream that cannot be
written to any more is no error of the computation; the command line reports it at its end.
"""

from __future__ import annotations

import codecs
from collections.abc import Iterable
from typing import Any, TextIO

SPELLED = {"±": "+/-", "…": "...", "–": "-", "—": "-", "−": "-", "×": "x", "●": "*", "•": "*"}
"""ASCII in place of characters of the library's own texts."""

HORIZONTAL, VERTICAL = "─━═╌╍┄┅╴╶╸╺╼╾", "│┃║╎╏┆┇╵╷╹╻"
"""Lines of frames and bars; all other characters of frames are corners."""


def printable(text: str) -> str:
    r"""The text with control characters, except line breaks and tabs, as escapes such as ``\x1b``.

    Names and messages of environments and files may hold sequences that move the cursor, rename the
    window or hide text.
    """
    return "".join(
        c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text
    )


class Output:
    """A text stream that writes to another one and never raises.

    Characters that the encoding lacks are spelled in ASCII.  After a write that failed all further
    text is dropped.

    Args:
        stream: what is written to.

    Attributes:
        error: why text is dropped; None if it is not.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | None = None

    @property
    def encoding(self) -> str:
        return self._stream.encoding or "utf-8"

    def write(self, text: str) -> int:
        if self.error is None:
            try:
                self._stream.write(_encodable(text, self.encoding))
            except OSError as error:
                self.error = error
        return len(text)

    def flush(self) -> None:
        if self.error is None:
            try:
                self._stream.flush()
            except OSError as error:
                self.error = error

    def __getattr__(self, name: str) -> Any:  # such as `isatty` and `fileno`
        return getattr(self._stream, name)


def _encodable(text: str, encoding: str) -> str:
    """The text itself, or with an ASCII spelling of what the encoding lacks."""
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return text.encode(encoding, _SPELLING).decode(encoding)
    return text


def _ascii(characters: Iterable[str]) -> str:
    return "".join(
        SPELLED.get(c)
        or ("-" if c in HORIZONTAL else "|" if c in VERTICAL else "+" if "─" <= c <= "╿" else "?")
        for c in characters
    )


def _spell(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    return _ascii(error.object[error.start : error.end]), error.end


_SPELLING = "kreps.spelling"
codecs.register_error(_SPELLING, _spell)
