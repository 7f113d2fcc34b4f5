"""The replay window: which rollouts an update learns from (the forgetting of Sec. 4.1)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kreps.data.history import stacked
from kreps.data.rewards import is_informative, is_long_enough, reward_depends_on_state
from kreps.data.rollouts import NO_ROLLOUTS, Rollout, Rollouts, Transitions
from kreps.data.task import TaskSpec

RESERVED_SHARE = 3
"""One in so many of the window's rollouts is reserved for those with a state-dependent reward.
Where a goal is seldom reached, the newest rollouts may not contain it, and learning from them alone
would only lower the cost of actions."""


@dataclass(frozen=True, eq=False)
class ReplayWindow:
    """The newest rollouts, a third of which are the newest informative ones.

    Where every rollout is informative, as in most tasks, these are simply the newest.

    Attributes:
        task: that the rollouts are of.
        capacity: largest number of rollouts; None keeps all.
        min_steps: more rollouts are kept until they have so many steps.
        rollouts: those kept, oldest first.
        informative: of each, whether its reward depends on the state (`is_informative`).
    """

    task: TaskSpec
    capacity: int | None
    min_steps: int = 0
    rollouts: Rollouts = NO_ROLLOUTS
    informative: tuple[bool, ...] = ()

    def append(self, rollouts: Iterable[Rollout]) -> ReplayWindow:
        """The window after some new rollouts.

        Raises:
            DataError: observations or actions of another width than the task's.
        """
        new = Rollouts.from_list(rollouts)
        new.check(self.task)
        seen = [*self.rollouts, *new]
        informative = [*self.informative, *(is_informative(rollout, self.task) for rollout in new)]
        kept = self._kept(informative, [len(rollout) for rollout in seen])
        return ReplayWindow(
            self.task,
            self.capacity,
            self.min_steps,
            Rollouts.from_list([seen[i] for i in kept]),
            tuple(informative[i] for i in kept),
        )

    def _kept(self, informative: list[bool], steps: list[int]) -> list[int]:
        """Numbers of the rollouts to keep, oldest first.

        Args:
            informative: of each rollout, whether its reward depends on the state.
            steps: of each rollout.
        """
        numbers = list(range(len(informative)))
        if self.capacity is None:
            return numbers
        needed = 1 + int(np.searchsorted(np.cumsum(steps[::-1]), self.min_steps))
        capacity = max(self.capacity, needed)
        if len(numbers) <= capacity:
            return numbers
        candidates = [i for i in numbers if informative[i]]
        reserved = candidates[len(candidates) - min(self._reserved, len(candidates)) :]
        others = sorted(set(numbers) - set(reserved))
        return sorted(reserved + others[len(reserved) - capacity :])

    @property
    def _reserved(self) -> int:
        """Number of rollouts reserved for informative ones."""
        return 0 if self.capacity is None else self.capacity // RESERVED_SHARE

    @property
    def newest(self) -> Rollouts:
        """The newest rollouts, as many as are not reserved."""
        if self.capacity is None:
            return self.rollouts
        return self.rollouts[self._reserved - max(self.capacity, len(self.rollouts)) :]

    @cached_property
    def reward_depends_on_state(self) -> bool:
        """Whether the rewards of the window depend on more than the action."""
        return reward_depends_on_state(self.rollouts, self.task)

    @cached_property
    def newest_depend_on_state(self) -> bool:
        """The same for the newest rollouts; False if there are none."""
        return len(self.newest) > 0 and reward_depends_on_state(self.newest, self.task)

    @property
    def all_informative(self) -> bool:
        """Whether every rollout that is long enough to decide it is informative."""
        return all(
            informative or not is_long_enough(rollout, self.task)
            for rollout, informative in zip(self.rollouts, self.informative, strict=True)
        )

    @property
    def steps(self) -> int:
        """Number of steps of all rollouts."""
        return self.rollouts.steps

    @cached_property
    def states(self) -> Rollouts:
        """The rollouts with states of the task as points, which may have earlier observations."""
        return stacked(self.rollouts, self.task)

    @property
    def transitions(self) -> Transitions:
        """The steps of all rollouts, in order, from state to state."""
        return self.states.transitions
