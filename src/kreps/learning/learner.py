"""The facade: collect roll-outs, update, report, and do it again.

`Learner` is the surface; `KREPS` and the comparative methods of Sec. 4.2 say how they update.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np

from kreps.algorithms import npalp, value_iteration
from kreps.algorithms.state import LearnerState, UpdateReport
from kreps.algorithms.update import update as reps_update
from kreps.data.compute import Compute
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import LinearFunction
from kreps.kernels.threads import blas_threads
from kreps.learning import storage
from kreps.learning.collect import collect, collect_grid
from kreps.learning.environment import Environment, task_of, without_restarts
from kreps.learning.policy import Policy
from kreps.policies.base import StochasticPolicy
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT
from kreps.policies.exploration import PINK, RED, WHITE, BangBang, Gaussian
from kreps.presets import changed, flat, settings_of
from kreps.seeding import Purpose, generator
from kreps.settings import (
    GridValueIterationSettings,
    LearnerSettings,
    NPALPSettings,
    OnPolicySettings,
    Settings,
    ValueIterationSettings,
)


def _whole(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 0:
        raise ConfigurationError(f"{name} = {value!r}, but it must be a whole number >= 0")
    return int(value)


@dataclass(frozen=True)
class IterationReport:
    """What a callback is told after each iteration.

    Attributes:
        iteration: updates made, this one included.
        rollouts, steps: roll-outs and environment steps seen so far.
        average_reward: per step, over the new roll-outs.
        update: what the method reports of the update, with CPU seconds by stage.
        rollout_seconds: CPU seconds that the new roll-outs took.
    """

    iteration: int
    rollouts: int
    steps: int
    average_reward: float
    update: Any
    rollout_seconds: float


Callback = Callable[[Any, IterationReport], bool | None]
"""Called with learner and report after each iteration; returning False ends the learning early."""

MethodSettings = TypeVar("MethodSettings", bound=LearnerSettings)
OnPolicy = TypeVar("OnPolicy", bound=OnPolicySettings)


class Learner(Generic[MethodSettings]):
    """What every method offers: `learn`, `update`, `predict`, `save`, `resume`.

    Args:
        env: a Gymnasium environment with Box observations and bounded Box actions, or a
            `TaskSpec` if all data comes through `update`.  The learner restarts it at random as
            in the paper (Sec. 4.1), so it need not end by itself.
        seed: of everything random; the same seed gives the same policy, byte for byte.
        periodic: coordinates of the observation that are angles in rad; None asks the
            environment's ``metadata["periodic_coordinates"]``.
        threads: BLAS threads while learning; None leaves BLAS as it is.  Another number may
            change the last bits of a policy.
        **settings: any field of the method's ``settings_type``.

    Raises:
        SpaceError: the environment's spaces cannot be served.
        ConfigurationError: unknown or impossible settings.
    """

    method: ClassVar[str]
    """Its name in files."""

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
        **settings: Any,
    ) -> None:
        self.seed = _whole("seed", seed)
        self.env: Environment | None = None
        if isinstance(env, TaskSpec):
            if periodic is not None:
                raise ConfigurationError(
                    f"periodic = {periodic!r} beside a TaskSpec, which names them itself; "
                    "write TaskSpec(..., periodic=...)"
                )
            self.task = env
        else:
            self.task = task_of(env, periodic)
            self.env, probability = without_restarts(env)
            if probability is not None:
                asked = settings.setdefault("restart_probability", probability)
                if asked != probability:
                    raise ConfigurationError(
                        f"restart_probability = {asked!r}, but the environment's RandomRestart has "
                        f"{probability!r}; give one of them"
                    )
        self.settings = self._settings(settings)
        self.threads = None if threads is None else max(1, _whole("threads", threads))
        self.state = LearnerState(ReplayWindow(self.task, self.settings.window))
        self._policy: Policy | None = None

    def _settings(self, changes: dict[str, Any]) -> MethodSettings:
        return changed(self.settings_type(), changes)

    def __repr__(self) -> str:
        state = self.state
        return (
            f"<{type(self).__name__} seed {self.seed}: {state.iteration} updates from "
            f"{state.rollouts} roll-outs ({state.steps} steps)>"
        )

    @property
    def exploring(self) -> bool:
        """Whether the next roll-outs explore, whatever was learnt: no reward tells of the states.

        Only learners that collect by their own policy do so.  Roll-outs of the window are asked,
        data sets are not.
        """
        return False

    @property
    def policy(self) -> Policy:
        """The policy that acts now: the one learnt last, if it was not refused.

        Raises:
            ConfigurationError: nothing has been learnt yet.
        """
        if self.state.policy is None:
            raise ConfigurationError(
                "no policy has been learnt yet; call learn() or update() first"
            )
        if self._policy is None or self._policy.process is not self.state.policy:
            self._policy = Policy(self.state.policy, self.seed)
        return self._policy

    def learn(
        self,
        iterations: int = 20,
        *,
        callback: Callback | Sequence[Callback] = (),
        progress: bool = True,
    ) -> Self:
        """Make ``iterations`` more updates, each from new roll-outs of the current policy.

        Args:
            iterations: how many.
            callback: one callable or several, called in order after each iteration.
            progress: show a live table (in a terminal) or a line per iteration.

        Raises:
            ConfigurationError: the learner was made without an environment.
            EnvironmentFailure: the environment raised; the learner is as after the last update.
            DataError: the environment returned NaN, infinities or wrong shapes; likewise.
        """
        if self.env is None:
            raise ConfigurationError(
                "this learner was made from a TaskSpec and has no environment to roll out in; "
                "give it data by update(rollouts), or make it from an environment"
            )
        iterations = _whole("iterations", iterations)
        callbacks = [callback] if callable(callback) else list(callback)
        if progress:
            from kreps.learning.progress import ProgressTable

            with ProgressTable(self.state.iteration + iterations) as table:
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
            with blas_threads(self.threads):
                rollouts = self._collect(self.env, on_rollout)
            seconds = time.process_time() - started
            info = self.update(rollouts)
            report = IterationReport(
                iteration=self.state.iteration,
                rollouts=self.state.rollouts,
                steps=self.state.steps,
                average_reward=float(rollouts.rewards.mean()),
                update=info,
                rollout_seconds=seconds,
            )
            if any([each(self, report) is False for each in callbacks]):
                break
        return self

    def update(self, rollouts: Iterable[Rollout]) -> UpdateReport:
        """One update from roll-outs collected anywhere; those kept from before count too.

        Args:
            rollouts: at least one; their actions as commanded, before any clipping.

        Raises:
            DataError: not roll-outs, none of them, or of other widths than the task's.
        """
        if isinstance(rollouts, Dataset):
            raise DataError(
                f"{type(self).__name__} learns from all samples at once and takes a list of "
                "roll-outs; only KREPS learns from a data set"
            )
        new = Rollouts.from_list(rollouts)
        if not new:
            raise DataError("there is no new rollout to learn from; give at least one")
        return self._update(new)

    def _update(self, samples: Any) -> UpdateReport:
        rng = generator(self.seed, Purpose.UPDATE, self.state.iteration)
        with blas_threads(self.threads):
            self.state, info = self._updated(samples, rng)
        return info

    def _updated(self, samples: Any, rng: np.random.Generator) -> tuple[LearnerState, UpdateReport]:
        return type(self).algorithm(self.state, samples, self.task, self.settings, rng)

    def _collect(self, env: Environment, on_rollout: Callable[[int], None] | None) -> Rollouts:
        """The next iteration's data."""
        raise NotImplementedError

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[FloatArray, Any]:
        """`kreps.Policy.predict` of the current policy."""
        return self.policy.predict(observation, state, episode_start, deterministic)

    def save(self, path: str | Path) -> None:
        """Write a checkpoint from which `resume` goes on as if nothing had happened."""
        storage.save_checkpoint(path, self.method, self.state, self.task, self.settings, self.seed)

    @classmethod
    def resume(cls, path: str | Path, env: Environment | None = None) -> Self:
        """A learner as it was when it was saved; settings and seed come from the file.

        Args:
            path: written by `save`.
            env: the environment it learnt in; None if all data comes through `update`.

        Raises:
            StorageError: the file is missing, damaged or foreign.
            ConfigurationError: the environment is not of the shape that was learnt in.
        """
        state, task, settings, seed = storage.load_checkpoint(path, cls.method, cls.settings_type)
        learner = cls(task, seed=seed, **flat(settings))
        if env is not None:
            learner.env, _ = without_restarts(env)
            found = task_of(env, task.periodic)
            same = found.observation_size == task.observation_size and (
                np.array_equal(found.action_low, task.action_low)
                and np.array_equal(found.action_high, task.action_high)
            )
            if not same:
                raise ConfigurationError(
                    f"the environment has {found.observation_size} observation coordinates and "
                    f"actions in {found.action_low} to {found.action_high}, the checkpoint "
                    f"{task.observation_size} and {task.action_low} to {task.action_high}; "
                    "resume in the environment that it was learnt in"
                )
        learner.state = state
        return learner


