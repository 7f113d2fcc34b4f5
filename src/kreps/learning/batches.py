"""The rollouts of one iteration: by the acting policy, and by the explorer while there is one."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from math import ceil

import numpy as np

from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.learning.collect import collect_planned, decisions_in
from kreps.learning.environment import Environment
from kreps.learning.planning import PlannedRollout, planned_rollouts
from kreps.policies.base import StochasticPolicy
from kreps.settings import OnPolicySettings

MIN_ROLLOUTS = 2
"""Smallest size of a growing batch, in mean rollouts: one of the policy and one of the explorer."""

MAX_ROLLOUT = 2.0
"""Largest length of a rollout of a growing batch, in mean rollouts: a longer one would take the
steps of the rest of a small batch, whose rollouts should start in more than one state."""

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
        settings: ``initial_rollouts``, ``rollouts_per_iteration`` and ``growth``, of an update:
            nothing in them is left to be chosen.
        iteration: updates so far.
        decisions: made so far.
    """
    if iteration == 0:
        return settings.initial_rollouts  # type: ignore[return-value]  # chosen, in an update
    if not settings.growth:
        return settings.rollouts_per_iteration
    grown = settings.growth * decisions * settings.p
    return min(max(grown, MIN_ROLLOUTS), settings.rollouts_per_iteration)


@dataclass(frozen=True)
class Part:
    """Rollouts of one policy that are made one after the other, with lengths drawn together.

    Attributes:
        policy: that acts.
        first: number of the first of them in the iteration.
        count: number of rollouts.
    """

    policy: StochasticPolicy
    first: int
    count: int


@dataclass(frozen=True)
class BatchPlan:
    """What the rollouts of one iteration will be: who acts, how often, and with which numbers.

    `collect_batch` carries it out in an environment, `kreps.learning.session` on a robot.

    Attributes:
        policies: the acting one first; each makes an equal part of the batch.
        exponent: of the spectrum of their noise.
        size: in mean rollouts.  With ``growth`` rollouts are made until they have the steps of so
            many, but for less than half of one, or until there are `MAX_SHORT_ROLLOUTS` times as
            many.
        settings: restart probability, lengths and growth.
        seed: of the learner.
        iteration: updates so far.
    """

    policies: tuple[StochasticPolicy, ...]
    exponent: float
    size: float
    settings: OnPolicySettings
    seed: int
    iteration: int

    def parts(self) -> Generator[Part, int, int]:
        """The parts in order.  Each ``yield`` is to be sent the steps that the part had.

        Returns:
            Number of the rollouts of the acting policy.
        """
        done = acting = 0
        shares = _shares(self.size, len(self.policies), self.settings)
        for policy, missing in zip(self.policies, shares, strict=True):
            most = done + ceil(MAX_SHORT_ROLLOUTS * missing)
            while done < most:
                count = min(max(1, round(missing)), most - done)
                steps = yield Part(policy, done, count)
                done += count
                missing -= steps * self.settings.p
                if missing < 0.5 or not self.settings.growth:
                    break
            acting = acting or done
        return acting

    def rollouts(self, part: Part, decisions: int | None) -> list[PlannedRollout]:
        """The rollouts of a part.

        Args:
            part: of this batch.
            decisions: largest number of decisions in an episode; None without a limit.
        """
        if self.settings.growth:
            longest = ceil(MAX_ROLLOUT / self.settings.p)
            decisions = longest if decisions is None else min(decisions, longest)
        return planned_rollouts(
            part.count,
            first=part.first,
            seed=self.seed,
            iteration=self.iteration,
            restart_probability=self.settings.p,
            stratified=self.settings.rollout_lengths == "stratified",
            exponent=self.exponent,
            decisions=decisions,
        )


def collect_batch(
    env: Environment, task: TaskSpec, plan: BatchPlan, on_rollout: Callable[[int], None] | None
) -> Collected:
    """The new rollouts of one iteration.

    Args:
        env, task: as of `collect`.
        plan: of the iteration.
        on_rollout: called with the number of rollouts that are complete.
    """
    collected: list[Rollout] = []

    def tell(count: int) -> None:
        if on_rollout is not None:
            on_rollout(before + count)

    parts = plan.parts()
    part = next(parts)
    while True:
        before = len(collected)
        planned = plan.rollouts(part, decisions_in(env, task))
        new = collect_planned(env, task, part.policy, planned, tell)
        collected.extend(new)
        try:
            part = parts.send(new.steps)
        except StopIteration as done:
            return Collected(Rollouts.from_list(collected), done.value)


def _shares(size: float, count: int, settings: OnPolicySettings) -> list[float]:
    """Equal parts of a batch; in whole rollouts, the larger part first, if batches do not grow."""
    if settings.growth:
        return [size / count] * count
    return [len(part) for part in np.array_split(np.arange(round(size)), count)]
