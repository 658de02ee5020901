"""Conversions of ROS's own setters and constructors, with the rules that hold for all values.

They make arrays of numbers at once: ``numpy.array(values, dtype)`` where their number is fixed
(which takes ``"12"`` for 12, ``None`` for NaN, and cuts off what is too large), else
``array(code, values)`` (in which 1e39 is infinite, as a ``float32``). What comes out is right in
itself, so that a check of the packet finds nothing (:mod:`neuros.transport.values`). So the same
rules are kept where an array is made. One of a fixed size keeps them for its elements, too.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterable, Sequence
from functools import cache, wraps
from typing import Any

import numpy  # its first use loads it: 70 ms, and most messages have no arrays

from neuros.errors import WrongValue
from neuros.transport.schema import Field, Shape, Sort, schema
from neuros.transport.values import (
    Convert,
    Mismatch,
    converter,
    single_converter,
    to_numbers,
)

_MEMORY = (bytes, bytearray)  # each use of a union would create it anew
_Put = Callable[[Any, Any], None]


@cache
def guard_setters(kind: Any) -> None:
    """Have a message class, and those of the messages within it, refuse what would change."""
    sequences: dict[str, Convert] = {}
    for field in schema(kind).fields:
        name, is_array = field.slot[1:], field.shape is Shape.ARRAY
        if field.type.sort is Sort.MESSAGE:
            guard_setters(field.type.message)
        elif is_array or (field.shape is Shape.BUFFER and field.type.sort is Sort.FLOAT):
            convert = _refusing(name, _to_array(field) if is_array else _to_sequence(field))
            generated = getattr(kind, name)
            get = _view_of(field) if is_array else generated.fget
            setattr(kind, name, property(get, _setter(field, convert, generated.fset)))
            if not is_array:
                sequences[name] = convert
    if sequences:
        _guard_constructor(kind, sequences)


def _setter(field: Field, convert: Convert, generated: _Put) -> _Put:
    slot, code = field.slot, field.type.code if field.shape is Shape.BUFFER else ""

    def put(message: Any, value: Any) -> None:
        if message._check_fields:  # ROS_PYTHON_CHECK_FIELDS: ROS refuses more
            generated(message, value)
        elif type(value) is array and value.typecode == code:
            setattr(message, slot, value[:])
        else:
            setattr(message, slot, convert(value))

    return put


def _guard_constructor(kind: Any, sequences: dict[str, Convert]) -> None:
    """It makes sequences itself, before it calls their setters."""
    generated = kind.__init__

    @wraps(generated)
    def construct(message: Any, **values: Any) -> None:
        for name in values.keys() & sequences.keys():
            values[name] = sequences[name](values[name])
        generated(message, **values)

    kind.__init__ = construct


def _refusing(path: str, convert: Convert) -> Convert:
    """Raises :class:`~neuros.errors.WrongValue`, with the path of the field."""

    def converted(value: Any) -> Any:
        try:
            return convert(value)
        except Mismatch as wrong:
            wrong.within(path)
            raise WrongValue(wrong.path, wrong.found, wrong.allowed) from None

    return converted


def _to_sequence(field: Field) -> Convert:
    """A function that makes an ``array.array`` of all that ROS makes one of."""
    code, convert_other = field.type.code, converter(field)

    def convert(value: Any) -> Any:
        if (type(value) is array and value.typecode == code) or isinstance(value, _MEMORY):
            return array(code, value)
        if isinstance(value, Iterable) and not (
            isinstance(value, str) or hasattr(type(value), "__array__")
        ):
            value = value if type(value) is list else list(value)
            if (made := _unchanged(code, value)) is not None:
                return made
        return convert_other(value)

    return convert


def _to_array(field: Field) -> Convert:
    """A function that makes an array of NumPy, of matrices, too: their shape is kept."""
    code, dtype = field.type.code, numpy.dtype(field.type.code)

    def convert(value: Any) -> Any:
        if isinstance(value, list | tuple):
            if (made := _unchanged(code, value)) is not None:
                return numpy.array(made)
            if all(isinstance(row, list | tuple | numpy.ndarray) for row in value):
                return numpy.array([convert(row) for row in value], dtype)
        return numpy.array(to_numbers(field, value), dtype)

    return convert


def _unchanged(code: str, values: Sequence[Any]) -> array[Any] | None:
    """Numbers of Python, which most are, in an array; ``None`` if they are not, or do not fit."""
    kinds = list(map(type, values))
    if kinds.count(float) < len(kinds) and not {float, int}.issuperset(kinds):
        return None
    try:
        return array(code, struct.pack(f"={len(values)}{code}", *values))
    except (OverflowError, struct.error):
        return None


def _view_of(field: Field) -> Callable[[Any], Any]:
    slot, name, is_double = field.slot, field.slot[1:], field.type.code == "d"
    to_array, to_number = _to_array(field), single_converter(field.type)

    def convert(value: Any) -> Any:
        has_many = isinstance(value, list | tuple | array | numpy.ndarray)
        return to_array(value) if has_many else to_number(value)

    converted = _refusing(name, convert)

    class CheckedView(_field_array()):  # type: ignore[misc]
        def __setitem__(self, place: Any, value: Any) -> None:
            # Parts of the field have a base; a copy is the plugin's own.
            if not (is_double and type(value) is float) and self.base is not None:
                value = converted(value)
            super().__setitem__(place, value)

    return lambda message: getattr(message, slot).view(CheckedView)


@cache
def _field_array() -> Any:
    class FieldArray(numpy.ndarray):
        """A view of the numbers in a field with a fixed number of them; what plugins see."""

        def __array_wrap__(self, made: Any, *_: Any) -> Any:
            """What a plugin computes from it is an array like any other, or a number."""
            return numpy.asarray(made)[()]

        def __repr__(self) -> str:
            return repr(self.view(numpy.ndarray))

        def __reduce__(self) -> Any:
            return self.view(numpy.ndarray).__reduce__()

    return FieldArray
