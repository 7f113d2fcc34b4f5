"""Policies as ONNX models, which give mean and standard deviation of the actions without Python.

A model computes the same as `SparseGP`, with the numbers of `kreps.learning.storage.exported`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from kreps.errors import ConfigurationError
from kreps.kernels.kernel import Factor, Periodic, SmoothedImage, SquaredExponential, smoothing
from kreps.learning.storage.atomic import write_atomically
from kreps.learning.storage.checksum import BLANK, NAME, sealed
from kreps.learning.storage.exported import (
    DTYPES,
    SINGLE_PRECISION_TOLERANCE,
    Number,
    arithmetic_of,
    coordinates_of,
    has_lags,
    inwards,
    lags_size,
)
from kreps.learning.storage.exported import single_precision_error as single_precision_error
from kreps.learning.storage.onnx_graph import Graph
from kreps.learning.storage.onnx_lags import add_next_lags, add_state
from kreps.policies.sparse_gp import SparseGP

OPSET, IR_VERSION = 17, 8
"""Versions of 2022, so that older runtimes on robots can read a model."""

GUARD = "observation_or_action_is_not_finite"
"""Name of the node that fails if a number is NaN or infinite."""


def write_onnx(
    policy: SparseGP,
    path: str | Path,
    dtype: str = "float64",
    tolerance: float = SINGLE_PRECISION_TOLERANCE,
) -> str:
    """Write a model of a policy with opset 17 of ONNX; the same policy gives the same bytes.

    Input ``observation`` (batch, do).  Outputs ``action`` (batch, da), the mean clipped to the
    task's limits, and ``standard_deviation`` (batch, da) of the commanded action, both in the
    task's units.  A batch needs memory for batch x centres x coordinates numbers.

    A policy of states with earlier steps (`kreps.data.history`) also has the input ``lags``
    (batch, h do + k da) and the output ``next_lags``, which is the input of the next decision.  At
    the start of an episode they are h times the observation, then zeros.

    A model never hands out a number that is not finite: if one is among observations or results,
    its evaluation ends with an error that has `GUARD` in its text.

    Args:
        policy: r centres.
        path: the file to replace.
        dtype: "float64" or "float32", of input and outputs.  The arithmetic is of the same type,
            unless `single_precision_error` is above the tolerance; then it is float64.
        tolerance: of the mean, in units of the action scale.

    Returns:
        The type of the arithmetic.

    Raises:
        ConfigurationError: ONNX is not installed, or another dtype, or numbers of the policy are
            too large for it.
        StorageError: the file cannot be written.
    """
    arithmetic = arithmetic_of(policy, dtype, tolerance)
    try:
        import onnx
    except ImportError as error:
        raise ConfigurationError(
            f"writing {path} needs ONNX, which is not installed: pip install 'kreps[onnx]'"
        ) from error
    graph = _graph_of(policy, onnx.helper, DTYPES[dtype], DTYPES[arithmetic])
    model = onnx.helper.make_model(
        graph,
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="kreps",
        producer_version=version("kreps"),
        doc_string=(
            "A Gaussian process policy. action: its mean, clipped to the limits of the task; "
            "standard_deviation: of the commanded action; both in the units of the task."
        ),
    )
    onnx.helper.set_model_props(model, {"kreps": _note(policy, arithmetic), NAME: BLANK})
    write_atomically(path, sealed(model.SerializeToString(deterministic=True)))
    return arithmetic


def _note(policy: SparseGP, arithmetic: str) -> str:
    """The metadata of a model: version, kind of policy, arithmetic and task."""
    task = policy.task
    content = {
        "version": version("kreps"),
        "policy": "sparse-gp",
        "centres": len(policy.states),
        "arithmetic": arithmetic,
        "action_low": task.action_low.tolist(),
        "action_high": task.action_high.tolist(),
        "periodic": list(task.periodic),
        "action_repeat": task.action_repeat,
        "dt": task.dt,
        "image_shape": None if task.image_shape is None else list(task.image_shape),
        **({"lags": [task.history, task.action_lags]} if has_lags(task) else {}),
    }
    return json.dumps(content, sort_keys=True)


def _graph_of(policy: SparseGP, helper: Any, border: Number, arithmetic: Number) -> Any:
    """The graph with inputs and outputs of dtype ``border``, computed in ``arithmetic``."""
    graph, task = Graph(helper, arithmetic), policy.task
    widths = {"observation": task.observation_size}
    state = "observation"
    if has_lags(task):
        widths["lags"] = lags_size(task)
        state = add_state(graph, task)
    inputs = tuple(widths)
    commanded, deviation = _mean_and_deviation(graph, policy, state, border)
    zero = _zero_if_finite(graph, (*inputs, commanded, deviation), border)
    low, high = (
        graph.constant(name, inwards(limit, task.action_centre, border), border)
        for name, limit in (("action_low", task.action_low), ("action_high", task.action_high))
    )
    action = graph.node("Min", graph.node("Max", commanded, low), high)
    if task.given_spaces.whole_actions:
        action = graph.node("Round", action)
    graph.node("Add", action, zero, out="action")
    graph.node("Add", deviation, zero, out="standard_deviation")
    widths |= {"action": task.action_size, "standard_deviation": task.action_size}
    if has_lags(task):
        widths["next_lags"] = lags_size(task)
        add_next_lags(graph, task, border)
    borders = [
        helper.make_tensor_value_info(name, graph.kind(border), ["batch", width])
        for name, width in widths.items()
    ]
    given, returned = borders[: len(inputs)], borders[len(inputs) :]
    return helper.make_graph(
        graph.nodes, "kreps_policy", given, returned, initializer=graph.constants
    )


def _mean_and_deviation(
    graph: Graph, policy: SparseGP, state: str, border: Number
) -> tuple[str, str]:
    """Mean and standard deviation of the commanded action, (batch, da) each."""
    task = policy.task
    k = _kernel_values(graph, policy, graph.cast(state, graph.dtype))

    weights = graph.constant("mean_weights", policy.mean_weights * task.action_scale)
    centre = graph.constant("action_centre", task.action_centre)
    mean = graph.cast(graph.node("Add", graph.node("MatMul", k, weights), centre), border)

    part = graph.node("MatMul", k, graph.constant("explained", policy.explained.T))
    squares = graph.node("Mul", part, part)
    explained = graph.node("ReduceSum", squares, graph.integers("centre_axis", [1]), keepdims=1)
    left = graph.node("Sub", graph.constant("signal", policy.signal), explained)
    left = graph.node("Max", left, graph.constant("zero", 0.0))
    deviation = graph.node("Sqrt", graph.node("Add", left, graph.constant("noise", policy.noise)))
    deviation = graph.node("Mul", deviation, graph.constant("action_scale", task.action_scale))
    return mean, graph.cast(deviation, border)


def _zero_if_finite(graph: Graph, values: Sequence[str], border: Number) -> str:
    """A zero, which cannot be computed if any of the values is NaN or infinite.

    An operation of ONNX cannot be made to fail, except by an index that is out of bounds: the zero
    is taken out of a vector of one element, at the number of values that are not finite.
    """
    counts = []
    for name in values:
        faulty = graph.node("Or", graph.node("IsNaN", name), graph.node("IsInf", name))
        counts.append(graph.node("ReduceSum", graph.cast(faulty, np.float64), keepdims=0))
    index = graph.cast(graph.node("Sum", *counts), np.int64)
    zeros = graph.constant("zeros", [0.0], border)
    return graph.node("Gather", zeros, index, out=GUARD, axis=0)


def _kernel_values(graph: Graph, policy: SparseGP, state: str) -> str:
    """``k(state, centres)``, (batch, r)."""
    scaled = coordinates_of(policy, graph.dtype)
    found = [
        _coordinates(graph, factor, state, f"factor_{i}")
        for i, factor in enumerate(policy.kernel.factors)
    ]
    coordinates = graph.node("Concat", *found, axis=1)
    coordinates = graph.node("Sub", coordinates, graph.constant("origin", scaled.origin))
    per_length = graph.constant("per_lengthscale", scaled.per_lengthscale)
    coordinates = graph.node("Mul", coordinates, per_length)
    each = graph.node("Unsqueeze", coordinates, graph.integers("centres_axis", [1]))
    centres = graph.constant("centres", scaled.centres)
    difference = graph.node("Sub", each, centres)
    squares = graph.node("Mul", difference, difference)
    axis = graph.integers("coordinates_axis", [2])
    squared = graph.node("ReduceSum", squares, axis, keepdims=0)
    return graph.node("Exp", graph.node("Mul", squared, graph.constant("minus_half", -0.5)))


def _coordinates(graph: Graph, factor: Factor, state: str, name: str) -> str:
    """``factor.coordinates(state)``, (batch, m); ``name`` is that of its constants."""
    assert isinstance(factor, SquaredExponential | Periodic | SmoothedImage)
    dims = graph.integers(f"{name}_dims", factor.dims)
    columns = graph.node("Gather", state, dims, axis=1)
    if isinstance(factor, SquaredExponential):
        return columns
    if isinstance(factor, Periodic):
        parts = [graph.node(operation, columns) for operation in ("Cos", "Sin")]
        return graph.node("Concat", *parts, axis=1)
    down, across = (smoothing(size) for size in factor.shape)
    shape = graph.integers(f"{name}_shape", [0, *factor.shape])  # 0: the size of the batch
    image = graph.node("Reshape", columns, shape)
    image = graph.node("MatMul", graph.constant(f"{name}_down", down), image)
    image = graph.node("MatMul", image, graph.constant(f"{name}_across", across.T))
    return graph.node(
        "Reshape", image, graph.integers(f"{name}_flat", [0, len(down) * len(across)])
    )
