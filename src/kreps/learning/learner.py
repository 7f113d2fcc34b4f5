"""The learning loop: collect rollouts, update, report.

`Learner` is the interface that all methods share; `kreps.learning.methods` has the methods.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from numbers import Integral
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from kreps.algorithms.state import LearnerState, UpdateReport
from kreps.data.dataset import Dataset
from kreps.data.outliers import find_outliers, warn_of_outliers
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.envs.held_actions import HeldActions, held
from kreps.errors import ConfigurationError, DataError, enough_memory, shown
from kreps.kernels.arrays import default_errstate
from kreps.kernels.threads import blas_threads
from kreps.learning import storage, timescale
from kreps.learning.batches import Collected
from kreps.learning.environment import Environment, environment_for, task_of
from kreps.learning.iteration import Callback, IterationReport, callbacks_of, is_false
from kreps.learning.policy import Policy
from kreps.learning.wrappers import without_restarts
from kreps.presets import flat, preset_of
from kreps.seeding import Purpose, generator
from kreps.settings import LearnerSettings


def whole_number(name: str, value: Any) -> int:
    """A whole number that a user gave.

    Raises:
        ConfigurationError: it is none, negative, or has more than 128 bits.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or not 0 <= int(value) < 2**128:
        raise ConfigurationError(
            f"{name} = {shown(value)}, but it must be a whole number >= 0 of at most 128 bits"
        )
    return int(value)


MethodSettings = TypeVar("MethodSettings", bound=LearnerSettings)