class OnPolicyLearner(Learner[OnPolicy]):
    """A learner that explores by its own stochastic policy, from start states only (Sec. 4.1)."""

    def _collect(self, env: Environment, on_rollout: Callable[[int], None] | None) -> Rollouts:
        policy, exponent = self._acting()
        return collect(
            env,
            self.task,
            policy,
            self._batch(),
            seed=self.seed,
            iteration=self.state.iteration,
            restart_probability=self.settings.restart_probability,
            stratified=self.settings.rollout_lengths == "stratified",
            exponent=exponent,
            on_rollout=on_rollout,
        )

    def _batch(self) -> int:
        """Roll-outs of the next iteration."""
        first = self.state.iteration == 0
        return self.settings.initial_rollouts if first else self.settings.rollouts_per_iteration

    @property
    def exploring(self) -> bool:
        window = self.state.window
        return len(window.rollouts) > 0 and not window.newest_depend_on_state

    def _acting(self) -> tuple[StochasticPolicy, float]:
        """The policy of the next roll-outs, and the exponent of its noise's spectrum."""
        if self.exploring:
            return BangBang(self.task), RED
        if self.state.policy is not None:
            return self.state.policy, WHITE
        if self.settings.exploration.noise == "bang-bang":
            return BangBang(self.task), WHITE
        gaussian = Gaussian(self.task, self.settings.exploration.scale)
        return gaussian, PINK if self.settings.exploration.noise == "pink" else WHITE


