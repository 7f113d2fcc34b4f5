"""Environments of the command line, made by their Gymnasium names."""

from __future__ import annotations

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


def labels_of(env: Environment, task: TaskSpec) -> Labels:
    """Labels from the environment's metadata, or numbered ones."""
    metadata = env.metadata or {}
    observations = metadata.get("observation_labels") or [
        f"observation {i}" for i in range(task.observation_size)
    ]
    actions = metadata.get("action_labels") or [f"action {i}" for i in range(task.action_size)]
    return Labels(list(observations), list(actions))


def references_of(config: RunConfig) -> dict[str, float]:
    """Reference rewards of a run's task by name, from best to worst.

    Empty where none are known for the task at the run's restart probability.
    """
    # only this setting is read: a run of an earlier version may have unknown ones
    default = LearnerSettings.restart_probability
    if config.settings.get("restart_probability", default) != REFERENCE_RESTART_PROBABILITY:
        return {}
    return REFERENCE_REWARDS.get(config.environment, {})
