"""Output of the command line."""

from __future__ import annotations

from rich.console import Console

console = Console()


def say(message: str) -> None:
    """Print plain text: no markup, as paths may hold brackets, and no added line breaks."""
    console.print(message, markup=False, highlight=False, soft_wrap=True)
