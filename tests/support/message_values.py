"""Right and wrong values for the fields of any message class, drawn by hypothesis."""

from __future__ import annotations

import importlib
import math
import struct
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy
import std_msgs
from hypothesis import strategies as st

from neuros.transport.messages import message_class
from neuros.transport.schema import Field, Leaf, Shape, Sort, Type, schema

MOST_ITEMS = 3
_PLAIN = st.characters(exclude_characters="\0", exclude_categories=["Cs"])


def message_classes() -> list[Any]:
    """Every message class of every package that is installed here, loaded."""
    folder = Path(std_msgs.__file__).parents[1]
    return [
        message_class(f"{package}/msg/{name}")
        for package in sorted(file.parts[-3] for file in folder.glob("*/msg/__init__.py"))
        for name, kind in sorted(vars(importlib.import_module(f"{package}.msg")).items())
        if hasattr(kind, "get_fields_and_field_types")
    ]


def parts(value: Any) -> Any:
    """All that a message consists of, with the exact classes and bits."""
    if hasattr(value, "get_fields_and_field_types"):
        inner = [getattr(value, f"_{name}") for name in value.get_fields_and_field_types()]
        return type(value), [parts(each) for each in inner]
    if isinstance(value, list):
        return list, [parts(each) for each in value]
    if isinstance(value, float):
        return float, struct.pack("<d", value)
    if isinstance(value, array | numpy.ndarray):
        kind = value.typecode if isinstance(value, array) else (value.dtype, value.shape)
        return type(value), kind, value.tobytes()
    return type(value), value


# ------------------------------------------------------------------ right ones


@st.composite
def right_messages(draw: st.DrawFn, kind: Any) -> tuple[Any, Any]:
    """A message whose values fit, of many types, and the one that receivers must see."""
    given, expected = kind(), kind()
    for field in schema(kind).fields:
        value, seen = draw(right_values(field))
        setattr(given, field.slot, value)
        setattr(expected, field.slot, seen)
    return given, expected


@st.composite
def right_values(draw: st.DrawFn, field: Field) -> tuple[Any, Any]:
    """A value for a field, and what receivers see."""
    of = field.type
    if field.shape is Shape.SINGLE:
        return draw(single_values(of))
    least = field.size or 0
    most = field.size if field.size is not None else min(field.bound or MOST_ITEMS, MOST_ITEMS)
    items = draw(st.lists(single_values(of), min_size=least, max_size=most))
    given, seen = [value for value, _ in items], [value for _, value in items]
    if field.shape is Shape.LIST:
        return draw(st.sampled_from([list, tuple]))(given), seen
    exact = numpy.array(seen, of.code)
    ways = [given, tuple(given), seen, exact, exact.astype(exact.dtype.newbyteorder())]
    if of.sort is Sort.INTEGER and all(abs(number) < 2**53 for number in seen):
        ways.append(exact.astype(float))
    if field.shape is Shape.ARRAY:
        ways.append(exact.reshape(-1, 1))
        return draw(st.sampled_from(ways)), exact
    as_array = array(of.code, seen)
    ways += [as_array] + ([bytes(seen)] if of.code == "B" else [])
    return draw(st.sampled_from(ways)), as_array


@st.composite
def single_values(draw: st.DrawFn, of: Type) -> tuple[Any, Any]:
    """A value of a type, and what receivers see."""
    if of.sort is Sort.MESSAGE:
        return draw(right_messages(of.message))
    if of.sort is Sort.BOOL:
        truth = draw(st.booleans())
        return draw(st.sampled_from([truth, numpy.bool_(truth), numpy.array([truth])])), truth
    if of.sort is Sort.BYTE:
        byte = draw(st.binary(min_size=1, max_size=1))
        return draw(st.sampled_from([byte, bytearray(byte), memoryview(byte)])), byte
    if of.sort in (Sort.TEXT, Sort.WIDE_TEXT):
        text = draw(st.text(_PLAIN, max_size=min(of.bound or 8, 8)))
        return draw(st.sampled_from([text, numpy.str_(text)])), text
    if of.sort is Sort.INTEGER:
        return draw(_integers(of))
    return draw(_floats(of))


@st.composite
def _integers(draw: st.DrawFn, of: Type) -> tuple[Any, int]:
    allowed = range_of(of)
    number = draw(st.integers(allowed[0], allowed[-1]))
    exact = numpy.array([number], of.code)
    ways = [number, number, exact[0], exact, exact.reshape(())]
    if abs(number) < 2**53:
        ways += [float(number), numpy.float64(number)]
    if number in (0, 1):
        ways.append(bool(number))
    return draw(st.sampled_from(ways)), number


