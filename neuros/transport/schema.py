"""The schema of a message class: its fields, their types and bounds, found out once.

ROS describes the fields of a class that it generates in its ``SLOT_TYPES``. All that handles
messages uses this one reading of them: the check of values, codecs, copies, buffers, previews.
It uses the slots of a message, not its properties: these convert what they are given, and may copy.
"""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from operator import attrgetter, itemgetter
from typing import Any, TypeAlias

from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractSequence,
    AbstractWString,
    Array,
    BasicType,
)

Path: TypeAlias = "tuple[str, ...]"
"""Slots that lead from a message to a part of it."""


class Sort(Enum):
    """Kinds of values."""

    BOOL = "bool"
    INTEGER = "integer"
    FLOAT = "float"
    BYTE = "byte"
    CHARACTER = "character"  # IDL files alone have them
    TEXT = "text"
    WIDE_TEXT = "wide text"
    MESSAGE = "message"


NUMBERS = (Sort.INTEGER, Sort.FLOAT)


class Shape(Enum):
    """Number of values in a field, and their container in Python."""

    SINGLE = "single"
    BUFFER = "buffer"  # a sequence of numbers: array.array
    ARRAY = "array"  # a fixed number of numbers: numpy.ndarray
    LIST = "list"  # any other sequence, or fixed number of values


@dataclass(frozen=True)
class Type:
    """The type of one value.

    Attributes:
        name: as ``.msg`` files have it: ``float64``, ``string<=8``, ``geometry_msgs/Point``.
        code: of a bool, number or byte, as ``struct`` calls it (of numbers, ``array`` too).
        bound: the most characters that a text may have.
        message: the class of a message.
    """

    name: str
    sort: Sort
    code: str = ""
    bound: int | None = None
    message: Any = None


@dataclass(frozen=True)
class Field:
    """A field of a message class.

    Attributes:
        name: as ``.msg`` files have the type: ``float64[9]``, ``string<=8[<=4]``.
        type: of the value, or of each value in it.
        size: how many there are, where that is fixed.
        bound: how many there may be.
    """

    slot: str
    name: str
    type: Type
    shape: Shape
    size: int | None = None
    bound: int | None = None

    @property
    def is_message(self) -> bool:
        return self.shape is Shape.SINGLE and self.type.sort is Sort.MESSAGE

    @property
    def is_unbounded(self) -> bool:
        """Whether it may have any number of values, or of characters."""
        if self.shape is Shape.SINGLE:
            return self.type.sort in (Sort.TEXT, Sort.WIDE_TEXT) and self.type.bound is None
        return self.size is None and self.bound is None


@dataclass(frozen=True)
class Leaf:
    """A field of a message, or of one within it: how it is reached, and which of them has it."""

    path: Path
    owner: int
    field: Field


BASIC_TYPES = {
    "boolean": Type("bool", Sort.BOOL, "?"),
    "octet": Type("byte", Sort.BYTE, "c"),
    "char": Type("char", Sort.CHARACTER),
    "wchar": Type("wchar", Sort.CHARACTER),
    "float": Type("float32", Sort.FLOAT, "f"),
    "double": Type("float64", Sort.FLOAT, "d"),
} | {
    name: Type(name, Sort.INTEGER, code)
    for name, code in zip(
        ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"),
        "bBhHiIqQ",
        strict=True,
    )
}
"""By their names in IDL."""


_MANY = 15
"""Slots; fewer are set one by one, which takes less than to prepare for all of them."""


