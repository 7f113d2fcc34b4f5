"""Policies and checkpoints as files: named float64 arrays (safetensors) and one JSON header.

Reading trusts nothing: a file is checked for kind, version, size, names, shapes and finite values
before it is used, and whatever is wrong with it comes out as `StorageError`.  Writing is
atomic: a reader, or a run killed at any moment, sees the old file or the new one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from kreps.algorithms.state import LearnerState
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec, is_sane
from kreps.data.window import ReplayWindow
from kreps.errors import DataError, KrepsError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import FourierExpansion, KernelExpansion, LinearFunction
from kreps.kernels.kernel import Kernel, WrapAngle, wrap_factors
from kreps.kernels.threads import blas_threads
from kreps.legacy import checkpoint_settings
from kreps.policies.base import LearntPolicy
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT, CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP
from kreps.policies.value_based import LipschitzPolicy, SoftmaxPolicy
from kreps.presets import AnySettings, changed, flat
from kreps.settings import LearnerSettings

VERSION = 2
MAX_FILE_BYTES = 2**30
MAX_HEADER_BYTES = 2**22

POLICY_ARRAYS = {
    "policy.lengthscales",
    "policy.states",
    "policy.targets",
    "policy.weights",
    "policy.signal_and_noise",
    "policy.mean_weights",
    "policy.explained",
    "policy.table",
    "policy.candidates",
    "policy.offset_and_temperature",
    "policy.actions",
    "policy.bounds",
    "policy.slope_and_noise",
}
ROLLOUT_ARRAYS = {
    "window.lengths",
    "window.terminated",
    "window.observations",
    "window.actions",
    "window.rewards",
}
CHECKPOINT_ARRAYS = (
    POLICY_ARRAYS
    | ROLLOUT_ARRAYS
    | {
        "value.lengthscales",
        "value.cuts",
        "value.centres",
        "value.alpha",
        "value.frequencies",
        "value.theta",
        "start.policy",
        "start.embedding",
        "start.reward",
    }
)

ARRAYS = {"policy": POLICY_ARRAYS, "rollouts": ROLLOUT_ARRAYS, "checkpoint": CHECKPOINT_ARRAYS}

Tensors = dict[str, FloatArray]
Header = dict[str, Any]


# ---- files ------------------------------------------------------------------------------------


def write_atomically(path: Path, content: bytes) -> None:
    """Replace the file as a whole; the directory must exist."""
    if not path.name or "\0" in str(path):
        raise StorageError(f"{str(path)!r} does not name a file")
    concat = path.with_name(f".{path.name}.part")
    try:
        with open(concat, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        concat.replace(path)
    except OSError as error:
        with suppress(OSError):
            concat.unlink()
        raise StorageError(
            f"cannot write {path}: {error}; check the folder and its space"
        ) from error


def write_arrays(path: Path, kind: str, tensors: Tensors, header: Header) -> None:
    """Write arrays and a JSON header; the same content gives the same bytes."""
    known = {"kind": kind, "version": VERSION, "arrays": sorted(tensors)}
    text = json.dumps({**known, **header}, sort_keys=True)
    if len(text) > MAX_HEADER_BYTES // 2:  # quoting may double it
        raise StorageError(
            f"the header of {path} would have {len(text)} bytes, the limit is "
            f"{MAX_HEADER_BYTES // 2}; observe with fewer coordinates, such as smaller images"
        )
    arrays = {name: np.ascontiguousarray(tensors[name]) for name in sorted(tensors)}
    content = safetensors.numpy.save(arrays, metadata={"kreps": text})
    if len(content) > MAX_FILE_BYTES:
        raise StorageError(
            f"{path} would have {len(content)} bytes, the limit is {MAX_FILE_BYTES}; keep fewer "
            "roll-outs by a smaller window, or observe with fewer coordinates"
        )
    write_atomically(path, content)


def read_header(path: Path, kind: str) -> Header:
    """What `write_arrays` wrote beside the arrays.

    Raises:
        StorageError: missing, unreadable, damaged, too large, or of another kind or version.
    """
    with _reading(path, kind) as file:
        return _header(file.metadata(), kind)


def read_arrays(path: Path, kind: str) -> tuple[Tensors, Header]:
    """Read what `write_arrays` wrote.

    Raises:
        StorageError: missing, unreadable, damaged, too large, of another kind or version, or
            holding anything but finite float64 arrays.
    """
    with _reading(path, kind) as file:
        header = _header(file.metadata(), kind)
        names = list(file.keys())
        for name in names:
            if name not in ARRAYS[kind]:
                raise StorageError(f"a {kind} has no array {name!r:.60}")
            if file.get_slice(name).get_dtype() != "F64":
                raise StorageError(f"array {name!r} is not of 64-bit floats")
        promised = header.get("arrays")
        if not isinstance(promised, list):
            raise StorageError("its header does not name its arrays")
        missing = [n for n in promised if n not in names]
        if missing:
            raise StorageError(f"array {missing[0]!r:.60} is missing")
        if len(promised) != len(names):
            raise StorageError("it holds arrays that its header does not name")
        tensors = {n: np.asarray(file.get_tensor(n)) for n in names}
    for name, values in tensors.items():
        if not is_sane(values).all():
            raise StorageError(
                f"{path} holds NaN, infinities or absurdly large numbers in {name!r}: it is damaged"
            )
    return tensors, header


@contextmanager
def _reading(path: Path, kind: str) -> Iterator[Any]:
    """The open file; whatever goes wrong comes out as `StorageError`."""
    try:
        if not path.is_file():
            raise StorageError(f"{path} is not a file; check the path")
        _check_size(path)
        with safetensors.safe_open(path, framework="numpy") as file:
            yield file
    except StorageError as error:
        raise StorageError(f"cannot read {path} as a kreps {kind}: {error}") from error
    except (
        OSError,
        ValueError,
        TypeError,
        MemoryError,
        RecursionError,
        safetensors.SafetensorError,
    ) as error:
        raise StorageError(
            f"cannot read {path} as a kreps {kind}: {error}; "
            "the file is damaged or comes from another program"
        ) from error


def _check_size(path: Path) -> None:
    """Bound what the reader may allocate before it parses anything."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise StorageError(f"it has {size} bytes, the limit is {MAX_FILE_BYTES}")
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
    if size < 8 or length > min(MAX_HEADER_BYTES, size - 8):
        raise StorageError(
            f"its header would have {length} bytes, the limit is {MAX_HEADER_BYTES} "
            f"in a file of {size}; it is damaged or not a safetensors file"
        )


