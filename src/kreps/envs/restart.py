"""Random restarts, which make the ergodic process of the paper (Sec. 4.1) of any environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from kreps.errors import ConfigurationError
from kreps.seeding import Purpose, generator

MAX_LENGTH = 2.0**62
"""Longest rollout: its number of steps must fit into an integer, however small p is."""


def restart_length(rng: np.random.Generator, probability: float) -> int:
    """Number of steps until a restart: at least one, ``(1 - p) / p`` in expectation.

    At p = 0.02 these are 49 (Sec. 4.1).
    """
    return max(1, int(rng.geometric(probability)) - 1)


def stratified_lengths(rng: np.random.Generator, probability: float, count: int) -> list[int]:
    """Lengths (count,) with the distribution of `restart_length` each, by stratified sampling.

    One is drawn from each of ``count`` equally likely ranges of lengths, in random order, so that
    their sum varies little.  At p = 0.02, 30 lengths have 1,470 steps in all with a standard
    deviation of 50, in place of 270 if they were independent.  Nearly all of it is due to the last
    range, so that of 10 lengths, with 490 steps, is also 50.
    """
    # scipy.stats.qmc.LatinHypercube does the same, but importing it takes longer than kreps does
    survivals = (count - rng.permutation(count) - rng.random(count)) / count
    until_restart = np.ceil(np.log(survivals) / np.log1p(-probability))
    return np.clip(until_restart - 1.0, 1.0, MAX_LENGTH).astype(np.int64).tolist()


class RandomRestart(gym.Wrapper[Any, Any, Any, Any]):
    """Truncates each episode after a random number of steps.

    The last observation is the successor of the last step, before the restart.  The step returns
    ``truncated = True`` and ``info["restart"] = True``.  Learners take p from the wrapper and
    include restarts in their equations.

    Args:
        env: any Gymnasium environment.
        probability: p, in (0, 1), of a restart at each step.

    Raises:
        ConfigurationError: a probability outside (0, 1).
    """

    def __init__(self, env: gym.Env[Any, Any], probability: float = 0.02) -> None:
        super().__init__(env)
        if isinstance(probability, str) or not 0.0 < probability < 1.0:
            raise ConfigurationError(
                f"restart probability = {probability!r}, but it must lie in (0, 1)"
            )
        self.restart_probability = probability
        self._rng: np.random.Generator | None = None
        self._left = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = generator(seed, Purpose.RESTART)
        elif self._rng is None:  # never seeded, so from fresh entropy as Gymnasium does
            self._rng, _ = gym.utils.seeding.np_random()
        self._left = restart_length(self._rng, self.restart_probability)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._left -= 1
        if self._left <= 0 and not terminated:
            truncated, info = True, {**info, "restart": True}
        return observation, reward, terminated, truncated, info
