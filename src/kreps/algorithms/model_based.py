"""Past the paper: the bounded step again, on samples that the transition model generates.

This is the idea of Dyna (Sutton 1990).  States are resampled by the weights just found, then taken
from model rollouts of the new policy; in each several actions are sampled and weighted.  Before the
new policy acts it must pass an acceptance test in the model against the previous one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from kreps.algorithms.acceptance import proposal_std_scale, rejects
from kreps.algorithms.generated import generate, split_budget
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.policy_targets import PolicyTargets
from kreps.algorithms.reps import Batch, Step, stationarity_ridge
from kreps.algorithms.state import LearnerState
from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import ModelEnv, supports_model_rollouts
from kreps.models.novelty import novelty_bonus
from kreps.models.transition import restart_features
from kreps.models.world_model import WorldModel


def generates_samples(batch: Batch[Any, Any]) -> bool:
    """Whether there is a model-based step: not while no reward depends on the state.

    The next rollouts then explore, whatever is learnt (`kreps.learning.learner.Learner.exploring`).
    """
    if batch.settings.model_based is None or batch.from_dataset:
        return False
    return batch.window.reward_depends_on_state


def has_model_rollouts(batch: Batch[Any, Any]) -> bool:
    """Whether policies can be rolled out in the model: dynamics, enough samples, no images."""
    dynamics = batch.settings.model == "dynamics"
    return generates_samples(batch) and dynamics and supports_model_rollouts(batch.data, batch.task)


def has_acceptance_test(batch: Batch[Any, Any]) -> bool:
    """Whether the new policy has to pass the acceptance test; the first one has no rival in it."""
    model_based = batch.settings.model_based
    return (
        model_based is not None
        and model_based.acceptance_rollouts > 0
        and has_model_rollouts(batch)
    )


def model_based_step(
    batch: Batch[Any, Any], step: Step, state: LearnerState, rng: np.random.Generator
) -> tuple[Step, FloatArray, bool | None]:
    """Bounded steps on generated samples, then the acceptance test.

    Args:
        batch: the samples.
        step: of Algorithm 1 on them.
        state: the previous policy, and where the fit of the reward model starts.
        rng: of the generated samples, the fits and the test.

    Returns:
        The last step, the log parameters of the reward model, and whether the new policy is
        rejected (None without a test).
    """
    settings, task = batch.settings, batch.task
    assert settings.model_based is not None
    world, reward_start = world_model(batch, step, state, rng)
    ridge, tested = stationarity_ridge(settings, step.model.errors), has_acceptance_test(batch)
    weights = batch.weights_in_memory(step.dual.weights)
    dual, policy, replayed = step.dual, step.policy, None
    # a goal that some rollouts did not reach is represented by few samples: keep their targets
    keep_replay_targets = not batch.window.all_informative
    sources = list(split_budget(world, settings.model_based))
    for source in sources:
        samples = generate(world, weights, policy.policy, source, settings, ridge, tested, rng)
        # V is nearly known, but the temperature may have to rise
        dual = solve_dual(samples.problem, start=(1.0, dual.theta))
        targets = PolicyTargets.from_generated(samples, dual.weights, task)
        if keep_replay_targets and replayed is not None:
            targets = targets.concat(replayed)
        last = source is sources[-1]
        std_scale = proposal_std_scale(tested, settings.model_based) if last else 1.0
        policy = batch.fit_policy(targets, step.kernel, policy.x, rng, std_scale)
        replayed = targets
    batch.clock.lap("generated samples")
    rejected = rejects(
        policy.policy, state.policy, world, settings.model_based.acceptance_rollouts, rng
    )
    batch.clock.lap("acceptance test")
    return replace(step, dual=dual, policy=policy), reward_start, rejected


def world_model(
    batch: Batch[Any, Any], step: Step, state: LearnerState, rng: np.random.Generator
) -> tuple[WorldModel, FloatArray]:
    """The learnt model as generated samples need it, and the log parameters of its reward model."""
    settings, features = batch.settings, step.features
    model_env = None
    if has_model_rollouts(batch):
        assert step.model.dynamics is not None
        model_env = ModelEnv(
            dynamics=step.model.dynamics,
            data=batch.data,
            kernel=step.kernel,
            task=batch.task,
            restart_probability=settings.restart_probability,
            exploring_starts=settings.exploring_starts,
            max_steps=max(map(len, batch.window.rollouts)),
        )
    reward_model, reward_start = batch.fit_reward(step.kernel, state.reward_start, rng)
    weights = batch.weights_in_memory(step.dual.weights)
    assert step.model.for_actions is not None and settings.model_based is not None
    world = WorldModel(
        task=batch.task,
        states=batch.data.states,
        features=features.own,
        phi=features.basis.features,
        restart=restart_features(
            features.start, features.own.mean(axis=0), settings.exploring_starts
        ),
        rewards=batch.rewards,
        expected_features=step.model.for_actions,
        reward_model=reward_model,
        model_env=model_env,
        bonus=novelty_bonus(
            model_env,
            batch.rewards,
            weights,
            settings.model_based.exploration_bonus,
            state.iteration,
        ),
    )
    return world, reward_start
