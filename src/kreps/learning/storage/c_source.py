"""Policies as C99 source, for controllers without an operating system.

The source computes the mean action of a `SparseGP`, as `kreps.learning.storage.onnx` does, with the
numbers of `kreps.learning.storage.exported`.  All sizes are fixed when it is written; it allocates
no memory and keeps no state.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.kernel import Factor, Periodic, SmoothedImage, smoothing
from kreps.learning.storage import c_text
from kreps.learning.storage.atomic import file_path, write_atomically
from kreps.learning.storage.exported import (
    DTYPES,
    Coordinates,
    arithmetic_of,
    coordinates_of,
    has_lags,
    inwards,
    lags_size,
    rounded,
)
from kreps.policies.sparse_gp import SparseGP

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
"""File names, without ``.c``, that can begin the names of functions."""

TYPES = {"float64": ("double", ""), "float32": ("float", "f")}
"""Types of C and the suffixes of their numbers and functions, by dtype."""

FLOAT_TOLERANCE = 1e-5
"""Largest error of the mean that ``float`` arithmetic may cause, in units of the action scale."""

LINE = 96
"""Columns of the lines with numbers."""


def write_c(policy: SparseGP, path: str | Path, dtype: str = "float64") -> str:
    """Write a policy as C99 source, ``NAME.c``, and its header, ``NAME.h``.

    ``NAME_act`` gives the mean action (da,), clipped to the task's limits, from the observation
    (do,), both in the task's units.  A policy of states with earlier steps (`kreps.data.history`)
    also has the argument ``lags`` (h do + k da,), which ``NAME_start`` sets at the start of an
    episode and ``NAME_act`` updates.  The same policy gives the same bytes.

    Args:
        policy: r centres.
        path: the source to replace; its header lies beside it.
        dtype: "float64" for ``double`` or "float32" for ``float``, of arguments and results.

    Returns:
        The dtype of the arithmetic: ``dtype``, unless `single_precision_error` is above
        `FLOAT_TOLERANCE`; then it is float64.

    Raises:
        ConfigurationError: a file name that cannot begin a name in C, another dtype, or numbers of
            the policy are too large for it.
        StorageError: a file cannot be written.
    """
    path = file_path(path)
    if path.suffix != ".c" or NAME.fullmatch(path.stem) is None:
        raise ConfigurationError(
            f"{path.name!r:.60} cannot be the name of C source, as it begins the names of its "
            "functions; choose letters, digits and underscores, such as arm_policy.c"
        )
    arithmetic = arithmetic_of(policy, dtype, FLOAT_TOLERANCE)
    header, source = _text(policy, path.stem, dtype, arithmetic)
    write_atomically(path.with_suffix(".h"), header.encode())
    write_atomically(path, source.encode())
    return arithmetic


def _text(policy: SparseGP, name: str, dtype: str, arithmetic: str) -> tuple[str, str]:
    """Header and source."""
    task, lags = policy.task, has_lags(policy.task)
    (number, of_number), (real, f) = TYPES[dtype], TYPES[arithmetic]
    scaled = coordinates_of(policy, DTYPES[arithmetic])
    names = {"name": name, "NAME": name.upper(), "f": f}
    declarations = c_text.DECLARATIONS_WITH_LAGS if lags else c_text.DECLARATIONS
    header = c_text.HEADER.substitute(
        names,
        version=version("kreps"),
        centres=len(scaled.centres),
        observations=task.observation_size,
        actions=task.action_size,
        lags=lags_size(task),
        repeat=task.action_repeat,
        period="of unknown length" if task.dt is None else f"of {task.dt:g} s",
        number=number,
        declarations=declarations.substitute(names),
    )
    embedding = "\n".join(_embedding(policy.kernel.factors, f))
    commanded = f"rint{of_number}(commanded)" if task.given_spaces.whole_actions else "commanded"
    parts = [
        _includes(name),
        f"typedef {name}_number number;\ntypedef {real} real; /* of the arithmetic */\n",
        _sizes(task, scaled),
        *_tables(policy, scaled, dtype, arithmetic),
        *([c_text.SMOOTH.substitute()] if task.image_shape else []),
        c_text.MEAN.substitute(f=f, embedding=embedding, commanded=commanded),
        (c_text.ACT_WITH_LAGS if lags else c_text.ACT).substitute(names),
        c_text.BENCHMARK.substitute(
            names,
            lags="\n    number lags[LAGS];" * lags,
            start=f"\n        {name}_start(observation, lags);" * lags,
            argument="lags, " * lags,
        ),
    ]
    return header, "\n".join(part.strip("\n") + "\n" for part in parts)


def _includes(name: str) -> str:
    return (
        "#ifdef KREPS_BENCHMARK\n#define _POSIX_C_SOURCE 199309L /* for clock_gettime */\n"
        f'#include <stdio.h>\n#include <time.h>\n#endif\n\n#include "{name}.h"\n\n#include <math.h>'
    )


def _sizes(task: TaskSpec, scaled: Coordinates) -> str:
    sizes = {
        "OBSERVATIONS": task.observation_size,
        "ACTIONS": task.action_size,
        "CENTRES": len(scaled.centres),
        "COORDINATES": len(scaled.origin),
    }
    if has_lags(task):
        sizes |= {"EARLIER": task.observed_size - task.observation_size, "LAGS": lags_size(task)}
    if task.image_shape:
        height, width = task.image_shape
        down, across = (len(smoothing(size)) for size in task.image_shape)
        sizes |= {"HEIGHT": height, "WIDTH": width, "DOWN": down, "ACROSS": across}
    return "\n".join(
        ["enum {", *(f"    {name} = {size}," for name, size in sizes.items()), "};"]
    ).replace(",\n};", "\n};")


def _tables(policy: SparseGP, scaled: Coordinates, dtype: str, arithmetic: str) -> Iterator[str]:
    """The numbers of a policy."""
    task = policy.task
    reals: dict[str, Any] = {
        "origin[COORDINATES]": scaled.origin,
        "per_lengthscale[COORDINATES]": scaled.per_lengthscale,
        "centre[CENTRES][COORDINATES]": scaled.centres,
        "mean_weight[CENTRES][ACTIONS]": policy.mean_weights * task.action_scale,
        "action_centre[ACTIONS]": task.action_centre,
    }
    numbers: dict[str, Any] = {
        f"action_{side}[ACTIONS]": inwards(limit, task.action_centre, DTYPES[dtype])
        for side, limit in (("low", task.action_low), ("high", task.action_high))
    }
    if has_lags(task):
        turns = np.zeros(task.observation_size)
        turns[list(task.periodic)] = 2.0 * np.pi
        reals["full_turn[OBSERVATIONS]"] = turns
        numbers |= {"lag_centre[ACTIONS]": task.action_centre}
        numbers |= {"lag_scale[ACTIONS]": task.action_scale}
    if task.image_shape:
        down, across = (smoothing(size) for size in task.image_shape)
        reals |= {"down[DOWN][HEIGHT]": down, "across[ACROSS][WIDTH]": across}
    for kind, values, of in (("real", reals, arithmetic), ("number", numbers, dtype)):
        for name, each in values.items():
            array = rounded(name.partition("[")[0], each, DTYPES[of])
            yield f"static const {kind} {name} = {_initialiser(array, TYPES[of][1])};\n"
    pixels = [factor.dims for factor in policy.kernel.factors if isinstance(factor, SmoothedImage)]
    if pixels:
        given = _initialiser(np.array(pixels), "")
        yield f"static const int pixel[{len(pixels)}][HEIGHT * WIDTH] = {given};\n"


def _initialiser(values: NDArray[Any], suffix: str) -> str:
    """The numbers as C reads them, exactly those that are given."""
    if values.ndim > 1:
        return "{\n" + ",\n".join(_initialiser(row, suffix) for row in values) + "\n}"
    texts = [
        str(value)
        if values.dtype.kind == "i"
        else np.format_float_scientific(value, trim="-") + suffix
        for value in values
    ]
    return "{" + "\n".join(textwrap.wrap(", ".join(texts), LINE)) + "}"


def _embedding(factors: tuple[Factor, ...], f: str) -> Iterator[str]:
    """Statements that compute the coordinates of each factor."""
    place, images = 0, 0
    for factor in factors:
        if isinstance(factor, SmoothedImage):
            yield f"    smooth(state, pixel[{images}], coordinate + {place});"
            images += 1
            place += len(smoothing(factor.shape[0])) * len(smoothing(factor.shape[1]))
            continue
        terms = (f"cos{f}({{}})", f"sin{f}({{}})") if isinstance(factor, Periodic) else ("{}",)
        for term in terms:
            for i in factor.dims:
                yield f"    coordinate[{place}] = {term.format(f'state[{i}]')};"
                place += 1
