"""Control period and time stamps, read where environments are known to have them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from kreps.data.task import is_period
from kreps.intake import MAX_MAGNITUDE
from kreps.kernels.arrays import FloatArray
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


def time_in(info: Any) -> Any:
    """``info["time"]``, the time since the start of a rollout in s; None if there is none."""
    return info.get("time") if isinstance(info, Mapping) else None


def time_stamps(times: Sequence[Any]) -> FloatArray | None:
    """The times (T + 1,) of the observations of a rollout in s, from `time_in` of each.

    None unless they are finite and increasing numbers: in a foreign environment ``info["time"]``
    may be anything.
    """
    if not all(isinstance(time, int | float) and abs(time) <= MAX_MAGNITUDE for time in times):
        return None
    return np.array(times, np.float64) if all(b > a for a, b in pairwise(times)) else None
