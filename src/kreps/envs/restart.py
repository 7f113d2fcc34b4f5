"""Restarts at random: what turns a task without end into the process that the paper learns on."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from kreps.errors import ConfigurationError
from kreps.seeding import Purpose, generator

LONGEST = 2.0**62
"""Steps that fit into an integer: a restart may be as unlikely as one likes."""


def restart_length(rng: np.random.Generator, probability: float) -> int:
    """Steps until a restart: at least one, ``(1 - p) / p`` on expectation (Sec. 4.1: 49)."""
    return max(1, int(rng.geometric(probability)) - 1)


def stratified_lengths(rng: np.random.Generator, probability: float, count: int) -> list[int]:
    """So many lengths (count,), each as likely as `restart_length`'s are, but not independent.

    One is drawn from each of ``count`` equally likely ranges of lengths, in random order, so that
    their sum is nearly what is expected.  At p = 0.02 thirty have 1,470 steps give or take 50, and
    270 if they are independent; ten have 490, give or take 50 too: it is of the last range.
    """
    # scipy.stats.qmc.LatinHypercube draws alike, but its import takes longer than that of kreps
    survivals = (count - rng.permutation(count) - rng.random(count)) / count
    until_restart = np.ceil(np.log(survivals) / np.log1p(-probability))
    return np.clip(until_restart - 1.0, 1.0, LONGEST).astype(np.int64).tolist()


class RandomRestart(gym.Wrapper[Any, Any, Any, Any]):
    """Truncates each episode after a random number of steps, whatever the environment.

    A restart belongs to the process that is learnt on, but the successor it interrupts is real:
    so it comes as ``truncated``, with the true successor as the last observation and
    ``info["restart"] = True``.  The learner is told p and handles restarts analytically.

    Args:
        env: any Gymnasium environment.
        probability: p, in (0, 1).
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
        elif self._rng is None:  # never seeded: as random as the environment itself
            self._rng, _ = gym.utils.seeding.np_random()
        self._left = restart_length(self._rng, self.restart_probability)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._left -= 1
        if self._left <= 0 and not terminated:
            truncated, info = True, {**info, "restart": True}
        return observation, reward, terminated, truncated, info
