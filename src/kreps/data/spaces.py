"""How an environment gives observations and takes actions: shapes, and the type of its numbers."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import FloatArray


@dataclass(frozen=True)
class Spaces:
    """The shapes of a Box of observations and a Box of actions.

    Learners and policies compute with vectors; this is the way there and back.

    Attributes:
        observation_shape: of one observation, with ds numbers in all.
        action_shape: of one action, with da numbers in all.
        action_dtype: NumPy's name of the numbers of an action.

    Raises:
        ConfigurationError: something that is no shape, or no type of numbers.
    """

    observation_shape: tuple[int, ...]
    action_shape: tuple[int, ...]
    action_dtype: str = "float64"

    def __post_init__(self) -> None:
        try:
            for name in ("observation_shape", "action_shape"):
                shape = tuple(operator.index(size) for size in getattr(self, name))
                object.__setattr__(self, name, shape)
            kind = np.dtype(self.action_dtype).kind
        except TypeError as error:
            raise ConfigurationError(f"{self} are no spaces: {error}") from error
        if min((1, *self.observation_shape, *self.action_shape)) < 1 or kind not in "fiub":
            raise ConfigurationError(
                f"{self} are no spaces: sizes must be at least 1, actions integers or floats"
            )

    @property
    def sizes(self) -> tuple[int, int]:
        """``(ds, da)``."""
        return math.prod(self.observation_shape), math.prod(self.action_shape)

    @property
    def whole_actions(self) -> bool:
        """Whether actions are integers."""
        return np.dtype(self.action_dtype).kind in "iub"

    def states(self, observations: FloatArray) -> tuple[FloatArray, bool]:
        """Observations as states (m, ds), and whether it was a single one.

        One of the environment's shape is single, and what has one axis more is a batch.  Flattened
        observations, (ds,) or (m, ds), are taken too.

        Raises:
            DataError: another shape.
        """
        shape, size = observations.shape, self.sizes[0]
        single = shape == self.observation_shape
        if single or shape[1:] == self.observation_shape or shape[1:] == (size,):
            return observations.reshape(-1, size), single
        if shape == (size,):
            return observations[None], True
        flat = "" if self.observation_shape == (size,) else f", or flattened ({size},)"
        raise DataError(
            f"the observation has shape {shape}, but {self.observation_shape}{flat} is needed, "
            "with one axis more in front for several"
        )

    def actions(self, applied: FloatArray) -> NDArray[Any]:
        """Applied actions (..., da) in the shape and the numbers of the environment."""
        whole = np.rint(applied) if self.whole_actions else applied
        return whole.astype(self.action_dtype).reshape((*applied.shape[:-1], *self.action_shape))
