"""What the learnt model predicts of any action: expected features, rewards and novelty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.models.model_env import ModelEnv
from kreps.models.novelty import NoveltyBonus


@dataclass(frozen=True)
class WorldModel:
    """The learnt model of n samples.

    Attributes:
        task: limits and scale of the actions.
        states: (n, ds) sampled states.
        features: (n, r) of V there.
        phi: features (m, r) of V at any states (m, ds).
        restart: (r,) mean features of the states that the process restarts in.
        rewards: (n,) observed, standardised.
        expected_features: ``E[phi(s')]`` (m, r) of sample numbers (m,), whose states the actions
            are taken in or nearest to, and of states and scaled, applied actions (m, ds + da).
        reward_model: expected reward (m, 1), less the mean, of such states and actions.
        model_env: rolls policies out in the model; None if the model cannot.
        bonus: exploration bonus; None if there is none.
    """

    task: TaskSpec
    states: FloatArray
    features: FloatArray
    phi: Callable[[FloatArray], FloatArray]
    restart: FloatArray
    rewards: FloatArray
    expected_features: Callable[[IntArray, FloatArray], FloatArray]
    reward_model: Callable[[FloatArray], FloatArray]
    model_env: ModelEnv | None
    bonus: NoveltyBonus | None

    def expected_rewards(self, inputs: FloatArray) -> FloatArray:
        """Expected rewards (m,), standardised, of states and scaled, applied actions (m, ds + da).

        They are clipped to the range of the observed rewards, beyond which a regression may
        overshoot.
        """
        predicted = self.rewards.mean() + self.reward_model(inputs)[:, 0]
        return np.clip(predicted, self.rewards.min(), self.rewards.max())

    def novelty(self, inputs: FloatArray) -> FloatArray:
        """Novelty (m,), in [0, 1], of the successors of states and actions (m, ds + da).

        A start state, which follows the end of an episode, has none.
        """
        if self.model_env is None or self.bonus is None:
            return np.zeros(len(inputs))
        successors, ends = self.model_env.dynamics.predict(inputs)
        _, similarity = self.model_env.nearest(successors)
        return (1.0 - ends[:, 0]) * self.bonus.novelty(similarity)
