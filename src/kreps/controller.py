"""The policy as its user holds it: predict, save, load."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kreps import storage
from kreps.arrays import FloatArray
from kreps.data import LARGEST, is_sane
from kreps.errors import DataError
from kreps.policies import LearntPolicy
from kreps.seeding import Purpose, generator


class Policy:
    """A learnt stochastic policy, with Stable-Baselines3's signature of `predict`.

    Args:
        process: what it draws from, for REPS a cost-sensitive Gaussian process.
        seed: of the exploration noise in `predict`.
    """

    def __init__(self, process: LearntPolicy, seed: int = 0) -> None:
        self.process = process
        self._noise = generator(seed, Purpose.PREDICT)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[FloatArray, Any]:
        """Actions for one observation or a batch of them, clipped to the task's limits.

        Args:
            observation: (ds,) or (m, ds).
            state, episode_start: accepted for compatibility; this policy has no memory.
            deterministic: the policy without its exploration (the mean of a Gaussian process).

        Returns:
            Action (da,) or actions (m, da) in the task's units, and ``state`` as it came.

        Raises:
            DataError: another shape, NaN or infinities.
        """
        task = self.process.task
        try:
            batch = np.asarray(observation, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise DataError(f"the observation is not an array of numbers: {error}") from error
        if batch.ndim not in (1, 2) or batch.shape[-1] != task.observation_size:
            raise DataError(
                f"the observation has shape {batch.shape}, but ({task.observation_size},) or "
                f"(m, {task.observation_size}) is needed; flatten images first"
            )
        if not is_sane(batch).all():
            raise DataError(
                f"the observation holds NaN, an infinity or a number beyond {LARGEST:g}: "
                "no action is safe there"
            )
        states = np.atleast_2d(batch)
        if deterministic:
            commanded = self.process.greedy(states)
        else:
            noise = self._noise.standard_normal((len(states), task.action_size))
            commanded = self.process.act(states, noise)
        actions = task.clip(commanded)
        return (actions[0] if batch.ndim == 1 else actions), state

    def save(self, path: str | Path) -> None:
        """Write the policy as arrays and JSON; read it back with `kreps.load_policy`."""
        storage.save_policy(self.process, path)


def load_policy(path: str | Path, seed: int = 0) -> Policy:
    """A policy saved by `Policy.save`; ``seed`` is that of its exploration noise.

    Raises:
        StorageError: the file is missing, damaged or foreign.
    """
    return Policy(storage.load_policy(path), seed)
