"""Many rollouts in flat arrays, and their transitions."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, overload

import numpy as np

from kreps.data.rollout import DROP, read_only
from kreps.data.rollout import Rollout as Rollout
from kreps.data.task import TaskSpec
from kreps.errors import DataError
from kreps.intake import (
    as_array,
    as_flags,
    as_rows,
    first_invalid_row,
    invalid,
)
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False, repr=False)
class Rollouts(Sequence[Rollout]):
    """R rollouts laid end to end in flat arrays: a sequence whose items are views of them.

    Made by `from_list` or `from_arrays`; the constructor itself checks nothing.

    Attributes:
        points: (n + R, ds) the observations of all rollouts: n states and the last successor of
            each rollout.  Those of rollout i are rows ``offsets[i] + i`` to ``offsets[i + 1] + i``.
        actions: (n, da) as commanded.
        rewards: (n,).
        offsets: (R + 1,) number of steps before each rollout, and n.
        terminated: (R,) whether the task ended with the last step of each rollout.
        times: (n + R,) time stamp of each row of ``points`` in s; None unless every rollout has
            time stamps.
    """

    points: FloatArray
    actions: FloatArray
    rewards: FloatArray
    offsets: IntArray
    terminated: BoolArray
    times: FloatArray | None = None

    @classmethod
    def from_list(cls, rollouts: Iterable[Rollout]) -> Rollouts:
        """Any number of rollouts, copied once into flat arrays; `Rollouts` are returned unchanged.

        Raises:
            DataError: an item that is no rollout, or rollouts of different widths.
        """
        if isinstance(rollouts, Rollouts):
            return rollouts
        if isinstance(rollouts, Rollout):
            raise DataError("a list of rollouts is needed, but this is one; write [rollout]")
        items = list(rollouts)
        for number, item in enumerate(items):
            if not isinstance(item, Rollout):
                raise DataError(
                    f"item {number} is a {type(item).__name__}, not a kreps.Rollout; build one "
                    "from observations (T + 1, ds), actions (T, da) and rewards (T,)"
                )
            if item.widths != items[0].widths:
                raise DataError(
                    f"rollout {number} has (observation, action) coordinates {item.widths}, those "
                    f"before it {items[0].widths}; give rollouts of one task"
                )
        if not items:
            return NO_ROLLOUTS
        times = [r.times for r in items if r.times is not None]
        return cls(
            read_only(np.concatenate([r.observations for r in items])),
            read_only(np.concatenate([r.actions for r in items])),
            read_only(np.concatenate([r.rewards for r in items])),
            np.cumsum([0, *(len(r) for r in items)]),
            np.array([r.terminated for r in items]),
            read_only(np.concatenate(times)) if len(times) == len(items) else None,
        )

    @classmethod
    def from_arrays(
        cls,
        observations: FloatArray,
        actions: FloatArray,
        rewards: FloatArray,
        lengths: Sequence[int] | IntArray | FloatArray,
        terminated: Sequence[bool] | BoolArray | None = None,
        *,
        read: bool = True,
    ) -> Rollouts:
        """R rollouts laid end to end in arrays.

        Args:
            observations: (n + R, ds), those of each rollout followed by its last successor.
            actions: (n, da) as commanded; shapes as of `Rollout`.
            rewards: (n,).
            lengths: (R,) steps of each rollout.
            terminated: (R,) whether the task ended with its last step; None if none did.
            read: whether to `read` the values now.  If not, as for memory maps, that must be done
                before they are used.

        Raises:
            DataError: sizes that do not fit together, NaN, infinities or absurdly large numbers,
                masked values, numbers or flags that are none.
        """
        observations = as_rows("observations", as_array("observations", observations))
        actions = as_rows("actions", as_array("actions", actions))
        rewards = as_rows("rewards", as_array("rewards", rewards))
        given = np.atleast_1d(as_array("lengths", lengths))
        steps = np.where((given >= 1) & (given <= rewards.size), given, 0).astype(np.intp)
        ended = np.zeros(len(steps), bool)
        if terminated is not None:
            ended = np.atleast_1d(as_flags("terminated", terminated))
        fits = (
            steps.ndim == 1
            and ((steps == given) & (steps >= 1)).all()
            and steps.sum() == len(rewards) == len(actions)
            and len(observations) == len(rewards) + len(steps)
            and len(ended) == len(steps)
        )
        if not fits:
            raise DataError(
                f"observations {observations.shape}, actions {actions.shape}, rewards "
                f"{rewards.shape} and {len(steps)} lengths that add up to {steps.sum()} do not fit "
                "together: R rollouts of n steps in all need (n + R, ds), (n, da), (n,) and (R,)"
            )
        offsets = np.cumsum([0, *steps.tolist()])
        made = cls(observations, actions, rewards, offsets, ended)
        return made.read() if read else made

    def read(self) -> Rollouts:
        """The same rollouts with their values checked and copied into memory, as float64.

        Raises:
            DataError: NaN, infinities or absurdly large numbers.
        """
        arrays = []
        for name, given in (
            ("observations", self.points),
            ("actions", self.actions),
            ("rewards", self.rewards),
        ):
            values = np.array(as_array(name, given), dtype=np.float64, subok=False)
            if (row := first_invalid_row(values)) is not None:
                rollout, t = self.place(row, of_points=name == "observations")
                where = f"row {t} of rollout {rollout}"
                raise DataError(f"{invalid(name)}, first in {where}; {DROP}")
            arrays.append(read_only(values))
        points, actions, rewards = arrays
        return Rollouts(points, actions, rewards, self.offsets, self.terminated, self.times)

    def place(self, row: int, *, of_points: bool = False) -> tuple[int, int]:
        """The rollout of a step, or of a row of ``points``, and the row's number in it."""
        starts = self.offsets[:-1] + (np.arange(len(self)) if of_points else 0)
        rollout = int(np.searchsorted(starts, row, side="right")) - 1
        return rollout, int(row - starts[rollout])

    def load(self) -> Rollouts:
        """Itself: it is in memory already (see `kreps.data.dataset.Chunk`)."""
        return self

    def check(self, task: TaskSpec) -> None:
        """Raise `DataError` unless there is no rollout or the widths are those of ``task``."""
        found = self.points.shape[1], self.actions.shape[1]
        wanted = task.observation_size, task.action_size
        if len(self) and found != wanted:
            raise DataError(
                f"the rollouts have {found[0]} observation and {found[1]} action coordinates, "
                f"the task {wanted[0]} and {wanted[1]}"
            )

    def __len__(self) -> int:
        """Number of rollouts R."""
        return len(self.terminated)

    @overload
    def __getitem__(self, index: int) -> Rollout: ...

    @overload
    def __getitem__(self, index: slice) -> Rollouts: ...

    def __getitem__(self, index: int | slice) -> Rollout | Rollouts:
        """One rollout, or several as a container; both are views unless a slice has a step."""
        if isinstance(index, slice):
            return self._slice(index)
        i = range(len(self))[operator.index(index)]
        low, high = self.offsets[i], self.offsets[i + 1]
        return Rollout.view(
            self.points[low + i : high + i + 1],
            self.actions[low:high],
            self.rewards[low:high],
            bool(self.terminated[i]),
            None if self.times is None else self.times[low + i : high + i + 1],
        )

    def _slice(self, index: slice) -> Rollouts:
        first, last, step = index.indices(len(self))
        if step != 1:
            return Rollouts.from_list([self[i] for i in range(first, last, step)])
        last = max(first, last)
        low, high = self.offsets[first], self.offsets[last]
        return Rollouts(
            self.points[low + first : high + last],
            self.actions[low:high],
            self.rewards[low:high],
            self.offsets[first : last + 1] - low,
            self.terminated[first:last],
            None if self.times is None else self.times[low + first : high + last],
        )

    def __repr__(self) -> str:
        return f"<Rollouts: {len(self)} of {self.steps} steps in all>"

    def __getstate__(self) -> dict[str, Any]:
        """The arrays alone: what is derived from them need not be sent to another process."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def steps(self) -> int:
        """Number of steps n of all rollouts."""
        return int(self.offsets[-1])

    @property
    def lengths(self) -> IntArray:
        """(R,) number of steps of each rollout."""
        return np.diff(self.offsets)

    def reward_quartiles(self) -> tuple[float, float]:
        """Lower and upper quartile of the rollouts' mean rewards per step.

        Each rollout counts by its steps, as in the mean reward of all steps.
        """
        means = np.add.reduceat(self.rewards, self.offsets[:-1]) / self.lengths
        lower, upper = np.quantile(np.repeat(means, self.lengths), (0.25, 0.75))
        return float(lower), float(upper)

    @cached_property
    def transitions(self) -> Transitions:
        """The n transitions; points, actions and rewards are the same arrays."""
        return Transitions.from_rollouts(self)


@dataclass(frozen=True, eq=False)
class Transitions:
    """n steps of R rollouts as flat arrays; a state is given by its row of ``points``.

    Attributes:
        points: (k, ds) states; of whole rollouts all n + R in order: the set S~ of Eq. 3.
        state, successor: (n,) rows of s_i and of s'_i.
        start: (R,) rows of the start states.
        rollout: (n,) number of the rollout that each step belongs to.
        actions: (n, da) commanded.
        rewards: (n,).
        terminated: (n,) whether the task ended with step i.
    """

    points: FloatArray
    state: IntArray
    successor: IntArray
    start: IntArray
    rollout: IntArray
    actions: FloatArray
    rewards: FloatArray
    terminated: BoolArray

    def __len__(self) -> int:
        """Number of steps n."""
        return len(self.rewards)

    @property
    def states(self) -> FloatArray:
        """(n, ds) the states s_i."""
        return self.points[self.state]

    @classmethod
    def from_rollouts(cls, rollouts: Iterable[Rollout]) -> Transitions:
        """All steps of some rollouts, in order."""
        flat = Rollouts.from_list(rollouts)
        numbers = np.arange(len(flat))
        rollout = np.repeat(numbers, flat.lengths)
        state = np.arange(flat.steps) + rollout
        terminated = np.zeros(flat.steps, dtype=bool)
        terminated[flat.offsets[1:] - 1] = flat.terminated
        start = flat.offsets[:-1] + numbers
        points, actions, rewards = flat.points, flat.actions, flat.rewards
        return cls(points, state, state + 1, start, rollout, actions, rewards, terminated)

    @classmethod
    def concat(cls, parts: Sequence[Transitions]) -> Transitions:
        """The steps of all parts, of which there must be one at least, in order."""
        if len(parts) == 1:
            return parts[0]
        points_before = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
        rollouts_before = np.cumsum([0, *(len(part.start) for part in parts[:-1])])
        shifted = list(zip(parts, points_before, rollouts_before, strict=True))
        return cls(
            points=np.concatenate([part.points for part in parts]),
            state=np.concatenate([part.state + points for part, points, _ in shifted]),
            successor=np.concatenate([part.successor + points for part, points, _ in shifted]),
            start=np.concatenate([part.start + points for part, points, _ in shifted]),
            rollout=np.concatenate([part.rollout + rollouts for part, _, rollouts in shifted]),
            actions=np.concatenate([part.actions for part in parts]),
            rewards=np.concatenate([part.rewards for part in parts]),
            terminated=np.concatenate([part.terminated for part in parts]),
        )

    def rows(self, chosen: IntArray) -> Transitions:
        """The steps with these numbers, and the start states of their rollouts."""
        if len(chosen) == len(self):
            return self
        k = len(chosen)
        present, rollout = np.unique(self.rollout[chosen], return_inverse=True)
        needed = (self.state[chosen], self.successor[chosen], self.start[present])
        return Transitions(
            points=self.points[np.concatenate(needed)],
            state=np.arange(k),
            successor=k + np.arange(k),
            start=2 * k + np.arange(len(present)),
            rollout=rollout,
            actions=self.actions[chosen],
            rewards=self.rewards[chosen],
            terminated=self.terminated[chosen],
        )


NO_ROLLOUTS = Rollouts(
    np.empty((0, 0)), np.empty((0, 0)), np.empty(0), np.zeros(1, np.intp), np.empty(0, bool)
)
"""The empty container, of no widths."""
