"""Policies as files: the task they act in, and one of five kinds of policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kreps.data.spaces import Spaces
from kreps.data.task import TaskSpec
from kreps.errors import StorageError
from kreps.kernels.arrays import FloatArray, default_errstate
from kreps.kernels.kernel import Kernel, WrapAngle, wrap_factors
from kreps.kernels.threads import blas_threads
from kreps.learning.storage.codec import (
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE,
    Array,
    Converted,
    Limit,
    Node,
    Number,
    OneOf,
    Optional,
    Plain,
    Record,
    StoredArrays,
    Tensors,
)
from kreps.learning.storage.files import MAX_FILE_BYTES, reading, warn_of, write_arrays
from kreps.policies.base import LearntPolicy
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT, CostSensitiveGP
from kreps.policies.relative_softmax import RelativeSoftmaxPolicy
from kreps.policies.sparse_gp import SparseGP
from kreps.policies.value_based import LipschitzPolicy, SoftmaxPolicy

TASK = Record(
    TaskSpec,
    {
        "observation_size": Plain(),
        "action_low": Plain(),
        "action_high": Plain(),
        "periodic": Plain(),
        "groups": Plain(),
        "image_shape": Plain(),
        "spaces": Optional(
            Record(
                Spaces,
                {
                    "observation_shape": Plain(),
                    "action_shape": Plain(),
                    "action_dtype": Plain(),
                },
            )
        ),
        "dt": Plain(),
        "time_limit": Plain(),
        "action_repeat": Plain(),
        "delay": Plain(),
        "history": Plain(),
    },
    absent={
        "spaces": None,
        "dt": None,
        "time_limit": None,
        "action_repeat": 1,
        "delay": 0,
        "history": 0,
    },
)

LENGTHSCALES = Limit("between 1e-100 and 1e100", lambda v: (v > 1e-100) & (v < 1e100))
TEMPERATURE = Limit("0 or above 1e-100", lambda v: (v == 0) | (v > 1e-100))


@dataclass(frozen=True)
class StoredKernel:
    """A kernel over states; the task decides its factors, except those of wrapping angles.

    Attributes:
        lengthscales: (g + w,) of the factors of the task, then of those of wrapping angles.
        wraps: (w,) where each angle wraps, in rad; w is 0 or the number of angles of the task.
    """

    lengthscales: FloatArray
    wraps: FloatArray


def _stored_kernel(kernel: Kernel) -> StoredKernel:
    wraps = [factor.begin for factor in kernel.factors if isinstance(factor, WrapAngle)]
    return StoredKernel(kernel.lengthscales, np.array(wraps, dtype=np.float64))


def _kernel(stored: StoredKernel, given: Mapping[str, Any]) -> Kernel:
    task: TaskSpec = given["task"]
    wraps = stored.wraps.tolist()
    if len(wraps) not in (0, len(task.periodic)):
        raise StorageError(
            f"a kernel has wraps of {len(wraps)} angles, but the task has {len(task.periodic)}"
        )
    factors = wrap_factors(task.periodic[: len(wraps)], wraps)
    return Kernel((*task.state_factors, *factors), stored.lengthscales)


def kernel_schema(wraps: str | int) -> Converted:
    """A kernel over states with so many wrapping angles: a number, or a letter for any."""
    lengthscales = f"g+{wraps}" if wraps else "g"
    return Converted(
        Record(
            StoredKernel,
            {"wraps": Array((wraps,)), "lengthscales": Array((lengthscales,), LENGTHSCALES)},
        ),
        _stored_kernel,
        _kernel,
    )


SUPPORT = (1, MAX_SUPPORT)


def _kernel_and_states(m: str) -> dict[str, Node]:
    return {"kernel": kernel_schema(wraps=0), "states": Array((m, "ds"))}


def gaussian_processes(m: str) -> dict[str, Record]:
    """Gaussian-process policies of m support points, by kind; m is the letter of their number."""
    cost_sensitive = Record(
        CostSensitiveGP,
        {
            **_kernel_and_states(m),
            "targets": Array((m, "da")),
            "weights": Array((m,), POSITIVE),
            "signal": Number(POSITIVE),
            "noise": Number(POSITIVE),
        },
        given=("task",),
        ranges={m: SUPPORT},
    )
    sparse = Record(
        SparseGP,
        {
            **_kernel_and_states(m),
            "mean_weights": Array((m, "da")),
            "explained": Array((m, m)),
            "signal": Number(POSITIVE),
            "noise": Number(POSITIVE),
        },
        given=("task",),
        ranges={m: SUPPORT},
    )
    return {"cost-sensitive-gp": cost_sensitive, "sparse-gp": sparse}


_SOFTMAX: dict[str, Node] = {
    **_kernel_and_states("m"),
    "table": Array(("m", "k")),
    "candidates": Array(("k", "da")),
    "offset": Number(),
    "temperature": Number(TEMPERATURE),
}
_SOFTMAX_SIZES = {"m": SUPPORT, "k": (1, MAX_SUPPORT)}

POLICY = OneOf(
    {
        **gaussian_processes("m"),
        "softmax": Record(SoftmaxPolicy, _SOFTMAX, given=("task",), ranges=_SOFTMAX_SIZES),
        "relative-softmax": Record(
            RelativeSoftmaxPolicy,
            {**_SOFTMAX, "action_rewards": Array(("k",))},
            given=("task",),
            ranges=_SOFTMAX_SIZES,
        ),
        "lipschitz": Record(
            LipschitzPolicy,
            {
                **_kernel_and_states("m"),
                "actions": Array(("m", "da")),
                "bounds": Array(("m",)),
                "slope": Number(NOT_NEGATIVE),
                "noise_fraction": Number(FRACTION),
                "noise_scale": Number(NOT_NEGATIVE),
            },
            given=("task",),
            ranges={"m": SUPPORT},
        ),
    }
)
"""Kinds of policies by their names in files.  Sizes: m support points, ds and da coordinates of
states and actions, g factors of the kernel, k candidate actions."""


def decode_task(header: Mapping[str, Any]) -> TaskSpec:
    """The task that a header holds; its constructor checks it."""
    task: TaskSpec
    (task,) = StoredArrays.from_memory({}).decode([("task", TASK, header["task"])], {})
    return task


def task_sizes(task: TaskSpec) -> dict[str, int]:
    """The sizes that the task decides."""
    return {
        "g": task.factor_count,
        "do": task.observation_size,
        "ds": task.state_size,
        "da": task.action_size,
    }


def save_policy(policy: LearntPolicy, path: str | Path, max_bytes: int = MAX_FILE_BYTES) -> None:
    """Write a policy to a file of at most ``max_bytes``.

    Raises:
        StorageError: another kind of policy, one that could not be loaded, or the file cannot be
            written.
    """
    tensors: Tensors = {}
    header = {
        "task": TASK.encode(policy.task, "task", tensors),
        "policy": POLICY.encode(policy, "policy", tensors),
    }
    nodes = [("policy", POLICY, header["policy"])]
    StoredArrays.from_memory(dict(tensors)).check(nodes, **task_sizes(policy.task))
    write_arrays(path, "policy", tensors, header, max_bytes)


def load_policy(path: str | Path) -> LearntPolicy:
    """A policy written by `save_policy`, of this or an earlier version.

    Raises:
        StorageError: the file is missing, damaged or foreign.
    """
    # with one thread, as in learning, so that the policy is the same to the last bit
    with reading(path, "policy") as (arrays, header), blas_threads(1), default_errstate():
        task = decode_task(header)
        policy: LearntPolicy
        nodes = [("policy", POLICY, header["policy"])]
        (policy,) = arrays.decode(nodes, {"task": task}, **task_sizes(task))
    warn_of(path, header, stacklevel=3)
    return policy
