"""What wrappers do to an environment: whose metadata still hold, restarts, state of their own."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sized
from typing import Any

import gymnasium as gym

from kreps.envs.held_actions import HeldActions
from kreps.envs.perturb import Perturbed
from kreps.envs.restart import RandomRestart
from kreps.errors import ConfigurationError

Environment = gym.Env[Any, Any]
Wrapper = gym.Wrapper[Any, Any, Any, Any]

KEEPS_STEPS = {
    "AddWhiteNoise",  # to pictures
    "Autoreset",
    "HumanRendering",
    "Monitor",  # of Stable-Baselines3
    "NormalizeReward",
    "ObstructView",
    "OrderEnforcing",
    "PassiveEnvChecker",
    "RecordEpisodeStatistics",
    "RecordVideo",
    "RenderCollection",
    "TimeLimit",
}
"""Known wrappers with a step of their own that change neither observations nor actions."""

KEEPS_OBSERVATIONS = KEEPS_STEPS | {"RepeatAction", "StickyAction"}
KEEPS_ORDER = {"FlattenObservation", "ReshapeObservation"}
"""They keep the coordinates of an array, and their order."""

KEEPS_ACTIONS = KEEPS_STEPS | {"ClipAction"}
CHANGES_TIME = {"AtariPreprocessing", "MaxAndSkipObservation", "RepeatAction"}
"""Wrappers of Gymnasium that take several steps of what they wrap in one of theirs."""


def wrappers_of(env: Environment) -> Iterator[Wrapper]:
    """The wrappers around an environment, outermost first."""
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env


def keeps_observations(wrapper: Wrapper) -> bool:
    """Whether a wrapper certainly leaves the coordinates of observations as they are."""
    name = _known_name(wrapper)
    if name in KEEPS_ORDER:
        return isinstance(wrapper.env.observation_space, gym.spaces.Box)
    return (
        isinstance(wrapper, RandomRestart | HeldActions)
        or name in KEEPS_OBSERVATIONS
        or _inherits(wrapper, gym.ActionWrapper, gym.RewardWrapper)
    )


def keeps_actions(wrapper: Wrapper) -> bool:
    """Whether a wrapper certainly leaves the coordinates of actions and their units as they are."""
    return (
        isinstance(wrapper, RandomRestart | HeldActions)
        or _known_name(wrapper) in KEEPS_ACTIONS
        or _inherits(wrapper, gym.ObservationWrapper, gym.RewardWrapper)
    )


def keeps_time(wrapper: Wrapper) -> bool:
    """Whether a step of a wrapper is certainly one step of what it wraps."""
    if name := _known_name(wrapper):
        return name not in CHANGES_TIME
    bases = (gym.Wrapper, gym.ActionWrapper, gym.ObservationWrapper, gym.RewardWrapper)
    own = type(wrapper).step
    return isinstance(wrapper, RandomRestart | Perturbed) or any(own is base.step for base in bases)


def _known_name(wrapper: Wrapper) -> str:
    """The name of a wrapper of Gymnasium, or of that of Stable-Baselines3; others have none."""
    kind = type(wrapper)
    known = ("gymnasium.", "stable_baselines3.common.monitor")
    return kind.__name__ if kind.__module__.startswith(known) else ""


def _inherits(wrapper: Wrapper, *bases: type[Wrapper]) -> bool:
    """Whether step and reset are those of ``gym.Wrapper``, or of one of its subclasses."""
    return all(
        any(getattr(type(wrapper), name) is getattr(base, name) for base in (gym.Wrapper, *bases))
        for name in ("step", "reset")
    )


def metadata_of(
    env: Environment, keeps: Callable[[Wrapper], bool]
) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """The metadata of an environment that hold for what the outermost wrapper gives and takes.

    Each key is looked for in wrappers with metadata of their own, outermost first, and then in the
    environment inside.

    Args:
        env: the environment with its wrappers.
        keeps: whether a wrapper leaves unchanged what the metadata are about.

    Returns:
        Metadata; and the keys that are left out, with the names of the wrappers that may change
        what they are about.
    """
    held: dict[str, Any] = {}
    left_out: dict[str, list[str]] = {}
    changing: list[str] = []
    for wrapper in wrappers_of(env):
        if _declares(wrapper):
            _take(wrapper.metadata, held, left_out, changing)
        if not keeps(wrapper):
            changing.append(type(wrapper).__name__)
        env = wrapper.env
    _take(env.metadata, held, left_out, changing)
    return held, left_out


def _take(
    metadata: Any,
    held: dict[str, Any],
    left_out: dict[str, list[str]],
    changing: list[str],
) -> None:
    for key, value in metadata.items() if isinstance(metadata, Mapping) else ():
        if key in held or key in left_out:
            continue
        empty = value is None or (isinstance(value, Sized) and len(value) == 0)
        if changing and not empty:
            left_out[key] = list(changing)
        else:
            held[key] = value


def _declares(wrapper: Wrapper) -> bool:
    """Whether a wrapper has metadata of its own, and no copy of those of what it wraps."""
    own = "metadata" in vars(type(wrapper)) or vars(wrapper).get("_metadata") is not None
    return own and not _known_name(wrapper)


def without_restarts(env: Environment) -> tuple[Environment, float | None]:
    """The environment inside an outermost `RandomRestart`, and the restart probability.

    The probability is None, and the environment itself is returned, if it has no such wrapper.

    Raises:
        ConfigurationError: a `RandomRestart` below other wrappers.
    """
    found = [each for each in wrappers_of(env) if isinstance(each, RandomRestart)]
    if len(found) > 1:
        raise ConfigurationError(
            f"the environment has {len(found)} RandomRestart wrappers, with probabilities "
            f"{[each.restart_probability for each in found]}, but the process has one; keep one, "
            "as the outermost wrapper"
        )
    if not found:
        return env, None
    if env is not found[0]:
        raise ConfigurationError(
            "the environment has a RandomRestart below other wrappers; make it the outermost "
            "wrapper"
        )
    return found[0].env, found[0].restart_probability


def warn_about_state(env: Environment) -> None:
    """A `UserWarning` for each wrapper that scales by statistics which no file of a run holds."""
    for wrapper in wrappers_of(env):
        learns = any(type(each).__name__ == "RunningMeanStd" for each in vars(wrapper).values())
        if learns and getattr(wrapper, "update_running_mean", True):
            name = type(wrapper).__name__
            warnings.warn(
                f"{name} scales by running statistics. They change with every step, and no "
                "checkpoint or policy file holds them, so what is resumed, loaded or evaluated "
                "later acts on other numbers than it was learnt from. Scale by fixed numbers "
                "(gymnasium.wrappers.TransformObservation, TransformReward), or set its statistics "
                "to the same values each time and update_running_mean = False",
                UserWarning,
                stacklevel=4,
            )
