"""Array types, and conversions between array libraries.

Everything that grows with the number of samples is computed in the array library of the samples:
NumPy, or any other that follows the array API standard, such as CuPy and PyTorch.  Results of the
size of a basis are NumPy arrays on the CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import array_api_compat
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

Array = Any
"""An array of float64 of any library that follows the array API standard."""


def default_errstate() -> np.errstate:
    """A context, or decorator, in which floating-point errors are handled as by default in NumPy.

    Kernel values far from all samples underflow to zero.  That is no error, also for a caller who
    looks for errors of their own by ``np.seterr(all="raise")``.
    """
    return np.errstate(all="warn", under="ignore")


def as_float(values: Any) -> FloatArray:
    """``values`` as a float64 array; no copy if it is one already."""
    return np.asarray(values, dtype=np.float64)


def namespace(array: Array) -> Any:
    """The array API namespace of the library that ``array`` belongs to."""
    return np if isinstance(array, np.ndarray) else array_api_compat.array_namespace(array)


def like(values: FloatArray, other: Array) -> Array:
    """``values`` in the library and on the device of ``other``."""
    if isinstance(other, np.ndarray):
        return values
    device = array_api_compat.device(other)
    return array_api_compat.array_namespace(other).asarray(values, device=device)


def as_numpy(array: Array) -> FloatArray:
    """``array`` as a NumPy array on the CPU; no copy if it is one already."""
    if isinstance(array, np.ndarray):
        return array
    if array_api_compat.is_torch_array(array):
        return array.cpu().numpy()
    if array_api_compat.is_cupy_array(array):
        return array.get()
    return as_float(np.from_dlpack(array, device="cpu"))


def columns(array: Array, chosen: Sequence[int] | IntArray) -> Array:
    """``array[:, chosen]``, also for libraries without indexing by arrays."""
    if isinstance(array, np.ndarray):
        return array[:, chosen]
    xp = namespace(array)
    return xp.take(array, xp.asarray(chosen, device=array_api_compat.device(array)), axis=1)


def rows(array: Array, chosen: IntArray) -> Array:
    """``array[chosen]``, also for libraries without indexing by arrays."""
    if isinstance(array, np.ndarray):
        return array[chosen]
    xp = namespace(array)
    return xp.take(array, xp.asarray(chosen, device=array_api_compat.device(array)), axis=0)


def grid_points(axes: Sequence[FloatArray]) -> FloatArray:
    """All combinations (m, d) of one value from each of d axes; the last axis varies fastest."""
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
