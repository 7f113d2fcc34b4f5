"""Gymnasium environments that are simulated by a batch model with a single row."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from kreps.envs.batch import BatchModel, time_stamps_of
from kreps.errors import DataError
from kreps.intake import as_numbers
from kreps.kernels.arrays import FloatArray


class BatchEnvironment(gym.Env[FloatArray, FloatArray]):
    """An environment whose dynamics are those of its ``batch_model``.

    A subclass sets ``batch_model``, the spaces and `picture`.  Where control periods vary, ``info``
    has the time since the start in s, under ``"time"``.
    """

    batch_model: BatchModel

    def __init__(
        self,
        render_mode: str | None,
        observation_space: gym.spaces.Space[Any],
        action_space: gym.spaces.Space[Any],
    ) -> None:
        self.render_mode = render_mode
        self.observation_space = observation_space
        self.action_space = action_space
        self._states = np.empty((0, 0))  # one row after the first reset

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        super().reset(seed=seed)
        self._states = self.batch_model.initial([self.np_random])
        return self._observe(), self._info()

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """One control period.

        Raises:
            DataError: an action of another size, or one that holds NaN or infinities.
        """
        values = as_numbers("actions", action, "check what commands it")
        if values.size != np.prod(self.action_space.shape or ()):
            raise DataError(
                f"actions: shape {values.shape}, but {self.action_space.shape} is needed"
            )
        self._states, rewards, ends = self.batch_model.step(
            self._states, values.reshape(1, -1), [self.np_random]
        )
        return self._observe(), float(rewards[0]), bool(ends[0]), False, self._info()

    def render(self) -> Any:
        return self.picture(self._states[0]) if self.render_mode == "rgb_array" else None

    def picture(self, state: FloatArray) -> NDArray[np.uint8]:
        """The rendered picture (height, width, 3), values 0 to 255, of a state (k,)."""
        raise NotImplementedError

    def _observe(self) -> FloatArray:
        return self.batch_model.observe(self._states)[0].copy()

    def _info(self) -> dict[str, Any]:
        times = time_stamps_of(self.batch_model, self._states)
        return {} if times is None else {"time": float(times[0])}
