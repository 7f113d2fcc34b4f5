"""kreps: kernel-based, non-parametric policy search.

Relative entropy policy search with RKHS embeddings: bounded policy updates from a convex dual, a
value function in an RKHS, a transition model by conditional kernel embedding, and a
cost-sensitive Gaussian-process policy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from kreps.envs.registration import register as _register
from kreps.errors import (
    ConfigurationError,
    DataError,
    EnvironmentFailure,
    KrepsError,
    NumericalError,
    SpaceError,
    StorageError,
)

if TYPE_CHECKING:
    from kreps.compute import Compute
    from kreps.controller import Policy, load_policy
    from kreps.data import Rollout, TaskSpec
    from kreps.dataset import Dataset
    from kreps.envs.restart import RandomRestart
    from kreps.learner import (
        KREPS,
        NPALP,
        GridValueIteration,
        IterationReport,
        ValueIteration,
    )
    from kreps.settings import RECIPES, Settings
    from kreps.storage import load_rollouts, rollout_folder, save_rollouts

__all__ = [
    "KREPS",
    "NPALP",
    "RECIPES",
    "Compute",
    "ConfigurationError",
    "DataError",
    "Dataset",
    "EnvironmentFailure",
    "GridValueIteration",
    "IterationReport",
    "KrepsError",
    "NumericalError",
    "Policy",
    "RandomRestart",
    "Rollout",
    "Settings",
    "SpaceError",
    "StorageError",
    "TaskSpec",
    "ValueIteration",
    "load_policy",
    "load_rollouts",
    "rollout_folder",
    "save_rollouts",
]

__version__ = "0.1.0"

# SciPy and the learner are loaded when first asked for: importing kreps to have its environments
# registered should cost little more than importing Gymnasium.
_HOMES = {
    "KREPS": "learner",
    "ValueIteration": "learner",
    "GridValueIteration": "learner",
    "NPALP": "learner",
    "IterationReport": "learner",
    "Policy": "controller",
    "load_policy": "controller",
    "RandomRestart": "envs.restart",
    "RECIPES": "settings",
    "Settings": "settings",
    "Compute": "compute",
    "Dataset": "dataset",
    "load_rollouts": "storage",
    "rollout_folder": "storage",
    "save_rollouts": "storage",
    "Rollout": "data",
    "TaskSpec": "data",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'kreps' has no attribute {name!r}")
    value = getattr(import_module(f"kreps.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)


_register()
