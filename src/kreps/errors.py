"""The library's errors: one small tree, so that ``except kreps.KrepsError`` catches them all.

Every message names the value that was met, the limit it broke and the remedy.
"""

from __future__ import annotations


class KrepsError(Exception):
    """Base class of every error that kreps raises on purpose."""


class ConfigurationError(KrepsError, ValueError):
    """A parameter, or a combination of parameters, that cannot be served."""


class SpaceError(ConfigurationError):
    """An observation or action space that cannot be served."""


class DataError(KrepsError, ValueError):
    """Roll-outs that cannot be learnt from: wrong shapes, NaN, infinities, nothing in them."""


class EnvironmentFailure(KrepsError, RuntimeError):
    """The environment raised during a roll-out; what was learnt before is untouched."""


class TrialFailure(KrepsError, RuntimeError):
    """At least one trial of an experiment raised; the results of the others are kept."""


class NumericalError(KrepsError, ArithmeticError):
    """A matrix could not be factorised even with the largest permitted jitter."""


class StorageError(KrepsError, OSError):
    """A file that is missing, damaged, foreign or of an unknown version."""
