"""Numbers of the packets of a port as one array, and back.

Environments (:mod:`~neuros_learn.gym`) and policies (:mod:`~neuros_learn.policies`) name them
alike: ``port`` for an array or all numbers of a message, without texts and time stamps, and
``port.field`` for a part of them. A shape in brackets is needed where the message does not fix the
length.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import cached_property, reduce
from math import prod
from typing import Any, TypeAlias

import numpy as np

from neuros.errors import EnvironmentFault, UsageError
from neuros.project.model import Port
from neuros.transport.schema import NUMBERS, Leaf, Shape, Sort, getter, schema

Sizes: TypeAlias = "tuple[int, ...]"
_STAMPS = ("Time", "Duration")


def shape_of(text: str | None) -> Sizes | None:
    """The shape in the brackets of a name; ``None`` without brackets."""
    return tuple(map(int, text.split(","))) if text else None


def numbers_of(
    port: Port, name: str, field: str = "", shape: Sizes | None = None, copies: int | None = None
) -> Numbers:
    """The numbers of a port, or of one of its fields.

    Args:
        name: of the port, for messages.
        field: with its leading dot; empty for all numbers.
        shape: of the numbers, of one copy; ``None``: that of the array, or one axis.
        copies: of the node, whose ports have arrays with a leading axis; ``None`` without it.

    Raises:
        UsageError: there is no such field, or the number of its values is not known, or another.
        EnvironmentFault: the project builds the type of the message, and has not built it yet.
    """
    if copies is not None:
        return _BatchNumbers(port, name, field, shape)
    return (_ArrayNumbers if port.array else Numbers)(port, name, field, shape)


class Numbers:
    """Numbers of the messages of a port, as one array.

    Attributes:
        port: its name. name: with the field.
        shape: of the array; without the axis of copies.
        dtype: of the array; ``uint8`` for truth values.
        is_bool: whether all are truth values.
    """

    shape: Sizes
    dtype: np.dtype[Any]
    is_bool: bool

    def __init__(self, port: Port, name: str, field: str, shape: Sizes | None) -> None:
        self.port, self.name = name, name + field
        brackets = "" if shape is None else f"[{','.join(map(str, shape))}]"
        self._resolve(port, f"{self.name}{brackets}", field, shape)

    def _resolve(self, port: Port, written: str, field: str, shape: Sizes | None) -> None:
        package, _, name = port.type.partition("/msg/")
        try:
            kind: type = getattr(importlib.import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError) as error:
            raise EnvironmentFault(f"message type {port.type} cannot be imported here") from error
        self._type = port.type
        leaves = _leaves_of(kind, field)
        if not leaves:
            known = ", ".join(f"{self.port}.{_path(leaf)}" for leaf in _leaves_of(kind, ""))
            raise UsageError(f"'{written}': there are no numbers of that name; there are {known}")
        # The size of a sequence without a bound is None.
        sizes = [1 if leaf.field.shape is Shape.SINGLE else leaf.field.size for leaf in leaves]
        free = [_path(leaf) for leaf, size in zip(leaves, sizes, strict=True) if size is None]
        if len(free) > 1 or (free and shape is None):
            raise UsageError(
                f"'{written}': the length of {self.port}.{free[0]} is not known: name that alone,"
                f" with its shape: '{self.port}.{free[0]}[3]'"
            )
        fixed = sum(size or 0 for size in sizes)
        count = fixed if shape is None else prod(shape)
        self._sizes = [count - fixed if size is None else size for size in sizes]
        if sum(self._sizes) != count or min(self._sizes) < 0:
            raise UsageError(f"'{written}': its messages have {fixed} numbers, not {count}")
        self._leaves, self.shape = leaves, (count,) if shape is None else shape
        self._get = getter([leaf.path for leaf in leaves])
        self._is_flat = all(leaf.field.shape is Shape.SINGLE for leaf in leaves)
        self.is_bool = all(leaf.field.type.sort is Sort.BOOL for leaf in leaves)
        types = (np.dtype(leaf.field.type.code) for leaf in leaves)
        self.dtype = np.dtype(np.uint8) if self.is_bool else np.result_type(*types)

    def read(self, message: Any) -> Any:
        values = self._get(message)
        if self._is_flat:
            return np.array(values, self.dtype).reshape(self.shape)
        parts = [np.array(value, self.dtype).reshape(-1) for value in values]
        for leaf, part, size in zip(self._leaves, parts, self._sizes, strict=True):
            if part.size != size:
                raise UsageError(
                    f"{self.port}.{_path(leaf)} holds {part.size} numbers, not {size}: say so in"
                    " brackets"
                )
        return (parts[0] if len(parts) == 1 else np.concatenate(parts)).reshape(self.shape)

    @cached_property
    def _make(self) -> Callable[[], Any]:
        # Needs rclpy, which checks before a run do without.
        from neuros.transport.messages import factory_of

        return factory_of(self._type)

    def message(self, values: Any) -> Any:
        return self.put(values, self._make())

    def put(self, values: Any, message: Any) -> Any:
        flat, start = np.asarray(values).reshape(-1), 0
        if flat.size != sum(self._sizes):
            raise UsageError(f"{self.name} takes {sum(self._sizes)} numbers, not {flat.size}")
        for leaf, size in zip(self._leaves, self._sizes, strict=True):
            numbers = _CONVERT[leaf.field.type.sort](flat[start : start + size])
            owner = reduce(getattr, leaf.path[:-1], message)
            is_one = leaf.field.shape is Shape.SINGLE
            setattr(owner, leaf.path[-1][1:], numbers[0] if is_one else numbers)
            start += size
        return message


class _ArrayNumbers(Numbers):
    """The numbers of a port of arrays."""

    def _resolve(self, port: Port, written: str, field: str, shape: Sizes | None) -> None:
        array = port.array
        assert array is not None
        if field:
            raise UsageError(
                f"'{written}': {self.port} is a {array}, without fields: leave them out"
            )
        if shape is not None and prod(shape) != array.size:
            raise UsageError(
                f"'{written}': its arrays have {array.size} numbers, not {prod(shape)}"
            )
        self._array, self.shape = array, shape or array.shape
        self._all = self.shape
        self.is_bool = array.dtype == "bool"
        self.dtype = np.dtype(np.uint8 if self.is_bool else array.dtype)

    def read(self, message: Any) -> Any:
        return message.astype(self.dtype).reshape(self._all)

    def message(self, values: Any) -> Any:
        given, is_float = np.asarray(values), self.dtype.kind == "f"
        if given.size != self._array.size:
            raise UsageError(f"{self.name} takes {self._array.size} numbers, not {given.size}")
        given = given.reshape(self._array.shape)
        if given.dtype == self._array.dtype:
            return given
        if given.dtype.kind == "f" and not is_float:
            given = np.rint(given)
        with np.errstate(over="ignore", invalid="ignore"):
            made = given.astype(self._array.dtype)
        pair = (np.isfinite(made), np.isfinite(given)) if is_float else (made, given)
        if not np.array_equal(*pair):
            raise ValueError(f"{self.name}: {values} does not fit in {self._array}")
        return made

    def put(self, values: Any, message: Any) -> Any:
        return self.message(values)


class _BatchNumbers(_ArrayNumbers):
    """The numbers of a port of arrays whose first axis is that of copies."""

    def _resolve(self, port: Port, written: str, field: str, shape: Sizes | None) -> None:
        whole = port.array
        if whole is None or len(whole.shape) < 2:
            raise UsageError(
                f"'{written}': a port of a node with copies has arrays, with a leading axis, not"
                f" {port.type}"
            )
        super()._resolve(Port(port.name, str(whole.of_one_copy)), written, field, shape)
        self._array, self._all = whole, (whole.shape[0], *self.shape)


_CONVERT: Mapping[Sort, Callable[[Any], list[Any]]] = {
    Sort.BOOL: lambda numbers: numbers.astype(bool).tolist(),
    Sort.INTEGER: lambda numbers: [round(number) for number in numbers.tolist()],
    Sort.FLOAT: lambda numbers: numbers.astype(float).tolist(),
}
"""Converters from an array of numbers to values of a field."""


def _leaves_of(kind: type, field: str) -> list[Leaf]:
    """The numeric fields; those of time stamps only if they are named."""
    known, path = schema(kind), tuple(f"_{part}" for part in field.split(".")[1:])
    return [
        leaf
        for leaf in known.leaves
        if leaf.path[: len(path)] == path
        and leaf.field.type.sort in (*NUMBERS, Sort.BOOL)
        and (path or known.kinds[leaf.owner].__name__ not in _STAMPS)
    ]


def _path(leaf: Leaf) -> str:
    return ".".join(slot[1:] for slot in leaf.path)
