"""The vectorised form of a task: many independent roll-outs advanced by one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from kreps.kernels.arrays import BoolArray, FloatArray


class BatchModel(Protocol):
    """m copies of a task in lock step, each with its own generator.

    An environment that offers one as its attribute ``batch_model`` is simulated in batches.  It
    must draw from the generators exactly what the environment draws from its own, so that both
    forms give the same trajectories from the same seeds.  States are the simulator's own; the
    learner sees only what `observe` makes of them.
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
        """Successors (m, k), rewards (m,) and ends (m,) for actions (m, da)."""
        ...


class SettableModel(BatchModel, Protocol):
    """A simulator that can be started anywhere, which robots and most environments cannot."""

    def states_at(self, observations: FloatArray) -> FloatArray:
        """States (m, k) that are observed as ``observations`` (m, ds)."""
        ...
