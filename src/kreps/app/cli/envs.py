"""The command that lists environments: envs."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import gymnasium as gym
import typer

from kreps.app.console import say, say_command
from kreps.errors import ConfigurationError, KrepsError
from kreps.learning.environment import opened, task_of

ENVS_EXAMPLES = ("kreps envs", "kreps envs my_robot.envs")

INDENT = 4

REGISTERING = """
To learn in an environment of your own, register it in a module, and give module and name:

    gymnasium.register("my/Arm-v0", entry_point="my_robot.envs:Arm", max_episode_steps=200)

    kreps train my_robot.envs:my/Arm-v0 --out runs/arm
"""


class Registered(NamedTuple):
    """A registered environment and the size of its task, or why it is no task of kreps."""

    name: str
    entry: str
    sizes: tuple[int, int] = (0, 0)
    dt: float | None = None
    time_limit: int | None = None
    refusal: str = ""

    @property
    def description(self) -> str:
        """Sizes of observations and actions, times, and what makes the environment."""
        observations, actions = self.sizes
        step = "" if self.dt is None else f", a step of {self.dt:.3g} s"
        episode = "" if self.time_limit is None else f", episodes of {self.time_limit} steps"
        sizes = f"{observations} observation and {actions} action coordinates"
        return f"{sizes}{step}{episode}; {self.entry}"


def envs(
    module: Annotated[
        str | None,
        typer.Argument(
            help="Module to import; only what it registers is listed. It may lie in the current "
            "folder.",
            show_default=False,
        ),
    ] = None,
    all_: Annotated[
        bool, typer.Option("--all", help="Also list what cannot be learnt, and why.")
    ] = False,
) -> None:
    """List the registered environments that can be learnt, and how one is registered.

    Each is made and closed again to read its spaces.  So that of a robot must not be connected by
    being made.
    """
    found = list(registered(module))
    learnable = [each for each in found if not each.refusal]
    for each in learnable:
        say(each.name)
        say(f"{'':<{INDENT}}{each.description}", indent=INDENT)
    refused = [each for each in found if each.refusal]
    if all_:
        for each in refused:
            say(f"{each.name}: {each.refusal}", indent=INDENT)
    elif refused:
        say(f"{len(refused)} others cannot be learnt here; --all says why.")
    say_command("", REGISTERING)


def registered(module: str | None) -> Iterator[Registered]:
    """The registered environments in the order of their registration.

    Args:
        module: imported first, and then only environments that it makes or registers are found;
            None finds all.

    Raises:
        ConfigurationError: it cannot be imported.
    """
    before = set(gym.registry)
    if module is not None:
        try:
            importlib.import_module(module)
        except Exception as error:  # whatever a foreign module raises
            raise ConfigurationError(
                f"cannot import the module {module!r:.60}: {error}; check its name and folder"
            ) from error
    for name, spec in list(gym.registry.items()):
        entry = _entry(spec.entry_point)
        if module is None or name not in before or entry.startswith((f"{module}:", f"{module}.")):
            yield _examined(name, entry)


def _entry(entry: Any) -> str:
    if isinstance(entry, str) or entry is None:
        return entry or ""
    return f"{entry.__module__}:{getattr(entry, '__qualname__', entry)}"


def _examined(name: str, entry: str) -> Registered:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with opened(name) as env:
                task = task_of(env)
        except KrepsError as error:
            return Registered(name, entry, refusal=" ".join(str(error).split()))
    return Registered(name, entry, task.sizes, task.dt, task.time_limit)


def names_of_environments(incomplete: str) -> list[str]:
    """Registered names that begin with ``incomplete``, for a shell."""
    return [name for name in gym.registry if name.startswith(incomplete)]