def _header(metadata: dict[str, str] | None, kind: str) -> Header:
    header = json.loads((metadata or {}).get("kreps", "null"))
    if not isinstance(header, dict) or "kind" not in header:
        raise StorageError("it has no kreps header: it comes from another program")
    if header["kind"] != kind:
        raise StorageError(f"it is a kreps {header['kind']!s:.40}")
    if header.get("version") != VERSION:
        raise StorageError(
            f"it has format version {header.get('version')!s:.20}, this release reads {VERSION}; "
            "read it with the release that wrote it"
        )
    return header


def _take(tensors: Tensors, shapes: dict[str, tuple[str | int, ...]], **sizes: int) -> Tensors:
    """The named arrays, after all letters in their shapes have been matched with each other."""
    for name, shape in shapes.items():
        if name not in tensors:
            raise StorageError(f"array {name!r} is missing")
        found = tensors[name].shape
        matches = len(found) == len(shape) and all(
            size == (sizes.setdefault(letter, size) if isinstance(letter, str) else letter)
            for letter, size in zip(shape, found, strict=True)
        )
        if not matches:
            raise StorageError(f"array {name!r} has shape {found}, but {shape} is needed")
    return {name: tensors[name] for name in shapes}


# ---- parts ------------------------------------------------------------------------------------


def _task_header(task: TaskSpec) -> Header:
    return {
        "observation_size": task.observation_size,
        "action_low": task.action_low.tolist(),
        "action_high": task.action_high.tolist(),
        "periodic": list(task.periodic),
        "groups": [list(group) for group in task.groups],
        "image_shape": None if task.image_shape is None else list(task.image_shape),
    }


