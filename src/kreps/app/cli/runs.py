"""What several commands do with a run folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from kreps.app.cli.paths import PATH
from kreps.app.environments import environment_of
from kreps.app.run_folder import RunFolder
from kreps.errors import ConfigurationError
from kreps.learning.methods import KREPS

RunArgument = Annotated[
    Path,
    typer.Argument(help="Folder of the run.", show_default=False, **{**PATH, "metavar": "RUN"}),
]


@contextmanager
def learnt(folder: RunFolder) -> Iterator[KREPS]:
    """The learner of a run, in its environment, which is closed at the end.

    Raises:
        ConfigurationError: the run has no update yet.
        StorageError: this is not a run folder, or a file is damaged.
    """
    require_checkpoint(folder)
    with environment_of(folder.config()) as env:
        yield KREPS.resume(folder.checkpoint_file, env)


def require_checkpoint(folder: RunFolder) -> None:
    """Check that a run has made an update.

    Raises:
        ConfigurationError: the run has no update yet.
        StorageError: this is not a run folder.
    """
    folder.config()
    if not folder.checkpoint_file.exists():
        raise ConfigurationError(
            f"{folder.path} has no checkpoint yet; make the first update with "
            f"`kreps resume {folder.path}`"
        )
