"""What is read from a Gymnasium environment: its task, limits, batch model and restarts."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np

from kreps.data.task import TaskSpec
from kreps.envs.batch import BatchModel
from kreps.envs.restart import RandomRestart
from kreps.errors import ConfigurationError, SpaceError

Environment = gym.Env[Any, Any]


def task_of(env: Environment, periodic: Sequence[int] | None = None) -> TaskSpec:
    """The specification of an environment's task.

    Args:
        env: any Gymnasium environment with Box observations and bounded Box actions.
        periodic: coordinates of the (flattened) observation that are angles in rad; None takes
            ``env.metadata["periodic_coordinates"]`` if it exists.

    Raises:
        ConfigurationError: not an environment.
        SpaceError: a space that is not supported.
    """
    if not isinstance(env, gym.Env):
        raise ConfigurationError(
            f"{env!r} is a {type(env).__name__}, but a single gymnasium.Env is needed; make one "
            "with gymnasium.make(name)"
        )
    observations, actions = env.observation_space, env.action_space
    if not isinstance(observations, gym.spaces.Box):
        raise SpaceError(
            f"the observation space is {observations}, but a Box is needed, as kernels compare "
            "states by distances; wrap the environment in gymnasium.wrappers.FlattenObservation"
        )
    if not isinstance(actions, gym.spaces.Box):
        raise SpaceError(
            f"the action space is {actions}, but a Box is needed, as policies are over continuous "
            "actions; use a continuous form of the task, or map a Box to these actions with "
            "gymnasium.wrappers.TransformAction"
        )
    if not actions.is_bounded():
        raise SpaceError(
            f"the action space {actions} is unbounded, but the first policy explores within finite "
            "limits; set them with gymnasium.wrappers.TransformAction and a bounded Box"
        )
    if periodic is None:
        periodic = (env.metadata or {}).get("periodic_coordinates", ())
    return TaskSpec(
        observation_size=int(np.prod(observations.shape)),
        action_low=actions.low.ravel(),
        action_high=actions.high.ravel(),
        periodic=tuple(periodic),
        groups=tuple((env.metadata or {}).get("observation_groups", ())),
        image_shape=(env.metadata or {}).get("observation_image_shape"),
    )


def require_same_shape(found: TaskSpec, task: TaskSpec) -> None:
    """Raise `ConfigurationError` unless an environment's task has the sizes and limits of ``task``.

    Args:
        found: of the environment.
        task: of a checkpoint.
    """
    same = found.observation_size == task.observation_size and (
        np.array_equal(found.action_low, task.action_low)
        and np.array_equal(found.action_high, task.action_high)
    )
    if not same:
        raise ConfigurationError(
            f"the environment has {found.observation_size} observation coordinates and actions in "
            f"{found.action_low} to {found.action_high}, the checkpoint {task.observation_size} "
            f"and {task.action_low} to {task.action_high}; resume in the environment of the "
            "checkpoint"
        )


def without_restarts(env: Environment) -> tuple[Environment, float | None]:
    """The environment inside an outermost `RandomRestart`, and the restart probability.

    The probability is None, and the environment itself is returned, if it has no such wrapper.

    Raises:
        ConfigurationError: a `RandomRestart` below other wrappers.
    """
    if isinstance(env, RandomRestart):
        return env.env, env.restart_probability
    if env.has_wrapper_attr("restart_probability"):
        raise ConfigurationError(
            "the environment has a RandomRestart below other wrappers; make it the outermost "
            "wrapper"
        )
    return env, None


def batch_model_of(env: Environment) -> BatchModel | None:
    """The vectorised form of an environment; None if it has none that computes the same.

    A wrapper may change what a step does, so only wrappers that are known not to are looked
    through.
    """
    transparent = (gym.wrappers.PassiveEnvChecker, gym.wrappers.OrderEnforcing)
    while isinstance(env, transparent):
        env = env.env
    if "batch_model" in vars(env):
        return cast(BatchModel, vars(env)["batch_model"])
    for owner in type(env).__mro__:
        if "batch_model" in vars(owner):  # a subclass with its own step or reset differs from it
            same = all(getattr(type(env), n) is getattr(owner, n) for n in ("step", "reset"))
            return cast(BatchModel, vars(owner)["batch_model"]) if same else None
    return None


def time_limit(env: Environment) -> int:
    """Steps after which a `TimeLimit` wrapper truncates; ``sys.maxsize`` without one."""
    while isinstance(env, gym.Wrapper):
        limit = env.spec.max_episode_steps if env.spec is not None else None
        if isinstance(env, gym.wrappers.TimeLimit) and limit is not None:
            return int(limit)
        env = env.env
    return sys.maxsize


def observation_limits(
    env: Environment, task: TaskSpec, ranges: Sequence[tuple[float, float]] | None
) -> list[tuple[float, float]]:
    """Smallest and largest value of each observation coordinate, finite unless it is an angle.

    Args:
        env: its observation space is used if ``ranges`` is None.
        task: of the environment.
        ranges: a pair for each coordinate.

    Raises:
        SpaceError: a coordinate without finite limits, or a wrong number of ranges.
    """
    if ranges is None:
        space = cast(gym.spaces.Box, env.observation_space)
        ranges = list(zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True))
    unbounded = [
        i
        for i, limits in enumerate(ranges)
        if i not in task.periodic and not np.isfinite(limits).all()
    ]
    if len(ranges) != task.observation_size or unbounded:
        raise SpaceError(
            f"a grid needs a finite range of each of the {task.observation_size} observation "
            f"coordinates; {len(ranges)} ranges are given and coordinates {unbounded} are "
            "unbounded: set ranges, such as ranges=((-3.0, 3.0), (-8.0, 8.0))"
        )
    return list(ranges)