@st.composite
def _floats(draw: st.DrawFn, of: Type) -> tuple[Any, float]:
    number: Any = draw(
        st.one_of(
            st.floats(width=32 if of.code == "f" else 64),
            st.floats(-1e38, 1e38),
            st.integers(-(2**60), 2**60),
            st.integers(-(2**60), 2**60).map(numpy.int64),
            st.floats(width=32).map(numpy.float32),
            st.floats(-1e38, 1e38).map(numpy.float64),
            st.floats(width=16).map(numpy.float16),
            st.floats(-1e38, 1e38).map(lambda number: numpy.array([number])),
            st.booleans(),
        )
    )
    seen = float(number[0] if isinstance(number, numpy.ndarray) else number)
    return number, float(numpy.float32(seen)) if of.code == "f" else seen


def range_of(of: Type) -> range:
    """What an integer field holds, by its name."""
    bits = int(of.name.removeprefix("u").removeprefix("int"))
    return range(2**bits) if of.name[0] == "u" else range(-(2 ** (bits - 1)), 2 ** (bits - 1))


# ------------------------------------------------------------------ wrong ones


@dataclass(frozen=True)
class Wrong:
    """A message with one wrong value, and the path to it; ``allowed`` is in what is said."""

    message: Any
    path: str
    allowed: str


def is_empty(kind: Any) -> bool:
    """Whether a class has nothing that could hold a wrong value."""
    return not schema(kind).leaves


@st.composite
def wrong_messages(draw: st.DrawFn, kind: Any) -> Wrong:
    """A message with a wrong value anywhere, also in a message in a list."""
    leaf: Leaf = draw(st.sampled_from(schema(kind).leaves))
    value, inner, allowed = draw(wrong_values(leaf.field))
    message = kind()
    holder = message
    for slot in leaf.path[:-1]:
        holder = getattr(holder, slot)
    setattr(holder, leaf.path[-1], value)
    return Wrong(message, ".".join(slot[1:] for slot in leaf.path) + inner, allowed)


@st.composite
def wrong_values(draw: st.DrawFn, field: Field) -> tuple[Any, str, str]:
    """A value that a field must not hold, the path to it from there, and what is allowed."""
    of, name = field.type, field.name
    if field.shape is Shape.SINGLE:
        return draw(_wrong_single_values(of))
    length = field.size if field.size is not None else 1
    ways: list[Any] = [(None, "", name), ("abc", "", name), (5, "", name), ({1: 2}, "", name)]
    ways += [({"a"}, "", name), (iter([]), "", name)]
    right = schema_default(of)
    if field.size is not None:
        ways += [([right] * (length + 1), "", f"exactly {length} item")]
        ways += [([right] * (length - 1), "", f"exactly {length} item")]
    if field.bound is not None:
        ways += [([right] * (field.bound + 1), "", f"at most {field.bound} item")]
    wrong, inner, allowed = draw(_wrong_single_values(of))
    step = f".{inner}" if inner and not inner.startswith("[") else inner
    ways += [([right] * (length - 1) + [wrong], f"[{length - 1}]{step}", allowed)] * 4
    return draw(st.sampled_from(ways))


def schema_default(of: Type) -> Any:
    """A right value of a type."""
    if of.sort is Sort.MESSAGE:
        return of.message()
    return {
        Sort.BOOL: True, Sort.INTEGER: 1, Sort.FLOAT: 1.0, Sort.BYTE: b"a",
        Sort.TEXT: "a", Sort.WIDE_TEXT: "a",
    }[of.sort]  # fmt: skip


@st.composite
def _wrong_single_values(draw: st.DrawFn, of: Type) -> tuple[Any, str, str]:
    if of.sort is Sort.MESSAGE:
        if is_empty(of.message) or draw(st.booleans()):
            return draw(st.sampled_from([None, 1.0, "text", object()])), "", of.name
        wrong = draw(wrong_messages(of.message))
        return wrong.message, wrong.path, wrong.allowed
    ways: list[Any] = [None, [1.0], object(), 1j, {}]
    if of.sort is Sort.FLOAT:
        ways += ["fast", b"1", numpy.array([1.0, 2.0]), numpy.array([]), numpy.array(["1"])]
        ways += [10**400, numpy.timedelta64(1, "s")] + ([1e39, -4e38] if of.code == "f" else [])
    elif of.sort is Sort.INTEGER:
        allowed = range_of(of)
        ways += ["1", 0.5, math.nan, math.inf, allowed[-1] + 1, allowed[0] - 1, 1e30]
        ways += [numpy.array([1, 2]), numpy.float32(2.5)]
    elif of.sort is Sort.BOOL:
        ways += ["yes", 2, 0.0, 1, numpy.array([True, False]), numpy.int8(1)]
    elif of.sort is Sort.BYTE:
        ways += [b"", b"ab", "a", 7]
    else:
        ways += [5, b"text", "before\0after", "half \ud800"]
        ways += ["x" * (of.bound + 1)] if of.bound is not None else []
    return draw(st.sampled_from(ways)), "", of.name
