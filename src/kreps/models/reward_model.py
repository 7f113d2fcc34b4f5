"""The reward model: expected rewards of states and actions, and of terminations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.basis import LinearFunction
from kreps.kernels.regression import LeaveOneOut

MAX_HELD_OUT = 300
"""Largest number of steps whose leave-one-out error is computed: enough to tell a good model from a
poor one, at a small part of the cost of the regression."""

MIN_SHARE = 0.5
"""Smallest share of steps without a termination at which these alone are regressed."""


@dataclass(frozen=True)
class RewardModel:
    """Expected rewards, standardised.

    The reward of the last step often jumps (a goal, a fall).  It is predicted as the reward of a
    step without a termination plus a constant.

    Attributes:
        regression: rewards (m, 1) of inputs (m, ds + da), relative to ``mean``.
        mean: of the rewards.
        at_termination: what the reward of a terminating step exceeds the regression by, on average.
        smallest, largest: observed rewards.  Predictions are clipped to them, as a regression may
            overshoot.
        loo: leave-one-out errors of the regression, at some steps; None if they are not known.
    """

    regression: LinearFunction
    mean: float
    at_termination: float
    smallest: float
    largest: float
    loo: LeaveOneOut | None = None

    def __call__(self, inputs: FloatArray, probabilities: FloatArray) -> FloatArray:
        """Expected rewards (m,).

        Args:
            inputs: (m, ds + da) states and scaled, applied actions.
            probabilities: (m,) of a termination.
        """
        predicted = self.mean + self.regression(inputs)[:, 0]
        predicted = predicted + probabilities * self.at_termination
        return np.clip(predicted, self.smallest, self.largest)

    def jacobian(self, inputs: FloatArray, predicted: FloatArray) -> FloatArray:
        """Derivatives (m, ds + da) of rewards; zero where they are clipped.

        Args:
            inputs: (m, ds + da) states and scaled, applied actions.
            predicted: (m,) the rewards there.
        """
        clipped = (predicted <= self.smallest) | (predicted >= self.largest)
        return np.where(clipped[:, None], 0.0, self.regression.jacobian(inputs)[:, 0])


def regressed_steps(data: Transitions) -> IntArray:
    """Numbers of the steps whose rewards are regressed: those without a termination.

    All steps, if most of them terminate.
    """
    going_on = np.flatnonzero(~data.terminated)
    return going_on if len(going_on) >= MIN_SHARE * len(data) else np.arange(len(data))


def held_out_steps(count: int) -> IntArray:
    """Numbers of at most `MAX_HELD_OUT` of some regressed steps, evenly spaced."""
    return np.arange(0, count, -(-count // MAX_HELD_OUT))


def reward_model(
    regression: LinearFunction,
    rewards: FloatArray,
    data: Transitions,
    inputs: FloatArray,
    loo: LeaveOneOut | None = None,
) -> RewardModel:
    """The reward model from its regression.

    Args:
        regression: of ``rewards - rewards.mean()``, fitted to `regressed_steps`.
        rewards: (n,) standardised.
        data: n transitions.
        inputs: (n, ds + da) their states and scaled, applied actions.
        loo: leave-one-out errors of the regression.
    """
    mean = float(rewards.mean())
    ended = np.flatnonzero(data.terminated)
    at_termination = 0.0
    if len(ended) and len(regressed_steps(data)) < len(data):
        predicted = mean + regression(inputs[ended])[:, 0]
        at_termination = float(np.mean(rewards[ended] - predicted))
    low, high = float(rewards.min()), float(rewards.max())
    return RewardModel(regression, mean, at_termination, low, high, loo)