def _task_of(header: Header) -> TaskSpec:
    fields = header["task"]
    return TaskSpec(
        int(fields["observation_size"]),
        fields["action_low"],
        fields["action_high"],
        tuple(fields["periodic"]),
        tuple(tuple(group) for group in fields["groups"]),
        fields["image_shape"],
    )


def _state_kernel(task: TaskSpec, lengthscales: FloatArray, cuts: Sequence[float] = ()) -> Kernel:
    if not ((lengthscales > 1e-50) & (lengthscales < 1e50)).all():
        raise StorageError(f"lengthscales {lengthscales} are not all between 1e-50 and 1e50")
    cut = wrap_factors(task.periodic[: len(cuts)], cuts)  # all of them, or none
    return Kernel((*task.state_factors, *cut), lengthscales)


def _process_parts(policy: CostSensitiveGP) -> Tensors:
    return {
        "policy.targets": policy.targets,
        "policy.weights": policy.weights,
        "policy.signal_and_noise": np.array([policy.signal, policy.noise]),
    }


def _process_of(
    tensors: Tensors, task: TaskSpec, kernel: Kernel, states: FloatArray
) -> CostSensitiveGP:
    t = _take(
        tensors,
        {
            "policy.targets": ("m", "da"),
            "policy.weights": ("m",),
            "policy.signal_and_noise": (2,),
        },
        m=len(states),
        da=task.action_size,
    )
    weights, variances = t["policy.weights"], t["policy.signal_and_noise"]
    if not ((weights > 0).all() and (variances > 0).all()):
        raise StorageError("the policy has weights or variances <= 0")
    with blas_threads(1):  # as while learning, so that it is the same policy to the last bit
        return CostSensitiveGP(
            task=task,
            kernel=kernel,
            states=states,
            targets=t["policy.targets"],
            weights=weights,
            signal=float(variances[0]),
            noise=float(variances[1]),
        )


def _sparse_parts(policy: SparseGP) -> Tensors:
    return {
        "policy.mean_weights": policy.mean_weights,
        "policy.explained": policy.explained,
        "policy.signal_and_noise": np.array([policy.signal, policy.noise]),
    }


def _sparse_of(tensors: Tensors, task: TaskSpec, kernel: Kernel, states: FloatArray) -> SparseGP:
    t = _take(
        tensors,
        {
            "policy.mean_weights": ("m", "da"),
            "policy.explained": ("m", "m"),
            "policy.signal_and_noise": (2,),
        },
        m=len(states),
        da=task.action_size,
    )
    signal, noise = t["policy.signal_and_noise"].tolist()
    if not (signal > 0 and noise > 0):
        raise StorageError("the policy has variances <= 0")
    return SparseGP(
        task, kernel, states, t["policy.mean_weights"], t["policy.explained"], signal, noise
    )


def _softmax_parts(policy: SoftmaxPolicy) -> Tensors:
    return {
        "policy.table": policy.table,
        "policy.candidates": policy.candidates,
        "policy.offset_and_temperature": np.array([policy.offset, policy.temperature]),
    }


def _softmax_of(
    tensors: Tensors, task: TaskSpec, kernel: Kernel, states: FloatArray
) -> SoftmaxPolicy:
    t = _take(
        tensors,
        {
            "policy.table": ("m", "k"),
            "policy.candidates": ("k", "da"),
            "policy.offset_and_temperature": (2,),
        },
        m=len(states),
        da=task.action_size,
    )
    offset, temperature = t["policy.offset_and_temperature"]
    if len(t["policy.candidates"]) == 0 or not (temperature == 0 or temperature > 1e-50):
        raise StorageError("the policy has no candidate actions, or its temperature is no number")
    return SoftmaxPolicy(
        task,
        kernel,
        states,
        t["policy.table"],
        float(offset),
        t["policy.candidates"],
        float(temperature),
    )


def _lipschitz_parts(policy: LipschitzPolicy) -> Tensors:
    return {
        "policy.actions": policy.actions,
        "policy.bounds": policy.bounds,
        "policy.slope_and_noise": np.array(
            [policy.slope, policy.noise_fraction, policy.noise_scale]
        ),
    }


