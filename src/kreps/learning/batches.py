"""The rollouts of one iteration: by the acting policy, and by the explorer while there is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import numpy as np

from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.learning.collect import collect
from kreps.learning.environment import Environment
from kreps.policies.base import StochasticPolicy
from kreps.settings import OnPolicySettings

MIN_ROLLOUTS = 2
"""Smallest size of a growing batch, in mean rollouts: one of the policy and one of the explorer."""

MAX_SHORT_ROLLOUTS = 10
"""Largest number of rollouts per mean rollout of a growing batch, however early episodes end."""


@dataclass(frozen=True)
class Collected:
    """The new rollouts of one iteration.

    Attributes:
        rollouts: those of the acting policy first.
        acting: number of these.
    """

    rollouts: Rollouts
    acting: int

    @property
    def of_acting(self) -> Rollouts:
        """The rollouts of the acting policy."""
        return self.rollouts[: self.acting]

    @property
    def explorer_share(self) -> float:
        """Share of the steps that the explorer made."""
        return 1.0 - self.of_acting.steps / self.rollouts.steps


def batch_size(settings: OnPolicySettings, iteration: int, decisions: float) -> float:
    """Size of the batch of an iteration, in mean rollouts.

    Args:
        settings: ``initial_rollouts``, ``rollouts_per_iteration`` and ``growth``.
        iteration: updates so far.
        decisions: made so far.
    """
    if iteration == 0:
        return settings.initial_rollouts
    if not settings.growth:
        return settings.rollouts_per_iteration
    grown = settings.growth * decisions * settings.p
    return min(max(grown, MIN_ROLLOUTS), settings.rollouts_per_iteration)


def collect_batch(
    env: Environment,
    task: TaskSpec,
    policies: list[StochasticPolicy],
    size: float,
    settings: OnPolicySettings,
    *,
    seed: int,
    iteration: int,
    exponent: float,
    on_rollout: Callable[[int], None] | None,
) -> Collected:
    """The new rollouts of one iteration, an equal part of them by each policy.

    Args:
        env, task, seed, iteration, exponent, on_rollout: as of `collect`.
        policies: the acting one first.
        size: in mean rollouts.  With ``growth`` rollouts are made until they have the steps of so
            many, but for less than half of one, or until there are `MAX_SHORT_ROLLOUTS` times as
            many.
        settings: restart probability, lengths and growth.
    """
    p = settings.p
    collected: list[Rollout] = []
    acting = 0

    def tell(count: int) -> None:
        if on_rollout is not None:
            on_rollout(before + count)

    for policy, missing in zip(policies, _parts(size, len(policies), settings), strict=True):
        most = len(collected) + ceil(MAX_SHORT_ROLLOUTS * missing)
        while len(collected) < most:
            before = len(collected)
            new = collect(
                env,
                task,
                policy,
                min(max(1, round(missing)), most - len(collected)),
                first=before,
                seed=seed,
                iteration=iteration,
                restart_probability=p,
                stratified=settings.rollout_lengths == "stratified",
                exponent=exponent,
                on_rollout=tell,
            )
            collected.extend(new)
            missing -= new.steps * p
            if missing < 0.5 or not settings.growth:
                break
        acting = acting or len(collected)
    return Collected(Rollouts.from_list(collected), acting)


def _parts(size: float, count: int, settings: OnPolicySettings) -> list[float]:
    """Equal parts of a batch; in whole rollouts, the larger part first, if batches do not grow."""
    if settings.growth:
        return [size / count] * count
    return [len(part) for part in np.array_split(np.arange(round(size)), count)]
