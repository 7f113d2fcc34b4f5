"""The errors of the library, all derived from `KrepsError`.

Messages name the value found, the limit that it violates, and the remedy.
"""

from __future__ import annotations


class KrepsError(Exception):
    """Base class of all errors that kreps raises."""


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
    """A matrix could not be factorised even with the largest permitted jitter."""


class StorageError(KrepsError, OSError):
    """A file is missing, damaged, of another program or kind, or of an unknown version."""