def _lipschitz_of(
    tensors: Tensors, task: TaskSpec, kernel: Kernel, states: FloatArray
) -> LipschitzPolicy:
    t = _take(
        tensors,
        {
            "policy.actions": ("m", "da"),
            "policy.bounds": ("m",),
            "policy.slope_and_noise": (3,),
        },
        m=len(states),
        da=task.action_size,
    )
    slope, fraction, scale = t["policy.slope_and_noise"].tolist()
    if not (slope >= 0 and 0 <= fraction <= 1 and scale >= 0):
        raise StorageError("the policy has a slope or noise that is out of range")
    return LipschitzPolicy(
        task,
        kernel,
        states,
        t["policy.actions"],
        t["policy.bounds"],
        slope,
        fraction,
        scale,
    )


_POLICIES: dict[str, tuple[type[Any], Callable[[Any], Tensors], Callable[..., LearntPolicy]]] = {
    "cost-sensitive-gp": (CostSensitiveGP, _process_parts, _process_of),
    "sparse-gp": (SparseGP, _sparse_parts, _sparse_of),
    "softmax": (SoftmaxPolicy, _softmax_parts, _softmax_of),
    "lipschitz": (LipschitzPolicy, _lipschitz_parts, _lipschitz_of),
}
"""By name in files: the class, what to write of it beside kernel and states, how to read it."""

POLICIES_OF_METHOD = {
    "reps": {"cost-sensitive-gp", "sparse-gp"},
    "value-iteration": {"softmax"},
    "grid-value-iteration": {"softmax"},
    "npalp": {"lipschitz"},
}
"""What each method learns; the first has V in an RKHS beside it."""


def _policy_parts(policy: LearntPolicy) -> tuple[Tensors, str]:
    """The arrays of a policy, and the name of its kind."""
    for kind, (owner, parts, _) in _POLICIES.items():
        if isinstance(policy, owner):
            common = {
                "policy.lengthscales": policy.kernel.lengthscales,
                "policy.states": policy.states,
            }
            return common | parts(policy), kind
    raise StorageError(f"a policy of type {type(policy).__name__} cannot be written to a file")


def _policy_of(tensors: Tensors, task: TaskSpec, kind: str) -> LearntPolicy:
    if kind not in _POLICIES:
        raise StorageError(f"it holds an unknown kind of policy {kind!r:.40}")
    t = _take(
        tensors,
        {"policy.lengthscales": ("factors",), "policy.states": ("m", "ds")},
        factors=task.factor_count,
        ds=task.observation_size,
    )
    states = t["policy.states"]
    if not 0 < len(states) <= MAX_SUPPORT:
        raise StorageError(
            f"the policy has {len(states)} support points, but 1 to {MAX_SUPPORT} are possible"
        )
    read = _POLICIES[kind][2]
    return read(tensors, task, _state_kernel(task, t["policy.lengthscales"]), states)


def _value_parts(value: LinearFunction) -> Tensors:
    common = {"value.lengthscales": value.kernel.lengthscales}
    cuts = [factor.begin for factor in value.kernel.factors if isinstance(factor, WrapAngle)]
    if cuts:
        common["value.cuts"] = np.array(cuts)
    if isinstance(value, FourierExpansion):
        return common | {"value.frequencies": value.frequencies, "value.theta": value.theta}
    assert isinstance(value, KernelExpansion)
    return common | {"value.centres": value.centres, "value.alpha": value.alpha}


