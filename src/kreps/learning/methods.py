"""The methods: KREPS, and those that the paper compares it with (Sec. 4.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from kreps.algorithms import npalp, value_iteration
from kreps.algorithms.state import LearnerState, UpdateReport
from kreps.algorithms.update import update as reps_update
from kreps.data.compute import Compute
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.basis import LinearFunction
from kreps.learning import timescale
from kreps.learning.batches import Collected
from kreps.learning.collect import collect_grid
from kreps.learning.environment import Environment, known_reward_of
from kreps.learning.learner import Learner
from kreps.learning.on_policy import OnPolicyLearner
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT
from kreps.settings import (
    GridValueIterationSettings,
    NPALPSettings,
    Settings,
    ValueIterationSettings,
)

AnyValueIterationSettings = TypeVar(
    "AnyValueIterationSettings", ValueIterationSettings, GridValueIterationSettings
)


class KREPS(OnPolicyLearner[Settings]):
    """Relative entropy policy search with RKHS embeddings.

    Args:
        env, seed, periodic, threads: as for `Learner`.
        preset: ``"model_based"``, ``"single_step"`` (one step on the sampled actions, without
            generated samples), ``"paper"`` (close to the printed method), ``"authors"`` (as the
            authors' scripts have it) or a `kreps.Settings`.
        compute: where low-rank updates compute sums over samples, and in which arrays.  It is not
            part of a checkpoint, so set it again after `resume`: ``learner.compute = ...``.
        **settings: any field of `kreps.Settings`, such as ``kl_bound=0.5``, ``value=kreps.Grid(5)``
            or ``**{"model_based.acceptance_rollouts": 0}`` for one field of a section.

    Raises:
        SpaceError: the environment's observation or action space is not supported.
        ConfigurationError: unknown or invalid settings.
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
        self.compute = compute or Compute()
        super().__init__(
            env, seed=seed, periodic=periodic, threads=threads, preset=preset, **settings
        )

    def _completed(self, task: TaskSpec, chooses: bool) -> TaskSpec:
        settings, repeat = self.settings, task.action_repeat
        if settings.action_repeat is not None or chooses:
            repeat = timescale.action_repeat(settings, task)
        history = 0 if settings.history == "auto" else settings.history
        return replace(
            task,
            action_repeat=repeat,
            delay=max(task.delay, settings.delay),
            history=max(task.history, history),
        )

    def update(self, rollouts: Iterable[Rollout] | Dataset) -> UpdateReport:
        """One update from new rollouts, collected anywhere, and those that the window has kept.

        If the policy acceptance test rejects the new policy, the previous one stays, and
        ``rejected`` is True in the report.

        Args:
            rollouts: at least one; their actions as commanded, before any clipping.  Or a
                `kreps.Dataset` of any size: then the update is from it alone, and it is not added
                to the window.

        Raises:
            DataError: no rollout, something that is no rollout, or widths that are not the task's.
            ConfigurationError: a data set with ``low_rank=None``, or more samples than an exact
                update can take.
            StorageError: a file of a data set is damaged, or has changed since it was opened.
        """
        if not isinstance(rollouts, Dataset):
            return super().update(rollouts)
        return self._update(rollouts)

    def _updated(self, samples: Any, rng: np.random.Generator) -> tuple[LearnerState, UpdateReport]:
        return reps_update(self.state, samples, self.update_settings, rng, self.compute)

    @property
    def value_function(self) -> LinearFunction:
        """V of the latest update (Eq. 3), in units of the reward.

        Raises:
            ConfigurationError: there was no update yet.
        """
        if self.state.value is None:
            raise ConfigurationError(
                "there is no V before the first update; call learn() or update()"
            )
        return self.state.value


class AnyValueIteration(Learner[AnyValueIterationSettings]):
    """Value iteration on any data; the reward function of the environment may be known."""

    def _updated(self, samples: Any, rng: np.random.Generator) -> tuple[LearnerState, UpdateReport]:
        known = known_reward_of(self.env) if self.settings.known_reward else None
        return value_iteration.update(
            self.state, samples, self.task, self.update_settings, rng, known
        )


class ValueIteration(
    AnyValueIteration[ValueIterationSettings], OnPolicyLearner[ValueIterationSettings]
):
    """Value iteration with RKHS embeddings and a softmax policy (Gruenewaelder et al. 2012).

    Arguments and errors are those of `Learner`, settings those of
    `kreps.settings.ValueIterationSettings`.
    """

    method = "value-iteration"
    settings_type = ValueIterationSettings


class GridValueIteration(AnyValueIteration[GridValueIterationSettings]):
    """Off-policy value iteration with RKHS embeddings on a grid of states and actions.

    Each iteration takes one step from every grid point; one iteration is enough.  The environment
    must be a simulator that can be set to any state, which a robot cannot: it needs a
    ``batch_model`` with ``states_at`` (see `kreps.envs.batch.SettableModel`), as
    `kreps/SwingUp-v0` and `kreps/Reaching-v0` have it.

    Arguments and errors are those of `Learner`, settings those of
    `kreps.settings.GridValueIterationSettings`.
    """

    method = "grid-value-iteration"
    settings_type = GridValueIterationSettings

    def _collect(self, env: Environment, on_rollout: Callable[[int], None] | None) -> Collected:
        settings = self.settings
        rollouts = collect_grid(
            env,
            self.task,
            settings.ranges,
            settings.grid_states,
            settings.grid_actions,
            max_points=min(settings.window or MAX_SUPPORT, MAX_SUPPORT),
            seed=self.seed,
            iteration=self.state.iteration,
        )
        if on_rollout is not None:
            on_rollout(len(rollouts))
        return Collected(rollouts, len(rollouts))


class NPALP(OnPolicyLearner[NPALPSettings]):
    """Non-parametric approximate linear programming (Pazis and Parr 2011).

    For deterministic tasks only: it takes the best observed outcome of an action for the expected
    one.

    Arguments and errors are those of `Learner`, settings those of `kreps.settings.NPALPSettings`.
    """

    method = "npalp"
    settings_type = NPALPSettings
    algorithm = staticmethod(npalp.update)


LEARNERS: dict[str, type[Learner[Any]]] = {
    learner.method: learner for learner in (KREPS, ValueIteration, GridValueIteration, NPALP)
}
"""Each method by its name in files."""
