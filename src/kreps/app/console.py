"""Output of the command line."""

from __future__ import annotations

import os
import sys
import textwrap
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, TextIO, cast

from rich.console import Console
from rich.text import Text

from kreps.terminal import Output, printable

MIN_WIDTH = 20
"""Narrower terminals are written to as if they were as wide as this."""


def console() -> Console:
    """Standard output as it is now: its width may have changed since the start of the program."""
    output = Console()
    return output if output.width > 0 else Console(width=MIN_WIDTH)


def say(message: str, indent: int = 0) -> None:
    """Print plain text, without markup, as paths may hold brackets.

    In a terminal lines are broken between words, elsewhere not.

    Args:
        message: one or several lines.
        indent: spaces before the continuation of a line that is broken.
    """
    output = console()
    _print(output, Text(_broken(output, message, indent)))


def say_error(message: str) -> None:
    """Print the message of an error on standard error."""
    output = Console(stderr=True)
    text = Text(_broken(output, f"error: {message}"))
    text.stylize("bold red", 0, len("error:"))
    _print(output, text)


def say_command(label: str, command: str) -> None:
    """Print a command or path, which is not broken, so that it can be copied from the terminal."""
    _print(console(), Text(printable(f"{label}{command}")))


def _print(output: Console, text: Text) -> None:
    output.print(text, soft_wrap=True)


def _broken(output: Console, message: str, indent: int = 0) -> str:
    text = printable(message)
    if not output.is_terminal:
        return text
    wrapper = textwrap.TextWrapper(
        width=max(output.width, MIN_WIDTH),
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join(wrapper.fill(line) for line in text.split("\n"))


class Loss:
    """Whether standard output was lost; see `guarded`."""

    error: OSError | None = None


@contextmanager
def guarded() -> Iterator[Loss]:
    """Let no output raise: what cannot be written is dropped (`Output`).

    Yields:
        Afterwards its ``error`` is why standard output was lost: a full disk, for example.  It is
        None if nothing was lost, and where the reader of a pipe went away, as ``| head`` does.
    """
    loss = Loss()
    out, err = (None if stream is None else Output(stream) for stream in (sys.stdout, sys.stderr))
    usual, warnings.formatwarning = warnings.formatwarning, _format_warning
    try:
        with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, err)):
            yield loss
    finally:
        warnings.formatwarning = usual
        for stream in (out, err):
            if stream is not None:  # None if it was closed from the start
                stream.flush()
                if stream.error is not None:
                    _discard(stream)
        if out is not None and not isinstance(out.error, BrokenPipeError):
            loss.error = out.error


def _discard(stream: Output) -> None:
    """Send what is left in the buffer nowhere; Python would try again to write it at its end."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _format_warning(
    message: Warning | str, category: Any, filename: str, lineno: int, line: str | None = None
) -> str:
    """A warning without the place in the code, and without the colours that Gymnasium adds."""
    text = Text.from_ansi(str(message)).plain
    return f"{_broken(Console(stderr=True), f'warning: {text}')}\n"
