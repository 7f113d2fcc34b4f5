"""Environments of the command line, made by their Gymnasium names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

from kreps.app.run_folder import RunConfig
from kreps.data.task import TaskSpec
from kreps.envs.references import REFERENCE_RESTART_PROBABILITY, REFERENCE_REWARDS
from kreps.errors import ConfigurationError
from kreps.learning.environment import opened
from kreps.learning.wrappers import Environment, Wrapper, keeps_actions, keeps_observations
from kreps.learning.wrappers import metadata_of as usable_metadata
from kreps.terminal import printable


class Labels(NamedTuple):
    """Names of the observation and action coordinates, with their units."""

    observations: list[str]
    actions: list[str]


def environment_of(config: RunConfig, **options: Any) -> AbstractContextManager[Environment]:
    """A new environment of a run, which is closed at the end in any case (`opened`).

    Args:
        config: of the run.
        options: of ``gymnasium.make``, beside those of the run.

    Raises:
        ConfigurationError: the run is from recorded data.
    """
    if not config.environment:
        raise ConfigurationError(
            "this run is from recorded data and has no environment, which is needed to evaluate, "
            "to film or to go on; make one, and give it to kreps.KREPS.resume(CHECKPOINT, env)"
        )
    return opened(config.environment, {**config.arguments, **options})


def metadata_of(env: Environment) -> Mapping[str, Any]:
    """The environment's metadata; empty if it is no mapping."""
    metadata = env.metadata
    return metadata if isinstance(metadata, Mapping) else {}


def literal(text: str) -> str:
    """Text that Matplotlib draws as it is: without control characters and without mathematics."""
    return printable(text).replace("$", r"\$")


def labels_of(env: Environment, task: TaskSpec) -> Labels:
    """Labels from the environment's metadata, or numbered ones where those are not usable.

    They are not usable if a wrapper may change what they are about.
    """

    def labels(kind: str, count: int, keeps: Callable[[Wrapper], bool]) -> list[str]:
        given = usable_metadata(env, keeps)[0].get(f"{kind}_labels")
        if not isinstance(given, list | tuple) or len(given) != count:
            return [f"{kind} {i}" for i in range(count)]
        return [literal(str(label)) for label in given]

    return Labels(
        labels("observation", task.observation_size, keeps_observations),
        labels("action", task.action_size, keeps_actions),
    )


def references_of(config: RunConfig) -> dict[str, float]:
    """Reference rewards of a run's task by name, from best to worst.

    Empty where none are known for the task with the run's arguments and restart probability.
    """
    if config.arguments:
        return {}
    # Only this setting is read: a run of an earlier version may have unknown ones.  Where it is
    # chosen, it is that of the references, as their tasks end no episode.
    given = config.settings.get("restart_probability")
    held = config.settings.get("action_repeat") not in (None, 1)
    if held or (given is not None and given != REFERENCE_RESTART_PROBABILITY):
        return {}
    return REFERENCE_REWARDS.get(config.environment, {})
