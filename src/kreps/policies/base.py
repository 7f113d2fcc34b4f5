"""The interfaces of policies."""

from __future__ import annotations

from typing import Protocol

from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray


class StochasticPolicy(Protocol):
    """A map from states and standard normal noise to commanded (unclipped) actions."""

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        """Commanded actions (m, da) for states (m, ds) and noise (m, da), in the task's units."""
        ...


class LearntPolicy(StochasticPolicy, Protocol):
    """A policy that also has actions without exploration."""

    @property
    def task(self) -> TaskSpec: ...

    def greedy(self, states: FloatArray) -> FloatArray:
        """Actions (m, da) at states (m, ds) without exploration, in the task's units."""
        ...
