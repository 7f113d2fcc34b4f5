"""Learners that collect rollouts by their own policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from kreps.kernels.arrays import default_errstate
from kreps.learning.batches import BatchPlan, Collected, batch_size, collect_batch
from kreps.learning.environment import Environment
from kreps.learning.learner import Learner
from kreps.policies.base import StochasticPolicy
from kreps.policies.exploration import PINK, RED, WHITE, BangBang, Gaussian
from kreps.settings import OnPolicySettings

OnPolicy = TypeVar("OnPolicy", bound=OnPolicySettings)


class OnPolicyLearner(Learner[OnPolicy]):
    """A learner that collects rollouts by its own stochastic policy, from start states only.

    These are the rollouts of Sec. 4.1.
    """

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
