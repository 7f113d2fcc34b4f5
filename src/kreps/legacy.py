"""The one place that translates names of earlier versions, as files of those versions hold them.

Settings are translated in the flat form of `kreps.presets`, files as arrays by name and a header.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.errors import StorageError

# ---- presets and settings ---------------------------------------------------------------------

PRESET_NAMES = {"default": "model_based", "observed": "single_step"}
"""Presets (then "recipes") of version 0.1 that have another name now."""

SETTING_NAMES = {
    "recipe": "preset",
    "restarts": "rollout_lengths",
    "exploration_scale": "exploration.scale",
    "features": "value",
    "grid_size": "value.size",
    "max_rank": "value.max_rank",
    "basis_tolerance": "value.tolerance",
    "angles": "value.angle_wrap",
    "approximation": "low_rank",
    "rank": "low_rank.rank",
    "imagined": "model_based.actions_per_state",
    "imagined_noise": "model_based.proposal_std_scale",
    "imagined_rollouts": "model_based.model_rollout_fraction",
    "judging_rollouts": "model_based.acceptance_rollouts",
    "optimism": "model_based.exploration_bonus",
}
"""Settings of version 0.1 that have another name now."""

ANGLE_WRAPS = {"cut": "discontinuous", "round": "continuous"}

RKHS_SETTINGS = {"max_rank", "basis_tolerance", "angles"}
MODEL_BASED_SETTINGS = {"imagined_noise", "imagined_rollouts", "judging_rollouts", "optimism"}
"""Settings of version 0.1 that had no effect without V in an RKHS, or with ``imagined=0``."""


def present_name(name: str) -> str | None:
    """What a setting of version 0.1 is called now; None if it is not such a name."""
    return SETTING_NAMES.get(name)


def present_preset(name: str) -> str:
    """What a preset is called now."""
    return PRESET_NAMES.get(name, name)


def present_settings(given: Mapping[str, Any], preset: str = "model_based") -> dict[str, Any]:
    """Settings of version 0.1, some or all of a learner's, in the flat form of `kreps.presets`.

    Settings that had no effect are left out: a setting of an absent section would add the section.
    ``approximation`` ``"uniform"`` and ``"fourier"`` become pivoted Cholesky, which replaced them.
    Names and values of the present version stay as they are.

    Args:
        given: changes of a preset, by name.
        preset: the preset that they change, by its old or new name.
    """
    values = dict(given)
    approximation = values.pop("approximation", "auto")
    features = values.pop("features", "rkhs")
    imagined = values.pop("imagined", 4 if present_preset(preset) == "model_based" else 0)
    unused = RKHS_SETTINGS if features == "grid" else {"grid_size"}
    unused = unused | MODEL_BASED_SETTINGS if imagined == 0 else unused
    new = {SETTING_NAMES.get(name, name): v for name, v in values.items() if name not in unused}
    if isinstance(new.get("value.angle_wrap"), str):
        new["value.angle_wrap"] = ANGLE_WRAPS.get(new["value.angle_wrap"], new["value.angle_wrap"])
    if features != "rkhs":  # all presets have V in an RKHS
        new["value"] = features
    if approximation == "exact":
        new["low_rank"] = None
        new.pop("low_rank.rank", None)
    elif approximation in ("pivoted", "uniform", "fourier"):
        new["low_rank.above"] = 0
    elif approximation != "auto":
        new["low_rank"] = approximation  # an unknown kind, which is an error later
    if "imagined" in given:
        no_model = {"model_based": None}
        new |= no_model if imagined == 0 else {"model_based.actions_per_state": imagined}
    return new


ADDED_IN_0_1 = {
    "imagined": 0,
    "exploring_starts": 0.0,
    "imagined_noise": 1.0,
    "imagined_rollouts": 0.0,
    "judging_rollouts": 0,
    "restarts": "independent",
    "optimism": 0.0,
    "angles": "round",
}
"""Settings that the first checkpoints of REPS lack, at the values that mean what these did."""


NOT_IN_0_1 = {"window_steps": 0, "growth": 0.0, "action_repeat": 1}
"""Settings that checkpoints of version 0.1 lack, at the values that mean what it did: its windows
and batches count rollouts, and its actions are never held."""


def checkpoint_settings(stored: Mapping[str, Any], method: str) -> dict[str, Any]:
    """All settings of a checkpoint of version 0.1, in the flat form."""
    if method != "reps":
        return present_settings(stored)
    settings = {**present_settings({**ADDED_IN_0_1, **stored}), **NOT_IN_0_1}
    if settings.get("model_based", True) is not None:
        for name in ("improvement_steps", "random_policies", "regulators", "gradient_steps"):
            settings[f"model_based.{name}"] = 0
    return settings


# ---- progress.csv -----------------------------------------------------------------------------

PROGRESS_COLUMNS = {
    "refused": "rejected",
    "cpu_seconds_imagined_step": "cpu_seconds_generated_samples",
    "cpu_seconds_judgement": "cpu_seconds_acceptance_test",
}
"""Columns of ``progress.csv`` of version 0.1 that have another name now."""


def present_columns(columns: Sequence[str]) -> tuple[str, ...]:
    """Columns of ``progress.csv``, of this or an earlier version, by their present names."""
    return tuple(PROGRESS_COLUMNS.get(name, name) for name in columns)


# ---- files of arrays --------------------------------------------------------------------------

FILE_VERSIONS = (1, 2)
"""Versions of the file format that are translated.

