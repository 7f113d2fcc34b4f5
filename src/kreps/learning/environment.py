"""Collects roll-outs: in batches where the task offers them, step by step from any environment.

Both ways address their randomness by roll-out, and lengths that are drawn together by batch, so
they give the same data from the same seed.
"""

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
    """What the learner must know of an environment.

    Args:
        env: any Gymnasium environment with Box observations and bounded Box actions.
        periodic: coordinates of the (flattened) observation that are angles in rad; None takes
            ``env.metadata["periodic_coordinates"]`` if it is there.

    Raises:
        SpaceError: a space that cannot be served, with what to do about it.
    """
    if not isinstance(env, gym.Env):
        raise ConfigurationError(
            f"{env!r} is a {type(env).__name__}, but a single gymnasium.Env is needed; make one "
            "with gymnasium.make(name)"
        )
    observations, actions = env.observation_space, env.action_space
    if not isinstance(observations, gym.spaces.Box):
        raise SpaceError(
            f"the observation space is {observations}, but a Box is needed: states are compared "
            "by distances; wrap the environment in gymnasium.wrappers.FlattenObservation"
        )
    if not isinstance(actions, gym.spaces.Box):
        raise SpaceError(
            f"the action space is {actions}, but a Box is needed: policies choose "
            "among continuous actions; choose a continuous form of the task, or map a "
            "Box to these actions with gymnasium.wrappers.TransformAction"
        )
    if not actions.is_bounded():
        raise SpaceError(
            f"the action space {actions} is unbounded, but the first policy needs limits to "
            "explore within; set them with gymnasium.wrappers.TransformAction and a bounded Box"
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


def without_restarts(env: Environment) -> tuple[Environment, float | None]:
    """The environment inside an outermost `RandomRestart`, and its probability."""
    if isinstance(env, RandomRestart):
        return env.env, env.restart_probability
    if env.has_wrapper_attr("restart_probability"):
        raise ConfigurationError(
            "the environment has a RandomRestart below other wrappers; make it the outermost one"
        )
    return env, None


def batch_model_of(env: Environment) -> BatchModel | None:
    """The task's vectorised form, unless a wrapper that it knows nothing of stands between."""
    transparent = (gym.wrappers.PassiveEnvChecker, gym.wrappers.OrderEnforcing)
    while isinstance(env, transparent):
        env = env.env
    if "batch_model" in vars(env):
        return cast(BatchModel, vars(env)["batch_model"])
    for owner in type(env).__mro__:
        if "batch_model" in vars(owner):  # a subclass that steps in its own way is not served by it
            same = all(getattr(type(env), n) is getattr(owner, n) for n in ("step", "reset"))
            return cast(BatchModel, vars(owner)["batch_model"]) if same else None
    return None


def time_limit(env: Environment) -> int:
    """Steps after which a wrapper cuts the environment off, so far as its spec tells."""
    while isinstance(env, gym.Wrapper):
        limit = env.spec.max_episode_steps if env.spec is not None else None
        if isinstance(env, gym.wrappers.TimeLimit) and limit is not None:
            return int(limit)
        env = env.env
    return sys.maxsize


def _limits(
    env: Environment, task: TaskSpec, ranges: Sequence[tuple[float, float]] | None
) -> list[tuple[float, float]]:
    """Finite limits of each observation coordinate that is no angle."""
    if ranges is None:
        space = cast(gym.spaces.Box, env.observation_space)
        ranges = list(zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True))
    endless = [
        i
        for i, limits in enumerate(ranges)
        if i not in task.periodic and not np.isfinite(limits).all()
    ]
    if len(ranges) != task.observation_size or endless:
        raise SpaceError(
            f"a grid needs a finite range of each of the {task.observation_size} observation "
            f"coordinates; {len(ranges)} ranges are given, coordinates {endless} have no limits: "
            "set ranges, such as ranges=((-3.0, 3.0), (-8.0, 8.0))"
        )
    return list(ranges)
