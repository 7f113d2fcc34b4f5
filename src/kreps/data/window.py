"""The replay window: which rollouts an update learns from (the forgetting of Sec. 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from kreps.data.rewards import is_informative, is_long_enough, reward_depends_on_state
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec

RESERVED = 3
"""One place in so many is reserved for rollouts with a state-dependent reward.  Where a goal is
seldom reached, the latest rollouts may not contain it, and learning from them alone only teaches
to avoid the cost of actions."""


@dataclass(frozen=True, eq=False)
class ReplayWindow:
    """The latest rollouts, with a third of the places reserved for informative ones.

    Where every rollout is informative, as in most tasks, these are simply the latest.

    Attributes:
        task: that the rollouts are of.
        capacity: largest number of rollouts; None keeps all.
        rollouts: those kept, oldest first.
        informative: of each, whether its reward depends on the state (`is_informative`).
    """

    task: TaskSpec
    capacity: int | None
    rollouts: tuple[Rollout, ...] = ()
    informative: tuple[bool, ...] = ()

    def append(self, rollouts: Sequence[Rollout]) -> ReplayWindow:
        """The window after some new rollouts.

        Raises:
            DataError: observations or actions of another width than the task's.
        """
        for rollout in rollouts:
            rollout.check(self.task)
        seen = (*self.rollouts, *rollouts)
        informative = (
            *self.informative,
            *(is_informative(rollout, self.task) for rollout in rollouts),
        )
        kept = list(range(len(seen)))
        if self.capacity is not None and len(seen) > self.capacity:
            places = [i for i in kept if informative[i]]
            reserved = places[len(places) - min(self._reserved, len(places)) :]
            others = sorted(set(kept) - set(reserved))
            kept = sorted(reserved + others[len(reserved) - self.capacity :])
        return ReplayWindow(
            self.task,
            self.capacity,
            tuple(seen[i] for i in kept),
            tuple(informative[i] for i in kept),
        )

    @property
    def _reserved(self) -> int:
        return 0 if self.capacity is None else self.capacity // RESERVED

    @property
    def newest(self) -> tuple[Rollout, ...]:
        """The rollouts in the places that are not reserved."""
        if self.capacity is None:
            return self.rollouts
        return self.rollouts[self._reserved - self.capacity :]

    @cached_property
    def reward_depends_on_state(self) -> bool:
        """Whether any reward of the window depends on more than the action."""
        return reward_depends_on_state(self.rollouts, self.task)

    @cached_property
    def newest_depend_on_state(self) -> bool:
        """The same for the newest rollouts; False if there are none."""
        return bool(self.newest) and reward_depends_on_state(self.newest, self.task)

    @property
    def all_informative(self) -> bool:
        """Whether every rollout that is long enough to decide it is informative."""
        return all(
            informative or not is_long_enough(rollout, self.task)
            for rollout, informative in zip(self.rollouts, self.informative, strict=True)
        )

    @property
    def steps(self) -> int:
        return sum(map(len, self.rollouts))

    @cached_property
    def transitions(self) -> Transitions:
        return Transitions.from_rollouts(self.rollouts)
