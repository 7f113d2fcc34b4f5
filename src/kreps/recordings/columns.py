"""Which columns of a recording are observations, actions, rewards, ends and time stamps."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from kreps.checks import Checked
from kreps.errors import ConfigurationError, StorageError, shown
from kreps.kernels.arrays import FloatArray

TimeUnit = Literal["s", "ms", "us", "ns"]

ELEMENT = re.compile(r"(.+)\[(\d+)\]")
"""The name of one number of a column that has several per row."""

MAX_WIDTH = 64
"""Largest number of numbers per row of a column that is listed where none is named."""

RewardFunction = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""Rewards (n,) of states (n, ds), actions (n, da) and successors (n, ds)."""

LISTS = ("observations", "actions", "next_observations")

COMMON_NAMES: dict[str, tuple[str, ...]] = {
    "observations": ("observations", "observation", "obs", "observation.state"),
    "actions": ("actions", "action"),
    "next_observations": ("next_observations", "next_obs"),
    "reward": ("reward", "rewards", "next.reward"),
    "terminated": ("terminated", "terminations", "terminals"),
    "truncated": ("truncated", "truncations", "timeouts"),
    "episode": ("episode", "episode_id", "episode_index"),
    "time": ("time", "timestamp", "timestamps"),
}
"""Names that are taken where the mapping names no column: those of Minari, LeRobot and D4RL."""


@dataclass(frozen=True)
class Columns(Checked):
    """The columns of a recording by what they are.  Row t has what belongs to step t.

    A name may be that of a column with several numbers per row, all of which are taken; one of them
    is named by its index, as in ``"position[0]"``.  A field that is not given is the first of the
    `COMMON_NAMES` that the recording has.

    Attributes:
        observations: at the start of the step.
        actions: as commanded at the observation, before any clipping.
        reward: of the step, that is, after the action.
        reward_function: computes the rewards (n,) from observations (n, ds), actions (n, da) and
            next observations (n, ds), where none were recorded.
        next_observations: after the step; without them that is the next row of the same episode.
        terminated: true where the task ended with the step.
        truncated: true where the episode was cut off after the step.
        episode: number or name of the episode; it changes from one to the next.
        time: time stamp of the observation.
        time_unit: of numbers in ``time``.
        clock: of a ROS 2 bag: the topic whose messages begin the steps; that of the first action if
            not given.

    Raises:
        ConfigurationError: something that is no name, or both a reward and a function.
    """

    observations: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    reward: str | None = None
    reward_function: RewardFunction | None = None
    next_observations: tuple[str, ...] = ()
    terminated: str | None = None
    truncated: str | None = None
    episode: str | None = None
    time: str | None = None
    time_unit: TimeUnit = "s"
    clock: str | None = None

    def __post_init__(self) -> None:
        for name in LISTS:
            given = getattr(self, name)
            names = (given,) if isinstance(given, str) else given
            if not (isinstance(names, list | tuple) and all(isinstance(n, str) for n in names)):
                raise ConfigurationError(
                    f"{name} = {shown(given)}, but a list of names of columns is needed, such as "
                    '["angle", "velocity"]'
                )
            object.__setattr__(self, name, tuple(names))
        for name in ("reward", "terminated", "truncated", "episode", "time", "clock"):
            if not isinstance(getattr(self, name), str | None):
                raise ConfigurationError(
                    f"{name} = {shown(getattr(self, name))}, but the name of one column is needed"
                )
        self._choose("time_unit", TimeUnit)
        if self.reward_function is not None and self.reward is not None:
            raise ConfigurationError(
                f"reward = {shown(self.reward)} and a reward_function are given; leave one out"
            )
        if not (self.reward_function is None or callable(self.reward_function)):
            raise ConfigurationError(
                f"reward_function = {shown(self.reward_function)}, but a function of observations, "
                "actions and next observations is needed"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """All names of columns that are given."""
        single = (self.reward, self.terminated, self.truncated, self.episode, self.time)
        listed = (*self.observations, *self.actions, *self.next_observations)
        return (*listed, *(name for name in single if name is not None))

    @property
    def bases(self) -> set[str]:
        """The names that are given, without the index of an element."""
        elements = (element[1] for element in map(ELEMENT.fullmatch, self.names) if element)
        return {*self.names, *elements}

    def needs(self, name: str, width: int = 1) -> bool:
        """Whether a column is named, as a whole or by an element, or has a common name.

        Without any name every column is needed, of up to `MAX_WIDTH` numbers per row.
        """
        common = any(name in names for names in COMMON_NAMES.values())
        return common or name in self.bases or (not self.names and width <= MAX_WIDTH)

    def completed(self, present: Collection[str]) -> Columns:
        """With the `COMMON_NAMES` among the columns that are present, where none are given."""
        found: dict[str, Any] = {}
        for field, names in COMMON_NAMES.items():
            computed = field == "reward" and self.reward_function is not None
            if computed or (field == "next_observations" and self.observations):
                continue  # what is named may be other numbers than those of the common name
            name = next((name for name in names if name in present), None)
            if name is not None and not getattr(self, field):
                found[field] = (name,) if field in LISTS else name
        return replace(self, **found)


def columns_of(given: Columns | Mapping[str, Any] | str | Path | None) -> Columns:
    """Columns as they are given: themselves, their fields, or a TOML file with ``[columns]``.

    Raises:
        ConfigurationError: unknown fields, or values that are no names.
        StorageError: the file cannot be read.
    """
    if isinstance(given, Columns):
        return given
    if given is None:
        return Columns()
    if isinstance(given, str | Path):
        return columns_of(read_toml(given).get("columns", {}))
    if not isinstance(given, Mapping):
        raise ConfigurationError(
            f"columns = {shown(given)}, but kreps.Columns, a dictionary of its fields or the path "
            "of a TOML file is needed"
        )
    known = [field.name for field in fields(Columns)]
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ConfigurationError(
            f"columns have no field {unknown[0]!r:.60}; choose among {', '.join(known)}"
        )
    return Columns(**{**given, **_function(given.get("reward_function"))})


def read_toml(path: str | Path) -> dict[str, Any]:
    """The content of a TOML file, which may have the tables ``columns`` and ``task``.

    Raises:
        StorageError: it is missing or no TOML.
        ConfigurationError: it has other tables.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StorageError(f"cannot read {path} as TOML: {error}; check the path") from error
    for name, value in content.items():
        if name not in ("columns", "task") or not isinstance(value, dict):
            raise ConfigurationError(f"{path} has {name!r:.60}, but only [columns] and [task] may")
    return content


def _function(given: Any) -> dict[str, Any]:
    """The field of a reward function, which a file names as ``module:function``."""
    if not isinstance(given, str):
        return {}
    module, _, name = given.partition(":")
    try:
        return {"reward_function": getattr(import_module(module), name)}
    except (ImportError, ValueError, AttributeError) as error:
        raise ConfigurationError(
            f"reward_function = {given!r:.60} cannot be imported: {error}; write module:function, "
            "with a module in the current folder or an installed one"
        ) from error
