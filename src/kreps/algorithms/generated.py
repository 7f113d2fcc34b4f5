"""A second bounded step on actions drawn anew, with the transition model saying what they lead to.

The weights of Eq. 1 can only choose among the actions that happened to be taken, one in each state.
A transition model predicts for *any* action, so more can be asked of the same roll-outs: in the
states as the first step reweighted them actions are drawn from its policy, and the same convex
problem is solved once more for them.  The KL bound then holds from what they were drawn from, so
that old roll-outs no longer tie the new policy to the old ones that made them.  And the policy so
found is led by the model to states that no sample is in: there the same is done once again.

What is compared in the model can be wide, and what is done in the world narrow: actions are drawn
with more than the policy's deviation, and the one fitted to them acts with as much less of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.algorithms.acceptance import is_judged, least_temperature, widening
from kreps.algorithms.dual import DualProblem
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.sampling import resample
from kreps.models.dynamics import after_ends
from kreps.models.transition import feature_differences
from kreps.models.world_model import Outlook
from kreps.policies.base import StochasticPolicy
from kreps.settings import Settings

MOST_IMAGINED = 20_000
"""Samples at most: what the model expects of each, a number a feature of V, is held in memory."""


@dataclass(frozen=True)
class ImaginedSamples:
    """m actions drawn in k states.

    Attributes:
        states: (k, ds).
        of: (m,) which of the states each action is drawn in, in order.
        actions: (m, da) commanded, in the task's units.
        problem: rewards and differences of features as the model expects them.
    """

    states: FloatArray
    of: IntArray
    actions: FloatArray
    problem: DualProblem


def counts(outlook: Outlook, settings: Settings) -> tuple[int, int]:
    """How many actions are imagined in sampled states, and in states that a policy is led to."""
    whole = min(settings.imagined * len(outlook.states), MOST_IMAGINED)
    ahead = round(settings.imagined_rollouts * whole) if outlook.simulator is not None else 0
    return whole - ahead, ahead


def places(outlook: Outlook, settings: Settings) -> tuple[bool, ...]:
    """Where actions are imagined, step after step: not led, in sampled states, then led."""
    sampled, ahead = counts(outlook, settings)
    return (False,) * (sampled > 0) + (True,) * (ahead > 0)


def imagine(
    outlook: Outlook,
    weights: FloatArray,
    policy: StochasticPolicy,
    task: TaskSpec,
    settings: Settings,
    ridge: float,
    rng: np.random.Generator,
    led: bool = False,
) -> ImaginedSamples:
    """Actions around the policy's in states drawn by the weights (n,) or in states it is led to.

    Args:
        outlook, weights: of n samples.
        policy: to draw actions from.
        task: limits and scale of the actions.
        settings: ``imagined`` draws a sample, up to `MOST_IMAGINED` in both places, with
            ``imagined_noise``; the share of them in ``imagined_rollouts``; the bounds.
        ridge: rho times the number of draws.
        rng: of the draws.
        led: whether the states are those of simulated roll-outs of the policy, as many as there are
            samples: one of `places`.
    """
    count = counts(outlook, settings)[led]
    if led:
        assert outlook.simulator is not None
        states, rows = outlook.simulator.rollouts(policy, min(len(weights), count), rng)
        of = np.arange(count) * len(states) // count
        features = outlook.features_at(states)
    else:
        rows, of = np.unique(resample(weights, count, rng), return_inverse=True)
        states, features = outlook.states[rows], outlook.features[rows]
    judged = is_judged(outlook.simulator, settings)
    noise = widening(judged, settings) * rng.standard_normal((count, task.action_size))
    actions = policy.act(states[of], noise)
    inputs = np.concatenate([states[of], task.scaled(task.clip(actions))], axis=1)
    rewards = outlook.rewards_of(inputs)
    expected = outlook.expect(rows[of], inputs)
    p = settings.restart_probability
    if outlook.optimism is not None:
        unknown = outlook.unknown_of(inputs)
        rewards = rewards + unknown * outlook.optimism.surplus(p)
        expected = after_ends(expected, unknown[:, None], outlook.restart)
    problem = DualProblem(
        rewards=rewards - rewards.max(),
        differences=feature_differences(features[of], expected, outlook.restart, p),
        kl_bound=settings.kl_bound,
        ridge=ridge / count,
        eta_floor=least_temperature(judged, settings),
    )
    return ImaginedSamples(states, of, actions, problem)
