"""The errors of the library, all derived from `KrepsError`.

Messages name the value found, the limit that it violates, and the remedy.
"""

from __future__ import annotations


def printable(text: str) -> str:
    """The text with escapes (``\\x1b``) in place of all that a terminal might act on or not show.

    These are control characters, line breaks among them, and halves of surrogate pairs, as text of
    files, environments and file names may hold them.
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class KrepsError(Exception):
    """Base class of all errors that kreps raises; as text it is one line that can be printed."""

    def __str__(self) -> str:
        return printable(super().__str__())


class ConfigurationError(KrepsError, ValueError):
    """An invalid parameter or combination of parameters."""


class SpaceError(ConfigurationError):
    """An observation or action space that is not supported."""


class DataError(KrepsError, ValueError):
    """Invalid data: wrong types or shapes, NaN, infinities, no rollout or no step."""


class EnvironmentFailure(KrepsError, RuntimeError):
    """The environment raised an exception; the learner is as after the last update."""


class TrialFailure(KrepsError, RuntimeError):
    """At least one trial of an experiment raised; the results of the others are kept."""


class NumericalError(KrepsError, ArithmeticError):
    """A matrix could not be factorised with any permitted jitter, or an action is not finite."""


class StorageError(KrepsError, OSError):
    """A file is missing, damaged, of another program or kind, or of an unknown version."""
