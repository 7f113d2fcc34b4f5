"""Checks of single fields of settings, which are frozen dataclasses."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from numbers import Integral, Real
from typing import Any, get_args

from kreps.errors import ConfigurationError, shown

MAX_COUNT = 100_000
"""Largest number of rollouts, grid points per coordinate or candidate actions: all are made."""

MAX_WHOLE_NUMBER = 10**15
"""Largest whole number elsewhere, where it only limits others."""

MAX_ACTION_REPEAT = 10_000
"""Largest number of steps for which an action is held."""

MAX_LAGS = 100
"""Largest delay and history, in steps."""


class Checked:
    """Checks of single fields, for frozen dataclasses.

    Each raises `ConfigurationError` with the value and what it must be.
    """

    def _choose(self, name: str, kind: Any) -> None:
        if getattr(self, name) not in get_args(kind):
            raise ConfigurationError(
                f"{name} = {shown(getattr(self, name))} is unknown; choose one of "
                + ", ".join(repr(choice) for choice in get_args(kind))
            )

    def _positive(self, *names: str) -> None:
        for name in names:
            self._check(name, Real, "positive and finite", lambda v: 0 < v < inf)

    def _flag(self, name: str) -> None:
        if not isinstance(getattr(self, name), bool):
            raise ConfigurationError(
                f"{name} = {shown(getattr(self, name))}, but it must be True or False"
            )

    def _counts(self, name: str, largest: int) -> None:
        """Accept a sequence of whole numbers, and store it as a tuple."""
        values = tuple(getattr(self, name))
        if not values or not all(type(v) is int and 1 <= v <= largest for v in values):
            raise ConfigurationError(
                f"{name} = {shown(values)}, but it must be whole numbers from 1 to {largest}, one "
                "for each coordinate"
            )
        object.__setattr__(self, name, values)

    def _whole(self, *names: str, largest: int = MAX_WHOLE_NUMBER) -> None:
        for name in names:
            limit = f"a whole number from 1 to {largest}"
            self._check(name, Integral, limit, lambda v: 1 <= v <= largest)

    def _check(self, name: str, kind: type, limit: str, holds: Callable[[Any], bool]) -> None:
        """Accept numbers of any type, NumPy's included, and store them as Python's."""
        value = getattr(self, name)
        is_number = isinstance(value, kind) and not isinstance(value, bool)
        if is_number and kind is Real:
            try:
                value = float(value)
            except OverflowError:  # a whole number that is too large for a float
                value = inf
        if not (is_number and holds(value)):
            raise ConfigurationError(f"{name} = {shown(value)}, but it must be {limit}")
        object.__setattr__(self, name, int(value) if kind is Integral else value)

    def _section(self, name: str, *kinds: type) -> None:
        value = getattr(self, name)
        if not isinstance(value, kinds):
            names = ["None" if k is type(None) else f"kreps.{k.__name__}(...)" for k in kinds]
            raise ConfigurationError(
                f"{name} = {shown(value)}, but it must be {' or '.join(names)}; "
                f'to change one field, write {{"{name}.field": value}}'
            )
