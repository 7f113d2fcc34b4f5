"""What several commands do with a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kreps.app.environments import make_environment
from kreps.app.run_folder import RunFolder
from kreps.errors import ConfigurationError
from kreps.learning.methods import KREPS

RunArgument = Annotated[Path, typer.Argument(help="Folder of the run.", show_default=False)]


def learnt(folder: RunFolder) -> KREPS:
    """The learner of a run, in its environment.

    Raises:
        ConfigurationError: the run has no update yet.
        StorageError: this is not a run folder, or a file is damaged.
    """
    config = folder.config()
    if not folder.checkpoint_file.exists():
        raise ConfigurationError(
            f"{folder.path} has no checkpoint yet; make the first update with "
            f"`kreps resume {folder.path}`"
        )
    return KREPS.resume(folder.checkpoint_file, make_environment(config.environment))
