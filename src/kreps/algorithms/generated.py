"""Samples that the transition model generates: actions around the policy's, in replayed states or
in states that the policy visits in model rollouts.

The weights of Eq. 1 can only choose among the actions that were taken, one in each state.  A
transition model predicts the successor of any action, so the same convex problem can be solved
again for several actions per state.  The KL bound then holds relative to the distribution that
the actions were sampled from, no longer relative to the mixture of old policies in the window.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from kreps.algorithms.acceptance import proposal_std_scale, temperature_floor
from kreps.algorithms.dual import DualProblem
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.sampling import systematic_resampling
from kreps.models.dynamics import with_terminations
from kreps.models.transition import feature_differences
from kreps.models.world_model import WorldModel
from kreps.policies.base import StochasticPolicy
from kreps.settings import ModelBased, Settings

MAX_VISITED = 1_000
"""Largest number of actions that are generated in model rollouts for one step: several such steps
follow each other, and their cost is proportional to it."""


class StateSource(Enum):
    """Which states actions are generated in."""

    REPLAY = "replay"
    """Sampled states, resampled by the weights of the step before."""

    MODEL_ROLLOUT = "model rollout"
    """States visited in model rollouts of the policy of the step before."""


@dataclass(frozen=True)
class GeneratedSamples:
    """m generated actions in k states.

    Attributes:
        states: (k, ds).
        state_of: (m,) which of the states each action is taken in, in order.
        actions: (m, da) commanded, in the task's units.
        problem: the dual, with expected rewards and feature differences, before the value of
            terminations is added.
        rewards: (m,) expected, standardised, without exploration bonus.
        terminations: (m,) probabilities of a termination.
    """

    states: FloatArray
    state_of: IntArray
    actions: FloatArray
    problem: DualProblem
    rewards: FloatArray
    terminations: FloatArray


def split_budget(world: WorldModel, model_based: ModelBased) -> dict[StateSource, int]:
    """How many actions are generated per source of states, for the sources that have any."""
    budget = min(model_based.actions_per_state * len(world.states), model_based.max_samples)
    visited = 0
    if world.model_env is not None:
        visited = min(round(model_based.model_rollout_fraction * budget), MAX_VISITED)
    counts = {StateSource.REPLAY: budget - visited, StateSource.MODEL_ROLLOUT: visited}
    return {source: count for source, count in counts.items() if count}


def generate(
    world: WorldModel,
    weights: FloatArray,
    policy: StochasticPolicy,
    source: StateSource,
    settings: Settings,
    ridge: float,
    tested: bool,
    rng: np.random.Generator,
) -> GeneratedSamples:
    """Actions sampled around the policy's, with expected rewards and features of successors.

    Args:
        world: the learnt model of n samples.
        weights: (n,) by which sampled states are drawn.
        policy: from which actions are sampled, with inflated standard deviation.
        source: of the states.
        settings: ``model_based``, and the bounds of the dual.
        ridge: rho times the number of samples.
        tested: whether the new policy has to pass the acceptance test.
        rng: of states and actions.
    """
    model_based = settings.model_based
    assert model_based is not None
    count = split_budget(world, model_based)[source]
    if source is StateSource.MODEL_ROLLOUT:
        assert world.model_env is not None
        states, rows = world.model_env.visited_states(policy, min(len(weights), count), rng)
        state_of = np.arange(count) * len(states) // count
        features = world.phi(states)
    else:
        drawn = systematic_resampling(weights, count, rng)
        rows, state_of = np.unique(drawn, return_inverse=True)
        states, features = world.states[rows], world.features[rows]
    task = world.task
    std_scale = proposal_std_scale(tested, model_based)
    noise = std_scale * rng.standard_normal((count, task.action_size))
    actions = policy.act(states[state_of], noise)
    inputs = np.concatenate([states[state_of], task.scaled_applied(actions)], axis=1)
    p = settings.p
    outcomes = expected_outcomes(world, rows[state_of], inputs, p)
    problem = DualProblem(
        rewards=outcomes.rewards + outcomes.bonus,
        differences=feature_differences(features[state_of], outcomes.features, world.restart, p),
        kl_bound=settings.kl_bound,
        ridge=ridge / count,
        eta_floor=temperature_floor(tested, settings),
    )
    return GeneratedSamples(
        states, state_of, actions, problem, outcomes.rewards, outcomes.terminations
    )


@dataclass(frozen=True)
class Outcomes:
    """What the model predicts of m actions.

    Attributes:
        rewards: (m,) standardised.
        features: (m, r) of V at the successor; those of the restart after a termination, and in the
            proportion of its novelty after a successor that is unlike any sample.
        terminations: (m,) probabilities of a termination.
        bonus: (m,) exploration bonus.
    """

    rewards: FloatArray
    features: FloatArray
    terminations: FloatArray
    bonus: FloatArray


def expected_outcomes(
    world: WorldModel, rows: IntArray, inputs: FloatArray, restart_probability: float
) -> Outcomes:
    """Predictions for m actions.

    As in R-max, an unexplored region is an absorbing state that pays an optimistic reward until the
    restart.  Its total value is added to the reward of the action that leads there, and a restart
    follows; so V need not represent it.

    Args:
        world: the learnt model.
        rows: (m,) samples whose states the actions are taken in or nearest to.
        inputs: (m, ds + da) states and scaled, applied actions.
        restart_probability: p.
    """
    terminations, novelty = world.terminations_and_novelty(inputs)
    rewards = world.reward_model(inputs, terminations)
    features = world.expected_features(rows, inputs)
    bonus = np.zeros(len(inputs))
    if world.bonus is not None:
        bonus = novelty * world.bonus.exploration_bonus(restart_probability)
        features = with_terminations(features, novelty[:, None], world.restart)
    return Outcomes(rewards, features, terminations, bonus)
