"""What is learnt from: the task's shape, roll-outs, the window kept of them, its transitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kreps.data.task import LARGEST, TaskSpec, is_sane
from kreps.errors import DataError
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Rollout:
    """One roll-out of ``T >= 1`` steps, copied at construction so that no buffer can overwrite it.

    Attributes:
        observations: (T + 1, ds); row t + 1 is the true successor of row t, the last one
            included (what came *before* any restart).
        actions: (T, da) as the policy commanded them, before clipping.
        rewards: (T,).
        terminated: whether the last step really ended the task (not: was cut off).

    Raises:
        DataError: wrong shapes, no step at all, NaN or infinities.
    """

    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    terminated: bool = False

    def __post_init__(self) -> None:
        for name, dimensions in (("observations", 2), ("actions", 2), ("rewards", 1)):
            try:
                values = np.array(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise DataError(f"{name} are not an array of numbers: {error}") from error
            if values.ndim != dimensions:
                raise DataError(
                    f"{name} have shape {values.shape}, but {dimensions} dimensions are needed: "
                    "observations (T + 1, ds), actions (T, da), rewards (T,)"
                )
            if not is_sane(values).all():
                row = int(np.argwhere(~is_sane(values))[0, 0])
                raise DataError(
                    f"{name} hold NaN, an infinity or a number beyond {LARGEST:g}, first in row "
                    f"{row}; drop the roll-out, or cut it before that step"
                )
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        steps = len(self.rewards)
        if steps == 0:
            raise DataError("the roll-out has no step; leave empty roll-outs out")
        if len(self.actions) != steps or len(self.observations) != steps + 1:
            raise DataError(
                f"{len(self.observations)} observations, {len(self.actions)} actions and {steps} "
                "rewards do not fit together: T rewards need T actions and T + 1 observations "
                "(the last one is the successor of the last step)"
            )
        object.__setattr__(self, "terminated", bool(self.terminated))

    def __len__(self) -> int:
        return len(self.rewards)

    def check(self, task: TaskSpec) -> None:
        """Raise `DataError` unless the widths are those of ``task``."""
        found = self.observations.shape[1], self.actions.shape[1]
        wanted = task.observation_size, task.action_size
        if found != wanted:
            raise DataError(
                f"the roll-out has {found[0]} observation and {found[1]} action coordinates, "
                f"the task {wanted[0]} and {wanted[1]}"
            )


@dataclass(frozen=True, eq=False)
class Transitions:
    """The n steps of some roll-outs as flat arrays; states are named by row of ``points``.

    Attributes:
        points: (n + R, ds) all states of R roll-outs in order: the set S~ of Eq. 3.
        state, successor: (n,) rows of s_i and of s'_i.
        start: (R,) rows of the start states.
        rollout: (n,) which of the R roll-outs each step is of.
        actions: (n, da) commanded.
        rewards: (n,).
        terminated: (n,) whether step i really ended the task.
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
        return len(self.rewards)

    @property
    def states(self) -> FloatArray:
        return self.points[self.state]

    @classmethod
    def from_rollouts(cls, rollouts: Sequence[Rollout]) -> Transitions:
        """Flatten at least one roll-out."""
        return cls.from_arrays(
            np.concatenate([r.observations for r in rollouts]),
            np.concatenate([r.actions for r in rollouts]),
            np.concatenate([r.rewards for r in rollouts]),
            np.array([len(r) for r in rollouts]),
            np.array([r.terminated for r in rollouts]),
        )

    @classmethod
    def from_arrays(
        cls,
        points: FloatArray,
        actions: FloatArray,
        rewards: FloatArray,
        lengths: IntArray,
        ended: BoolArray,
    ) -> Transitions:
        """R roll-outs laid end to end in arrays: (n + R, ds), (n, da), (n,), (R,) and (R,)."""
        ends = np.cumsum(lengths)
        rollout = np.repeat(np.arange(len(lengths)), lengths)
        state = np.arange(len(rewards)) + rollout
        terminated = np.zeros(len(rewards), dtype=bool)
        terminated[ends - 1] = ended
        start = ends - lengths + np.arange(len(lengths))
        return cls(points, state, state + 1, start, rollout, actions, rewards, terminated)

    @classmethod
    def concat(cls, parts: Sequence[Transitions]) -> Transitions:
        """All steps of at least one set of them, in order."""
        if len(parts) == 1:
            return parts[0]
        before = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
        earlier = np.cumsum([0, *(len(part.start) for part in parts[:-1])])
        return cls(
            points=np.concatenate([part.points for part in parts]),
            state=np.concatenate([p.state + b for p, b in zip(parts, before, strict=True)]),
            successor=np.concatenate([p.successor + b for p, b in zip(parts, before, strict=True)]),
            start=np.concatenate([p.start + b for p, b in zip(parts, before, strict=True)]),
            rollout=np.concatenate([p.rollout + e for p, e in zip(parts, earlier, strict=True)]),
            actions=np.concatenate([part.actions for part in parts]),
            rewards=np.concatenate([part.rewards for part in parts]),
            terminated=np.concatenate([part.terminated for part in parts]),
        )

    def rows(self, chosen: IntArray) -> Transitions:
        """Some of the steps, with the start states of the roll-outs that they are of."""
        if len(chosen) == len(self):
            return self
        k = len(chosen)
        of, rollout = np.unique(self.rollout[chosen], return_inverse=True)
        named = (self.state[chosen], self.successor[chosen], self.start[of])
        return Transitions(
            points=self.points[np.concatenate(named)],
            state=np.arange(k),
            successor=k + np.arange(k),
            start=2 * k + np.arange(len(of)),
            rollout=rollout,
            actions=self.actions[chosen],
            rewards=self.rewards[chosen],
            terminated=self.terminated[chosen],
        )
