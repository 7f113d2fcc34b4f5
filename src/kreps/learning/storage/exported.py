"""What exported policies share, as ONNX models and as C: their numbers and their precision.

Exported policies compute kernel values from differences of coordinates, not from inner products as
in `kreps.kernels.gram.gaussian_gram`: inner products are faster in large batches, but their
rounding errors in the exponent are up to ``|e|^2`` times as large.  In single precision that would
be too much, as weights are large, of alternating sign, and multiply each error of a kernel value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.policies.sparse_gp import SparseGP

Number = type[np.floating[Any]]

DTYPES: dict[str, Number] = {"float64": np.float64, "float32": np.float32}

SINGLE_PRECISION_TOLERANCE = 1e-4
"""Largest error of the mean that single precision may cause, in units of the action scale."""


def arithmetic_of(policy: SparseGP, dtype: str, tolerance: float) -> str:
    """The type of the arithmetic of a policy whose input and output have type ``dtype``.

    It is the same type, unless `single_precision_error` is above the tolerance; then it is float64.

    Raises:
        ConfigurationError: another dtype.
    """
    if dtype not in tuple(DTYPES):  # a tuple, as dtype may not be hashable
        raise ConfigurationError(
            f"dtype = {dtype!r:.40}, but a policy is exported in one of {', '.join(DTYPES)}"
        )
    return dtype if single_precision_error(policy) <= tolerance else "float64"


def single_precision_error(policy: SparseGP) -> float:
    """Upper estimate of the error of the mean in single precision, in units of the action scale.

    The relative error of a kernel value ``k_j`` is a few times 2^-24.  The error of the mean is
    then that much of ``sum_j k_j |w_j|``, which is largest near the centres.  Measured errors were
    less than half of this estimate.
    """
    k = policy.kernel.gram(policy.states)
    magnitude = float((k @ np.abs(policy.mean_weights)).max(initial=0.0))
    return 2.0 * float(np.finfo(np.float32).eps) * magnitude


@dataclass(frozen=True)
class Coordinates:
    """How kernel coordinates are scaled: ``(coordinates - origin) * per_lengthscale``.

    Attributes:
        origin: (e,) representable in the type of the arithmetic.  It is subtracted from states and
            centres before the division by lengthscales: differences near the centres then keep all
            digits, wherever the centres lie.
        per_lengthscale: (e,) reciprocal lengthscales.
        centres: (r, e) scaled coordinates of the centres.
    """

    origin: FloatArray
    per_lengthscale: FloatArray
    centres: FloatArray


def coordinates_of(policy: SparseGP, arithmetic: Number) -> Coordinates:
    """The scaled coordinates of a policy that is computed in ``arithmetic``."""
    kernel = policy.kernel
    parts = [factor.coordinates(policy.states) for factor in kernel.factors]
    raw = np.concatenate(parts, axis=1)
    with np.errstate(over="ignore"):  # `rounded` raises an error with the name
        origin = raw.mean(axis=0).astype(arithmetic).astype(np.float64)
    per_length = 1.0 / np.repeat(kernel.lengthscales, [part.shape[1] for part in parts])
    return Coordinates(origin, per_length, (raw - origin) * per_length)


def rounded(name: str, values: Any, dtype: Number) -> NDArray[Any]:
    """Values in a type; ``name`` is what they are called in the error.

    Raises:
        ConfigurationError: one is too large for it.
    """
    array = np.asarray(values, dtype=np.float64)
    with np.errstate(over="ignore"):
        result = array.astype(dtype)
    if not np.isfinite(result).all():
        raise ConfigurationError(
            f"{name} of the policy go up to {np.abs(array).max():.3g}, the limit of "
            f"{np.dtype(dtype).name} is {np.finfo(dtype).max:.3g}; "
            "export it in float64, or learn in other units"
        )
    return result


def inwards(limit: FloatArray, centre: FloatArray, dtype: Number) -> NDArray[Any]:
    """``limit`` rounded to ``dtype`` towards ``centre``, so that no action is beyond it."""
    with np.errstate(over="ignore"):
        near = limit.astype(dtype)
    beyond = np.abs(near.astype(np.float64) - centre) > np.abs(limit - centre)
    return np.where(beyond, np.nextafter(near, centre.astype(dtype)), near)


def has_lags(task: TaskSpec) -> bool:
    """Whether states have more than the observation."""
    return task.state_size > task.observation_size


def lags_size(task: TaskSpec) -> int:
    """Number of earlier observations and actions, h do + k da."""
    return task.state_size - task.observation_size
