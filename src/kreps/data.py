"""What is learnt from: the task's shape, roll-outs, the window kept of them, its transitions."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kreps.arrays import BoolArray, FloatArray, IntArray
from kreps.errors import ConfigurationError, DataError
from kreps.kernels import Factor, factors_of

LONGEST_SIDE = 1024
"""Of an image, in pixels: smoothing costs its square in memory, its cube in time."""

LARGEST = 1e100
"""Numbers beyond this are no data: their squares would overflow."""


def is_sane(values: FloatArray) -> BoolArray:
    """Which ``values`` are neither NaN nor infinite nor absurdly large."""
    return np.abs(values) <= LARGEST


@dataclass(frozen=True, eq=False)
class TaskSpec:
    """What the learner must know of a task; everything else it learns.

    Attributes:
        observation_size: number of coordinates of an observation.
        action_low, action_high: (da,) finite limits of the actions, in the task's units.
        periodic: the observation coordinates that are angles in rad (period 2 pi).
        groups: observation coordinates that share a lengthscale, such as the pixels of an image;
            a coordinate in no group has its own.
        image_shape: (height, width) if the groups are images, each row by row from the top; then
            every coordinate belongs to one.
    """

    observation_size: int
    action_low: FloatArray
    action_high: FloatArray
    periodic: tuple[int, ...] = ()
    groups: tuple[tuple[int, ...], ...] = ()
    image_shape: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "action_low", np.array(self.action_low, np.float64, ndmin=1))
        object.__setattr__(self, "action_high", np.array(self.action_high, np.float64, ndmin=1))
        try:
            periodic = tuple(sorted({operator.index(i) for i in self.periodic}))
            object.__setattr__(self, "periodic", periodic)
            object.__setattr__(self, "observation_size", operator.index(self.observation_size))
            groups = tuple(tuple(sorted({operator.index(i) for i in g})) for g in self.groups)
            object.__setattr__(self, "groups", tuple(g for g in groups if g))
        except TypeError as error:
            raise ConfigurationError(
                f"observation_size = {self.observation_size!r} and periodic = {self.periodic!r}, "
                "but a whole number and a list of whole numbers are needed, as 3 and (0, 2)"
            ) from error
        if self.observation_size < 1:
            raise ConfigurationError(
                f"observation_size = {self.observation_size}, but at least one coordinate is needed"
            )
        low, high = self.action_low, self.action_high
        if low.ndim != 1 or low.shape != high.shape or low.size == 0:
            raise ConfigurationError(
                f"action limits have shapes {low.shape} and {high.shape}; "
                "give two vectors of the same positive length"
            )
        if not (is_sane(low).all() and is_sane(high).all() and (low < high).all()):
            raise ConfigurationError(
                f"action limits {low} to {high} must be finite and low < high; "
                "the policy needs a scale for its actions, so give a bounded range"
            )
        grouped = [i for group in self.groups for i in group]
        if len(set(grouped)) < len(grouped):
            raise ConfigurationError("a coordinate is in two groups; it has one lengthscale")
        angles = set(self.periodic)
        mixed = [g for g in self.groups if 0 < len(angles.intersection(g)) < len(g)]
        if mixed:
            raise ConfigurationError(
                f"the group {mixed[0]!s:.60} mixes angles and other coordinates, which share "
                "no scale"
            )
        if self.image_shape is not None:
            try:
                height, width = (operator.index(size) for size in self.image_shape)
            except (TypeError, ValueError):
                height, width = 0, 0
            if not (1 <= height <= LONGEST_SIDE and 1 <= width <= LONGEST_SIDE):
                raise ConfigurationError(
                    f"image_shape = {self.image_shape!r:.60}, but (height, width) is needed, two "
                    f"whole numbers from 1 to {LONGEST_SIDE}"
                )
            object.__setattr__(self, "image_shape", (height, width))
            if {len(group) for group in self.groups} != {height * width} or (
                len(grouped) != self.observation_size
            ):
                raise ConfigurationError(
                    f"image_shape = {self.image_shape}, but the groups have "
                    f"{[len(group) for group in self.groups]!s:.60} of {self.observation_size} "
                    f"coordinates; each must be an image of {height} x {width}, and all in one"
                )
        named = (*self.periodic, *grouped)
        outside = [i for i in named if not 0 <= i < self.observation_size]
        if outside:
            raise ConfigurationError(
                f"periodic or grouped coordinates {outside!s:.60} do not exist: observations have "
                f"{self.observation_size} coordinates, numbered from 0"
            )

    @property
    def state_factors(self) -> tuple[Factor, ...]:
        """The factors of a kernel over observations, each with one lengthscale."""
        return factors_of(self.observation_size, self.periodic, self.groups, self.image_shape)

    @property
    def factor_count(self) -> int:
        """How many lengthscales that are, counted without making them (a file may lie)."""
        return self.observation_size - sum(len(group) - 1 for group in self.groups)

    @property
    def action_size(self) -> int:
        return len(self.action_low)

    @property
    def action_centre(self) -> FloatArray:
        return 0.5 * (self.action_low + self.action_high)

    @property
    def action_scale(self) -> FloatArray:
        """Half the range (da,): actions in these units lie in [-1, 1] around the centre."""
        return 0.5 * (self.action_high - self.action_low)

    def scaled(self, actions: FloatArray) -> FloatArray:
        """Actions (m, da) around their centre, in units of the action scale."""
        return (actions - self.action_centre) / self.action_scale

    def unscaled(self, actions: FloatArray) -> FloatArray:
        """Scaled actions (m, da) in the task's units."""
        return self.action_centre + self.action_scale * actions

    def clip(self, actions: FloatArray) -> FloatArray:
        """The *applied* actions: what the actuators make of the commanded ones."""
        return np.clip(actions, self.action_low, self.action_high)


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
    def of(cls, rollouts: Sequence[Rollout]) -> Transitions:
        """Flatten at least one roll-out."""
        return cls.laid_out(
            np.concatenate([r.observations for r in rollouts]),
            np.concatenate([r.actions for r in rollouts]),
            np.concatenate([r.rewards for r in rollouts]),
            np.array([len(r) for r in rollouts]),
            np.array([r.terminated for r in rollouts]),
        )

    @classmethod
    def laid_out(
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
    def joined(cls, parts: Sequence[Transitions]) -> Transitions:
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


@dataclass(frozen=True)
class Window:
    """The latest ``capacity`` roll-outs: the forgetting mechanism of Sec. 4.1; None keeps all."""

    capacity: int | None
    rollouts: tuple[Rollout, ...] = field(default=())

    def extend(self, rollouts: Iterable[Rollout]) -> Window:
        kept = (*self.rollouts, *rollouts)
        if self.capacity is not None:
            kept = kept[-self.capacity :]
        return Window(self.capacity, kept)

    @cached_property
    def transitions(self) -> Transitions:
        return Transitions.of(self.rollouts)
