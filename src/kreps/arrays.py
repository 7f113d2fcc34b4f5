"""The array types the library speaks, and the one conversion at its border."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


def as_float(values: Any) -> FloatArray:
    """``values`` as a float64 array; no copy if it is one already."""
    return np.asarray(values, dtype=np.float64)


def grid_points(axes: Sequence[FloatArray]) -> FloatArray:
    """Every combination (m, d) of one value of each of d axes; the last axis runs fastest."""
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
