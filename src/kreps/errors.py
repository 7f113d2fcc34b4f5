"""The errors of the library, all derived from `KrepsError`.

Messages name the value found, the limit that it violates, and the remedy.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from kreps.terminal import printable


def shown(value: object) -> str:
    """A value for a message, cut off where it is long."""
    try:
        return f"{value!r:.60}"
    except Exception:  # such as a whole number of more digits than Python writes
        return f"a {type(value).__name__}"


class KrepsError(Exception):
    """Base class of all errors that kreps raises; as text it is one line that can be printed."""

    def __str__(self) -> str:
        return printable(super().__str__()).replace("\n", r"\n").replace("\t", r"\t")


class ConfigurationError(KrepsError, ValueError):
    """An invalid parameter or combination of parameters."""


@contextmanager
def enough_memory(what: str) -> Iterator[None]:
    """An error of the library where the memory is not enough for something."""
    try:
        yield
    except MemoryError as error:
        raise ConfigurationError(
            f"{what} needs more memory than there is ({error}); lower the settings of which it "
            "makes many, such as window, rollouts per iteration or samples of the model"
        ) from error


class SpaceError(ConfigurationError):
    """An observation or action space that is not supported."""


class DataError(KrepsError, ValueError):
    """Invalid data: wrong types or shapes, NaN, infinities, no rollout or no step."""


class DataWarning(UserWarning):
    """Data that are learnt from although they look like errors of measurement."""


class EnvironmentFailure(KrepsError, RuntimeError):
    """The environment raised an exception; the learner is as after the last update."""


class TrialFailure(KrepsError, RuntimeError):
    """At least one trial of an experiment raised; the results of the others are kept."""


class NumericalError(KrepsError, ArithmeticError):
    """A matrix could not be factorised with any permitted jitter, or an action is not finite."""


class StorageError(KrepsError, OSError):
    """A file is missing, damaged, of another program or kind, or of an unknown version."""
