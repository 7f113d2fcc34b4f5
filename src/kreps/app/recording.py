"""A rollout of a policy with the pictures that the environment draws."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.app.environments import metadata_of
from kreps.errors import EnvironmentFailure, KrepsError
from kreps.kernels.arrays import FloatArray
from kreps.learning.environment import Environment, spaces_of
from kreps.learning.policy import Policy

Picture = NDArray[np.uint8]
"""(height, width, 3), red, green and blue."""

DEFAULT_FPS = 20.0
"""Pictures per second where the environment's metadata has no usable number."""

FPS_RANGE = 0.1, 1000.0
MAX_SIDE = 800
"""Of a picture, in pixels; larger ones are thinned out, as a film keeps all of them in memory."""


@dataclass(frozen=True)
class Recording:
    """A rollout with its pictures.

    Attributes:
        frames: T pictures (height, width, 3).
        observations: (T, ds), one for each picture.
        actions: (T, da), taken at these observations.
        fps: pictures per second.
    """

    frames: Sequence[Picture]
    observations: FloatArray
    actions: FloatArray
    fps: float


def record(
    env: Environment, policy: Policy, steps: int, seed: int, *, deterministic: bool
) -> Recording:
    """Let the policy act, holding its actions as it was learnt, and keep a copy of each picture.

    Args:
        env: made with ``render_mode="rgb_array"``.
        policy: that acts.
        steps: largest length of the rollout.
        seed: of the environment.
        deterministic: whether the policy acts without its exploration noise.

    Raises:
        EnvironmentFailure: the environment raised, or draws no pictures.
    """
    frames, observations, actions = [], [], []
    held: Any = None
    spaces = spaces_of(env)
    try:
        observation, _ = env.reset(seed=seed)
        for _ in range(steps):
            frames.append(picture_of(env.render()))  # first: without pictures no step is taken
            observations.append(np.array(observation, dtype=np.float64).ravel())
            action, held = policy.predict(observations[-1], held, deterministic=deterministic)
            actions.append(np.ravel(action))
            observation, _, terminated, truncated, _ = env.step(spaces.actions(actions[-1]))
            if terminated or truncated:
                break
    except KrepsError:
        raise
    except Exception as error:  # whatever a foreign environment raises
        raise EnvironmentFailure(
            f"the environment cannot be filmed, it raised {type(error).__name__}: {error}"
        ) from error
    return Recording(
        frames, np.array(observations), np.array(actions), frame_rate(metadata_of(env))
    )


def picture_of(drawn: Any) -> Picture:
    """A copy of what ``render`` returned, as a picture.

    Arrays (height, width) of grey values, with one, three or four channels, are taken, as integers
    up to 255 or as floats up to 1 or 255.  Of a list of pictures the last one is taken.

    Raises:
        EnvironmentFailure: it is no picture.
    """
    if isinstance(drawn, list | tuple) and drawn and isinstance(drawn[-1], np.ndarray):
        drawn = drawn[-1]
    pixels = np.asarray(drawn)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or 0 in pixels.shape:
        raise EnvironmentFailure(f"its render() returned {_described(drawn)}; {_REMEDY}")
    if pixels.dtype.kind not in "buif":
        raise EnvironmentFailure(f"its render() returned {pixels.dtype} pixels; {_REMEDY}")
    every = math.ceil(max(pixels.shape[:2]) / MAX_SIDE)
    pixels = pixels[::every, ::every, :3]
    if pixels.dtype.kind in "bf":
        pixels = np.nan_to_num(pixels.astype(np.float64))
        pixels = np.round(pixels * (255.0 if pixels.max() <= 1.0 else 1.0))
    three = np.broadcast_to(pixels, (*pixels.shape[:2], 3))
    return np.clip(three, 0, 255).astype(np.uint8)


_REMEDY = 'a film needs an array (height, width, 3) of uint8 for render_mode="rgb_array"'


def _described(drawn: Any) -> str:
    if isinstance(drawn, np.ndarray):
        return f"an array of shape {drawn.shape}"
    return "None instead of a picture" if drawn is None else f"a {type(drawn).__name__}"


def frame_rate(metadata: Mapping[str, Any]) -> float:
    """Pictures per second from ``metadata["render_fps"]``; `DEFAULT_FPS` if it is no number > 0."""
    try:
        rate = float(metadata["render_fps"])
    except (KeyError, TypeError, ValueError):
        return DEFAULT_FPS
    return min(max(rate, FPS_RANGE[0]), FPS_RANGE[1]) if rate > 0.0 else DEFAULT_FPS
