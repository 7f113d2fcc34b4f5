"""The control period of an environment, read where environments are known to tell it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from kreps.data.task import is_period
from kreps.learning.wrappers import Environment, keeps_time, metadata_of, wrappers_of


def control_period(env: Environment) -> float | None:
    """Seconds of simulated or real time that a step of an environment takes; None if unknown.

    The first of these that is a positive number: ``metadata["dt"]``; ``dt`` of the environment
    (MuJoCo in Gymnasium); ``control_timestep()`` of an environment of dm_control that shimmy has
    wrapped; one over ``metadata["render_fps"]``, as an environment usually draws each step.

    Nothing inside a wrapper counts that may take several steps at once.  Such a wrapper can tell
    the period by ``metadata["dt"]`` of its own.
    """
    metadata, _ = metadata_of(env, keeps_time)
    inside = env.unwrapped if all(map(keeps_time, wrappers_of(env))) else None
    candidates: tuple[Callable[[], Any], ...] = (
        lambda: metadata.get("dt"),
        lambda: getattr(inside, "dt", None),
        lambda: inside._env.control_timestep(),  # type: ignore[union-attr]
        lambda: 1.0 / metadata["render_fps"],
    )
    return next(filter(is_period, map(_tried, candidates)), None)


def _tried(read: Callable[[], Any]) -> Any:
    """What was read, as a number where it is one; None after any error of a foreign object."""
    try:
        value = read()
        return None if isinstance(value, str | bool | Mapping) else float(value)
    except Exception:
        return None
