"""The vectorised form of an environment, which simulates many rollouts at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from kreps.kernels.arrays import BoolArray, FloatArray


class BatchModel(Protocol):
    """m independent copies of an environment, each with its own random generator.

    An environment with an attribute ``batch_model`` is simulated by it.  For each copy it must draw
    the same random numbers as the environment, so that both give the same rollouts from the same
    seeds.  States are internal to the simulator; only observations are learnt from.
    """

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        """Start states (m, k)."""
        ...

    def observe(self, states: FloatArray) -> FloatArray:
        """Observations (m, ds) of states (m, k)."""
        ...

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Successors (m, k), rewards (m,) and whether the task ended (m,), for actions (m, da)."""
        ...


class SettableModel(BatchModel, Protocol):
    """A batch model that can be set to any state."""

    def states_at(self, observations: FloatArray) -> FloatArray:
        """The states (m, k) with these observations (m, ds)."""
        ...
