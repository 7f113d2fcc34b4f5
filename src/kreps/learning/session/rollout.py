"""One rollout on a robot while it is made, from its observations and rewards in turn."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from kreps.data.history import first_lags, next_lags, states_of
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, DataError, shown
from kreps.intake import as_flag, as_number, is_sane
from kreps.kernels.arrays import FloatArray, default_errstate
from kreps.learning.collect import as_state
from kreps.learning.planning import PlannedRollout
from kreps.policies.base import StochasticPolicy


class End(StrEnum):
    """Why a rollout ended."""

    TERMINATED = "terminated"
    TIME_LIMIT = "time limit"
    LENGTH = "drawn length"
    WATCHDOG = "watchdog"
    ABORTED = "aborted"


@dataclass(frozen=True, eq=False)
class RecordedRollout:
    """A rollout that has ended.

    Attributes:
        rollout: its complete steps: those whose successor was observed.
        end: why it ended.
        cycles: control cycles of these steps; an action may be held for several.
        late: actions that came more than half a period late.
    """

    rollout: Rollout
    end: End
    cycles: int
    late: int


class RolloutInProgress:
    """The steps of a rollout so far.

    Args:
        task: with the ``action_repeat`` and the ``time_limit`` of the robot.
        policy: that acts.
        planned: its length and noise.

    Attributes:
        end: why the rollout has ended; None while it goes on.
    """

    def __init__(self, task: TaskSpec, policy: StochasticPolicy, planned: PlannedRollout) -> None:
        self.task, self.policy, self.planned = task, policy, planned
        self.end: End | None = None
        self._noise = planned.noise(task.action_size)
        self._points: list[FloatArray] = []
        self._actions: list[FloatArray] = []
        self._rewards: list[float] = []
        self._cycles = 0  # with a reward
        self._complete_cycles = 0  # of steps whose successor was observed
        self._left = 0  # cycles for which the action is still to be held
        self._sum = 0.0  # of the rewards of the action that is held
        self._reward_due = self._terminated = False

    @property
    def acting(self) -> bool:
        """Whether an action was handed out and none has followed."""
        return self.end is None and bool(self._actions)

    def act(self, observation: Any) -> FloatArray | None:
        """The applied action (da,) of a cycle; None if the rollout ends with this observation.

        Raises:
            ConfigurationError: the reward of the action before is missing.
            DataError: no observation (ds,) of finite numbers.
        """
        if self._reward_due:
            raise ConfigurationError(
                "act() was called again before the reward of the last action was given; call "
                "reward(r) once after each action, and then act(observation)"
            )
        state = as_state(observation, self.task)
        limit = self.task.time_limit
        at_limit = limit is not None and self._cycles >= limit
        if self._left == 0 or self._terminated or at_limit:
            self._decide(state, at_limit)
        if self.end is not None:
            return None
        self._left -= 1
        self._reward_due = True
        return self.task.clip(self._actions[-1])

    def _decide(self, state: FloatArray, at_limit: bool) -> None:
        """Complete the step before with its successor, and choose a new action or end."""
        newest = state[None]
        if not self._points:
            self._lags = first_lags(newest, self.task)
        self._points.append(state)
        if self._actions:
            self._rewards.append(self._sum)
            self._complete_cycles, self._sum = self._cycles, 0.0
        if self._terminated:
            self.end = End.TERMINATED
        elif at_limit:
            self.end = End.TIME_LIMIT
        elif (noise := next(self._noise, None)) is None:
            self.end = End.LENGTH
        else:
            with default_errstate():
                states = states_of(newest, self._lags, self.task)
                self._actions.append(self.policy.act(states, noise[None])[0])
            applied = self.task.scaled_applied(self._actions[-1][None])
            self._lags = next_lags(newest, self._lags, applied, self.task)
            self._left = self.task.action_repeat

    def reward(self, reward: Any, terminated: Any) -> None:
        """Count the reward of the last action, in one cycle.

        Raises:
            ConfigurationError: there is no action without a reward.
            DataError: no finite number, or no flag.
        """
        if not self._reward_due:
            raise ConfigurationError(
                "reward() was called without an action before it, or twice for the same action; "
                "call act(observation) first, and reward(r) once after it"
            )
        value = as_number("reward", reward)
        if not is_sane(np.array(value)):
            raise DataError(f"reward = {shown(reward)}, but a finite number is needed")
        self._terminated = as_flag("terminated", terminated)
        self._sum += value
        self._cycles += 1
        self._reward_due = False

    def recorded(self, late: int) -> RecordedRollout | None:
        """The rollout that has ended; None if no step is complete."""
        assert self.end is not None
        steps = len(self._rewards)
        if not steps:
            return None
        points, actions = np.stack(self._points[: steps + 1]), np.stack(self._actions[:steps])
        rollout = Rollout(points, actions, np.array(self._rewards), self.end == End.TERMINATED)
        return RecordedRollout(rollout, self.end, self._complete_cycles, late)
