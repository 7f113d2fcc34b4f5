"""Comparison of policies in a learnt model, for tests of what is optimised in it."""

from __future__ import annotations

import numpy as np

from kreps.algorithms.acceptance import ModelComparison
from kreps.models.model_env import ModelEnv
from kreps.models.reward_model import RewardModel
from kreps.models.world_model import WorldModel


def compared_in(env: ModelEnv, rewards: RewardModel, rollouts: int, seed: int) -> ModelComparison:
    """A comparison without features of V and without an exploration bonus."""
    states = env.data.states
    world = WorldModel(
        task=env.task,
        states=states,
        features=np.empty((len(states), 0)),
        phi=lambda states: np.empty((len(states), 0)),
        restart=np.empty(0),
        expected_features=lambda rows, inputs: np.empty((len(rows), 0)),
        dynamics=env.dynamics,
        terminations=None,
        reward_model=rewards,
        model_env=env,
        bonus=None,
    )
    return ModelComparison(world, rollouts, seed)
