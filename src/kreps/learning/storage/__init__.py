"""Policies, rollouts and checkpoints as files."""

from kreps.learning.storage.atomic import remove_parts, write_atomically
from kreps.learning.storage.checkpoints import (
    POLICIES_OF_METHOD,
    load_checkpoint,
    require_storable,
    save_checkpoint,
)
from kreps.learning.storage.checksum import check_file
from kreps.learning.storage.files import MAX_FILE_BYTES, VERSION
from kreps.learning.storage.policies import load_policy, save_policy
from kreps.learning.storage.rollouts import (
    RolloutFile,
    load_rollouts,
    rollout_folder,
    save_rollouts,
)

__all__ = [
    "MAX_FILE_BYTES",
    "POLICIES_OF_METHOD",
    "VERSION",
    "RolloutFile",
    "check_file",
    "load_checkpoint",
    "load_policy",
    "load_rollouts",
    "remove_parts",
    "require_storable",
    "rollout_folder",
    "save_checkpoint",
    "save_policy",
    "save_rollouts",
    "write_atomically",
]
