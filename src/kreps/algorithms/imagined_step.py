"""A second bounded step on actions drawn anew, with the transition model saying what they lead to.

The weights of Eq. 1 can only choose among the actions that happened to be taken, one in each state.
A transition model predicts for *any* action, so more can be asked of the same roll-outs: in the
states as the first step reweighted them, actions are drawn from the policy that it gave, and the
same convex problem is solved once more for them.  The KL bound then holds from that policy, so that
old roll-outs no longer tie the new policy to the old ones that made them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kreps.algorithms.transition_model import feature_differences
from kreps.arrays import FloatArray, IntArray
from kreps.data import TaskSpec
from kreps.dual import ETA_LEAST, DualProblem
from kreps.policies import StochasticPolicy
from kreps.settings import Settings

MOST_IMAGINED = 20_000
"""Samples at most: what the model expects of each, a number a feature of V, is held in memory."""


@dataclass(frozen=True)
class Outlook:
    """What a model says of any action in the states of n samples.

    Attributes:
        states: (n, ds).
        features: (n, r) of V there.
        restart: (r,) mean features of the states that the process restarts in.
        rewards: (n,) observed, standardised.
        expect: expected features (m, r) of the successor, of sample numbers (m,) and of their
            states and scaled, applied actions (m, ds + da).
        reward: what reward (m, 1) is to be expected of such states and actions, from its mean.
    """

    states: FloatArray
    features: FloatArray
    restart: FloatArray
    rewards: FloatArray
    expect: Callable[[IntArray, FloatArray], FloatArray]
    reward: Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class ImaginedSamples:
    """m states with actions drawn for them.

    Attributes:
        rows: (m,) sample numbers of the states, in order.
        actions: (m, da) commanded, in the task's units.
        problem: rewards and differences of features as the model expects them.
    """

    rows: IntArray
    actions: FloatArray
    problem: DualProblem


def resample(p: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """``count`` sample numbers in order, i at least ``floor(count p_i)`` times (systematic)."""
    places = (np.arange(count) + rng.uniform()) / count
    return np.minimum(np.searchsorted(np.cumsum(p), places * p.sum()), len(p) - 1)


def imagine(
    outlook: Outlook,
    weights: FloatArray,
    policy: StochasticPolicy,
    task: TaskSpec,
    settings: Settings,
    ridge: float,
    rng: np.random.Generator,
) -> ImaginedSamples:
    """Draws of a state from the weights (n,) and of an action from the policy.

    Args:
        outlook, weights: of n samples.
        policy: to draw actions from.
        task: limits and scale of the actions.
        settings: ``imagined`` draws a sample, up to `MOST_IMAGINED` in all; the bounds.
        ridge: rho times the number of draws.
        rng: of the draws.
    """
    count = min(settings.imagined * len(weights), MOST_IMAGINED)
    rows = resample(weights, count, rng)
    states = outlook.states[rows]
    actions = policy.act(states, rng.standard_normal((count, task.action_size)))
    inputs = np.concatenate([states, task.scaled(task.clip(actions))], axis=1)
    # a regression may overshoot what was ever observed, and would be believed
    observed = outlook.rewards
    said = observed.mean() + outlook.reward(inputs)[:, 0]
    rewards = np.clip(said, observed.min(), observed.max())
    problem = DualProblem(
        rewards=rewards - rewards.max(),
        differences=feature_differences(
            outlook.features[rows],
            outlook.expect(rows, inputs),
            outlook.restart,
            settings.restart_probability,
        ),
        kl_bound=settings.kl_bound,
        ridge=ridge / count,
        eta_floor=max(settings.eta_floor, ETA_LEAST),
    )
    return ImaginedSamples(rows, actions, problem)
