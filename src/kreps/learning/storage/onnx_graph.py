"""An ONNX graph that is built node by node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.learning.storage.exported import Number, rounded


class Graph:
    """Nodes and constants, in the order in which they are added.

    Attributes:
        dtype: of the arithmetic.
    """

    def __init__(self, helper: Any, dtype: Number) -> None:
        self.helper, self.dtype = helper, dtype
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, values: Any, dtype: Number | None = None) -> str:
        """Add a tensor, of the dtype of the arithmetic unless another one is given."""
        array = rounded(name, values, dtype or self.dtype)
        return self._tensor(name, array)

    def integers(self, name: str, values: Sequence[int]) -> str:
        return self._tensor(name, np.array(values, dtype=np.int64))

    def _tensor(self, name: str, array: NDArray[Any]) -> str:
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
        kind = self.kind(array.dtype)
        self.constants.append(self.helper.make_tensor(name, kind, array.shape, data, raw=True))
        return name

    def kind(self, dtype: Any) -> int:
        """The number of a dtype in ONNX."""
        return int(self.helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    def node(self, operation: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        """Add a node; the name of its output, ``out`` or a new one, is returned."""
        name = out or f"{operation.lower()}_{len(self.nodes)}"
        self.nodes.append(self.helper.make_node(operation, inputs, [name], name=name, **attributes))
        return name

    def cast(self, values: str, dtype: Any) -> str:
        return self.node("Cast", values, to=self.kind(dtype))
