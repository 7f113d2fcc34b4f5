"""Dataclasses as named arrays and one JSON header, by a declared schema.

A schema is a tree of the nodes below, one for each field of each dataclass.  Arrays are named by
their path in the tree (``"policy.kernel.lengthscales"``); everything else is in the header, which
has the shape of the tree.

Reading is done in two passes.  The first one compares the header and the types and shapes of all
arrays with the schema; nothing is read of the arrays.  Sizes in shapes are letters, such as
``("m", "ds")``: the first array with a letter decides its size, and all others must agree.  The
second pass reads the arrays, checks their values and builds the objects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kreps.errors import StorageError
from kreps.intake import MAX_LEARNT, MAX_MAGNITUDE, is_sane

Tensors = dict[str, NDArray[Any]]
Layout = dict[str, tuple[str, tuple[int, ...]]]
"""Type (as safetensors names it) and shape of arrays, by name."""

Sizes = dict[str, int]
Load = Callable[[str], NDArray[Any]]

NUMBER_TYPES = {"F64": np.dtype(np.float64), "I64": np.dtype(np.int64), "BOOL": np.dtype(np.bool_)}


class Node(Protocol):
    """How one value is stored under a name."""

    def encode(self, value: Any, name: str, tensors: Tensors) -> Any:
        """Put the arrays of a value into ``tensors``; the return value is for the header."""
        ...

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        """First pass: take the arrays of this value out of ``layout``, and fix ``sizes``.

        Raises:
            StorageError: something is missing, or has another type or shape.
        """
        ...

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> Any:
        """Second pass: the value.  ``given`` are values by name that are stored elsewhere.

        Raises:
            StorageError: a number is out of its range.
        """
        ...


@dataclass(frozen=True)
class Limit:
    """A range of numbers, and its name in messages."""

    text: str
    holds: Callable[[Any], Any]


POSITIVE = Limit("positive", lambda v: v > 0)
NOT_NEGATIVE = Limit("at least 0", lambda v: v >= 0)
FRACTION = Limit("in [0, 1]", lambda v: (v >= 0) & (v <= 1))
DATA = Limit(f"at most {MAX_MAGNITUDE:g}", is_sane)


@dataclass(frozen=True)
class Array:
    """An array of a shape with letters.

    Attributes:
        shape: of each axis a letter, a number, or a sum such as ``"n+R"`` of letters that other
            arrays have before it.
        limit: that every number must keep.  Floats are at most 1e200 in any case.
        dtype: one of `NUMBER_TYPES`.
    """

    shape: tuple[str | int, ...]
    limit: Limit | None = None
    dtype: str = "F64"

    def encode(self, value: Any, name: str, tensors: Tensors) -> Any:
        values = np.ascontiguousarray(value, NUMBER_TYPES[self.dtype]).reshape(np.shape(value))
        self._require(values, name)
        tensors[name] = values
        return True

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        if header is not True:
            raise StorageError(f"its header has {header!r:.40} in the place of array {name!r}")
        if name not in layout:
            raise StorageError(f"array {name!r} is missing")
        dtype, found = layout.pop(name)
        if dtype != self.dtype:
            raise StorageError(
                f"array {name!r} has numbers of type {dtype!s:.20}, but {self.dtype} is needed"
            )
        matches = len(found) == len(self.shape) and all(
            size == _size(axis, size, sizes) for axis, size in zip(self.shape, found, strict=True)
        )
        if not matches:
            raise StorageError(
                f"array {name!r} has shape {found}, but ({', '.join(map(str, self.shape))}) is "
                f"needed, with {_shown(sizes)}"
            )

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> Any:
        values = load(name)
        self._require(values, name)
        return values

    def _require(self, values: NDArray[Any], name: str) -> None:
        """Raise `StorageError` unless all numbers are within their limits.

        These are the same in writing and in reading, so that what is saved can be loaded.
        """
        if self.dtype == "F64":
            check_sane(name, values)
        if self.dtype == "BOOL" and (values.view(np.uint8) > 1).any():
            raise StorageError(f"array {name!r} holds flags other than 0 and 1: it is damaged")
        if self.limit is not None and not np.all(self.limit.holds(values)):
            raise StorageError(f"array {name!r} holds numbers that are not {self.limit.text}")


def check_sane(name: str, values: NDArray[np.float64]) -> None:
    """Raise `StorageError` unless all numbers are finite and at most 1e200."""
    if not is_sane(values, MAX_LEARNT).all():
        raise StorageError(f"array {name!r} holds NaN, infinities or numbers beyond {MAX_LEARNT:g}")


def _size(axis: str | int, found: int, sizes: Sizes) -> int:
    """The size that an axis must have; a new letter takes the size that was found."""
    if isinstance(axis, int):
        return axis
    if "+" not in axis:
        return sizes.setdefault(axis, found)
    return sum(int(part) if part.isdigit() else sizes[part] for part in axis.split("+"))


def _shown(sizes: Sizes) -> str:
    return ", ".join(f"{letter} = {size}" for letter, size in sizes.items())


@dataclass(frozen=True)
class Number:
    """One float, stored as an array without axes."""

    limit: Limit | None = None

    @property
    def _array(self) -> Array:
        return Array((), self.limit)

    def encode(self, value: Any, name: str, tensors: Tensors) -> Any:
        return self._array.encode(value, name, tensors)

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        self._array.check(header, name, layout, sizes)

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> float:
        return float(self._array.decode(header, name, load, given))


@dataclass(frozen=True)
class Whole:
    """A whole number >= 0 in the header.

    Attributes:
        bits: that it has at most.
    """

    bits: int = 63

    def encode(self, value: Any, name: str, tensors: Tensors) -> Any:
        return int(value)

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        if type(header) is not int or not 0 <= header < 2**self.bits:
            raise StorageError(
                f"{name} = {header!r:.40}, but it must be a whole number >= 0 of at most "
                f"{self.bits} bits"
            )

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> int:
        return int(header)


@dataclass(frozen=True)
class Plain:
    """Numbers, text, and lists of them in the header; the owner's constructor checks them."""

    def encode(self, value: Any, name: str, tensors: Tensors) -> Any:
        return plain(value)

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        pass

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> Any:
        return header


