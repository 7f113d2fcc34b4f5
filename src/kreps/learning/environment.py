"""What is read from a Gymnasium environment: its task, limits and batch model."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, cast

import gymnasium as gym
import numpy as np

from kreps.data.spaces import Spaces
from kreps.data.task import TaskSpec
from kreps.envs.batch import KnownReward
from kreps.envs.batch import batch_model_of as batch_model_of
from kreps.errors import ConfigurationError, SpaceError
from kreps.kernels.arrays import FloatArray
from kreps.learning.control_period import control_period
from kreps.learning.wrappers import Environment as Environment
from kreps.learning.wrappers import (
    keeps_observations,
    metadata_of,
    warn_about_state,
    without_restarts,
    wrappers_of,
)

ANGLES, GROUPS, IMAGE_SHAPE = (
    "periodic_coordinates",
    "observation_groups",
    "observation_image_shape",
)
"""Keys of ``env.metadata`` about the coordinates of observations."""


@contextmanager
def opened(name: str, arguments: Mapping[str, Any] | None = None) -> Iterator[Environment]:
    """A new environment, which is closed at the end, after an error, and after Ctrl-C.

    Every environment that kreps makes is made here: that of a robot must not stay powered.  If it
    cannot be closed there is a `UserWarning`.

    Args:
        name: Gymnasium name; ``module:name`` imports the module first.
        arguments: of ``gymnasium.make``.

    Raises:
        ConfigurationError: it cannot be made.
    """
    try:
        env: Environment = gym.make(name, **(arguments or {}))
    except Exception as error:  # whatever a foreign environment raises
        raise ConfigurationError(
            f"cannot make the environment {name!r}: {error}; check its name and arguments, or "
            "write module:name to have its module imported first"
        ) from error
    try:
        yield env
    finally:
        try:
            env.close()
        except Exception as error:  # what was learnt and what went wrong before must not be hidden
            warnings.warn(
                f"close() of the environment {name!r} raised {type(error).__name__}: {error}; "
                "check whether it is still powered",
                UserWarning,
                stacklevel=3,
            )


def task_of(env: Environment, periodic: Sequence[int] | None = None) -> TaskSpec:
    """The specification of an environment's task.

    Metadata are used only if no wrapper around the environment that they belong to may change the
    observations; otherwise there is a `UserWarning`.

    Args:
        env: any Gymnasium environment with Box observations and bounded Box actions.
        periodic: coordinates of the (flattened) observation that are angles in rad; None takes
            ``env.metadata["periodic_coordinates"]`` if it exists.

    Raises:
        ConfigurationError: not an environment.
        SpaceError: a space that is not supported.
    """
    size, low, high = _sizes_and_limits(env)
    keys = (ANGLES, GROUPS, IMAGE_SHAPE) if periodic is None else (GROUPS, IMAGE_SHAPE)
    metadata = _observation_metadata(env, keys)
    return TaskSpec(
        observation_size=size,
        action_low=low,
        action_high=high,
        periodic=tuple(metadata.get(ANGLES, ()) if periodic is None else periodic),
        groups=tuple(metadata.get(GROUPS, ())),
        image_shape=metadata.get(IMAGE_SHAPE),
        spaces=spaces_of(env),
        dt=control_period(env),
        time_limit=None if (limit := time_limit(env)) == sys.maxsize else limit,
    )


def spaces_of(env: Environment) -> Spaces:
    """Shapes and numbers of an environment whose spaces are supported."""
    observations, actions = env.observation_space, env.action_space
    return Spaces(observations.shape or (), actions.shape or (), str(actions.dtype))


def _sizes_and_limits(env: Environment) -> tuple[int, FloatArray, FloatArray]:
    """Number of observation coordinates, and limits (da,) of the actions, of supported spaces."""
    if not isinstance(env, gym.Env):
        raise ConfigurationError(
            f"{env!r:.60} is a {type(env).__name__}, but a single gymnasium.Env is needed; make "
            "one with gymnasium.make(name)"
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
    low, high = (np.array(limit, np.float64).ravel() for limit in (actions.low, actions.high))
    return int(np.prod(observations.shape)), low, high


def _observation_metadata(env: Environment, keys: tuple[str, ...]) -> dict[str, Any]:
    """Metadata about the observations that a learner gets.

    Args:
        env: the environment with its wrappers.
        keys: what is asked for.  There is a `UserWarning` if a wrapper makes one of them unusable.
    """
    metadata, left_out = metadata_of(env, keeps_observations)
    unusable = [key for key in keys if key in left_out]
    if unusable:
        names = left_out[unusable[-1]]
        images = "" if unusable == [ANGLES] else f"; for images set the metadata of {names[0]}"
        warnings.warn(
            f"{' and '.join(names)} may change the observations, so metadata of the environment "
            f"inside are not used: {', '.join(unusable)}. Say which coordinates that the learner "
            f"gets are angles: periodic=[...], or [] for none{images}",
            UserWarning,
            stacklevel=5,
        )
    return metadata


def environment_for(
    env: Environment, task: TaskSpec, restart_probability: float | None
) -> Environment:
    """The environment that a learner collects in, without its random restarts.

    The only way into a learner, for a new one and for one that is resumed.

    Args:
        env: as given by the user.  There is a `UserWarning` if a wrapper has running statistics.
        task: of the learner.
        restart_probability: of the learner; None if it chooses it.

    Raises:
        ConfigurationError: no environment, one with other sizes, limits or restarts.
        SpaceError: a space that is not supported.
    """
    size, low, high = _sizes_and_limits(env)
    same = size == task.observation_size and (
        np.array_equal(low, task.action_low) and np.array_equal(high, task.action_high)
    )
    if not same:
        raise ConfigurationError(
            f"the environment has {size} observation coordinates and actions in {low} to {high}, "
            f"the learner {task.observation_size} and {task.action_low} to {task.action_high}; "
            "give the environment of the checkpoint"
        )
    inside, probability = without_restarts(env)
    if probability is not None and probability != restart_probability:
        raise ConfigurationError(
            f"restart_probability = {restart_probability!r}, but the environment's RandomRestart "
            f"has {probability!r}; give the environment without RandomRestart, or with the same "
            "probability"
        )
    warn_about_state(env)
    return inside


def known_reward_of(env: Environment | None) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """The reward function of an environment: ``rewards`` of its batch model.

    Raises:
        ConfigurationError: no environment, or one whose reward function is not known.
    """
    model = None if env is None else batch_model_of(env)
    if not hasattr(model, "rewards"):
        raise ConfigurationError(
            f"known_reward = True, but the reward function of {env} is not known: it has no "
            "batch_model with rewards(observations, actions); set known_reward=False to learn it"
        )
    return cast(KnownReward, model).rewards


def time_limit(env: Environment) -> int:
    """Steps after which an episode is truncated; ``sys.maxsize`` if that is not known.

    It is that of `TimeLimit` wrappers, or that of an environment of dm_control.
    """
    limits: list[Any] = [
        wrapper.spec.max_episode_steps if wrapper.spec else vars(wrapper).get("_max_episode_steps")
        for wrapper in wrappers_of(env)
        if isinstance(wrapper, gym.wrappers.TimeLimit)
    ]
    limits.append(getattr(getattr(env.unwrapped, "_env", None), "_step_limit", None))  # shimmy
    known = (int(each) for each in limits if isinstance(each, int | float) and each < sys.maxsize)
    return min((limit for limit in known if limit >= 1), default=sys.maxsize)


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
