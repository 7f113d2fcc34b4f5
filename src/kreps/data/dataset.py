"""Any number of transitions, in chunks that need not be in memory."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from kreps.data.compute import CHUNK_SIZE
from kreps.data.history import stacked
from kreps.data.rollouts import Rollout, Rollouts, Transitions
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray


class Chunk(Protocol):
    """Some whole rollouts, read when they are needed, perhaps by another process.

    Implemented by `Rollouts` in memory, `ArrayChunk` and `kreps.learning.storage.RolloutFile`.
    """

    @property
    def steps(self) -> int:
        """Number of samples."""
        ...

    def load(self) -> Rollouts:
        """The rollouts in memory, with their values checked."""
        ...


@dataclass(frozen=True)
class ArrayChunk:
    """Rollouts in arrays whose values are read and checked by each `load`, such as memory maps."""

    unread: Rollouts

    @property
    def steps(self) -> int:
        return self.unread.steps

    def load(self) -> Rollouts:
        return self.unread.read()


@dataclass(frozen=True)
class StackedChunk:
    """A chunk whose points are states with earlier observations and actions.

    Attributes:
        chunk: with observations as points.
        task: how many observations and actions a state has.
    """

    chunk: Chunk
    task: TaskSpec

    @property
    def steps(self) -> int:
        return self.chunk.steps

    def load(self) -> Rollouts:
        """The rollouts in memory.

        Raises:
            DataError: observations or actions of another width than the task's.
        """
        rollouts = self.chunk.load()
        rollouts.check(self.task)
        return stacked(rollouts, self.task)


@dataclass(frozen=True)
class Dataset:
    """Chunks of whole rollouts: in memory, memory-mapped, or a folder of files.

    See `Dataset.from_rollouts`, `Dataset.from_arrays` and `kreps.rollout_folder`.
    """

    chunks: tuple[Chunk, ...]

    def __post_init__(self) -> None:
        if not self.chunks:
            raise DataError("there is no rollout to learn from; give at least one")

    @classmethod
    def from_rollouts(cls, rollouts: Iterable[Rollout], *, chunk_size: int = CHUNK_SIZE) -> Dataset:
        """Rollouts in memory.

        Args:
            rollouts: at least one.
            chunk_size: a chunk ends with the rollout that fills this many samples.

        Raises:
            DataError: no rollout, something that is no rollout, or different widths.
        """
        flat = Rollouts.from_list(rollouts)
        return cls(tuple(flat[part] for part in chunk_slices(flat.offsets, chunk_size)))

    @classmethod
    def from_arrays(
        cls,
        observations: FloatArray,
        actions: FloatArray,
        rewards: FloatArray,
        lengths: Sequence[int] | IntArray,
        terminated: Sequence[bool] | BoolArray | None = None,
        *,
        chunk_size: int = CHUNK_SIZE,
    ) -> Dataset:
        """R rollouts laid end to end in arrays, such as ``np.load(path, mmap_mode="r")``.

        Args:
            observations: (n + R, ds), those of each rollout followed by its last successor.
            actions: (n, da) as commanded.
            rewards: (n,).
            lengths: (R,) steps of each rollout.
            terminated: (R,) whether the task ended with its last step; None if none did.
            chunk_size: a chunk ends with the rollout that fills this many samples.

        Raises:
            DataError: no rollout, or sizes that do not fit together.
        """
        flat = Rollouts.from_arrays(observations, actions, rewards, lengths, terminated, read=False)
        parts = chunk_slices(flat.offsets, chunk_size)
        return cls(tuple(ArrayChunk(flat[part]) for part in parts))

    def with_states(self, task: TaskSpec) -> Dataset:
        """The same samples with states of the task as points, where these are no observations."""
        if task.state_size == task.observation_size:
            return self
        return Dataset(tuple(StackedChunk(chunk, task) for chunk in self.chunks))

    def __len__(self) -> int:
        """Number of samples n."""
        return int(self.offsets[-1])

    @cached_property
    def offsets(self) -> IntArray:
        """(chunks + 1,) number of samples before each chunk, and n."""
        return np.cumsum([0, *(chunk.steps for chunk in self.chunks)])

    def split(self, values: FloatArray) -> list[FloatArray]:
        """The parts of ``values`` (n, ...) that belong to each chunk."""
        return np.split(values, self.offsets[1:-1])

    def first(self, steps: int) -> Rollouts:
        """The rollouts of the first chunks, of as many as have so many samples, or of all."""
        count = int(np.searchsorted(self.offsets[1:], steps)) + 1
        return Rollouts.from_list([each for chunk in self.chunks[:count] for each in chunk.load()])

    def take(self, rows: IntArray) -> Transitions:
        """The samples of these numbers, which must ascend."""
        parts = []
        bounds = np.searchsorted(rows, self.offsets)
        for i, chunk in enumerate(self.chunks):
            chosen = rows[bounds[i] : bounds[i + 1]] - self.offsets[i]
            if len(chosen):
                parts.append(chunk.load().transitions.rows(chosen))
        return Transitions.concat(parts)


def chunk_slices(offsets: IntArray, chunk_size: int) -> list[slice]:
    """Which rollouts each chunk holds, from the number of samples before each of them (R + 1,)."""
    if chunk_size < 1:
        raise ConfigurationError(f"chunk_size = {chunk_size}, but it must be at least 1")
    count, first, slices = len(offsets) - 1, 0, []
    while first < count:
        last = min(int(np.searchsorted(offsets, offsets[first] + chunk_size)), count)
        slices.append(slice(first, last))
        first = last
    return slices
