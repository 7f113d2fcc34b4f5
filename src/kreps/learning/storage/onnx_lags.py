"""The nodes of an ONNX model of a policy that needs earlier steps (`kreps.data.history`)."""

from __future__ import annotations

import numpy as np

from kreps.data.task import TaskSpec
from kreps.learning.storage.exported import Number
from kreps.learning.storage.onnx_graph import Graph


def add_state(graph: Graph, task: TaskSpec) -> str:
    """The state (batch, ds) of ``observation`` (batch, do) and ``lags`` (batch, h do + k da)."""
    names = graph.cast("observation", graph.dtype), graph.cast("lags", graph.dtype)
    known = graph.node("Concat", *names, axis=1)
    size, observed = task.observation_size, task.observed_size
    parts = [names[0]]
    if task.history:
        later = _columns(graph, known, "later", 0, observed - size)
        change = graph.node("Sub", later, _columns(graph, known, "earlier", size, observed))
        # x - 2 pi floor(x / 2 pi + 1/2), of the changes of angles
        per_turn, turn = np.zeros(size), np.zeros(size)
        per_turn[list(task.periodic)], turn[list(task.periodic)] = 0.5 / np.pi, 2.0 * np.pi
        times = (np.tile(each, task.history) for each in (per_turn, turn))
        per_turns, turns = map(graph.constant, ("per_turn", "turn"), times)
        fraction = graph.node("Mul", change, per_turns)
        whole = graph.node("Floor", graph.node("Add", fraction, graph.constant("half", 0.5)))
        parts.append(graph.node("Sub", change, graph.node("Mul", whole, turns)))
    if task.action_lags:
        parts.append(_columns(graph, known, "taken", observed, task.state_size))
    return graph.node("Concat", *parts, axis=1)


def add_next_lags(graph: Graph, task: TaskSpec, border: Number) -> None:
    """The output ``next_lags`` (batch, h do + k da), from the inputs and ``action``."""
    known = graph.node("Concat", "observation", "lags", axis=1)
    size, observed = task.observation_size, task.observed_size
    parts = [_columns(graph, known, "observed", 0, observed - size)] if task.history else []
    if task.action_lags:
        centre = graph.constant("lag_centre", task.action_centre, border)
        scale = graph.constant("lag_scale", task.action_scale, border)
        parts.append(graph.node("Div", graph.node("Sub", "action", centre), scale))
    if task.action_lags > 1:
        last = task.state_size - task.action_size
        parts.append(_columns(graph, known, "kept", observed, last))
    graph.node("Concat", *parts, out="next_lags", axis=1)


def _columns(graph: Graph, values: str, name: str, first: int, last: int) -> str:
    """Columns ``first`` to ``last``, excluded, of a matrix."""
    chosen = graph.integers(f"{name}_columns", list(range(first, last)))
    return graph.node("Gather", values, chosen, axis=1)