def _value_of(tensors: Tensors, task: TaskSpec) -> LinearFunction:
    fourier = "value.frequencies" in tensors
    shapes: dict[str, tuple[str | int, ...]] = (
        {"value.frequencies": ("half", "coordinates"), "value.theta": ("r",)}
        if fourier
        else {"value.centres": ("r", "ds"), "value.alpha": ("r",)}
    )
    cuts: Sequence[float] = ()
    if "value.cuts" in tensors:
        cuts = _take(tensors, {"value.cuts": (len(task.periodic),)})["value.cuts"].tolist()
    t = _take(
        tensors,
        {"value.lengthscales": ("factors",), **shapes},
        factors=task.factor_count + len(cuts),
        ds=task.observation_size,
    )
    kernel = _state_kernel(task, t["value.lengthscales"], cuts)
    if not fourier:
        return KernelExpansion(kernel, t["value.centres"], t["value.alpha"])
    value = FourierExpansion(kernel, t["value.frequencies"], t["value.theta"])
    value(np.zeros((1, task.observation_size)))  # sizes that do not fit are refused here
    return value


def _rollout_parts(rollouts: Rollouts) -> Tensors:
    return {
        "window.lengths": rollouts.lengths.astype(np.float64),
        "window.terminated": rollouts.terminated.astype(np.float64),
        "window.observations": rollouts.points,
        "window.actions": rollouts.actions,
        "window.rewards": rollouts.rewards,
    }


def _rollouts_of(tensors: Tensors, ds: str | int, da: str | int) -> Rollouts:
    t = _take(
        tensors,
        {
            "window.lengths": ("R",),
            "window.terminated": ("R",),
            "window.observations": ("points", ds),
            "window.actions": ("n", da),
            "window.rewards": ("n",),
        },
    )
    return Rollouts.from_arrays(
        t["window.observations"],
        t["window.actions"],
        t["window.rewards"],
        t["window.lengths"],
        t["window.terminated"] != 0,
    )


# ---- roll-outs --------------------------------------------------------------------------------


def save_rollouts(rollouts: Iterable[Rollout], path: str | Path) -> None:
    """Write at least one roll-out to a file; read it back with `load_rollouts`.

    Raises:
        DataError: no roll-out, something else, or different widths.
        StorageError: the file cannot be written.
    """
    flat = Rollouts.from_list([rollouts] if isinstance(rollouts, Rollout) else rollouts)
    if not flat:
        raise DataError("there is no rollout to save; give at least one")
    write_arrays(Path(path), "rollouts", _rollout_parts(flat), {"samples": flat.steps})


def load_rollouts(path: str | Path) -> Rollouts:
    """Rollouts written by `save_rollouts`.

    Raises:
        StorageError: the file is missing, damaged or foreign.
    """
    tensors, _ = read_arrays(Path(path), "rollouts")
    try:
        return _rollouts_of(tensors, "ds", "da")
    except KrepsError as error:
        raise _inconsistent(path, "file of rollouts", error) from error


@dataclass(frozen=True)
class RolloutFile:
    """A file of rollouts as a chunk of a data set, which is read whenever it is needed."""

    path: Path
    steps: int

    def load(self) -> Rollouts:
        rollouts = load_rollouts(self.path)
        if rollouts.steps != self.steps:
            raise StorageError(
                f"{self.path} holds {rollouts.steps} samples, but had {self.steps} when the folder "
                "was opened; open it again"
            )
        return rollouts


def rollout_folder(path: str | Path) -> Dataset:
    """The files of roll-outs (``*.safetensors``) in a folder, in the order of their names.

    Raises:
        StorageError: no such folder, or a file in it that is damaged or foreign.
    """
    folder = Path(path).resolve()  # workers may stand in another one
    if not folder.is_dir():
        raise StorageError(f"{folder} is not a folder; check the path")
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise StorageError(
            f"{folder} holds no *.safetensors; write roll-outs there with kreps.save_rollouts"
        )
    chunks = []
    for file in files:
        samples = read_header(file, "rollouts").get("samples")
        if type(samples) is not int or samples < 1:
            raise StorageError(f"{file} does not say how many samples it holds: it is damaged")
        chunks.append(RolloutFile(file, samples))
    return Dataset(tuple(chunks))


# ---- policies and checkpoints -----------------------------------------------------------------


def save_policy(policy: LearntPolicy, path: str | Path) -> None:
    tensors, kind = _policy_parts(policy)
    write_arrays(Path(path), "policy", tensors, {"task": _task_header(policy.task), "policy": kind})


