"""Learners that collect rollouts by their own policy."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from numpy.typing import NDArray

from kreps.errors import ConfigurationError, shown
from kreps.kernels.arrays import default_errstate
from kreps.learning import timescale
from kreps.learning.batches import BatchPlan, Collected, batch_size, collect_batch
from kreps.learning.environment import Environment
from kreps.learning.learner import Learner
from kreps.learning.session import RobotSession
from kreps.learning.session.timing import Clock
from kreps.policies.base import StochasticPolicy
from kreps.policies.exploration import PINK, RED, WHITE, BangBang, Gaussian
from kreps.settings import OnPolicySettings

OnPolicy = TypeVar("OnPolicy", bound=OnPolicySettings)


class OnPolicyLearner(Learner[OnPolicy]):
    """A learner that collects rollouts by its own stochastic policy, from start states only.

    These are the rollouts of Sec. 4.1.
    """

    @property
    def update_settings(self) -> OnPolicy:
        return timescale.with_batches(super().update_settings, self.task)

    def _collect(self, env: Environment, on_rollout: Callable[[int], None] | None) -> Collected:
        return collect_batch(env, self.task, self._batch_plan(), on_rollout)

    def _batch_plan(self) -> BatchPlan:
        """What the rollouts of the next iteration will be."""
        policy, exponent = self._collecting_policy()
        settings, iteration = self.update_settings, self.state.iteration
        decisions = self.state.steps / self.task.action_repeat
        explorer = None if self.exploring else self.state.explorer
        return BatchPlan(
            policies=(policy,) if explorer is None else (policy, explorer),
            exponent=exponent,
            size=batch_size(settings, iteration, decisions),
            settings=settings,
            seed=self.seed,
            iteration=iteration,
        )

    def session(
        self,
        folder: str | Path = "runs/robot",
        *,
        period: float | None = None,
        stop_action: Any = None,
        stop: Callable[[NDArray[Any]], object] | None = None,
        watchdog: float = 2.0,
        clock: Clock = time,
    ) -> RobotSession:
        """Learn on a robot, in a control loop of one's own; no environment is needed.

        The rollouts and updates are those that `learn` would make, with the same lengths and the
        same noise.  Everything is recorded in the folder.  A session that is opened again there,
        also after a power cut, goes on where it was.  docs/real_robot.md has a program.

        Args:
            folder: of the session; it is made if it is not there.
            period: of control, in s; None takes the ``dt`` of the task.
            stop_action: (da,) action at which the robot rests; None means zeros.
            stop: called with the stop action, by another thread, if the watchdog ends a rollout;
                and if the ``with`` block is left while one is running.  Without it, the stop
                action is only what `RobotSession.act` returns.
            watchdog: periods after an action without a new observation that end the rollout.
            clock: that tells the time and waits; another one for simulated time.

        Raises:
            ConfigurationError: no period or two different ones, a stop action beyond the limits.
                On entering the ``with`` block: the folder is of another task, seed or settings.
            StorageError: on entering the block: the folder cannot be used.
        """
        period = self.task.dt if period is None else period
        task = replace(self.task, dt=period)
        if task.dt is None or self.task.dt not in (None, task.dt):
            raise ConfigurationError(
                f"period = {shown(period)} and dt = {self.task.dt} of the task, but one control "
                "period in s is needed; write session(period=0.05) or TaskSpec(..., dt=0.05)"
            )
        if self.task.dt is None:
            self.task = task
            self.state = replace(self.state, window=replace(self.state.window, task=task))
        return RobotSession(
            self,
            folder,
            period=task.dt,
            stop_action=stop_action,
            stop=stop,
            watchdog=watchdog,
            clock=clock,
        )

    @property
    @default_errstate()
    def exploring(self) -> bool:
        window = self.state.window
        return len(window.rollouts) > 0 and not window.newest_depend_on_state

    def _collecting_policy(self) -> tuple[StochasticPolicy, float]:
        """The policy of the next rollouts, and the exponent of its noise's spectrum."""
        if self.exploring:
            return BangBang(self.task), RED
        if self.state.policy is not None:
            return self.state.policy, WHITE
        if self.settings.exploration.noise == "bang-bang":
            return BangBang(self.task), WHITE
        gaussian = Gaussian(self.task, self.settings.exploration.scale)
        return gaussian, PINK if self.settings.exploration.noise == "pink" else WHITE
