"""Past the paper: the same bounded step again, on samples that the transition model generates.

Dyna's idea (Sutton 1990): states drawn by the weights just found and states that the new policy
visits in the model, each with actions drawn anew.  Before it acts, the new policy must pass an
acceptance test in the model against the one before.
"""

from __future__ import annotations

import numpy as np

from kreps.algorithms.acceptance import refuses, widening
from kreps.algorithms.generated import imagine, places
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.reps import Batch, PolicySamples, Step, stationarity_ridge
from kreps.algorithms.state import LearnerState
from kreps.data.rewards import each_tells, tells_of_states
from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import Simulator, can_be_simulated
from kreps.models.novelty import optimism_of
from kreps.models.transition import restart_features
from kreps.models.world_model import Outlook


def generates_samples(batch: Batch) -> bool:
    """Whether there is a second step: not where no reward depends on the state."""
    if batch.settings.imagined == 0 or batch.settings.model == "sample" or batch.from_dataset:
        return False
    return tells_of_states(batch.window.rollouts, batch.task)


def can_simulate(batch: Batch) -> bool:
    """Whether the model can be rolled out: only the dynamics, on enough samples, not in images."""
    dynamics = batch.settings.model == "dynamics"
    return generates_samples(batch) and dynamics and can_be_simulated(batch.data, batch.task)


def model_based_step(
    batch: Batch, step: Step, state: LearnerState, rng: np.random.Generator
) -> tuple[Step, FloatArray, bool | None]:
    """The step repeated on generated samples, the reward model's parameters, and the verdict."""
    task, settings = batch.task, batch.settings
    world, reward_start = world_model(batch, step, state, rng)
    ridge = stationarity_ridge(settings, step.model.errors)
    weights, dual, policy, earlier = batch.of_data(step.dual.weights), step.dual, step.policy, None
    keep_earlier = not each_tells(batch.window.rollouts, task)  # a goal known from few samples
    sources = places(world, settings)
    for led in sources:
        samples = imagine(world, weights, policy.policy, task, settings, ridge, rng, led)
        dual = solve_dual(samples.problem, start=(1.0, dual.theta))  # V is nearly known, eta not
        found = PolicySamples.imagined(samples, dual.weights, task)
        targets = found.beside(earlier) if keep_earlier and earlier is not None else found
        narrower = widening(world.simulator is not None and settings.judging_rollouts > 0, settings)
        scale = narrower if led == sources[-1] else 1.0
        policy = batch.fit_policy(targets, step.kernel, policy.x, rng, scale)
        earlier = found
    batch.clock.lap("imagined step")
    refused = refuses(policy.policy, state.policy, world, settings, rng)
    batch.clock.lap("judgement")
    return (
        Step(step.kernel, step.features, step.model, step.problem, dual, policy),
        reward_start,
        refused,
    )


def world_model(
    batch: Batch, step: Step, state: LearnerState, rng: np.random.Generator
) -> tuple[Outlook, FloatArray]:
    """Everything that generated samples need: expected features, rewards and, if any, roll-outs."""
    settings, features = batch.settings, step.features
    simulator = None
    if can_simulate(batch):
        simulator = Simulator(
            dynamics=step.model.dynamics,
            data=batch.data,
            kernel=step.kernel,
            task=batch.task,
            restart_probability=settings.restart_probability,
            exploring_starts=settings.exploring_starts,
            longest=max(map(len, batch.window.rollouts)),
        )
    reward, reward_start = batch.fit_reward(step.kernel, state.reward_start, rng)
    weights = batch.of_data(step.dual.weights)
    world = Outlook(
        states=batch.data.states,
        features=features.own,
        features_at=features.basis.features,
        restart=restart_features(features.start, features.own.mean(axis=0), settings),
        rewards=batch.rewards,
        expect=step.model.of_actions,
        reward=reward,
        simulator=simulator,
        optimism=optimism_of(simulator, batch.rewards, weights, state.iteration, settings),
    )
    return world, reward_start
