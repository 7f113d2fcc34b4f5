"""The command line: train, resume, import, settings, evaluate, diagnose, export and so on.

Each module has the commands of one purpose; this one assembles them.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from inspect import getdoc
from typing import Annotated, Any

import typer

import kreps
from kreps.app.cli.envs import ENVS_EXAMPLES, envs
from kreps.app.cli.export import CARD_EXAMPLES, EXPORT_EXAMPLES, card, export
from kreps.app.cli.flags import with_settings
from kreps.app.cli.help import Command
from kreps.app.cli.inspect import (
    DIAGNOSE_EXAMPLES,
    EVALUATE_EXAMPLES,
    PLOT_EXAMPLES,
    VIDEO_EXAMPLES,
    diagnose,
    evaluate,
    plot,
    video,
)
from kreps.app.cli.recorded import IMPORT_EXAMPLES, import_
from kreps.app.cli.reproduce import REPRODUCE_EXAMPLES, SEARCH_EXAMPLES, reproduce, search
from kreps.app.cli.settings import SETTINGS_EXAMPLES, settings
from kreps.app.cli.train import RESUME_EXAMPLES, TRAIN_EXAMPLES, resume, train
from kreps.app.cli.tune import TUNE_EXAMPLES, tune
from kreps.app.console import guarded, say, say_error
from kreps.errors import KrepsError
from kreps.terminal import printable

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="Kernel-based, non-parametric policy search: REPS with RKHS embeddings.\n\n"
    "[bold]Start here:[/bold]  kreps train kreps/SwingUp-v0 --out runs/swing-up",
)


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        say(f"kreps {kreps.__version__}")
        raise typer.Exit


def _add(command: Callable[..., Any], examples: Sequence[str], name: str | None = None) -> None:
    lines = "\n\n".join(f"  {example}" for example in examples)
    help_ = getdoc(command)
    app.command(name, cls=Command, help=help_, epilog=f"Examples:\n\n{lines}")(command)


_add(with_settings(train), TRAIN_EXAMPLES)
_add(resume, RESUME_EXAMPLES)
_add(import_, IMPORT_EXAMPLES, name="import")
_add(with_settings(tune), TUNE_EXAMPLES)
_add(settings, SETTINGS_EXAMPLES)
_add(envs, ENVS_EXAMPLES)
_add(evaluate, EVALUATE_EXAMPLES)
_add(plot, PLOT_EXAMPLES)
_add(diagnose, DIAGNOSE_EXAMPLES)
_add(video, VIDEO_EXAMPLES)
_add(export, EXPORT_EXAMPLES)
_add(card, CARD_EXAMPLES)
_add(reproduce, REPRODUCE_EXAMPLES)
_add(search, SEARCH_EXAMPLES)


def main() -> None:
    """Run the command line; an error of the library is printed as one line, not as a traceback.

    Modules of environments are found in the current folder, too, as with ``python -m kreps``.  A
    terminal that is closed, or ``kill``, ends the program as Ctrl-C does: environments are closed.
    """
    if "" not in sys.path:
        sys.path.append("")
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP, and nohup ignores it
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)
    with guarded() as loss:
        code = _run()
    if loss.error is not None:
        stored = "" if code else "; all files of the command are written"
        say_error(f"standard output was lost: {loss.error.strerror}{stored}")
        code = code or 1
    sys.exit(code)


def _run() -> int:
    """Run a command and return its exit status."""
    try:
        # a command's typer.Exit is returned as its code
        return app(prog_name="kreps", standalone_mode=False) or 0
    except KrepsError as error:
        say_error(str(error))
    except Exception as error:
        if not hasattr(error, "show"):
            raise
        if hasattr(error, "message"):  # a usage error of the command line
            error.message = printable(error.message)
        with suppress(OSError):
            error.show()
    return 2
