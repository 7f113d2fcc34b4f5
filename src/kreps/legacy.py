"""The one place that translates names of earlier versions, as files of those versions hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

PRESET_NAMES = {"default": "model_based", "observed": "single_step"}
"""Presets (then "recipes") of version 0.1."""

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


def present_name(name: str) -> str | None:
    """What a setting of version 0.1 is called now; None if that is no such name."""
    return SETTING_NAMES.get(name)


def present_preset(name: str) -> str:
    """What a preset is called now."""
    return PRESET_NAMES.get(name, name)


def present_settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings, some or all of a learner's, in the flat form of `kreps.presets`.

    Settings of the present version are left as they are.  ``approximation`` ``"uniform"`` and
    ``"fourier"`` are no more: pivoted Cholesky takes their place.
    """
    values = dict(given)
    # "exploration" is a name of both versions: a section now, then the kind of noise
    noise = values.pop("exploration", None)
    if noise is not None:
        values["exploration.noise"] = noise
    approximation = values.pop("approximation", "auto")
    no_model_based = values.get("imagined") == 0
    on_grid = values.get("features") == "grid"
    new = {SETTING_NAMES.get(name, name): value for name, value in values.items()}
    if "value.angle_wrap" in new:
        new["value.angle_wrap"] = ANGLE_WRAPS.get(new["value.angle_wrap"], new["value.angle_wrap"])
    rkhs_only = {"value.max_rank", "value.tolerance", "value.angle_wrap"}
    dropped = (
        (rkhs_only if on_grid else {"value.size"})
        if "features" in values or ("grid_size" in values)
        else set()
    )
    if approximation == "exact":
        new["low_rank"] = None
        dropped |= {"low_rank.rank"}
    elif approximation != "auto":
        new["low_rank.above"] = 0
    if no_model_based:
        dropped |= {name for name in new if name.startswith("model_based.")}
        new["model_based"] = None
    return {name: value for name, value in new.items() if name not in dropped}


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


def checkpoint_settings(stored: Mapping[str, Any], method: str) -> dict[str, Any]:
    """All settings of a checkpoint, of this or an earlier version, in the flat form."""
    if method != "reps" or "rollout_lengths" in stored:
        return present_settings(stored)
    return present_settings({**ADDED_IN_0_1, **stored})


PROGRESS_COLUMNS = {
    "refused": "rejected",
    "cpu_seconds_imagined_step": "cpu_seconds_generated_samples",
    "cpu_seconds_judgement": "cpu_seconds_acceptance_test",
}
"""Columns of ``progress.csv`` of version 0.1 that have another name now."""


def present_columns(columns: Sequence[str]) -> tuple[str, ...]:
    """Columns of ``progress.csv``, of this or an earlier version, by their present names."""
    return tuple(PROGRESS_COLUMNS.get(name, name) for name in columns)
