"""Environments of the command line, made by their Gymnasium names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym

from kreps.app.run_folder import RunConfig
from kreps.data.task import TaskSpec
from kreps.envs.references import REFERENCE_RESTART_PROBABILITY, REFERENCE_REWARDS
from kreps.errors import ConfigurationError
from kreps.learning.environment import Environment
from kreps.settings import LearnerSettings


class Labels(NamedTuple):
    """Names of the observation and action coordinates, with their units."""

    observations: list[str]
    actions: list[str]


def make_environment(environment: str, **options: Any) -> Environment:
    """The environment of a Gymnasium name; ``module:name`` imports the module first.

    Raises:
        ConfigurationError: it cannot be made.
    """
    try:
        return gym.make(environment, **options)
    except Exception as error:  # whatever a foreign environment raises
        raise ConfigurationError(
            f"cannot make the environment {environment!r}: {error}; check its name, "
            "or write module:name to have its module imported first"
        ) from error


def metadata_of(env: Environment) -> Mapping[str, Any]:
    """The environment's metadata; empty if it is no mapping."""
    metadata = env.metadata
    return metadata if isinstance(metadata, Mapping) else {}


def labels_of(env: Environment, task: TaskSpec) -> Labels:
    """Labels from the environment's metadata, or numbered ones where those are not usable.

    A dollar sign is escaped, as Matplotlib would read mathematics between two of them.
    """
    metadata = metadata_of(env)

    def labels(kind: str, count: int) -> list[str]:
        given = metadata.get(f"{kind}_labels")
        if not isinstance(given, list | tuple) or len(given) != count:
            return [f"{kind} {i}" for i in range(count)]
        return [str(label).replace("$", r"\$") for label in given]

    return Labels(labels("observation", task.observation_size), labels("action", task.action_size))


def references_of(config: RunConfig) -> dict[str, float]:
    """Reference rewards of a run's task by name, from best to worst.

    Empty where none are known for the task at the run's restart probability.
    """
    # only this setting is read: a run of an earlier version may have unknown ones
    default = LearnerSettings.restart_probability
    if config.settings.get("restart_probability", default) != REFERENCE_RESTART_PROBABILITY:
        return {}
    return REFERENCE_REWARDS.get(config.environment, {})