Version 1 is version 2 with fewer settings.  Version 3 is the present one without a checksum.
"""

Tensors = dict[str, NDArray[Any]]
Header = dict[str, Any]

PACKED = {
    "policy.signal_and_noise": ("policy.signal", "policy.noise"),
    "policy.offset_and_temperature": ("policy.offset", "policy.temperature"),
    "policy.slope_and_noise": ("policy.slope", "policy.noise_fraction", "policy.noise_scale"),
}
"""Vectors of numbers that are stored one by one now."""

ARRAY_NAMES = {
    "policy.lengthscales": "policy.kernel.lengthscales",
    "value.lengthscales": "value.kernel.lengthscales",
    "value.cuts": "value.kernel.wraps",
    "start.policy": "policy_start",
    "start.embedding": "embedding_start",
    "start.reward": "reward_start",
}

_POLICY = {"states", "targets", "weights", "mean_weights", "explained", "table", "candidates"}
_POLICY_ARRAYS = {
    "policy.lengthscales",
    *PACKED,
    *(f"policy.{name}" for name in {*_POLICY, "actions", "bounds"}),
}
_ROLLOUT_ARRAYS = {
    f"window.{name}" for name in ("lengths", "terminated", "observations", "actions", "rewards")
}
_VALUE = {"centres", "alpha", "frequencies", "theta"}
FILE_ARRAYS = {
    "policy": _POLICY_ARRAYS,
    "rollouts": _ROLLOUT_ARRAYS,
    "checkpoint": {
        *_POLICY_ARRAYS,
        *_ROLLOUT_ARRAYS,
        *ARRAY_NAMES,
        *(f"value.{name}" for name in _VALUE),
    },
}
"""All arrays of version 2, by kind of file."""

NO_FOURIER_V = (
    "its V is in random Fourier features, which are no longer supported, and is left out; "
    "the policy is unchanged and the next update estimates V anew"
)


def present_file(kind: str, tensors: Tensors, header: Header) -> tuple[Tensors, Header]:
    """Arrays and header of format version 1 or 2 as those of the present one.

    Args:
        kind: "policy", "rollouts" or "checkpoint".
        tensors: float64 arrays by their old names.
        header: as it was stored.

    Raises:
        StorageError, KeyError, TypeError, ValueError: something is missing, or makes no sense.
            Shapes and values that are the same now are left to be checked as present ones.
    """
    named = header.get("arrays", sorted(tensors) if header["version"] == 1 else None)
    if not isinstance(named, list):
        raise StorageError("its header does not name its arrays")
    missing = [name for name in named if name not in [*tensors]]
    if missing:
        raise StorageError(f"array {missing[0]!r:.60} is missing")
    if len(named) != len(tensors):
        raise StorageError("it holds arrays that its header does not name")
    if kind == "rollouts":
        new = _present_rollouts(tensors, "rollouts")
        return new, {"rollouts": _tree(new, "rollouts")}
    task = {"groups": [], "image_shape": None, **header["task"]}
    if kind == "policy":
        new = _present_arrays(tensors)
        return new, {"task": task, "policy": _present_policy(new, header["policy"])}
    return _present_checkpoint(tensors, {**header, "task": task})


def _present_checkpoint(tensors: Tensors, header: Header) -> tuple[Tensors, Header]:
    notes = []
    if "value.frequencies" in tensors:
        notes.append(NO_FOURIER_V)
        # the reward model starts from its defaults, as its kernel was that of V
        left_out = ("value.", "start.reward")
        tensors = {n: v for n, v in tensors.items() if not n.startswith(left_out)}
    method = header.get("method")
    learnt = header["iteration"] != 0
    new = _present_arrays(tensors)
    new |= _present_rollouts(tensors, "window") if _ROLLOUT_ARRAYS & tensors.keys() else {}
    has_value = learnt and method == "reps" and not notes
    state = {
        **{name: header[name] for name in ("iteration", "rollouts", "steps")},
        "window": _tree(new, "window"),
        "policy": _present_policy(new, header["policy"]) if learnt else None,
        "value": (_tree(new, "value") or {}) if has_value else None,
        **{f"{name}_start": _tree(new, f"{name}_start") for name in _STARTS},
    }
    if not isinstance(header["settings"], dict):
        raise StorageError(f"its settings are {header['settings']!r:.40}, not named values")
    settings = checkpoint_settings(header["settings"], str(method))
    kept = {name: header[name] for name in ("task", "seed")}
    return new, {**kept, "method": method, "settings": settings, "state": state, "notes": notes}


_STARTS = ("embedding", "reward", "policy")


def _present_policy(tensors: Tensors, kind: Any) -> Header:
    return {"kind": kind, **(_tree(tensors, "policy") or {})}


def _present_arrays(tensors: Tensors) -> Tensors:
    """All arrays but those of rollouts by their present names."""
    new: Tensors = {}
    for name, values in tensors.items():
        if name in PACKED:
            if values.shape != (len(PACKED[name]),):
                raise StorageError(f"array {name!r} has shape {values.shape}")
            new |= {part: np.array(v) for part, v in zip(PACKED[name], values, strict=True)}
        elif name not in _ROLLOUT_ARRAYS:
            new[ARRAY_NAMES.get(name, name)] = values
    for owner in ("policy", "value"):
        if f"{owner}.kernel.lengthscales" in new:
            new.setdefault(f"{owner}.kernel.wraps", np.zeros(0))
    return new


def _present_rollouts(tensors: Tensors, name: str) -> Tensors:
    """The arrays of rollouts under a name, with offsets in place of lengths."""
    lengths, ended, points, actions, rewards = (
        tensors[f"window.{part}"]
        for part in ("lengths", "terminated", "observations", "actions", "rewards")
    )
    n = len(np.atleast_1d(rewards))
    whole = lengths.ndim == 1 and ((lengths >= 1) & (lengths <= n) & (lengths % 1 == 0)).all()
    if not whole or lengths.sum() != n:
        raise StorageError("the lengths of its rollouts do not fit their data")
    if not ((ended == 0) | (ended == 1)).all():
        raise StorageError(
            "array 'window.terminated' holds flags other than 0 and 1: it is damaged"
        )
    return {
        f"{name}.offsets": np.cumsum([0, *lengths.astype(np.int64)], dtype=np.int64),
        f"{name}.terminated": ended == 1,
        f"{name}.points": points,
        f"{name}.actions": actions,
        f"{name}.rewards": rewards,
    }


def _tree(tensors: Tensors, name: str) -> Any:
    """What the header has of the arrays under a name: True for each, None if there are none."""
    if name in tensors:
        return True
    parts = {n[len(name) + 1 :].split(".")[0] for n in tensors if n.startswith(f"{name}.")}
    return {part: _tree(tensors, f"{name}.{part}") for part in sorted(parts)} or None
