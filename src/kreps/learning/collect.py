"""Collection of rollouts: in batches if the environment has a batch model, otherwise step by step.

Rollouts are planned before they are made (`kreps.learning.planning`), so that both ways give the
same data from the same seed.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, cast

import gymnasium as gym
import numpy as np

from kreps.data.history import first_lags, next_lags, states_of
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.envs.batch import BatchModel, SettableModel, time_stamps_of
from kreps.envs.held_actions import held
from kreps.errors import ConfigurationError, DataError, EnvironmentFailure, NumericalError
from kreps.intake import as_array, as_flag, as_flags, as_number, as_numbers
from kreps.kernels.arrays import BoolArray, FloatArray, IntArray, default_errstate, grid_points
from kreps.learning.control_period import time_in, time_stamps
from kreps.learning.environment import (
    Environment,
    batch_model_of,
    observation_limits,
    spaces_of,
    time_limit,
)
from kreps.learning.planning import PlannedRollout, longest_rollout, planned_rollouts
from kreps.policies.base import StochasticPolicy
from kreps.policies.exploration import WHITE
from kreps.seeding import Purpose, generator


def collect(
    env: Environment,
    task: TaskSpec,
    policy: StochasticPolicy,
    count: int,
    *,
    seed: int,
    iteration: int,
    first: int = 0,
    restart_probability: float,
    stratified: bool = False,
    exponent: float = WHITE,
    on_rollout: Callable[[int], None] | None = None,
) -> Rollouts:
    """Rollouts of a policy, of random length.

    Args:
        env: without `RandomRestart`: lengths are drawn here.
        task: of the environment; each action is held for its ``action_repeat``.
        policy: with its exploration noise.
        count: number of rollouts.
        seed: of the learner.
        iteration: number of updates so far; with the seed it addresses all random numbers.
        first: number of the first of them in the iteration.
        restart_probability: p, which determines the distribution of lengths.
        stratified: whether lengths are stratified (`stratified_lengths`), so that each depends on
            ``count``.  If not, each is that of `RandomRestart` with the rollout's seed.
        exponent: of the spectrum of the policy's noise (`coloured_noise`).
        on_rollout: called with the number of rollouts that are complete.

    Raises:
        EnvironmentFailure: the environment raised an exception.
        DataError: it returned NaN, infinities or observations of another size.
    """
    planned = planned_rollouts(
        count,
        seed=seed,
        iteration=iteration,
        first=first,
        restart_probability=restart_probability,
        stratified=stratified,
        exponent=exponent,
        decisions=decisions_in(env, task),
    )
    return collect_planned(env, task, policy, planned, on_rollout)


def decisions_in(env: Environment, task: TaskSpec) -> int:
    """Largest number of decisions in an episode of an environment, by its time limit."""
    return -(-time_limit(env) // task.action_repeat)


def collect_planned(
    env: Environment,
    task: TaskSpec,
    policy: StochasticPolicy,
    planned: Sequence[PlannedRollout],
    on_rollout: Callable[[int], None] | None = None,
) -> Rollouts:
    """The rollouts that are planned, by one policy; arguments and errors as of `collect`."""
    seeds = [each.seed for each in planned]
    noises = [each.noise(task.action_size) for each in planned]
    longest = longest_rollout([each.length for each in planned], task)
    return simulate(env, task, policy, seeds, noises, on_rollout, longest)


def collect_grid(
    env: Environment,
    task: TaskSpec,
    ranges: Sequence[tuple[float, float]] | None,
    grid_states: int | Sequence[int],
    grid_actions: int,
    *,
    max_points: int,
    seed: int,
    iteration: int,
) -> Rollouts:
    """One step from every point of a grid of states and actions, as rollouts of one step each.

    Args:
        env: its batch model must be a `kreps.envs.batch.SettableModel`.
        task: of the environment.
        ranges: smallest and largest value of each observation coordinate; None takes those of the
            observation space.
        grid_states, grid_actions: points per coordinate; of states one number, or one for each.
        max_points: largest number of grid points.
        seed, iteration: address the random numbers of the steps.

    Raises:
        ConfigurationError: the environment cannot be set to a state, or there are too many points.
        SpaceError: an observation coordinate has no finite limits.
        EnvironmentFailure: the environment raised an exception.
        DataError: it returned NaN, infinities or observations of another size.
    """
    model = batch_model_of(env)
    if model is None or not hasattr(model, "states_at"):
        raise ConfigurationError(
            f"{env} cannot be set to a given state, as a grid of states needs: it has no "
            "batch_model with states_at(observations); use kreps.ValueIteration, which collects "
            "rollouts from start states"
        )
    sizes = [grid_states] * task.observation_size if isinstance(grid_states, int) else grid_states
    if len(sizes) != task.observation_size:
        raise ConfigurationError(
            f"grid_states = {tuple(sizes)}, but the task has {task.observation_size} observation "
            "coordinates; give one number for each"
        )
    count = math.prod(sizes) * grid_actions**task.action_size
    if count > max_points:
        raise ConfigurationError(
            f"a grid of {grid_states} points in each of {task.observation_size} state and "
            f"{grid_actions} in each of {task.action_size} action coordinates has "
            f"{count if count < 10**9 else 'more than 10^9'} points, but at most {max_points} are "
            "allowed (by the window and the cost of an exact update); lower grid_states or "
            "grid_actions"
        )
    axes = grid_axes(task, observation_limits(env, task, ranges), sizes, grid_actions)
    states, actions = np.split(grid_points(axes), [task.observation_size], axis=1)
    rngs = [generator(seed, Purpose.ENVIRONMENT, iteration, j) for j in range(count)]
    try:
        simulated = cast(SettableModel, model).states_at(states)
        observations = _checked(model.observe(simulated), count, task)
        simulated, rewards, ended = _step(model, simulated, actions, rngs)
        successors = _checked(model.observe(simulated), count, task)
    except DataError:
        raise
    except Exception as error:
        raise _failure(error, "a step from a grid of states", 0) from error
    points = np.stack([observations, successors], axis=1).reshape(2 * count, -1)
    return Rollouts.from_arrays(points, actions, rewards, np.ones(count), ended)


def grid_axes(
    task: TaskSpec,
    limits: Sequence[tuple[float, float]],
    grid_states: Sequence[int],
    grid_actions: int,
) -> list[FloatArray]:
    """The grid's values of each state and action coordinate, ``ds + da`` arrays.

    Args:
        task: limits of the actions, and which coordinates are angles.
        limits: smallest and largest value of each observation coordinate.
        grid_states: points of each state coordinate.  Angles are spaced over a whole turn.
        grid_actions: points of each action coordinate.
    """
    states = [
        np.arange(size) * 2.0 * np.pi / size if i in task.periodic else np.linspace(*limit, size)
        for i, (limit, size) in enumerate(zip(limits, grid_states, strict=True))
    ]
    actions = [
        np.linspace(low, high, grid_actions)
        for low, high in zip(task.action_low, task.action_high, strict=True)
    ]
    return states + actions


def simulate(
    env: Environment,
    task: TaskSpec,
    policy: StochasticPolicy,
    seeds: Sequence[int],
    noises: Sequence[Iterable[FloatArray]],
    on_rollout: Callable[[int], None] | None = None,
    longest: int = sys.maxsize,
) -> Rollouts:
    """One rollout per seed, as long as its noise unless the task ends before.

    Args:
        env: without random restarts.
        task: of the environment; each action is held for its ``action_repeat``.
        policy: that acts.
        seeds: (R,) of the environment.
        noises: R times (length, da) standard normal numbers for the policy, in arrays or row by row
            (`kreps.policies.exploration.noise_rows`).
        on_rollout: called with the number of rollouts that are complete.
        longest: largest number of steps that a rollout may have (`longest_rollout`).

    Raises:
        ConfigurationError: a rollout has more steps.
        EnvironmentFailure: the environment raised an exception.
        DataError: it returned NaN, infinities or observations of another size.
    """
    env = held(env, task.action_repeat)
    model = batch_model_of(env)
    if model is not None:
        rollouts = _simulate_batch(model, task, policy, seeds, noises, longest)
        if on_rollout is not None:
            on_rollout(len(rollouts))
        return rollouts
    collected = []
    for number, (seed, noise) in enumerate(zip(seeds, noises, strict=True)):
        collected.append(_simulate_one(env, task, policy, seed, noise, number, longest))
        if on_rollout is not None:
            on_rollout(number + 1)
    return Rollouts.from_list(collected)


def _require_end(steps: int, longest: int) -> None:
    """Raise `ConfigurationError` if a rollout has more steps than ``longest``."""
    if steps > longest:
        raise ConfigurationError(
            f"a rollout has more than {longest} steps and goes on, but all of its batch must fit "
            "in memory; raise restart_probability (a rollout has 1 / p steps on average), limit "
            "the steps of the environment (gymnasium.wrappers.TimeLimit), or ask for fewer"
        )


def _simulate_batch(
    model: BatchModel,
    task: TaskSpec,
    policy: StochasticPolicy,
    seeds: Sequence[int],
    noises: Sequence[Iterable[FloatArray]],
    longest: int,
) -> Rollouts:
    rngs = [gym.utils.seeding.np_random(seed)[0] for seed in seeds]
    rows = [iter(noise) for noise in noises]
    live = np.arange(len(rngs))
    lengths, terminated = np.zeros(len(live), np.intp), np.zeros(len(live), dtype=bool)
    steps: list[tuple[IntArray, FloatArray, FloatArray, FloatArray]] = []
    stamps: list[FloatArray] = []  # empty where control periods are constant
    t = 0
    try:
        states = np.array(model.initial(rngs))
        current = first = _checked(model.observe(states), len(live), task)
        start = time_stamps_of(model, states)
        lags = first_lags(first, task)
        while len(live):
            drawn = [next(rows[j], None) for j in live.tolist()]
            going = np.array([row is not None for row in drawn])
            live, states, current, lags = live[going], states[going], current[going], lags[going]
            if not len(live):
                break
            with default_errstate():
                noise = np.stack([row for row in drawn if row is not None])
                actions = policy.act(states_of(current, lags, task), noise)
            applied = task.clip(actions)
            states, rewards, done = _step(model, states, applied, [rngs[j] for j in live.tolist()])
            lags = next_lags(current, lags, task.scaled(applied), task)
            current = _checked(model.observe(states), len(live), task)
            steps.append((live, actions, rewards, current))
            if start is not None:
                stamps.append(np.array(time_stamps_of(model, states)))
            t += 1
            lengths[live] = t
            terminated[live[done]] = True
            _require_end(t, longest)
            live, states = live[~done], states[~done]
            current, lags = current[~done], lags[~done]
    except (ConfigurationError, DataError, NumericalError):
        raise
    except Exception as error:
        raise _failure(error, "a batch of rollouts", t) from error
    rollout = np.concatenate([numbers for numbers, *_ in steps])
    order = np.argsort(rollout, kind="stable")  # one rollout after the other
    actions, rewards, successors = (
        np.concatenate([step[part] for step in steps])[order] for part in (1, 2, 3)
    )
    starts = np.cumsum(lengths) - lengths
    points = np.insert(successors, starts, first, axis=0)
    collected = Rollouts.from_arrays(points, actions, rewards, lengths, terminated)
    if start is None:
        return collected
    return replace(collected, times=np.insert(np.concatenate(stamps)[order], starts, start))


def _simulate_one(
    env: Environment,
    task: TaskSpec,
    policy: StochasticPolicy,
    seed: int,
    noise: Iterable[FloatArray],
    number: int,
    longest: int,
) -> Rollout:
    spaces = spaces_of(env)
    observations: list[FloatArray] = []
    actions: list[FloatArray] = []
    rewards: list[float] = []
    times: list[Any] = []
    terminated = False
    try:
        observation, info = env.reset(seed=seed)
        times.append(time_in(info))
        observations.append(as_state(observation, task))
        lags = first_lags(observations[-1][None], task)
        for row in noise:
            newest = observations[-1][None]
            with default_errstate():  # the environment keeps the caller's
                action = policy.act(states_of(newest, lags, task), row[None])[0]
            applied = task.clip(action)
            lags = next_lags(newest, lags, task.scaled(applied[None]), task)
            observation, reward, ended, cut, info = env.step(spaces.actions(applied))
            times.append(time_in(info))
            observations.append(as_state(observation, task))
            actions.append(action)
            rewards.append(as_number("reward", reward))
            _require_end(len(rewards), longest)
            terminated = as_flag("terminated", ended)
            if terminated or as_flag("truncated", cut):
                break
    except DataError as error:
        where = f"rollout {number} of the environment, after {len(actions)} steps"
        raise DataError(f"{where}: {error}") from error
    except (ConfigurationError, NumericalError):
        raise
    except Exception as error:
        raise _failure(error, f"rollout {number}", len(rewards)) from error
    try:
        return Rollout(
            np.stack(observations),
            np.stack(actions),
            np.array(rewards),
            terminated,
            time_stamps(times),
        )
    except DataError as error:
        raise DataError(f"rollout {number} of the environment: {error}") from error


def _failure(error: Exception, where: str, steps: int) -> EnvironmentFailure:
    return EnvironmentFailure(
        f"the environment raised {type(error).__name__} in {where}, after {steps} steps: {error}; "
        "the learner is as after the last update, so repair the environment and call learn() again"
    )


def _checked(observations: Any, count: int, task: TaskSpec) -> FloatArray:
    """The observations, if they are of shape (count, ds)."""
    return _of_shape("observations", observations, (count, task.observation_size))


def _of_shape(name: str, values: Any, shape: tuple[int, ...]) -> FloatArray:
    found = as_array(name, values)
    if found.shape != shape:
        raise DataError(
            f"the batch model returned {name} of shape {found.shape}, but {shape} is needed"
        )
    return np.array(found)  # a copy, as the model may use its arrays again


def _step(
    model: BatchModel, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """A step of a batch model, if it returns one number and one flag for each row."""
    successors, rewards, ended = model.step(states, actions, rngs)
    rows = (len(rngs),)
    done = as_flags("ends", _of_shape("ends", ended, rows))
    return successors, _of_shape("rewards", rewards, rows), done


def as_state(observation: Any, task: TaskSpec) -> FloatArray:
    """An observation as a vector (ds,) of finite numbers."""
    state = as_numbers("observations", observation, "repair what measures it").ravel()
    if len(state) != task.observation_size:
        raise DataError(
            f"an observation has {len(state)} coordinates, but the observation space has "
            f"{task.observation_size}"
        )
    return state
