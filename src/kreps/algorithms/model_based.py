"""The model-based step, which the paper has not: bounded steps on samples of the learnt model.

This is the idea of Dyna (Sutton 1990).  In a first step states are resampled by the weights of
Algorithm 1, in a second they are visited in model rollouts of the policy of the first.  In each
state several actions are sampled around the policy's, and weighted by the same dual.  The new
policy acts only if it passes an acceptance test against the previous one in the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kreps.algorithms.acceptance import proposal_std_scale, rejects
from kreps.algorithms.dual import DualSolution
from kreps.algorithms.ends import AbsorbingEnd, solve_with_end
from kreps.algorithms.generated import GeneratedSamples, StateSource, generate, split_budget
from kreps.algorithms.policy_targets import PolicyFit, PolicyTargets
from kreps.algorithms.reps import Batch, Step, stationarity_ridge
from kreps.algorithms.state import LearnerState
from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import ModelEnv, supports_model_rollouts
from kreps.models.novelty import novelty_bonus
from kreps.models.world_model import WorldModel


def generates_samples(batch: Batch[Any, Any]) -> bool:
    """Whether there is a model-based step.

    There is none in updates from a data set, nor as long as no reward in the window depends on the
    state: then the next rollouts explore, whatever is learnt (`Learner.exploring`).
    """
    if batch.settings.model_based is None or batch.from_dataset:
        return False
    return batch.window.reward_depends_on_state


def has_model_rollouts(batch: Batch[Any, Any]) -> bool:
    """Whether policies are rolled out in the model.

    It has to be a dynamics model of enough samples, and states must not be images.
    """
    dynamics = batch.settings.model == "dynamics"
    return generates_samples(batch) and dynamics and supports_model_rollouts(batch.data, batch.task)


def has_acceptance_test(batch: Batch[Any, Any]) -> bool:
    """Whether the new policy has to pass the acceptance test.

    The first update has the settings of a tested one, although there is no previous policy yet.
    """
    model_based = batch.settings.model_based
    return (
        model_based is not None
        and model_based.acceptance_rollouts > 0
        and has_model_rollouts(batch)
    )


@dataclass(frozen=True)
class GeneratedStep:
    """The results of one bounded step on generated samples.

    Attributes:
        samples: generated actions, with the problem of their weights.
        dual: its solution.
        end: the state after a termination, with the average reward of the solution.
        targets: weighted means of these actions, and of those of the step before if they are kept.
        policy: fitted to the targets.
    """

    samples: GeneratedSamples
    dual: DualSolution
    end: AbsorbingEnd | None
    targets: PolicyTargets
    policy: PolicyFit


def model_based_step(
    batch: Batch[Any, Any], step: Step, state: LearnerState, rng: np.random.Generator
) -> tuple[Step, FloatArray, bool | None]:
    """Bounded steps on generated samples, then the acceptance test.

    Args:
        batch: the samples.
        step: of Algorithm 1 on them.
        state: the previous policy, and the start of the fit of the reward model.
        rng: of the generated samples, the fits and the test.

    Returns:
        The last step, the log parameters of the reward model, and whether the new policy is
        rejected (None without a test).
    """
    model_based = batch.settings.model_based
    assert model_based is not None
    world, reward_start = world_model(batch, step, state, rng)
    sources = list(split_budget(world, model_based))
    latest: GeneratedStep | None = None
    for source in sources:
        # only the last policy acts, so only its standard deviation is deflated
        last = source is sources[-1]
        std_scale = proposal_std_scale(has_acceptance_test(batch), model_based) if last else 1.0
        latest = generated_step(batch, world, step, latest, source, std_scale, rng)
    assert latest is not None
    batch.clock.lap("generated samples")
    rejected = rejects(
        latest.policy.policy, state.policy, world, model_based.acceptance_rollouts, rng
    )
    batch.clock.lap("acceptance test")
    step = replace(step, dual=latest.dual, policy=latest.policy, reward_model=world.reward_model)
    return step, reward_start, rejected


def generated_step(
    batch: Batch[Any, Any],
    world: WorldModel,
    step: Step,
    previous: GeneratedStep | None,
    source: StateSource,
    std_scale: float,
    rng: np.random.Generator,
) -> GeneratedStep:
    """One bounded step on generated samples.

    Args:
        batch: the samples from which the model was learnt.
        world: the learnt model.
        step: of Algorithm 1 on these samples.
        previous: the generated step before; None for the first, which follows ``step``.
        source: of the states.
        std_scale: factor by which the standard deviation of the fitted policy is deflated.
        rng: of the generated samples and the fit.
    """
    settings = batch.settings
    before = step if previous is None else previous
    ridge = stationarity_ridge(settings, step.model.errors)
    weights = batch.weights_in_memory(step.dual.weights)
    samples = generate(
        world,
        weights,
        before.policy.policy,
        source,
        settings,
        ridge,
        has_acceptance_test(batch),
        rng,
    )
    # V changes little between the steps; but the temperature may have to rise, and starts at 1
    _, dual, end = solve_with_end(
        samples.problem,
        samples.terminations,
        before.end,
        samples.rewards,
        start=(1.0, before.dual.theta),
    )
    targets = PolicyTargets.from_generated(samples, dual.weights, batch.task)
    # Where not every rollout reached the goal, model rollouts may miss it too.  Then the targets
    # in replayed states are kept.
    if previous is not None and not batch.window.all_informative:
        targets = targets.concat(previous.targets)
    policy = batch.fit_policy(targets, step.kernel, before.policy.x, rng, std_scale)
    return GeneratedStep(samples, dual, end, targets, policy)


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
            restart_probability=settings.p,
            exploring_starts=settings.exploring_starts,
            max_steps=max(map(len, batch.window.rollouts)),
            end_reward=0.0 if step.end is None else step.end.reward,
        )
    rewards, reward_start = batch.fit_reward(step.kernel, state.reward_start, rng)
    weights = batch.weights_in_memory(step.dual.weights)
    assert step.model.for_actions is not None and settings.model_based is not None
    world = WorldModel(
        task=batch.task,
        states=batch.data.states,
        features=features.own,
        phi=features.basis.features,
        restart=features.restart,
        expected_features=step.model.for_actions,
        dynamics=step.model.dynamics,
        terminations=step.model.terminations_for_actions,
        reward_model=rewards,
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