def plain(value: Any) -> Any:
    """Small arrays and tuples as lists, as JSON has them; anything else as it is."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True)
class Optional:
    """A value or None, which is null in the header."""

    node: Node

    def encode(self, value: Any, name: str, tensors: Tensors) -> Any:
        return None if value is None else self.node.encode(value, name, tensors)

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        if header is not None:
            self.node.check(header, name, layout, sizes)

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> Any:
        return None if header is None else self.node.decode(header, name, load, given)


@dataclass(frozen=True)
class Record:
    """A dataclass, by one node for each field.

    Attributes:
        owner: the dataclass.  Every field must have a node or be among the given ones.
        nodes: by field.
        given: fields that are not stored, but passed to `decode` as ``given``.
        ranges: smallest and largest possible size by letter.
        absent: what stands in the header for fields that files of before do not have.
        omitted: fields that are left out of the header where they are None.
    """

    owner: type[Any]
    nodes: Mapping[str, Node]
    given: tuple[str, ...] = ()
    ranges: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    absent: Mapping[str, Any] = field(default_factory=dict)
    omitted: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        assert {each.name for each in fields(self.owner)} == {*self.nodes, *self.given}

    def encode(self, value: Any, name: str, tensors: Tensors) -> dict[str, Any]:
        return {
            part: node.encode(getattr(value, part), _join(name, part), tensors)
            for part, node in self.nodes.items()
            if part not in self.omitted or getattr(value, part) is not None
        }

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        header = self._filled(header) if isinstance(header, dict) else header
        found = sorted(header) if isinstance(header, dict) else header
        if found != sorted(self.nodes):
            raise StorageError(
                f"its header has {found!s:.200} of {name!r}, but {sorted(self.nodes)} are needed"
            )
        for part, node in self.nodes.items():
            node.check(header[part], _join(name, part), layout, sizes)
        for letter, (low, high) in self.ranges.items():
            if not low <= sizes[letter] <= high:
                raise StorageError(
                    f"the arrays of {name!r} have {letter} = {sizes[letter]}, but {low} to {high} "
                    "are possible"
                )

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> Any:
        header = self._filled(header)
        parts = {
            part: node.decode(header[part], _join(name, part), load, given)
            for part, node in self.nodes.items()
        }
        return self.owner(**parts, **{part: given[part] for part in self.given})

    def _filled(self, header: dict[str, Any]) -> dict[str, Any]:
        return {**dict.fromkeys(self.omitted), **self.absent, **header}


def _join(name: str, part: str) -> str:
    return f"{name}.{part}" if name else part


@dataclass(frozen=True)
class OneOf:
    """One of several dataclasses; the header has the name of its kind under ``"kind"``."""

    kinds: Mapping[str, Record]

    def encode(self, value: Any, name: str, tensors: Tensors) -> dict[str, Any]:
        for kind, record in self.kinds.items():
            if type(value) is record.owner:
                return {"kind": kind, **record.encode(value, name, tensors)}
        raise StorageError(
            f"a {name} of type {type(value).__name__} cannot be written to a file; one of "
            f"{', '.join(record.owner.__name__ for record in self.kinds.values())} can"
        )

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        record, parts = self._record(header, name)
        record.check(parts, name, layout, sizes)

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> Any:
        record, parts = self._record(header, name)
        return record.decode(parts, name, load, given)

    def _record(self, header: Any, name: str) -> tuple[Record, dict[str, Any]]:
        kind = header.get("kind") if isinstance(header, dict) else None
        if not isinstance(kind, str) or kind not in self.kinds:
            raise StorageError(f"it holds an unknown kind of {name}: {kind!r:.40}")
        return self.kinds[kind], {part: v for part, v in header.items() if part != "kind"}


@dataclass(frozen=True)
class Converted:
    """A value that is stored in the form of another one.

    Attributes:
        node: of the form that is stored.
        to_stored: the value in that form.
        from_stored: the value, from that form and the given values.
    """

    node: Node
    to_stored: Callable[[Any], Any]
    from_stored: Callable[[Any, Mapping[str, Any]], Any]

    def encode(self, value: Any, name: str, tensors: Tensors) -> Any:
        return self.node.encode(self.to_stored(value), name, tensors)

    def check(self, header: Any, name: str, layout: Layout, sizes: Sizes) -> None:
        self.node.check(header, name, layout, sizes)

    def decode(self, header: Any, name: str, load: Load, given: Mapping[str, Any]) -> Any:
        return self.from_stored(self.node.decode(header, name, load, given), given)


@dataclass(frozen=True)
class StoredArrays:
    """The arrays of a file, which are read when they are asked for.

    Attributes:
        layout: of all arrays.
        load: reads one by name.
    """

    layout: Mapping[str, tuple[str, tuple[int, ...]]]
    load: Load

    @classmethod
    def from_memory(cls, tensors: Tensors) -> StoredArrays:
        names = {dtype: name for name, dtype in NUMBER_TYPES.items()}
        layout = {name: (names[v.dtype], v.shape) for name, v in tensors.items()}
        return cls(layout, tensors.__getitem__)

    def check(self, nodes: Sequence[tuple[str, Node, Any]], **sizes: int) -> None:
        """Compare the layout with the schema of the values that make up the file.

        Args:
            nodes: name, node and header of each value.
            **sizes: those that are known before.

        Raises:
            StorageError: the file holds something else, more or less.
        """
        left = dict(self.layout)
        for name, node, header in nodes:
            node.check(header, name, left, sizes)
        if left:
            raise StorageError(f"it has an array {min(left)!r:.60} that is of no use in it")

    def decode(
        self,
        nodes: Sequence[tuple[str, Node, Any]],
        given: Mapping[str, Any],
        **sizes: int,
    ) -> list[Any]:
        """`check` the file and build its values, of which ``given`` are stored elsewhere.

        Raises:
            StorageError: as `check`, or a number out of its range.
        """
        self.check(nodes, **sizes)
        return [node.decode(header, name, self.load, given) for name, node, header in nodes]