class KREPS(OnPolicyLearner[Settings]):
    """Relative entropy policy search with RKHS embeddings.

    Args:
        env, seed, periodic, threads: as of `Learner`.
        recipe: ``"default"``, ``"observed"`` (one step on the actions that were taken), ``"paper"``
            (close to the printed method) or a `kreps.Settings`.
        compute: who works on the chunks of updates of low rank, and in which arrays; not part of a
            checkpoint, so set it again after `resume`: ``learner.compute = ...``.
        **settings: any field of `kreps.Settings`, such as ``kl_bound``.

    Raises:
        SpaceError: the environment's spaces cannot be served.
        ConfigurationError: unknown or impossible settings.
    """

    method = "reps"
    settings_type = Settings

    def __init__(
        self,
        env: Environment | TaskSpec,
        *,
        seed: int = 0,
        preset: str | Settings = "model_based",
        periodic: Sequence[int] | None = None,
        threads: int | None = 1,
        compute: Compute | None = None,
        **settings: Any,
    ) -> None:
        self._preset = preset
        self.compute = compute or Compute()
        super().__init__(env, seed=seed, periodic=periodic, threads=threads, **settings)

    def _settings(self, changes: dict[str, Any]) -> Settings:
        return settings_of(self._preset, **changes)

    def update(self, rollouts: Iterable[Rollout] | Dataset) -> UpdateReport:
        """One update from roll-outs collected anywhere; those kept from before count too.

        A policy that the model finds worse than the one before is refused, and that one stays; the
        report says so (``refused``).

        Args:
            rollouts: at least one; their actions as commanded, before any clipping.  Or a
                `kreps.Dataset` of any size, which is learnt from alone and not kept: later updates
                see only the roll-outs that were given as such.

        Raises:
            DataError: not roll-outs, none of them, or of other widths than the task's.
            ConfigurationError: a data set with ``approximation="exact"``.
            StorageError: a data set's file that is damaged, or not as it was when it was opened.
        """
        if not isinstance(rollouts, Dataset):
            return super().update(rollouts)
        return self._update(rollouts)

    def _updated(self, samples: Any, rng: np.random.Generator) -> tuple[LearnerState, UpdateReport]:
        return reps_update(self.state, samples, self.settings, rng, self.compute)

    @property
    def value_function(self) -> LinearFunction:
        """V of the last update (Eq. 3), in units of the reward.

        Raises:
            ConfigurationError: nothing has been learnt yet.
        """
        if self.state.value is None:
            raise ConfigurationError("no V has been learnt yet; call learn() or update() first")
        return self.state.value


class ValueIteration(OnPolicyLearner[ValueIterationSettings]):
    """Value iteration with RKHS embeddings, exploring by softmax (Gruenewaelder et al. 2012).

    Arguments and errors are those of `Learner`; settings `kreps.settings.ValueIterationSettings`.
    """

    method = "value-iteration"
    settings_type = ValueIterationSettings
    algorithm = staticmethod(value_iteration.update)


class GridValueIteration(Learner[GridValueIterationSettings]):
    """Off-policy value iteration with RKHS embeddings on a grid of states and actions.

    It is given what no robot offers: a simulator that can be set to any state.  Its environment
    needs a ``batch_model`` with ``states_at`` (see `kreps.envs.batch.SettableModel`), as
    `kreps/SwingUp-v0` and `kreps/Reaching-v0` have it.  Each iteration tries one step from every
    grid point; one iteration is enough.

    Arguments and errors are those of `Learner`; settings
    `kreps.settings.GridValueIterationSettings`.
    """

    method = "grid-value-iteration"
    settings_type = GridValueIterationSettings
    algorithm = staticmethod(value_iteration.update)

    def _collect(self, env: Environment, on_rollout: Callable[[int], None] | None) -> Rollouts:
        settings = self.settings
        rollouts = collect_grid(
            env,
            self.task,
            settings.ranges,
            settings.grid_states,
            settings.grid_actions,
            most=min(settings.window or MAX_SUPPORT, MAX_SUPPORT),
            seed=self.seed,
            iteration=self.state.iteration,
        )
        if on_rollout is not None:
            on_rollout(len(rollouts))
        return rollouts


class NPALP(OnPolicyLearner[NPALPSettings]):
    """Non-parametric approximate linear programming (Pazis and Parr 2011).

    For deterministic tasks only: it takes the best that was seen to happen for what will happen.

    Arguments and errors are those of `Learner`; settings `kreps.settings.NPALPSettings`.
    """

    method = "npalp"
    settings_type = NPALPSettings
    algorithm = staticmethod(npalp.update)


LEARNERS: dict[str, type[Learner[Any]]] = {
    learner.method: learner for learner in (KREPS, ValueIteration, GridValueIteration, NPALP)
}
"""By name in files."""
