"""The door: arrays, numbers and flags of users, environments and files, checked as they enter.

Arrays must be of real numbers that are all there.  What NumPy would convert in silence is an error
here: the real part of a complex number, what is behind the mask of a masked array, a number in a
text, and whatever an array of objects has.  The bounds of numbers are here too; files have the
same (`kreps.learning.storage`), so that what is learnt can be saved, and what is saved be loaded.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.errors import DataError

MAX_MAGNITUDE = 1e100
"""Larger numbers are not accepted as data: products of some of them would overflow."""

MAX_LEARNT = 1e200
"""Larger numbers are not accepted as parameters of a policy or of V: these are ratios and products
of data, such as a reward per distance of states."""

REMEDIES = {
    "c": "give real and imaginary parts as two coordinates",
    "O": "convert them to numbers, such as by astype(float)",
}
"""What to do about arrays of some kinds of numbers (`numpy.dtype.kind`)."""


def is_sane(values: NDArray[np.float64], largest: float = MAX_MAGNITUDE) -> NDArray[np.bool_]:
    """Which ``values`` are neither NaN nor infinite nor beyond ``largest``."""
    return np.abs(values) <= largest


def as_array(name: str, values: Any) -> NDArray[Any]:
    """``values`` as an array of real numbers or flags, of any size and precision.

    Nothing is copied or read if it is an array already: a memory map stays one.

    Args:
        name: of the values, in messages.
        values: an array of any library, a number, or nested lists of numbers.

    Raises:
        DataError: masked values, complex numbers, text, objects, or lists of different lengths.
    """
    if _is_masked(values):
        raise DataError(
            f"{name}: masked (missing) values, which cannot be learnt from; leave these steps out, "
            "or fill them with numbers (numpy.ma.filled)"
        )
    try:
        array = np.asanyarray(values)
    except Exception as error:  # whatever the array's own library raises
        raise DataError(f"{name}: not an array of numbers: {error}") from error
    if array.dtype.kind not in "biuf":
        shown = f"{values!r:.40}" if array.ndim == 0 else f"an array of {array.dtype}"
        remedy = REMEDIES.get(array.dtype.kind, "convert them to numbers")
        raise DataError(f"{name}: {shown}, but real numbers are needed; {remedy}")
    return array.data if isinstance(array, np.ma.MaskedArray) else array


def _is_masked(values: Any) -> bool:
    """Whether a masked value is in an array, or in lists, of which NumPy would drop the masks."""
    if isinstance(values, list | tuple):
        nested = (each for each in values if isinstance(each, list | tuple | np.ma.MaskedArray))
        return any(map(_is_masked, nested))
    return isinstance(values, np.ma.MaskedArray) and bool(np.ma.is_masked(values))


def as_numbers(name: str, values: Any, remedy: str) -> NDArray[np.float64]:
    """A copy of `as_array` as float64, so that a buffer that is used again cannot change it.

    Args:
        name, values: as of `as_array`.
        remedy: what to do about numbers that are not finite, in messages.

    Raises:
        DataError: as `as_array`; or a NaN, an infinity or an absurdly large number, whose row is
            named.
    """
    with np.errstate(over="ignore"):  # of longer floats; refused below
        copy = np.array(as_array(name, values), dtype=np.float64, subok=False)
    if (row := first_invalid_row(copy)) is not None:
        where = f", first in row {row}" if copy.ndim else ""
        raise DataError(f"{invalid(name)}{where}; {remedy}")
    return copy


def first_invalid_row(values: NDArray[np.float64]) -> int | None:
    """Number of the first row with a value that is NaN, infinite or too large, if any is."""
    valid = is_sane(values)
    return None if valid.all() else int(np.argwhere(np.atleast_1d(~valid))[0, 0])


def invalid(name: str) -> str:
    """The beginning of a message about values beyond the bounds."""
    return f"{name} hold NaN, an infinity or a number beyond {MAX_MAGNITUDE:g}"


def as_number(name: str, value: Any) -> float:
    """A single number, also from an array of one; NaN and infinities are not checked here.

    Raises:
        DataError: as `as_array`, or several numbers.
    """
    array = as_array(name, value)
    if array.size != 1:
        raise DataError(f"{name}: shape {array.shape}, but one number is needed")
    return float(array.item())


def as_flags(name: str, values: Any) -> NDArray[np.bool_]:
    """A copy of flags; numbers are accepted if they are 0 or 1.

    Raises:
        DataError: something else, such as NaN or the text "False", which Python counts as true.
    """
    try:
        array = as_array(name, values)
        valid = bool(((array == 0) | (array == 1)).all())
    except DataError:
        valid = False
    if not valid:
        raise DataError(f"{name} = {values!r:.60}, but True or False is needed")
    return np.array(array, dtype=bool, subok=False)


def as_flag(name: str, value: Any) -> bool:
    """A single flag, also from an array of one.

    Raises:
        DataError: as `as_flags`, or several flags.
    """
    array = as_flags(name, value)
    if array.size != 1:
        raise DataError(f"{name}: shape {array.shape}, but one flag is needed")
    return bool(array.item())


def as_rows(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """A view of values with one row, or one reward, per step."""
    least, most = {"observations": (2, np.inf), "actions": (1, np.inf), "rewards": (1, 1)}[name]
    if not least <= values.ndim <= most:
        raise DataError(
            f"{name} of shape {values.shape} do not fit together with the others: "
            "observations (T + 1, ds), actions (T, da), rewards (T,) are needed, or observations "
            "and actions in the shapes of the environment"
        )
    return values if name == "rewards" else values.reshape(len(values), prod(values.shape[1:]))


def ended_by(terminated: Any, steps: int) -> bool:
    """Whether a rollout of so many steps ended with the last, from one flag or one per step."""
    each = as_flags("terminated", terminated)
    if each.size == 1:
        return bool(each.item())
    if each.shape != (steps,) or each[:-1].any():
        raise DataError(
            f"terminated has shape {each.shape} and is true {np.count_nonzero(each)} times, but "
            f"one flag is needed, or {steps}, of which only the last may be true; cut the rollout "
            "where the task ended"
        )
    return bool(each[-1])


def as_times(times: Any, steps: int) -> NDArray[np.float64]:
    """A copy of the time stamps in s of the observations of a rollout of so many steps.

    Raises:
        DataError: as `as_numbers`, another number of them, or times that do not increase.
    """
    stamps = as_numbers("times", times, "leave the times out")
    if stamps.shape != (steps + 1,) or not (np.diff(stamps) > 0.0).all():
        raise DataError(
            f"times of shape {stamps.shape}, but {steps + 1} increasing numbers are needed, one "
            "for each observation; leave the times out if they are not known"
        )
    return stamps