def load_policy(path: str | Path) -> LearntPolicy:
    """Raises `StorageError` if the file is not an intact policy."""
    tensors, header = read_arrays(Path(path), "policy")
    try:
        return _policy_of(tensors, _task_of(header), header["policy"])
    except (KrepsError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise _inconsistent(path, "policy", error) from error


def save_checkpoint(
    path: str | Path,
    method: str,
    state: LearnerState,
    task: TaskSpec,
    settings: LearnerSettings,
    seed: int,
) -> None:
    """Everything that a learner needs to go on exactly where it stands.

    No generator state is among it, because none exists: see `kreps.seeding`.
    """
    tensors: Tensors = {}
    header: Header = {
        "method": method,
        "task": _task_header(task),
        "settings": flat(settings),
        "seed": seed,
        "iteration": state.iteration,
        "rollouts": state.rollouts,
        "steps": state.steps,
    }
    if len(state.window.rollouts):
        tensors |= _rollout_parts(state.window.rollouts)
    if state.policy is not None:
        parts, header["policy"] = _policy_parts(state.policy)
        tensors |= parts
    if state.value is not None:
        tensors |= _value_parts(state.value)
    if state.embedding_start is not None:
        tensors["start.embedding"] = state.embedding_start
    if state.reward_start is not None:
        tensors["start.reward"] = state.reward_start
    if state.policy_start is not None:
        tensors["start.policy"] = state.policy_start
    write_arrays(Path(path), "checkpoint", tensors, header)


def load_checkpoint(
    path: str | Path, method: str, settings_type: type[AnySettings]
) -> tuple[LearnerState, TaskSpec, AnySettings, int]:
    """State, task, settings and seed of a learner of this method.

    Raises:
        StorageError: the file is not intact, or of another method.
    """
    tensors, header = read_arrays(Path(path), "checkpoint")
    if header.get("method") != method:
        raise StorageError(
            f"{path} is a checkpoint of the method {header.get('method')!s:.40}, not {method}; "
            "resume it with the class of that method"
        )
    try:
        task = _task_of(header)
        settings = changed(settings_type(), checkpoint_settings(header["settings"], method))
        counts = [header[name] for name in ("seed", "iteration", "rollouts", "steps")]
        if not all(type(count) is int and count >= 0 for count in counts):
            raise StorageError(f"seed and counts {counts} are not all whole numbers >= 0")
        seed, iteration, rollouts_seen, steps = counts
        window = ReplayWindow(task, settings.window)
        # a learner that has seen nothing but data sets has no roll-outs
        if ROLLOUT_ARRAYS & tensors.keys() or (iteration > 0 and method != "reps"):
            rollouts = _rollouts_of(tensors, task.observation_size, task.action_size)
            window = window.append(rollouts)
        learnt, g = iteration > 0, task.factor_count
        cut_count = len(tensors.get("value.cuts", ()))  # the reward's kernel has V's cuts
        if learnt and header["policy"] not in POLICIES_OF_METHOD[method]:
            raise StorageError(f"it holds a policy that {method} does not learn")
        state = LearnerState(
            window=window,
            iteration=iteration,
            rollouts=rollouts_seen,
            steps=steps,
            policy=_policy_of(tensors, task, header["policy"]) if learnt else None,
            value=_value_of(tensors, task) if learnt and method == "reps" else None,
            embedding_start=_start_of(tensors, "start.embedding", g + task.action_size + 1),
            reward_start=_start_of(tensors, "start.reward", g + cut_count + task.action_size + 1),
            policy_start=_start_of(tensors, "start.policy", g + 2),
        )
    except (KrepsError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise _inconsistent(path, "checkpoint", error) from error
    return state, task, settings, seed


def _start_of(tensors: Tensors, name: str, size: int) -> FloatArray | None:
    """Log hyper-parameters to start from, where the method has any."""
    return _take(tensors, {name: (size,)})[name] if name in tensors else None


def _inconsistent(path: str | Path, kind: str, error: Exception) -> StorageError:
    what = f"{type(error).__name__}: {error}" if not isinstance(error, KrepsError) else str(error)
    return StorageError(f"{path} is a damaged or forged kreps {kind}: {what}")
