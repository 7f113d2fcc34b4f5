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
    DataWarning,
    EnvironmentFailure,
    KrepsError,
    NumericalError,
    SpaceError,
    StorageError,
)

if TYPE_CHECKING:
    from kreps.data.compute import Compute
    from kreps.data.dataset import Dataset
    from kreps.data.rollouts import Rollout, Rollouts
    from kreps.data.task import TaskSpec
    from kreps.envs.restart import RandomRestart
    from kreps.learning.callbacks import Checkpoint, EvalCallback, StopOnReward
    from kreps.learning.iteration import IterationReport
    from kreps.learning.loggers import MLflow, TensorBoard, WandB
    from kreps.learning.methods import KREPS, NPALP, GridValueIteration, ValueIteration
    from kreps.learning.policy import Policy, load_policy
    from kreps.learning.storage import (
        check_file,
        load_rollouts,
        rollout_folder,
        save_rollouts,
    )
    from kreps.presets import PRESETS
    from kreps.recordings.columns import Columns
    from kreps.recordings.reading import read_rollouts
    from kreps.settings import RKHS, Exploration, Grid, LowRank, ModelBased, Settings

__all__ = [
    "KREPS",
    "NPALP",
    "PRESETS",
    "RKHS",
    "Checkpoint",
    "Columns",
    "Compute",
    "ConfigurationError",
    "DataError",
    "DataWarning",
    "Dataset",
    "EnvironmentFailure",
    "EvalCallback",
    "Exploration",
    "Grid",
    "GridValueIteration",
    "IterationReport",
    "KrepsError",
    "LowRank",
    "MLflow",
    "ModelBased",
    "NumericalError",
    "Policy",
    "RandomRestart",
    "Rollout",
    "Rollouts",
    "Settings",
    "SpaceError",
    "StopOnReward",
    "StorageError",
    "TaskSpec",
    "TensorBoard",
    "ValueIteration",
    "WandB",
    "check_file",
    "load_policy",
    "load_rollouts",
    "read_rollouts",
    "rollout_folder",
    "save_rollouts",
]

__version__ = "0.1.0"

# SciPy and the learner are loaded when first asked for: importing kreps to have its environments
# registered should cost little more than importing Gymnasium.
_HOMES = {
    "KREPS": "learning.methods",
    "ValueIteration": "learning.methods",
    "GridValueIteration": "learning.methods",
    "NPALP": "learning.methods",
    "IterationReport": "learning.iteration",
    "Checkpoint": "learning.callbacks",
    "EvalCallback": "learning.callbacks",
    "StopOnReward": "learning.callbacks",
    "MLflow": "learning.loggers",
    "TensorBoard": "learning.loggers",
    "WandB": "learning.loggers",
    "Policy": "learning.policy",
    "load_policy": "learning.policy",
    "check_file": "learning.storage",
    "RandomRestart": "envs.restart",
    "PRESETS": "presets",
    "RKHS": "settings",
    "Exploration": "settings",
    "Grid": "settings",
    "LowRank": "settings",
    "ModelBased": "settings",
    "Settings": "settings",
    "Compute": "data.compute",
    "Dataset": "data.dataset",
    "load_rollouts": "learning.storage",
    "rollout_folder": "learning.storage",
    "save_rollouts": "learning.storage",
    "Columns": "recordings.columns",
    "read_rollouts": "recordings.reading",
    "Rollout": "data.rollouts",
    "Rollouts": "data.rollouts",
    "TaskSpec": "data.task",
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
