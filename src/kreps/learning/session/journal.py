"""The folder of a session: a checkpoint, and one file for each rollout since the beginning.

A file of a rollout is written once, as a whole, after the rollout, and never again.  The
checkpoint is replaced after each update.  So a power cut loses at most the rollout in progress,
or an update, which is made again from the files of its rollouts.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kreps.data.rollouts import Rollouts
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, StorageError
from kreps.learning.planning import PlannedRollout
from kreps.learning.session.rollout import End, RecordedRollout
from kreps.learning.storage.atomic import given_path, remove_parts
from kreps.learning.storage.checkpoints import load_checkpoint
from kreps.learning.storage.codec import Tensors, Whole
from kreps.learning.storage.files import reading, write_arrays
from kreps.learning.storage.lock import locked
from kreps.learning.storage.rollouts import ROLLOUTS

if TYPE_CHECKING:
    from kreps.learning.learner import Learner


class Journal:
    """The files of one session.

    Attributes:
        path: of the folder.
        checkpoint_file: the learner after its latest update.
        rollouts_folder: a file per rollout; `kreps.rollout_folder` reads them as a data set.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = given_path(path)
        self.checkpoint_file = self.path / "checkpoint.safetensors"
        self.rollouts_folder = self.path / "rollouts"

    @contextmanager
    def open(self, learner: Learner[Any]) -> Iterator[None]:
        """Give the learner the state of the folder; let no other process learn in it meanwhile.

        Raises:
            ConfigurationError: the folder has another task, seed or other settings than the
                learner, or fewer updates.
            StorageError: the folder cannot be used, or another process learns in it.
        """
        try:
            self.rollouts_folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot make the folder {self.path}: {error}") from error
        with locked(self.path / ".lock"):
            remove_parts(self.checkpoint_file)
            for part in self.rollouts_folder.glob(".*.part"):
                part.unlink(missing_ok=True)
            if self.checkpoint_file.exists():
                self._restore(learner)
            else:
                learner.save(self.checkpoint_file)
            yield

    def _restore(self, learner: Learner[Any]) -> None:
        state, task, settings, seed = load_checkpoint(
            self.checkpoint_file, learner.method, learner.settings_type
        )
        made = learner.task
        if getattr(settings, "history", 0) == "auto":  # the updates have chosen both since
            made = replace(made, delay=task.delay, history=task.history)
        differing = [
            name
            for name, same in (
                ("task", _same(task, made)),
                ("settings", settings == learner.settings),
                ("seed", seed == learner.seed),
            )
            if not same
        ]
        if differing:
            raise ConfigurationError(
                f"{self.path} holds a session with another {' and another '.join(differing)} than "
                "this learner; make the learner as it was (the period is part of the task), or "
                "choose another folder"
            )
        if learner.state.iteration > state.iteration:
            raise ConfigurationError(
                f"the learner has made {learner.state.iteration} updates and the session in "
                f"{self.path} {state.iteration}, so going on there would lose some; make the "
                "learner anew, or choose another folder"
            )
        learner.state, learner.task = state, task

    def record(self, planned: PlannedRollout, recorded: RecordedRollout) -> None:
        """Write a rollout.

        Raises:
            StorageError: it cannot be written.
        """
        tensors: Tensors = {}
        header = {
            "rollouts": ROLLOUTS.encode(
                Rollouts.from_list([recorded.rollout]), "rollouts", tensors
            ),
            "end": recorded.end.value,
            "cycles": recorded.cycles,
            "late": recorded.late,
        }
        write_arrays(self._file(planned), "rollouts", tensors, header)

    def recorded(self, planned: PlannedRollout, task: TaskSpec) -> RecordedRollout | None:
        """The rollout that was planned so, if its file is there.

        Raises:
            StorageError: it is damaged, or of another task.
        """
        file = self._file(planned)
        if not file.exists():
            return None
        with reading(file, "rollouts") as (arrays, header):
            (rollouts,) = arrays.decode([("rollouts", ROLLOUTS, header["rollouts"])], {})
            for name in ("cycles", "late"):
                Whole().check(header[name], name, {}, {})
            rollouts.check(task)
            return RecordedRollout(
                rollouts[0], End(header["end"]), header["cycles"], header["late"]
            )

    def _file(self, planned: PlannedRollout) -> Path:
        name = f"{planned.iteration:06}-{planned.number:05}.safetensors"
        return self.rollouts_folder / name


def _same(task: TaskSpec, other: TaskSpec) -> bool:
    pairs = ((getattr(task, each.name), getattr(other, each.name)) for each in fields(TaskSpec))
    return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)
