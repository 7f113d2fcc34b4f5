"""Rollouts as files, and folders of such files as data sets."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout, Rollouts
from kreps.errors import DataError, StorageError
from kreps.learning.storage.atomic import given_path
from kreps.learning.storage.codec import (
    DATA,
    Array,
    Converted,
    Optional,
    Record,
    Sizes,
    Tensors,
)
from kreps.learning.storage.files import (
    MAX_FILE_BYTES,
    NO_CHECKSUM,
    Header,
    reading,
    warn_of,
    write_arrays,
)


def _checked(rollouts: Rollouts, given: Mapping[str, Any]) -> Rollouts:
    """The rollouts, once their offsets are known to fit the other arrays."""
    offsets, n = rollouts.offsets, len(rollouts.rewards)
    increasing = bool((offsets[1:] > offsets[:-1]).all())  # differences might overflow
    if not (len(offsets) > 1 and increasing and offsets[0] == 0 and offsets[-1] == n):
        raise StorageError(
            f"the offsets of its rollouts do not increase from 0 to {n}, its number of steps"
        )
    for values in (rollouts.points, rollouts.actions, rollouts.rewards, rollouts.times):
        if values is not None:
            values.flags.writeable = False
    return rollouts


ROLLOUTS = Converted(
    Record(
        Rollouts,
        {
            "rewards": Array(("n",), DATA),
            "terminated": Array(("R",), dtype="BOOL"),
            "offsets": Array(("R+1",), dtype="I64"),
            "points": Array(("n+R", "do"), DATA),
            "actions": Array(("n", "da"), DATA),
            "times": Optional(Array(("n+R",), DATA)),
        },
        omitted=("times",),
    ),
    lambda rollouts: rollouts,
    _checked,
)
"""R rollouts of n steps in all, of do coordinates of an observation."""


def save_rollouts(
    rollouts: Iterable[Rollout] | Rollout, path: str | Path, max_bytes: int = MAX_FILE_BYTES
) -> None:
    """Write at least one rollout to a file of at most ``max_bytes``; see `load_rollouts`.

    Raises:
        DataError: no rollout, something else, or rollouts of different widths.
        StorageError: the file cannot be written.
    """
    flat = Rollouts.from_list([rollouts] if isinstance(rollouts, Rollout) else rollouts)
    if not flat:
        raise DataError("there is no rollout to save; give at least one")
    tensors: Tensors = {}
    header = {"rollouts": ROLLOUTS.encode(flat, "rollouts", tensors)}
    write_arrays(path, "rollouts", tensors, header, max_bytes)


def load_rollouts(path: str | Path) -> Rollouts:
    """Rollouts written by `save_rollouts`, of this or an earlier version.

    Raises:
        StorageError: the file is missing, damaged or foreign.
    """
    rollouts, header = _loaded(path)
    warn_of(path, header, stacklevel=2)
    return rollouts


def _loaded(path: str | Path) -> tuple[Rollouts, Header]:
    with reading(path, "rollouts") as (arrays, header):
        rollouts: Rollouts
        (rollouts,) = arrays.decode([("rollouts", ROLLOUTS, header["rollouts"])], {})
    return rollouts, header


@dataclass(frozen=True)
class RolloutFile:
    """A file of rollouts as a chunk of a data set, which is read whenever it is needed.

    Attributes:
        path: absolute, as processes that read it may have other working directories.
        steps: number of steps in it.
    """

    path: Path
    steps: int

    def load(self) -> Rollouts:
        """The rollouts.

        Raises:
            StorageError: the file is damaged, or has another number of steps.
        """
        rollouts, _ = _loaded(self.path)
        if rollouts.steps != self.steps:
            raise StorageError(
                f"{self.path} holds {rollouts.steps} samples, but had {self.steps} when the folder "
                "was opened; open it again"
            )
        return rollouts


def rollout_folder(path: str | Path) -> Dataset:
    """The files of rollouts (``*.safetensors``) in a folder, in the order of their names.

    Hidden files are no part of it, such as the ``._`` companions that macOS leaves beside copies.

    Raises:
        StorageError: no such folder, or a file in it that is damaged or foreign.
    """
    # other processes may have another working directory
    folder = Path(os.path.realpath(given_path(path)))
    if not os.path.isdir(folder):  # noqa: PTH112 (a name that is too long is no error of its own)
        raise StorageError(f"{folder} is not a folder; check the path")
    found = folder.glob("*.safetensors")
    files = sorted(file for file in found if not file.name.startswith("."))
    if not files:
        raise StorageError(
            f"{folder} holds no *.safetensors; write rollouts there with kreps.save_rollouts"
        )
    chunks, without = [], 0
    for file in files:
        with reading(file, "rollouts", verify=False) as (arrays, header):  # verified by `load`
            sizes: Sizes = {}
            ROLLOUTS.check(header["rollouts"], "rollouts", dict(arrays.layout), sizes)
            if sizes["n"] < 1:
                raise StorageError("it holds no step")
        chunks.append(RolloutFile(file, sizes["n"]))
        without += NO_CHECKSUM in header["notes"]
    if without:
        warnings.warn(
            f"{folder}: {without} of its {len(files)} files have no checksum, as those of earlier "
            "versions, so damage to them would go unnoticed; save them again with this version",
            UserWarning,
            stacklevel=2,
        )
    return Dataset(tuple(chunks))
