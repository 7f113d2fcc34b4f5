"""What the learnt model predicts of any action: expected features, rewards and novelty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.models.dynamics import Dynamics
from kreps.models.model_env import ModelEnv
from kreps.models.novelty import NoveltyBonus
from kreps.models.reward_model import RewardModel


@dataclass(frozen=True)
class WorldModel:
    """The learnt model of n samples.

    Attributes:
        task: limits and scale of the actions.
        states: (n, ds) sampled states.
        features: (n, r) of V there.
        phi: features (m, r) of V at any states (m, ds).
        restart: (r,) mean features of the states that the process restarts in.
        expected_features: ``E[phi(s')]`` (m, r) of sample numbers (m,), whose states the actions
            are taken in or nearest to, and of states and scaled, applied actions (m, ds + da).
        dynamics: predicts successors; None if the transition model predicts features only.
        terminations: in its place, probabilities (m,) of a termination of states and actions; None
            if no episode terminated.
        reward_model: expected rewards.
        model_env: rolls policies out in the model; None if the model cannot.
        bonus: exploration bonus; None if there is none.
    """

    task: TaskSpec
    states: FloatArray
    features: FloatArray
    phi: Callable[[FloatArray], FloatArray]
    restart: FloatArray
    expected_features: Callable[[IntArray, FloatArray], FloatArray]
    dynamics: Dynamics | None
    terminations: Callable[[FloatArray], FloatArray] | None
    reward_model: RewardModel
    model_env: ModelEnv | None
    bonus: NoveltyBonus | None

    def terminations_and_novelty(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Probabilities of a termination (m,), and novelty of the successors (m,) in [0, 1].

        After a termination there is no novelty.

        Args:
            inputs: (m, ds + da) states and scaled, applied actions.
        """
        none = np.zeros(len(inputs))
        if self.dynamics is None:
            return none if self.terminations is None else self.terminations(inputs), none
        if self.dynamics.terminations is None and self.bonus is None:
            return none, none
        successors, terminations = self.dynamics.predict(inputs)
        if self.model_env is None or self.bonus is None:
            return terminations, none
        _, similarity = self.model_env.nearest(successors)
        return terminations, (1.0 - terminations) * self.bonus.novelty(similarity)