class Learner(Generic[MethodSettings]):
    """The interface of every method: `learn`, `update`, `predict`, `save`, `resume`.

    Args:
        env: a Gymnasium environment with Box observations and bounded Box actions, or a
            `TaskSpec` if all data comes through `update` or from a robot (`session`).  The learner
            restarts the environment at random as in the paper (Sec. 4.1), so its episodes need not
            end.
        seed: of all random numbers; the same seed gives the same policy, byte for byte.
        periodic: coordinates of the observation that are angles in rad; None takes them from
            ``env.metadata["periodic_coordinates"]``, unless a wrapper may change observations.
        threads: BLAS threads while learning; None leaves the number unchanged.  Another number may
            change the last bits of a policy, so learners that run at the same time in threads of
            one process must agree on it.
        preset: ``"default"``, ``"authors"`` (as in the authors' experiment scripts), or settings of
            the method's ``settings_type``.
        **settings: any field of the method's ``settings_type``.

    Raises:
        SpaceError: the environment's observation or action space is not supported.
        ConfigurationError: unknown or invalid settings.
    """

    method: ClassVar[str]
    """Name of the method in files."""

    settings_type: ClassVar[type[Any]]

    algorithm: ClassVar[Callable[..., tuple[LearnerState, UpdateReport]]]
    """One update: ``(state, rollouts, task, settings, rng) -> (state, report)``."""

    def __init__(
        self,
        env: Environment | TaskSpec,
        *,
        seed: int = 0,
        periodic: Sequence[int] | None = None,
        threads: int | None = 1,
        preset: str | MethodSettings = "default",
        **settings: Any,
    ) -> None:
        self.seed = whole_number("seed", seed)
        self.env: Environment | None = None
        if isinstance(env, TaskSpec):
            if periodic is not None:
                raise ConfigurationError(
                    f"periodic = {periodic!r} is given together with a TaskSpec, which has its "
                    "own; write TaskSpec(..., periodic=...)"
                )
            self.task = env
        else:
            self.task = task_of(env, periodic)
            _, probability = without_restarts(env)
            if probability is not None and settings.get("restart_probability") is None:
                settings["restart_probability"] = probability
        self.settings: MethodSettings = preset_of(self.settings_type, preset, settings)
        self.task = self._completed(self.task, chooses=not isinstance(env, TaskSpec))
        if not isinstance(env, TaskSpec):
            self._act_in(env)
        self.threads = None if threads is None else max(1, whole_number("threads", threads))
        self.state = LearnerState(
            ReplayWindow(self.task, self.settings.window, self.settings.window_steps)
        )
        self._policy: Policy | None = None

    def _completed(self, task: TaskSpec, chooses: bool) -> TaskSpec:
        """The task with what the settings say of it; ``chooses`` is False if the data are given."""
        return task

    def _act_in(self, env: Environment) -> None:
        """Collect in this environment from now on."""
        inside = environment_for(env, self.task, self.settings.restart_probability)
        self.env = held(inside, self.task.action_repeat)

    def __repr__(self) -> str:
        state = self.state
        return (
            f"<{type(self).__name__} seed {self.seed}: {state.iteration} updates from "
            f"{state.rollouts} rollouts ({state.steps} steps)>"
        )

    @property
    def exploring(self) -> bool:
        """Whether the next rollouts follow an exploration policy instead of the learnt one.

        They do while no reward of the newest rollouts in the window depends on the state: then no
        goal was reached, and what was learnt can only be to save actions.  Data sets are not
        considered.  Methods that do not collect by their own policy never explore in this way.
        """
        return False

    @property
    def restart_probability(self) -> float:
        """p of the next rollouts and the next update: that of the settings, or as chosen."""
        return timescale.restart_probability(self.settings, self.state.terminated)

    @property
    def update_settings(self) -> MethodSettings:
        """The settings of the next update: nothing in them is left to be chosen."""
        return replace(self.settings, restart_probability=self.restart_probability)

    @property
    def policy(self) -> Policy:
        """The acting policy: that of the latest update that was not rejected.

        Raises:
            ConfigurationError: there was no update yet.
        """
        if self.state.policy is None:
            raise ConfigurationError(
                "there is no policy before the first update; call learn() or update()"
            )
        policy, process, iteration = self._policy, self.state.policy, self.state.iteration
        if policy is None or policy.process is not process or policy.iteration != iteration:
            self._policy = policy = Policy(process, self.seed, iteration)
        return policy

    def learn(
        self,
        iterations: int = 20,
        *,
        callback: Callback | Sequence[Callback] | None = None,
        progress: bool = True,
    ) -> Self:
        """Collect rollouts of the current policy and update, ``iterations`` times.

        Args:
            iterations: number of updates.
            callback: one callable or several, called in order with learner and report after each
                iteration.  If one returns False, all others are called and learning ends.
            progress: whether to show a live table (in a terminal) or to print a line per iteration.

        Raises:
            ConfigurationError: the learner was made without an environment, or an argument is not
                what is described here; nothing was collected then.
            EnvironmentFailure: the environment raised an exception.  The learner is left as it was
                after the last update.
            DataError: the environment returned NaN, infinities or wrong shapes.  The learner is
                left likewise.
        """
        if self.env is None:
            raise ConfigurationError(
                "this learner was made from a TaskSpec and has no environment to collect rollouts "
                "in; pass rollouts to update(), learn on a robot in a session(), or make the "
                "learner from an environment"
            )
        iterations = whole_number("iterations", iterations)
        callbacks = callbacks_of(callback)
        if progress:
            from kreps.learning.progress import ProgressTable

            with ProgressTable(self.state.iteration + iterations) as table:
                table.say(timescale.choices(self.settings, self.task, self.state.terminated))
                return self._learn(iterations, [*callbacks, table], table.rollouts_done)
        return self._learn(iterations, callbacks, None)

    def _learn(
        self,
        iterations: int,
        callbacks: Sequence[Callback],
        on_rollout: Callable[[int], None] | None,
    ) -> Self:
        assert self.env is not None
        for _ in range(iterations):
            started = time.process_time()
            with blas_threads(self.threads, exact=True), enough_memory("collecting rollouts"):
                collected, taken = self._collected(self.env, on_rollout)
            report = self._learnt_from(collected, taken, time.process_time() - started)
            if any([is_false(each(self, report)) for each in callbacks]):
                break
        return self

    def learn_from(self, rollouts: Iterable[Rollout], callback: Callback | None = None) -> Self:
        """One update from recorded rollouts, as an iteration with a report for the callback.

        Args:
            rollouts: as for `update`.
            callback: called with learner and report, as by `learn`.

        Raises:
            DataError: as `update`.
        """
        recorded = Rollouts.from_list(rollouts)
        if not recorded:
            raise DataError("there is no rollout to learn from; give at least one")
        steps = recorded.steps * self.task.action_repeat
        report = self._learnt_from(Collected(recorded, len(recorded)), steps, 0.0)
        for each in callbacks_of(callback):
            each(self, report)
        return self

    def _learnt_from(self, collected: Collected, taken: int, seconds: float) -> IterationReport:
        """Update from the rollouts of an iteration.

        Args:
            collected: the rollouts.
            taken: steps of the environment that they took.
            seconds: of CPU time that they took.
        """
        before = self.state.steps
        probability, repeat = self.restart_probability, self.task.action_repeat
        rollouts, explorer_share = collected.of_acting, collected.explorer_share
        lower, upper = rollouts.reward_quartiles()
        info = self.update(collected.rollouts)
        self.state = replace(self.state, steps=before + taken)
        return IterationReport(
            iteration=self.state.iteration,
            rollouts=self.state.rollouts,
            steps=self.state.steps,
            average_reward=float(rollouts.rewards.sum()) / (taken * (1.0 - explorer_share)),
            mean_return=float(rollouts.rewards.sum()) / len(rollouts),
            terminated=float(rollouts.terminated.mean()),
            reward_quartiles=(lower / repeat, upper / repeat),
            explorer_share=explorer_share,
            update=info,
            rollout_seconds=seconds,
            restart_probability=probability,
        )

    def update(self, rollouts: Iterable[Rollout]) -> UpdateReport:
        """One update from new rollouts, collected anywhere, and those that the window has kept.

        Args:
            rollouts: at least one; their actions as commanded, before any clipping.

        Raises:
            DataError: no rollout, something that is no rollout, or widths that are not the task's;
                or numbers so far from one that what is learnt from them could not be saved.
        """
        if isinstance(rollouts, Dataset):
            raise DataError(
                f"{type(self).__name__} needs all samples in memory and takes a list of rollouts, "
                "not a data set; use KREPS for data sets"
            )
        new = Rollouts.from_list(rollouts)
        if not new:
            raise DataError("there is no new rollout to learn from; give at least one")
        new.check(self.task)
        warn_of_outliers(find_outliers(new, self.state.window.rollouts))
        return self._update(new)

    @default_errstate()
    def _update(self, samples: Any) -> UpdateReport:
        rng = generator(self.seed, Purpose.UPDATE, self.state.iteration)
        with blas_threads(self.threads, exact=True), enough_memory("the update"):
            state, info = self._updated(samples, rng)
            state = replace(state, steps=self._environment_steps(state))
        storage.require_storable(state)
        self.state, self.task = state, state.window.task
        return info

    def _updated(self, samples: Any, rng: np.random.Generator) -> tuple[LearnerState, UpdateReport]:
        return type(self).algorithm(self.state, samples, self.task, self.update_settings, rng)

    def _environment_steps(self, state: LearnerState) -> int:
        """Steps of the environment after an update whose state counts decisions, fully held."""
        before = self.state.steps
        return before + self.task.action_repeat * (state.steps - before)

    def _collected(
        self, env: Environment, on_rollout: Callable[[int], None] | None
    ) -> tuple[Collected, int]:
        """The rollouts of the next iteration, and the steps of the environment that they took."""
        if not isinstance(env, HeldActions):
            collected = self._collect(env, on_rollout)
            return collected, collected.rollouts.steps
        before = env.steps_taken
        return self._collect(env, on_rollout), env.steps_taken - before

    def _collect(self, env: Environment, on_rollout: Callable[[int], None] | None) -> Collected:
        """The rollouts of the next iteration.

        ``on_rollout`` is called with the number of rollouts that are complete.
        """
        raise NotImplementedError

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """`kreps.Policy.predict` of the current policy, with noise of its own after each update."""
        return self.policy.predict(observation, state, episode_start, deterministic)

    def save(self, path: str | Path) -> None:
        """Write a checkpoint, from which `resume` continues with the same bytes."""
        storage.save_checkpoint(path, self.method, self.state, self.task, self.settings, self.seed)

    @classmethod
    def resume(cls, path: str | Path, env: Environment | None = None) -> Self:
        """The learner of a checkpoint, with its settings and seed.

        Args:
            path: written by `save`.
            env: the environment to continue in; None if all data comes through `update`.

        What is no setting is not stored: set ``threads`` (and ``compute`` of KREPS) again if they
        were changed.

        Raises:
            StorageError: the file is missing, damaged or not a checkpoint of this method.
            ConfigurationError: no environment, or one with other observation or action sizes,
                limits or random restarts.
        """
        state, task, settings, seed = storage.load_checkpoint(path, cls.method, cls.settings_type)
        learner = cls(task, seed=seed, **flat(settings))
        if env is not None:
            learner._act_in(env)
        learner.state = state
        return learner
