"""Any number of transitions, in chunks that need not be in memory."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import is_sane
from kreps.errors import DataError
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray

CHUNK = 8192
"""Samples per chunk, about: 64 MB for each 1000 features."""


class Chunk(Protocol):
    """Some whole roll-outs, to be read when they are needed, perhaps by another process."""

    def __len__(self) -> int:
        """Number of samples."""
        ...

    def load(self) -> Transitions:
        """The transitions."""
        ...


@dataclass(frozen=True)
class RolloutChunk:
    """Roll-outs in memory."""

    rollouts: tuple[Rollout, ...]

    def __len__(self) -> int:
        return sum(len(rollout) for rollout in self.rollouts)

    def load(self) -> Transitions:
        return Transitions.from_rollouts(self.rollouts)


@dataclass(frozen=True)
class ArrayChunk:
    """Roll-outs laid end to end in arrays, which may be memory-mapped."""

    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    lengths: IntArray
    terminated: BoolArray

    def __len__(self) -> int:
        return len(self.rewards)

    def load(self) -> Transitions:
        values = [
            np.array(each, dtype=np.float64)  # off the disk, once
            for each in (self.observations, self.actions, self.rewards)
        ]
        for name, each in zip(("observations", "actions", "rewards"), values, strict=True):
            if not is_sane(each).all():
                row = int(np.argwhere(~is_sane(each))[0, 0])
                raise DataError(
                    f"{name} hold NaN, an infinity or an absurdly large number, first in row {row} "
                    f"of a chunk of {len(each)}; leave that roll-out out"
                )
        points, actions, rewards = values
        return Transitions.from_arrays(points, actions, rewards, self.lengths, self.terminated)


@dataclass(frozen=True)
class Dataset:
    """Chunks of whole roll-outs: in memory, memory-mapped, or a folder of files.

    See `Dataset.from_rollouts`, `Dataset.from_arrays` and `kreps.rollout_folder`.
    """

    chunks: tuple[Chunk, ...]

    def __post_init__(self) -> None:
        if not self.chunks:
            raise DataError("there is no roll-out to learn from; give at least one")

    @classmethod
    def from_rollouts(cls, rollouts: Iterable[Rollout]) -> Dataset:
        """Roll-outs in memory.

        Raises:
            DataError: none, something that is no roll-out, or different widths.
        """
        if isinstance(rollouts, Rollout):
            raise DataError(
                "a data set has several roll-outs; write Dataset.from_rollouts([rollout])"
            )
        groups: list[list[Rollout]] = []
        size, widths = CHUNK, None
        for number, rollout in enumerate(rollouts):
            if not isinstance(rollout, Rollout):
                raise DataError(f"item {number} is a {type(rollout).__name__}, not a kreps.Rollout")
            found = rollout.observations.shape[1], rollout.actions.shape[1]
            widths = widths or found
            if found != widths:
                raise DataError(
                    f"roll-out {number} has (observation, action) coordinates {found}, those "
                    f"before it {widths}; make a data set of each task's"
                )
            if size >= CHUNK:
                groups.append([])
                size = 0
            groups[-1].append(rollout)
            size += len(rollout)
        return cls(tuple(RolloutChunk(tuple(group)) for group in groups))

    @classmethod
    def from_arrays(
        cls,
        observations: FloatArray,
        actions: FloatArray,
        rewards: FloatArray,
        lengths: Sequence[int] | IntArray,
        terminated: Sequence[bool] | BoolArray | None = None,
    ) -> Dataset:
        """R roll-outs laid end to end in arrays, such as ``np.load(path, mmap_mode="r")``.

        Args:
            observations: (n + R, ds), those of each roll-out followed by its last successor.
            actions: (n, da) as commanded.
            rewards: (n,).
            lengths: (R,) steps of each roll-out.
            terminated: (R,) whether each really ended the task; None if none did.

        Raises:
            DataError: sizes that do not fit together.
        """
        # as any array: a memory map stays one
        observations, actions, rewards = map(np.asanyarray, (observations, actions, rewards))
        given = np.atleast_1d(lengths)
        steps = np.where(np.isfinite(given), given, 0).astype(np.intp)
        ended = np.zeros(len(steps), bool)
        if terminated is not None:
            ended = np.atleast_1d(np.asarray(terminated, bool))
        n = len(rewards)
        fits = (
            (observations.ndim, actions.ndim, rewards.ndim) == (2, 2, 1)
            and steps.ndim == 1
            and (steps == given).all()
            and (steps >= 1).all()
            and steps.sum() == n == len(actions)
            and len(observations) == n + len(steps)
            and len(ended) == len(steps)
        )
        if not fits:
            raise DataError(
                f"observations {observations.shape}, actions {actions.shape}, rewards "
                f"{rewards.shape} and {len(steps)} lengths that add up to {steps.sum()} do not fit "
                "together: R roll-outs of n steps in all need (n + R, ds), (n, da), (n,) and (R,)"
            )
        if n == 0:
            return cls(())
        ends = np.cumsum(steps)
        # a new chunk begins with the roll-out in which another CHUNK samples are full
        cuts = np.flatnonzero(np.diff((ends - steps) // CHUNK, prepend=-1))
        chunks = []
        for low, high in zip(cuts, [*cuts[1:], len(steps)], strict=True):
            a, b = int(ends[low] - steps[low]), int(ends[high - 1])
            chunks.append(
                ArrayChunk(
                    observations[a + low : b + high],
                    actions[a:b],
                    rewards[a:b],
                    steps[low:high],
                    ended[low:high],
                )
            )
        return cls(tuple(chunks))

    def __len__(self) -> int:
        """Number of samples n."""
        return int(self.offsets[-1])

    @cached_property
    def offsets(self) -> IntArray:
        """(chunks + 1,) number of samples before each chunk, and n."""
        return np.cumsum([0, *(len(chunk) for chunk in self.chunks)])

    def split(self, values: FloatArray) -> list[FloatArray]:
        """The parts of ``values`` (n, ...) that belong to each chunk."""
        return np.split(values, self.offsets[1:-1])

    def take(self, rows: IntArray) -> Transitions:
        """The samples of these numbers, which must rise."""
        parts = []
        cuts = np.searchsorted(rows, self.offsets)
        for i, chunk in enumerate(self.chunks):
            chosen = rows[cuts[i] : cuts[i + 1]] - self.offsets[i]
            if len(chosen):
                parts.append(chunk.load().rows(chosen))
        return Transitions.concat(parts)
