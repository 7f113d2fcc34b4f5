"""A run folder: the configuration of a run, its numbers, and all that resuming needs.

``config.json`` has the configuration.  After each iteration ``progress.csv``,
``policy.safetensors`` and then ``checkpoint.safetensors`` are replaced, each atomically.  The
checkpoint is written last, so the other files are never behind it; rows of ``progress.csv`` that
are ahead of it are dropped on resuming.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from kreps.app.progress_file import progress_row, progress_text, read_progress
from kreps.data.rollouts import Rollouts
from kreps.data.window import ReplayWindow
from kreps.errors import ConfigurationError, StorageError
from kreps.intake import MAX_MAGNITUDE
from kreps.learning.episodes import EpisodicReturn
from kreps.learning.iteration import IterationReport
from kreps.learning.methods import KREPS
from kreps.learning.storage import load_rollouts, remove_parts, save_policy, write_atomically
from kreps.learning.storage.lock import locked
from kreps.legacy import present_preset, present_settings
from kreps.versions import versions


@dataclass(frozen=True)
class RunConfig:
    """The configuration of a run, from which its environment and learner can be made again.

    Attributes:
        environment: Gymnasium name; empty if the run is from recorded data.
        iterations: updates to make in total.
        seed, preset, settings: as given to `KREPS`; ``settings`` holds only what was changed, by
            flat names such as ``"value.max_rank"``.
        periodic: as given to `KREPS`.
        arguments: of the environment, as given to ``gymnasium.make``.
        data: paths of the recordings, of a run from recorded data.
    """

    environment: str
    iterations: int
    seed: int
    preset: str
    settings: dict[str, Any]
    periodic: list[int] | None
    arguments: dict[str, Any] = field(default_factory=dict)
    data: list[str] = field(default_factory=list)

    def command(self, out: str) -> str:
        """The command that makes the run in the folder ``out``."""
        options = [
            *(("--set", f"{name}={_word(value)}") for name, value in self.settings.items()),
            *(("--env-arg", f"{name}={_word(value)}") for name, value in self.arguments.items()),
            *(("--periodic", str(i)) for i in self.periodic or ()),
            ("--preset", self.preset),
            ("--iterations", str(self.iterations)),
            ("--seed", str(self.seed)),
            ("--out", out),
        ]
        words = ["kreps", "train", self.environment, *(word for pair in options for word in pair)]
        return shlex.join(words)


class RunFolder:
    """The files of one run."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config_file = self.path / "config.json"
        self.progress_file = self.path / "progress.csv"
        self.checkpoint_file = self.path / "checkpoint.safetensors"
        self.policy_file = self.path / "policy.safetensors"
        self.evaluation_file = self.path / "evaluation.json"
        self.rollouts_file = self.path / "evaluation_rollouts.safetensors"

    def make(self) -> None:
        """Make the folder, unless it is there.

        Raises:
            StorageError: it cannot be made.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot make the folder {self.path}: {error}") from error

    @contextmanager
    def learning(self) -> Iterator[None]:
        """Let no other process learn in the folder as long as the block lasts.

        Raises:
            StorageError: another process learns in it, or nothing can be written in it.
        """
        with locked(self.path / ".lock"):
            for file in (
                self.config_file,
                self.progress_file,
                self.policy_file,
                self.checkpoint_file,
            ):
                remove_parts(file)
            yield

    def create(self, config: RunConfig) -> None:
        """Start a run here.

        Raises:
            ConfigurationError: the folder holds a run already.
            StorageError: the folder cannot be made.
        """
        self.make()
        if self.config_file.exists():
            raise ConfigurationError(
                f"{self.path} holds a run already; continue it with `kreps resume {self.path}`, "
                "remove it, or choose another folder"
            )
        self.write_config(config)

    def write_config(self, config: RunConfig) -> None:
        """Write ``config.json``, with the versions of the software."""
        content = {**vars(config), "versions": versions()}
        if not config.data:
            del content["data"]
        write_atomically(self.config_file, (json.dumps(content, indent=2) + "\n").encode())

    def config(self) -> RunConfig:
        """The content of ``config.json``, of this or an earlier version.

        Raises:
            StorageError: this is not a run folder.
        """
        try:
            content = json.loads(self.config_file.read_text())
            content.pop("versions", None)
            if "recipe" in content and "preset" not in content:  # version 0.1
                recipe = content.pop("recipe")
                content["settings"] = present_settings(content["settings"], recipe)
                content["preset"] = present_preset(recipe)
            config = RunConfig(**content)
            types = {"environment": str, "preset": str, "settings": dict, "arguments": dict}
            types["data"] = list
            for name, kind in types.items():
                if not isinstance(getattr(config, name), kind):
                    raise TypeError(f"{name} is not a {kind.__name__}")
            for name, bits in (("iterations", 63), ("seed", 128)):
                value = getattr(config, name)
                if type(value) is not int or not 0 <= value < 2**bits:
                    raise TypeError(f"{name} is not a whole number of at most {bits} bits")
            if not isinstance(config.periodic, list | None):
                raise TypeError("periodic is not a list")
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise StorageError(
                f"{self.path} is not a run folder with an intact config.json ({error}); "
                "start a run with `kreps train`"
            ) from error
        return config

    def rows(self) -> list[dict[str, str]]:
        """The rows of ``progress.csv`` (`read_progress`); empty if there is no such file."""
        return read_progress(self.progress_file)

    def recorded_rows(self) -> list[dict[str, str]]:
        """The rows of ``progress.csv``.

        Raises:
            ConfigurationError: there is none yet.
        """
        rows = self.rows()
        if not rows:
            raise ConfigurationError(
                f"{self.progress_file} holds no iteration yet; make the next update with "
                f"`kreps resume {self.path}`"
            )
        return rows

    def evaluation(self, iteration: int) -> dict[str, dict[str, Any]] | None:
        """Mean and standard error of the stochastic and the greedy policy of an iteration.

        They are those of ``evaluation.json``; None if it is missing or of another iteration.
        ``"episodic"`` has the fields of `kreps.learning.episodes.EpisodicReturn`, where they were
        recorded.

        Raises:
            StorageError: it is not what an evaluation writes.
        """
        try:
            content = json.loads(self.evaluation_file.read_text())
            found = {name: _evaluated(content[name]) for name in ("stochastic", "greedy")}
            return found if content["iteration"] == iteration else None
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise StorageError(
                f"{self.evaluation_file} is damaged ({error}); remove it, or evaluate again"
            ) from error

    def window(self) -> ReplayWindow | None:
        """The replay window of the checkpoint; None if there is none yet.

        Raises:
            StorageError: it is damaged.
        """
        if not self.checkpoint_file.exists():
            return None
        return KREPS.resume(self.checkpoint_file).state.window

    def evaluation_rollouts(self, iteration: int) -> Rollouts | None:
        """Rollouts of the greedy policy of an iteration, if it was evaluated; otherwise None.

        Raises:
            StorageError: a file is damaged.
        """
        if self.evaluation(iteration) is None or not self.rollouts_file.exists():
            return None
        return load_rollouts(self.rollouts_file)

    def remove_evaluation_rollouts(self) -> None:
        """Remove the rollouts of an earlier evaluation, if there are any.

        Raises:
            StorageError: they cannot be removed.
        """
        try:
            self.rollouts_file.unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(
                f"cannot replace {self.rollouts_file}: {error}; check the folder"
            ) from error

    def __call__(self, learner: KREPS, report: IterationReport) -> None:
        """As a callback of `KREPS.learn`: write the files of an iteration."""
        earlier = [row for row in self.rows() if int(row["iteration"]) < report.iteration]
        text = progress_text([*earlier, progress_row(learner, report)])
        write_atomically(self.progress_file, text.encode())
        assert learner.state.policy is not None
        save_policy(learner.state.policy, self.policy_file)
        learner.save(self.checkpoint_file)


def _word(value: Any) -> str:
    """A value as the command line reads it."""
    return "none" if value is None else value if isinstance(value, str) else json.dumps(value)


def _evaluated(content: Any) -> dict[str, Any]:
    """The numbers of one policy; a standard error that earlier versions lack is 0.

    Raises:
        ValueError, TypeError, OverflowError, KeyError: these are no finite numbers.
    """
    average = {"standard_error": 0.0, **content}
    found: dict[str, Any] = {
        name: _number(name, average[name]) for name in ("mean", "standard_error")
    }
    if content.get("episodic") is not None:
        episodic = content["episodic"]
        names = (field.name for field in fields(EpisodicReturn))
        found["episodic"] = {name: _number(name, episodic[name]) for name in names}
    return found


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} is {value!r:.40}, no number")
    if not abs(float(value)) <= MAX_MAGNITUDE:
        raise ValueError(f"{name} is {value:g}, no number up to {MAX_MAGNITUDE:g}")
    return float(value)
