"""A session with a robot: `learn`, turned inside out for a control loop of the user.

A small state machine: `RobotSession.rollouts` begins a rollout, `RobotSession.act` and
`RobotSession.reward` take turns until ``running`` is False, and the next turn of `rollouts` records
the rollout, updates where a batch is complete, and begins the next one.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import RLock
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from kreps.data.rollouts import Rollouts
from kreps.errors import ConfigurationError, DataWarning, EnvironmentFailure, shown
from kreps.intake import as_numbers
from kreps.kernels.arrays import default_errstate
from kreps.kernels.threads import blas_threads
from kreps.learning import timescale
from kreps.learning.batches import BatchPlan, Collected
from kreps.learning.iteration import Callback, callbacks_of, is_false
from kreps.learning.planning import PlannedRollout
from kreps.learning.session.journal import Journal
from kreps.learning.session.rollout import End, RecordedRollout, RolloutInProgress
from kreps.learning.session.timing import Clock, Pace, Watchdog
from kreps.policies.base import StochasticPolicy

if TYPE_CHECKING:
    from kreps.learning.on_policy import OnPolicyLearner

TRIES = 3
"""A rollout that was ended before its first step was complete is begun again so often in all."""


class RobotSession:
    """What `OnPolicyLearner.session` returns; use it in a ``with`` block.

    Args:
        learner, folder, period, stop_action, stop, watchdog, clock: as of
            `OnPolicyLearner.session`, with nothing left open.

    Attributes:
        period: of control, in s.
        stop_action: the action that `act` returns when a rollout is over.
        missed_deadlines: actions of this session that were more than half a period late.
    """

    def __init__(
        self,
        learner: OnPolicyLearner[Any],
        folder: str | Path,
        *,
        period: float,
        stop_action: Any,
        stop: Callable[[NDArray[Any]], object] | None,
        watchdog: float,
        clock: Clock,
    ) -> None:
        task = learner.task
        values = np.zeros(task.action_size)
        if stop_action is not None:
            values = as_numbers("stop_action", stop_action, "give finite numbers").ravel()
        if values.shape != (task.action_size,) or (task.clip(values) != values).any():
            raise ConfigurationError(
                f"stop_action = {shown(stop_action)} is not within the limits {task.action_low} "
                f"to {task.action_high}; give the action at which the robot rests"
            )
        if not watchdog > 1.0:
            raise ConfigurationError(
                f"watchdog = {shown(watchdog)}, but it must be more than one period, as "
                "observations are a period apart; 2 is usual"
            )
        self.period = period
        self.stop_action = task.given_spaces.actions(values)
        self.stop_action.flags.writeable = False
        self.missed_deadlines = 0
        self._learner, self._journal = learner, Journal(folder)
        self._stop, self._patience, self._clock = stop, watchdog * period, clock
        self._lock = RLock()  # of the rollout and its pace, which the watchdog's thread may end
        self._rollout: RolloutInProgress | None = None
        self._pace = Pace(period)
        self._open: ExitStack | None = None

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(self._journal.open(self._learner))
            stack.enter_context(blas_threads(self._learner.threads, exact=True))
            if self._stop is not None:
                stack.callback(Watchdog(self._watch, self._clock).close)
            self._open = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._open is not None
        with self._open, self._lock:
            rollout, self._rollout, self._open = self._rollout, None, None
            if rollout is None:
                return
            if rollout.end in (None, End.ABORTED) and self._stop is not None:
                self._stop(self.stop_action)
            if rollout.end is not None:
                self._recorded(rollout)

    # ---- between rollouts ---------------------------------------------------------------------

    def rollouts(
        self,
        updates: int,
        *,
        callback: Callback | Sequence[Callback] | None = None,
        progress: bool = True,
    ) -> Iterator[PlannedRollout]:
        """The rollouts to make, one after the other, until so many updates were made in all.

        Each turn of the loop is one rollout: bring the robot to a start state, then act until
        ``running`` is False.  Between two turns the rollout is recorded, and an update is made
        where a batch is complete, which takes seconds.  Let the robot rest meanwhile.

        Args:
            updates: number of updates, those before the session was opened again included.
            callback, progress: as of `Learner.learn`; the table is printed in lines.

        Yields:
            The rollout's ``iteration``, ``number`` and ``length``, and a ``seed`` for simulators.

        Raises:
            ConfigurationError: the session is not open, or the loop went on while a rollout was
                still running.
            EnvironmentFailure: a rollout was ended three times before its first step was complete.
            StorageError: a rollout cannot be written, or one that was recorded is damaged.
        """
        self._check_open()
        callbacks, learner = callbacks_of(callback), self._learner
        if progress:
            from kreps.learning.progress import ProgressTable

            table = ProgressTable(updates)  # not opened: a live one would take time of the robot's
            table.say(timescale.choices(learner.settings, learner.task, learner.state.terminated))
            callbacks.append(table)
        while learner.state.iteration < updates:
            started = time.process_time()
            collected, cycles = yield from self._batch(learner._batch_plan())
            report = learner._learnt_from(collected, cycles, time.process_time() - started)
            learner.save(self._journal.checkpoint_file)
            if any([is_false(each(learner, report)) for each in callbacks]):
                break

    def _batch(self, plan: BatchPlan) -> Generator[PlannedRollout, None, tuple[Collected, int]]:
        """The rollouts of one iteration; returns them and their control cycles."""
        made: list[RecordedRollout] = []
        parts = plan.parts()
        part = next(parts)
        while True:
            before = len(made)
            for planned in plan.rollouts(part, self._learner.task.decisions):
                recorded = self._journal.recorded(planned, self._learner.task)
                for _ in range(TRIES):
                    if recorded is None:
                        self._begin(part.policy, planned)
                        yield planned
                        recorded = self._finish()
                if recorded is None:
                    raise EnvironmentFailure(
                        f"rollout {planned.number} of iteration {planned.iteration} was ended "
                        f"before its first step was complete, {TRIES} times; check that "
                        "observations come, and that the watchdog leaves time for the first one "
                        "after an action"
                    )
                made.append(recorded)
            try:
                part = parts.send(sum(len(each.rollout) for each in made[before:]))
            except StopIteration as done:
                rollouts = Rollouts.from_list([each.rollout for each in made])
                return Collected(rollouts, done.value), sum(each.cycles for each in made)

    def _check_open(self) -> None:
        if self._open is None:
            raise ConfigurationError(
                "the session is not open; write `with learner.session(...) as robot:` and loop "
                "over its rollouts inside that block"
            )

    def _begin(self, policy: StochasticPolicy, planned: PlannedRollout) -> None:
        self._check_open()
        task = self._learner.task
        # what the policy computes once is computed now, so that the first action is not late
        with default_errstate():
            policy.act(np.zeros((1, task.state_size)), np.zeros((1, task.action_size)))
        with self._lock:
            self._rollout = RolloutInProgress(task, policy, planned)
            self._pace = Pace(self.period)

    def _finish(self) -> RecordedRollout | None:
        """Record the rollout that is over; None if it has no step and is to be made again."""
        with self._lock:
            rollout = self._current()
            if rollout.end is None:
                raise ConfigurationError(
                    "the next rollout was asked for while one is running; act until `running` is "
                    "False, or call abort() before"
                )
            self._rollout = None
            return self._recorded(rollout)

    def _recorded(self, rollout: RolloutInProgress) -> RecordedRollout | None:
        """Write a rollout that is over, and tell what was wrong with it."""
        planned, recorded = rollout.planned, rollout.recorded(self._pace.late)
        if recorded is not None:
            self._journal.record(planned, recorded)
        said = [self._pace.complaint()]
        if rollout.end in (End.WATCHDOG, End.ABORTED):
            steps = 0 if recorded is None else len(recorded.rollout)
            kept = f"its {steps} complete steps are kept" if steps else "it is made again"
            said.append(f"it was ended ({rollout.end}), and {kept}")
        if any(said):
            warnings.warn(
                f"rollout {planned.number} of iteration {planned.iteration}: "
                f"{'; '.join(filter(None, said))}",
                DataWarning,
                stacklevel=5,  # the user's loop over the rollouts
            )
        return recorded

    # ---- in a rollout -------------------------------------------------------------------------

    @property
    def running(self) -> bool:
        """Whether a rollout goes on: it has begun, and the robot is to act."""
        with self._lock:
            return self._rollout is not None and self._rollout.end is None

    def act(self, observation: Any) -> NDArray[Any]:
        """The action of a control cycle.

        Args:
            observation: (ds,) in the task's units, or in the shape of the environment.

        Returns:
            Action (da,) clipped to the task's limits, to be applied until the next one.  If the
            rollout is over, with this observation as its last or before, it is ``stop_action``.

        Raises:
            ConfigurationError: no rollout has begun, or the reward of the last action is missing.
            DataError: another shape, NaN or infinities.
        """
        with self._lock:
            rollout = self._current()
            self._check()
            if rollout.end is not None:
                return self.stop_action
            applied = rollout.act(observation)
            late = self._pace.late
            self._pace.tick(self._clock.monotonic())
            self.missed_deadlines += self._pace.late - late
            if applied is None:
                return self.stop_action
            return self._learner.task.given_spaces.actions(applied)

    def reward(self, reward: Any, terminated: Any = False) -> None:
        """The reward of the last action; nothing happens if the rollout is over.

        Args:
            reward: a finite number.
            terminated: whether the task has ended, as by a fall.  The rollout is over with the
                next observation.

        Raises:
            ConfigurationError: no rollout has begun, or no action is without a reward.
            DataError: NaN, infinities or no flag.
        """
        with self._lock:
            rollout = self._current()
            if rollout.end is None:
                rollout.reward(reward, terminated)

    def wait(self) -> None:
        """Sleep until the next control cycle is due; return at once if no rollout is running.

        Read the sensors afterwards.  A robot that sends its observations at the right times needs
        no call of it.
        """
        due = self._pace.due
        if due is not None and self.running:
            self._clock.sleep(max(0.0, due - self._clock.monotonic()))

    def abort(self) -> None:
        """End the rollout; its complete steps are kept, and nothing happens if none is running."""
        with self._lock:
            if self._rollout is not None:
                self._rollout.end = self._rollout.end or End.ABORTED

    def _current(self) -> RolloutInProgress:
        if self._rollout is None:
            raise ConfigurationError(
                "no rollout has begun; write `with learner.session(...) as robot:` and in it "
                "`for rollout in robot.rollouts(updates=20):`, and act inside that loop"
            )
        return self._rollout

    def _check(self) -> float:
        """End the rollout if the last action is too old; the seconds until that may be next."""
        rollout, last = self._rollout, self._pace.last
        if rollout is None or last is None or not rollout.acting:
            return self._patience
        left = last + self._patience - self._clock.monotonic()
        if left > 0.0:
            return left
        rollout.end = End.WATCHDOG
        return self._patience

    def _watch(self) -> float:
        """`_check`, which sends the stop action if it ends the rollout; called by a thread."""
        with self._lock:
            before = self._rollout
            acting = before is not None and before.acting
            left = self._check()
            ended = acting and before is not None and not before.acting
        if ended and self._stop is not None:
            self._stop(self.stop_action)
        return left
