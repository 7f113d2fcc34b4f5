"""The model-based step, which the paper has not: bounded steps on samples of the learnt model.

This is the idea of Dyna (Sutton 1990).  In a first step states are resampled by the weights of
Algorithm 1, in the others they are visited in model rollouts of the policy of the step before.  In
each state several actions are sampled around the policy's, and weighted by the same dual.  These
steps go on while the model predicts a larger return, and the best policy is kept.  A
linear-quadratic regulator of the model may take its place near an equilibrium, and steps by the
gradient of that return follow (`kreps.algorithms.candidates`).  The result acts only if it passes
an acceptance test against the previous policy.

While there is an exploration bonus, an explorer is optimised with it by bounded steps; a random
policy takes its place if it is better.  It collects half of the next rollouts, and is neither
tested nor reported: the acting policy is the best known, and a task that needs no exploration loses
nothing but these rollouts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kreps.algorithms.acceptance import (
    ModelComparison,
    compare_in_model,
    is_rejected,
    is_worse,
    proposal_std_scale,
    standard_error,
)
from kreps.algorithms.candidates import (
    with_gradient_steps,
    with_random_policies,
    with_regulators,
)
from kreps.algorithms.dual import DualSolution
from kreps.algorithms.ends import AbsorbingEnd, solve_with_end
from kreps.algorithms.generated import GeneratedSamples, StateSource, generate, split_budget
from kreps.algorithms.policy_targets import PolicyFit, PolicyTargets
from kreps.algorithms.real_returns import real_return
from kreps.algorithms.reps import Batch, Step, stationarity_ridge
from kreps.algorithms.state import LearnerState
from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import ModelEnv, supports_model_rollouts
from kreps.models.novelty import novelty_bonus
from kreps.models.world_model import WorldModel
from kreps.policies.base import LearntPolicy

REAL_RETURN_TOLERANCE = 0.02
"""By how much the return of a policy in the model may be below that of the previous one in truth,
in standard deviations of the reward: predictions are no more accurate than that."""

PATIENCE = 3
"""Steps in a row without a gain of one standard error in the model, after which there is none."""


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
        targets: weighted means of these actions, and of those in replayed states if they are kept.
        replayed: weighted means of the actions of the first step, in replayed states.
        policy: fitted to the targets.
    """

    samples: GeneratedSamples
    dual: DualSolution
    end: AbsorbingEnd | None
    targets: PolicyTargets
    replayed: PolicyTargets
    policy: PolicyFit


@dataclass(frozen=True)
class ModelBasedResult:
    """The results of the model-based step.

    Attributes:
        step: that of Algorithm 1, with the dual, the policy and the reward model of this one.
        reward_start: log parameters of the reward model.
        rejected: whether the acceptance test rejected the policy; None without a test.
        explorer: policy with the exploration bonus; None where there is none.
    """

    step: Step
    reward_start: FloatArray
    rejected: bool | None
    explorer: LearntPolicy | None


def model_based_step(
    batch: Batch[Any, Any], step: Step, state: LearnerState, rng: np.random.Generator
) -> ModelBasedResult:
    """Bounded steps on generated samples, the acceptance test, and the explorer.

    Args:
        batch: the samples.
        step: of Algorithm 1 on them.
        state: the previous policy, and the start of the fit of the reward model.
        rng: of the generated samples, the fits and the test.
    """
    model_based = batch.settings.model_based
    assert model_based is not None
    optimistic, reward_start = world_model(batch, step, state, rng)
    world = replace(optimistic, bonus=None)
    seed = int(rng.integers(2**63))  # policies are compared with the same random numbers
    has_ends = state.terminated or bool(batch.data.terminated.any())
    comparison = compare_in_model(world, model_based.acceptance_rollouts, seed, has_ends)
    best, returns = optimise(batch, world, step, comparison, rng)
    rejected = None
    if comparison is not None and returns is not None:
        count = model_based.regulators
        fit, returns = with_regulators(best.policy, returns, comparison, step.kernel, count)
        batch.clock.lap("regulators")
        fit, returns = with_gradient_steps(fit, returns, comparison, model_based.gradient_steps)
        batch.clock.lap("policy gradient")
        best = replace(best, policy=fit)
        rejected = fails_acceptance_test(batch, state, returns, comparison)
    explorer = None
    if optimistic.bonus is not None:
        explorer = optimise_explorer(batch, optimistic, step, seed, rng)
    step = replace(step, dual=best.dual, policy=best.policy, reward_model=world.reward_model)
    return ModelBasedResult(step, reward_start, rejected, explorer)


def fails_acceptance_test(
    batch: Batch[Any, Any], state: LearnerState, returns: FloatArray, comparison: ModelComparison
) -> bool | None:
    """Whether the new policy is worse than the previous one, which then stays; None without one.

    Where episodes end, its return must not be below that of the previous one in truth, either.

    Args:
        batch: the samples.
        state: with the previous policy.
        returns: (rollouts,) of the new policy in the model.
        comparison: that they are of.
    """
    if state.policy is None:
        return None
    rejected = is_rejected(returns - comparison.returns(state.policy), comparison.has_ends)
    if comparison.has_ends and not rejected:
        real = real_return(batch, state, comparison.from_starts)
        rejected = real is not None and is_worse(returns - real + REAL_RETURN_TOLERANCE)
    batch.clock.lap("acceptance test")
    return rejected