class Schema:
    """The fields of a message class, those of single messages within it laid out beside its own.

    Attributes:
        name: as ``.msg`` files have it, ``geometry_msgs/Point``.
        fields: its own, in the order of the definition.
        kinds: the class, and those of the messages within it, each behind the one that holds it.
        places: the slots that lead to each of these.
        switches: slots that hold no field (whether setters check): whose of these, name and value.
        leaves: all fields that hold no single message, in the order of the definition.
        encoded: the same, with ``None`` for each message without fields, which takes a byte.
        values: gets the values of all leaves of a message, as a tuple.
        fill: puts into new messages of ``kinds`` what belongs there: those behind the first one,
            the values of ``switches``, and those of all leaves.
    """

    def __init__(self, kind: Any) -> None:
        default, names = kind(), kind.get_fields_and_field_types()
        self.name = f"{kind.__module__.partition('.')[0]}/{kind.__name__}"
        self.fields = tuple(map(_field, names, kind.SLOT_TYPES))
        slots = {field.slot for field in self.fields}
        self.kinds: list[Any] = [kind]
        self.places: list[Path] = [()]
        self.switches = [(0, s, getattr(default, s)) for s in kind.__slots__ if s not in slots]
        self.encoded: list[Leaf | None] = [] if self.fields else [None]
        for field in self.fields:
            if field.is_message:
                self._add(field.slot, schema(field.type.message))
            else:
                self.encoded.append(Leaf((field.slot,), 0, field))
        self.leaves = [leaf for leaf in self.encoded if leaf is not None]
        self.values = getter([leaf.path for leaf in self.leaves])
        self.fill = self._filler()
        self._fixed = [value for *_, value in self.switches]

    def make(self, values: Iterable[Any]) -> Any:
        """A message of the class with these values of its leaves."""
        made = list(map(object.__new__, self.kinds))
        self.fill(made, [*made[1:], *self._fixed, *values])
        return made[0]

    def _add(self, slot: str, inner: Schema) -> None:
        place = len(self.kinds)
        self.kinds += inner.kinds
        self.places += [(slot, *path) for path in inner.places]
        self.switches += [(place + owner, name, value) for owner, name, value in inner.switches]
        self.encoded += [
            leaf and Leaf((slot, *leaf.path), place + leaf.owner, leaf.field)
            for leaf in inner.encoded
        ]

    def _filler(self) -> Callable[[list[Any], list[Any]], Any]:
        """Many slots are set in one go, without a turn of the interpreter for each."""
        place_of = {path: place for place, path in enumerate(self.places)}
        targets = [(place_of[path[:-1]], path[-1]) for path in self.places[1:]]
        targets += [(owner, slot) for owner, slot, _ in self.switches]
        targets += [(leaf.owner, leaf.field.slot) for leaf in self.leaves]
        owners = _items([owner for owner, _ in targets])
        names = [slot for _, slot in targets]
        if len(names) > _MANY:
            return lambda made, values: deque(map(setattr, owners(made), names, values), maxlen=0)

        def fill(made: list[Any], values: list[Any]) -> None:
            for message, name, value in zip(owners(made), names, values):  # noqa: B905, it costs
                setattr(message, name, value)

        return fill


@cache
def schema(kind: Any) -> Schema:
    return Schema(kind)


def getter(paths: Sequence[Path]) -> Callable[[Any], tuple[Any, ...]]:
    """A function that gets the values at several places of a message, as a tuple."""
    names = [".".join(path) for path in paths]
    if not names:
        return lambda message: ()
    get: Callable[[Any], Any] = attrgetter(*names)
    return get if len(names) > 1 else lambda message: (get(message),)


def _items(places: list[int]) -> Callable[[list[Any]], Sequence[Any]]:
    if len(places) == 1:
        return tuple  # there is one message only
    get: Callable[[list[Any]], tuple[Any, ...]] = itemgetter(*places)
    return get


def _field(name: str, of: Any) -> Field:
    """A field, from its entry in ``SLOT_TYPES``."""
    slot = f"_{name}"
    if isinstance(of, Array):
        inner = _type(of.value_type)
        shape = Shape.ARRAY if inner.sort in NUMBERS else Shape.LIST
        return Field(slot, f"{inner.name}[{of.size}]", inner, shape, size=of.size)
    if isinstance(of, AbstractSequence):
        inner = _type(of.value_type)
        shape = Shape.BUFFER if inner.sort in NUMBERS else Shape.LIST
        bound = of.maximum_size if of.has_maximum_size() else None
        limit = "" if bound is None else f"<={bound}"
        return Field(slot, f"{inner.name}[{limit}]", inner, shape, bound=bound)
    single = _type(of)
    return Field(slot, single.name, single, Shape.SINGLE)


def _type(of: Any) -> Type:
    if isinstance(of, BasicType):
        return BASIC_TYPES[of.typename]
    if isinstance(of, AbstractGenericString):
        is_wide = isinstance(of, AbstractWString)
        name, sort = ("wstring", Sort.WIDE_TEXT) if is_wide else ("string", Sort.TEXT)
        if not of.has_maximum_size():
            return Type(name, sort)
        return Type(f"{name}<={of.maximum_size}", sort, bound=of.maximum_size)
    kind = getattr(importlib.import_module(".".join(of.namespaces)), of.name)
    return Type(f"{of.namespaces[0]}/{of.name}", Sort.MESSAGE, message=kind)
