"""A pole that falls, its learnt model, and how long a policy keeps it upright."""

from __future__ import annotations

from functools import cache

import numpy as np

from kreps.algorithms.acceptance import ModelComparison
from kreps.data.history import stacked
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import KernelExpansion
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.models.dynamics import fit_dynamics
from kreps.models.model_env import ModelEnv
from kreps.models.reward_model import RewardModel
from kreps.models.transition import state_kernel
from kreps.policies.base import StochasticPolicy
from tests.compared import compared_in

TASK = TaskSpec(3, np.array([-2.0]), np.array([2.0]))
"""Sine and cosine of the angle, and its speed in rad/s that a torque changes."""


def pole(angle: float, speed: float, torque: float) -> tuple[float, float]:
    speed = speed + 0.1 * (9.0 * np.sin(angle) + 4.0 * np.clip(torque, -2.0, 2.0))
    return angle + 0.1 * speed, speed


def observed(angle: float, speed: float) -> FloatArray:
    return np.array([np.sin(angle), np.cos(angle), speed])


def falls() -> list[Rollout]:
    """The pole under random torques, from near the upright until it lies."""
    rng, found = np.random.default_rng(0), []
    for _ in range(25):
        angle, speed = rng.normal(0.0, 0.1, 2)
        states, torques = [observed(angle, speed)], rng.normal(0.0, 1.5, (12, 1))
        for torque in torques[:, 0]:
            angle, speed = pole(angle, speed, torque)
            states.append(observed(angle, speed))
            if abs(angle) > 1.0:
                break
        steps = len(states) - 1
        terminated = bool(abs(angle) > 1.0)
        found.append(Rollout(np.array(states), torques[:steps], np.ones(steps), terminated))
    return found


@cache
def compared() -> ModelComparison:
    """Comparison in the model of `falls`, with a reward of one until the pole lies."""
    rng = np.random.default_rng(0)
    data = stacked(Rollouts.from_list(falls()), TASK).transitions
    kernel = state_kernel(data, TASK, rng)
    dynamics, _, _ = fit_dynamics(data, kernel, TASK, None, rng)
    constant = KernelExpansion(
        Kernel((SquaredExponential((0,)),), np.ones(1)), np.zeros((1, 4)), np.zeros((1, 1))
    )
    env = ModelEnv(dynamics, data, kernel, TASK, 0.02, 0.0, 40, 0.0)
    return compared_in(env, RewardModel(constant, 1.0, 0.0, 0.0, 1.0), 20, seed=3)


def steps_upright(policy: StochasticPolicy, limit: int = 300) -> float:
    """Mean number of steps of the true pole, from five starts."""
    lengths = []
    for seed in range(5):
        angle, speed = np.random.default_rng(seed).normal(0.0, 0.1, 2)
        steps = 0
        while abs(angle) <= 1.0 and steps < limit:
            torque = policy.act(observed(angle, speed)[None], np.zeros((1, 1)))[0, 0]
            angle, speed = pole(angle, speed, torque)
            steps += 1
        lengths.append(steps)
    return float(np.mean(lengths))
