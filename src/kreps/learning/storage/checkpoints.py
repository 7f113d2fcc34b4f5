"""Checkpoints as files: everything that a learner needs to continue exactly where it stopped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from kreps.algorithms.state import LearnerState
from kreps.data.rollouts import Rollouts
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.errors import DataError, StorageError
from kreps.kernels.arrays import default_errstate
from kreps.kernels.basis import KernelExpansion
from kreps.kernels.threads import blas_threads
from kreps.learning.storage.codec import (
    Array,
    Converted,
    OneOf,
    Optional,
    Record,
    StoredArrays,
    Tensors,
    Whole,
)
from kreps.learning.storage.files import MAX_FILE_BYTES, reading, warn_of, write_arrays
from kreps.learning.storage.policies import (
    POLICY,
    TASK,
    decode_task,
    gaussian_processes,
    kernel_schema,
    task_sizes,
)
from kreps.learning.storage.rollouts import ROLLOUTS
from kreps.presets import AnySettings, changed, flat
from kreps.settings import LearnerSettings

POLICIES_OF_METHOD = {
    "reps": {"cost-sensitive-gp", "sparse-gp"},
    "value-iteration": {"softmax", "relative-softmax"},
    "grid-value-iteration": {"softmax", "relative-softmax"},
    "npalp": {"lipschitz"},
}
"""Kinds of the policies that each method learns."""


def _stored_window(window: ReplayWindow) -> Rollouts | None:
    return window.rollouts if len(window.rollouts) else None


def _window(stored: Rollouts | None, given: Mapping[str, Any]) -> ReplayWindow:
    window = ReplayWindow(given["task"], given["capacity"], given["min_steps"])
    return window if stored is None else window.append(stored)


VALUE = Record(
    KernelExpansion,
    {"kernel": kernel_schema("w"), "centres": Array(("r", "ds")), "alpha": Array(("r",))},
)
STATE = Record(
    LearnerState,
    {
        "iteration": Whole(),
        "rollouts": Whole(),
        "steps": Whole(),
        "terminated": Converted(Whole(bits=1), int, lambda stored, given: bool(stored)),
        "window": Converted(Optional(ROLLOUTS), _stored_window, _window),
        "policy": Optional(POLICY),
        "explorer": Optional(OneOf(gaussian_processes("e"))),
        "value": Optional(VALUE),
        "embedding_start": Optional(Array(("g+da+1",))),
        "reward_start": Optional(Array(("g+w+da+1",))),
        "policy_start": Optional(Array(("g+2",))),
    },
    absent={"terminated": 0, "explorer": None},
)
"""Sizes beside those of policies: w angles that wrap in V and in the reward model (0 without V),
e support points of the explorer, r centres of V, n steps and R rollouts of the window."""


def _encoded(state: LearnerState, task: TaskSpec) -> tuple[Any, Tensors]:
    """Header and arrays of a state, checked as when they are read."""
    tensors: Tensors = {}
    header = STATE.encode(state, "", tensors)
    arrays = StoredArrays.from_memory(tensors)
    arrays.check([("", STATE, header)], **_sizes(task, header))
    return header, tensors


def _sizes(task: TaskSpec, stored: Mapping[str, Any]) -> dict[str, int]:
    return task_sizes(task) | ({} if stored["value"] is not None else {"w": 0})


def require_storable(state: LearnerState) -> None:
    """Raise `DataError` if what an update has learnt could not be saved and loaded."""
    window = state.window
    try:
        _encoded(replace(state, window=ReplayWindow(window.task, window.capacity)), window.task)
    except StorageError as error:
        raise DataError(
            f"from these rollouts numbers would be learnt that no file can hold: {error}; scale "
            "observations and rewards to numbers around one"
        ) from error


def save_checkpoint(
    path: str | Path,
    method: str,
    state: LearnerState,
    task: TaskSpec,
    settings: LearnerSettings,
    seed: int,
    max_bytes: int = MAX_FILE_BYTES,
) -> None:
    """Write the state of a learner with its task, settings and seed.

    Random generators have no state to store: see `kreps.seeding`.

    Raises:
        StorageError: the file cannot be written, or would have more than ``max_bytes``.
    """
    stored, tensors = _encoded(state, task)
    header = {
        "method": method,
        "task": TASK.encode(task, "task", tensors),
        "settings": flat(settings),
        "seed": seed,
        "state": stored,
    }
    write_arrays(path, "checkpoint", tensors, header, max_bytes)


def load_checkpoint(
    path: str | Path, method: str, settings_type: type[AnySettings]
) -> tuple[LearnerState, TaskSpec, AnySettings, int]:
    """State, task, settings and seed of a learner of this method.

    A checkpoint of version 0.1 whose V is in Fourier features is loaded without V, with a
    `UserWarning`: no update uses the V of the one before.

    Raises:
        StorageError: the file is missing, damaged, foreign, or of another method.
    """
    with reading(path, "checkpoint") as (arrays, header), blas_threads(1), default_errstate():
        if header.get("method") != method:
            raise StorageError(
                f"it is of the method {header.get('method')!s:.40}, not {method}; resume it with "
                "the class of that method"
            )
        task = decode_task(header)
        if not isinstance(header["settings"], dict):
            raise StorageError(f"its settings are {header['settings']!r:.40}, not named values")
        settings = changed(settings_type(), header["settings"])
        Whole(bits=128).check(header["seed"], "seed", {}, {})
        stored = header["state"]
        _check_presence(stored, method)
        given = {
            "task": task,
            "capacity": settings.window,
            "min_steps": settings.window_steps,
        }
        (state,) = arrays.decode([("", STATE, stored)], given, **_sizes(task, stored))
    warn_of(path, header, stacklevel=3)
    return state, task, settings, header["seed"]


def _check_presence(stored: Any, method: str) -> None:
    """Whether the state has the parts that a learner of this method has after its updates."""
    needed = STATE.nodes.keys() - STATE.absent.keys()
    if not isinstance(stored, dict) or not needed <= stored.keys():
        raise StorageError(f"its header has no state with {', '.join(STATE.nodes)}")
    learnt = stored["iteration"] != 0
    policy = stored["policy"]
    kind = policy.get("kind") if isinstance(policy, dict) else None
    if learnt != (policy is not None):
        raise StorageError(f"it has {stored['iteration']!r:.40} updates and policy {policy!r:.40}")
    if learnt and kind not in POLICIES_OF_METHOD[method]:
        raise StorageError(f"it holds a policy {kind!r:.40}, which {method} does not learn")
    if stored["value"] is not None and not (learnt and method == "reps"):
        raise StorageError("it holds a V in an RKHS, but its method has not learnt one")
    if learnt and method != "reps" and stored["window"] is None:
        raise StorageError("it holds no rollouts, which only learners from data sets are without")