def optimise_explorer(
    batch: Batch[Any, Any], world: WorldModel, step: Step, seed: int, rng: np.random.Generator
) -> LearntPolicy:
    """The explorer: a policy optimised with the exploration bonus of the model.

    Args:
        batch: the samples.
        world: the learnt model, with the bonus.
        step: of Algorithm 1 on the samples.
        seed: of the model rollouts by which policies are compared.
        rng: of the generated samples and the fits.
    """
    model_based = batch.settings.model_based
    assert model_based is not None
    comparison = compare_in_model(world, model_based.acceptance_rollouts, seed)
    found, returns = optimise(batch, world, step, comparison, rng)
    fit = found.policy
    if comparison is not None and returns is not None:
        count = model_based.random_policies
        fit, _ = with_random_policies(fit, returns, comparison, count, rng)
        batch.clock.lap("random policies")
    return fit.policy


def optimise(
    batch: Batch[Any, Any],
    world: WorldModel,
    step: Step,
    comparison: ModelComparison | None,
    rng: np.random.Generator,
) -> tuple[GeneratedStep, FloatArray | None]:
    """Bounded steps on generated samples, while the model predicts a larger return.

    Args:
        batch: the samples from which the model was learnt.
        world: the learnt model.
        step: of Algorithm 1 on these samples.
        comparison: of policies; None for one step per source of states.
        rng: of the generated samples and the fits.

    Returns:
        The step whose policy has the largest return in the model, and its returns (rollouts,);
        the last step without a comparison.
    """
    model_based = batch.settings.model_based
    assert model_based is not None
    latest: GeneratedStep | None = None
    sources = list(split_budget(world, model_based))
    for source in sources:
        # an intermediate policy does not act, so its standard deviation is not deflated
        deflated = source is sources[-1]
        latest = generated_step(batch, world, step, latest, source, deflated, rng)
    assert latest is not None
    if comparison is None:
        return latest, None
    best, returns, without_gain = latest, comparison.returns(latest.policy.policy), 0
    if StateSource.MODEL_ROLLOUT not in sources:
        return best, returns
    for _ in range(model_based.improvement_steps):
        latest = generated_step(batch, world, step, latest, sources[-1], True, rng)
        new_returns = comparison.returns(latest.policy.policy)
        batch.clock.lap("acceptance test")
        gain = new_returns - returns
        without_gain = 0 if gain.mean() > standard_error(gain) else without_gain + 1
        if gain.mean() > 0.0:
            best, returns = latest, new_returns
        if without_gain == PATIENCE:
            break
    return best, returns


def generated_step(
    batch: Batch[Any, Any],
    world: WorldModel,
    step: Step,
    previous: GeneratedStep | None,
    source: StateSource,
    deflated: bool,
    rng: np.random.Generator,
) -> GeneratedStep:
    """One bounded step on generated samples.

    Args:
        batch: the samples from which the model was learnt.
        world: the learnt model.
        step: of Algorithm 1 on these samples.
        previous: the generated step before; None for the first, which follows ``step``.
        source: of the states.
        deflated: whether the standard deviation of the fitted policy is divided by the factor of
            the proposals.
        rng: of the generated samples and the fit.
    """
    settings, model_based = batch.settings, batch.settings.model_based
    assert model_based is not None
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
    # V changes little between the steps; but the temperature may have to rise, and starts at 1 or
    # where it was if that is higher, as it is with a large exploration bonus
    _, dual, end = solve_with_end(
        samples.problem,
        samples.terminations,
        before.end,
        samples.rewards,
        start=(max(1.0, before.dual.eta), before.dual.theta),
    )
    batch.clock.lap("generated samples")
    targets = PolicyTargets.from_generated(samples, dual.weights, batch.task)
    replayed = targets if previous is None else previous.replayed
    # Where not every rollout reached the goal, model rollouts may miss it too.  Then the targets
    # in replayed states are kept.
    if previous is not None and not batch.window.all_informative:
        targets = targets.concat(replayed)
    std_scale = proposal_std_scale(has_acceptance_test(batch), model_based) if deflated else 1.0
    policy = batch.fit_policy(targets, step.kernel, before.policy.x, rng, std_scale)
    return GeneratedStep(samples, dual, end, targets, replayed, policy)


def world_model(
    batch: Batch[Any, Any], step: Step, state: LearnerState, rng: np.random.Generator
) -> tuple[WorldModel, FloatArray]:
    """The learnt model as generated samples need it, and the log parameters of its reward model."""
    settings, features = batch.settings, step.features
    decisions = state.steps / batch.task.action_repeat + batch.seen[1]
    model_env = None
    if has_model_rollouts(batch):
        assert step.model.dynamics is not None
        model_env = ModelEnv(
            dynamics=step.model.dynamics,
            data=batch.data,
            # an unusual sequence of actions is no unexplored region
            kernel=step.kernel.part(slice(0, batch.task.observed_factors)),
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
            decisions * settings.p,
        ),
    )
    return world, reward_start
