"""Checks of the values of a message against its definition, with conversion where they fit.

rclpy trusts the types of fields when it serialises: an ``int`` in a ``float64`` arrives as 1e-323,
300 in a ``uint8`` as 44. So each packet is checked once, when a hook has returned it, before it is
sent, recorded or digested on any back end. What fits is converted in place: a number to the one of
Python that the field can hold (rounded, for a ``float32``), a tuple to a list, and so on. Nothing
changes a value afterwards, on any way. All else raises :class:`~neuros.errors.WrongValue`.

Most messages need no conversion. That is found out for all fields together; only otherwise is each
one looked at, and converted or refused.
"""

from __future__ import annotations

import numbers
import reprlib
import struct
import sys
from array import array
from collections.abc import Callable, KeysView, Sequence, ValuesView
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy

from neuros.errors import WrongValue
from neuros.transport.schema import Field, Leaf, Path, Shape, Sort, Type, getter, schema

Check: TypeAlias = Callable[[Any], Any]
Convert: TypeAlias = Callable[[Any], Any]
IsExact: TypeAlias = Callable[[Any], bool]

_NOTHING = object()
_PLAIN = "?bBhHiIlLqQefd"  # numbers of NumPy that Python has, too
_FLOAT = struct.Struct("<f")
_TEXTS = (Sort.TEXT, Sort.WIDE_TEXT)
_KINDS: dict[Sort, type] = {
    Sort.BOOL: bool, Sort.INTEGER: int, Sort.FLOAT: float, Sort.BYTE: bytes,
    Sort.CHARACTER: str, Sort.TEXT: str, Sort.WIDE_TEXT: str,
}  # fmt: skip
_REPR = reprlib.Repr()
_REPR.maxother = 60


@cache
def checker(kind: Any) -> Check:
    """The function that checks the messages of a class.

    It returns the message, converted in place where need be, or one of that very class in place of
    one of a derived class. It raises :class:`~neuros.errors.WrongValue`.
    """
    is_exact, convert = _exactness(kind).of_one, _convert_message(kind)

    def check(message: Any) -> Any:
        if type(message) is kind and is_exact(message):
            return message
        try:
            return convert(message)
        except Mismatch as wrong:
            raise WrongValue(wrong.path, wrong.found, wrong.allowed) from None

    return check


class Mismatch(Exception):
    """A wrong value, with the steps that lead to it from where it has come to so far."""

    def __init__(self, found: str, allowed: str, path: str = "") -> None:
        super().__init__()
        self.found, self.allowed, self.path = found, allowed, path

    def within(self, step: str) -> Mismatch:
        """This error, seen from one step further out."""
        is_first = not self.path or self.path.startswith("[")
        self.path = step + self.path if is_first else f"{step}.{self.path}"
        return self


# ---------------------------------------------------------------------- right already


class _Exactness(NamedTuple):
    """Checks whether the fields of a message, or of several, hold what a receiver would see.

    A ``float32`` between two that there are is rounded on the way: most are, in simulators.
    """

    of_one: IsExact
    of_all: Callable[[list[Any]], bool]


@cache
def _exactness(kind: Any) -> _Exactness:
    layout = schema(kind)
    # Sorted so that each group is a slice of all values, which are got in one go.
    leaves = sorted(layout.leaves, key=lambda leaf: _group(leaf.field))
    get = getter([*layout.places[1:], *(leaf.path for leaf in leaves)])
    kinds = (*layout.kinds[1:], *(_kind_of(leaf.field) for leaf in leaves))
    is_in_range = _is_in_range(leaves, len(kinds))

    def is_exact(message: Any) -> bool:
        try:
            found = get(message)
        except AttributeError:
            return False
        if tuple(map(type, found)) != kinds:
            return False
        return is_in_range is None or is_in_range(message, found)

    def are_exact(messages: list[Any]) -> bool:
        try:
            found = list(map(get, messages))
        except AttributeError:
            return False
        if list(map(type, chain.from_iterable(found))) != [*kinds] * len(messages):
            return False
        return is_in_range is None or all(map(is_in_range, messages, found))

    if len(kinds) == len(leaves) == 1 and _group(leaves[0].field) != 1:
        return _Exactness(_is_exact_single(leaves[0].field), are_exact)
    return _Exactness(is_exact, are_exact)


def _is_exact_single(field: Field) -> IsExact:
    """For messages with this field only, as most of ``std_msgs`` are: in half the time."""
    get, kind, check = attrgetter(field.slot), _kind_of(field), _is_exact_field(field)
    if _group(field) == 0:
        check = _range_of(field.type).__contains__

    def is_exact(message: Any) -> bool:
        try:
            value = get(message)
        except AttributeError:
            return False
        return type(value) is kind and (check is None or check(value))

    return is_exact


def _is_in_range(
    leaves: Sequence[Leaf], count: int
) -> Callable[[Any, tuple[Any, ...]], bool] | None:
    """For a message with values of the right classes, those of ``leaves`` last.

    ``None`` if any will do.
    """
    groups = [_group(leaf.field) for leaf in leaves]
    begin = count - len(leaves)
    between = begin + groups.count(0)
    end = between + groups.count(1)
    integers = struct.Struct(
        "<" + "".join(leaf.field.type.code for leaf in leaves[: groups.count(0)])
    )
    floats = struct.Struct(f"<{groups.count(1)}f")
    pack_integers, pack, unpack = integers.pack, floats.pack, floats.unpack
    has_integers, has_floats = between > begin, end > between
    setters = [_setter(leaf.path) for leaf in leaves[between - begin : end - begin]]
    checks = tuple(
        (begin + place, check)
        for place, leaf in enumerate(leaves)
        if (check := _is_exact_field(leaf.field)) is not None
    )
    if not (has_integers or has_floats or checks):
        return None

    def is_in_range(message: Any, found: tuple[Any, ...]) -> bool:
        try:
            if has_integers:
                pack_integers(*found[begin:between])
            if has_floats and (rounded := unpack(pack(*found[between:end]))) != found[between:end]:
                for put, value in zip(setters, rounded):  # noqa: B905, the check costs time
                    put(message, value)
        except (struct.error, OverflowError):
            return False
        for place, check in checks:  # noqa: SIM110, a generator takes thrice as long
            if not check(found[place]):
                return False
        return True

    return is_in_range


def _setter(path: Path) -> Callable[[Any, Any], None]:
    *holder, slot = path
    if not holder:
        return lambda message, value: setattr(message, slot, value)
    get = attrgetter(".".join(holder))
    return lambda message, value: setattr(get(message), slot, value)


def _group(field: Field) -> int:
    """0 for single integers, 1 for single ``float32``, 2 for the rest."""
    if field.shape is not Shape.SINGLE:
        return 2
    return 0 if field.type.sort is Sort.INTEGER else 1 if field.type.code == "f" else 2


def _kind_of(field: Field) -> type:
    if field.shape is Shape.SINGLE:
        return _KINDS[field.type.sort]
    return {Shape.BUFFER: array, Shape.ARRAY: numpy.ndarray, Shape.LIST: list}[field.shape]


def _is_exact_field(field: Field) -> IsExact | None:
    """For values of the right class, ``None`` where all of them are right."""
    of, bound = field.type, field.bound
    if field.shape is Shape.BUFFER:
        code = of.code
        if bound is None:
            return lambda value: bool(value.typecode == code)
        return lambda value: value.typecode == code and len(value) <= bound
    if field.shape is Shape.ARRAY:
        dtype, shape = numpy.dtype(of.code), (field.size,)
        return lambda value: (value.dtype is dtype or value.dtype == dtype) and value.shape == shape
    if field.shape is Shape.LIST:
        return _is_exact_list(field)
    if of.sort in _TEXTS:
        return _is_exact_text(of)
    if of.sort is Sort.BYTE:
        return lambda value: len(value) == 1
    return _is_character if of.sort is Sort.CHARACTER else None


def _is_exact_list(field: Field) -> IsExact:
    of, size, bound = field.type, field.size, field.bound
    is_message = of.sort is Sort.MESSAGE
    kinds: tuple[set[type], ...] = ({of.message if is_message else _KINDS[of.sort]}, set())
    are_exact = _exactness(of.message).of_all if is_message else _are_exact_values(of)

    def is_exact(values: list[Any]) -> bool:
        if set(map(type, values)) not in kinds:
            return False
        if size is not None and len(values) != size:
            return False
        if bound is not None and len(values) > bound:
            return False
        return are_exact is None or are_exact(values)

    return is_exact


def _are_exact_values(of: Type) -> Callable[[list[Any]], bool] | None:
    is_exact = _is_exact_field(Field("", of.name, of, Shape.SINGLE))
    if is_exact is None:
        return None
    if of.sort in _TEXTS and of.bound is None:
        return lambda texts: is_exact("".join(texts))
    return lambda values: all(map(is_exact, values))


def _is_exact_text(of: Type) -> IsExact:
    bound = of.bound
    if bound is None:
        return lambda text: "\0" not in text and (text.isascii() or _is_unicode(text))
    return lambda text: (
        len(text) <= bound and "\0" not in text and (text.isascii() or _is_unicode(text))
    )


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _is_character(value: str) -> bool:
    return len(value) == 1 and value.isascii()


# ---------------------------------------------------------------------- converted, or refused


@cache
def _convert_message(kind: Any) -> Convert:
    layout = schema(kind)
    fields = tuple((field.slot, _convert_field(field)) for field in layout.fields)

    def convert(message: Any) -> Any:
        if type(message) is not kind:
            if not isinstance(message, kind):
                raise Mismatch(_describe(message), layout.name)
            message = _of_very_class(message, kind)
        for slot, convert_field in fields:
            value = getattr(message, slot, _NOTHING)
            try:
                converted = convert_field(value)
            except Mismatch as wrong:
                raise wrong.within(slot[1:]) from None
            if converted is not value:
                setattr(message, slot, converted)
        return message

    return convert


def _of_very_class(message: Any, kind: Any) -> Any:
    """A message that is of a derived class, as one of the class itself."""
    twin: Any = object.__new__(kind)
    for slot in kind.__slots__:
        if hasattr(message, slot):
            setattr(twin, slot, getattr(message, slot))
    return twin


def _convert_field(field: Field) -> Convert:
    if field.shape is Shape.SINGLE:
        return single_converter(field.type)
    if field.shape is Shape.LIST:
        return _convert_list(field)
    return buffer_converter(field) if field.shape is Shape.BUFFER else _convert_array(field)


def single_converter(of: Type) -> Convert:
    if of.sort is Sort.MESSAGE:
        return _convert_message(of.message)
    if of.sort is Sort.INTEGER:
        return _convert_integer(of)
    if of.sort is Sort.FLOAT:
        return _convert_float(of)
    if of.sort in _TEXTS:
        return _convert_text(of)
    return {Sort.BOOL: _to_bool, Sort.BYTE: _to_byte, Sort.CHARACTER: _to_character}[of.sort]


def _convert_integer(of: Type) -> Convert:
    allowed = _range_of(of)
    text = f"{of.name}: {allowed[0]} to {allowed[-1]}"

    def convert(value: Any) -> int:
        number = value if type(value) is int else _number(value, text)
        if type(number) is float:
            if not number.is_integer():
                raise Mismatch(_describe(value), f"{text} without a fraction")
            number = int(number)
        if number not in allowed:
            raise Mismatch(_describe(value), text)
        return int(number)

    return convert


def _convert_float(of: Type) -> Convert:
    is_single = of.code == "f"
    largest = (2 - 2**-23) * 2.0**127 if is_single else sys.float_info.max  # IEEE 754
    limits = f"{of.name}: {-largest:.8g} to {largest:.8g}"

    def convert(value: Any) -> float:
        number = value if type(value) is float else _number(value, of.name)
        try:
            if not is_single:
                return float(number)
            rounded: float = _FLOAT.unpack(_FLOAT.pack(float(number)))[0]
        except OverflowError:
            raise Mismatch(_describe(value), limits) from None
        return rounded

    return convert


def _number(value: Any, allowed: str) -> int | float:
    """A number of any library, or an array with one, as one of Python."""
    if isinstance(value, float):  # numpy.float64 is one
        return float(value)
    if isinstance(value, numpy.generic) and value.dtype.char in _PLAIN:
        plain: int | float = value.item()
        return plain
    if hasattr(type(value), "__array__"):
        found = _as_array(value, allowed)
        if found.size == 1 and found.dtype.kind in "biuf":
            number = found.reshape(-1)[0]
            if found.dtype.kind != "f":
                return int(number)
            if not numpy.isfinite(number) or numpy.isfinite(float(number)):
                return float(number)
    elif isinstance(value, numbers.Integral):
        return int(value)
    elif isinstance(value, numbers.Real):
        return float(value)
    raise Mismatch(_describe(value), allowed)


def _as_array(value: Any, allowed: str) -> Any:
    try:
        found = numpy.asarray(value)
    except Exception:  # an array of another library, which has its reasons
        raise Mismatch(_describe(value), allowed) from None
    if isinstance(value, numpy.ma.MaskedArray) and numpy.ma.is_masked(value):
        raise Mismatch(_describe(value), allowed)
    return found


def _convert_text(of: Type) -> Convert:
    is_exact = _is_exact_text(of)

    def convert(value: Any) -> str:
        if not isinstance(value, str):
            raise Mismatch(_describe(value), of.name)
        text = str.__str__(value)
        if is_exact(text):
            return text
        if of.bound is not None and len(text) > of.bound:
            allowed = f"{of.name}: at most {of.bound} characters"
            raise Mismatch(f"{_REPR.repr(text)}: {len(text)} characters", allowed)
        reason = "without NUL" if "\0" in text else "without halves of surrogate pairs"
        raise Mismatch(_describe(value), f"{of.name} {reason}")

    return convert


def _to_bool(value: Any) -> bool:
    if type(value) is bool:
        return value
    if isinstance(value, numpy.bool_ | numpy.ndarray) and value.size == 1:
        found = _as_array(value, "bool: True or False")
        if found.dtype.kind == "b":
            return bool(found.reshape(-1)[0])
    raise Mismatch(_describe(value), "bool: True or False")


def _to_byte(value: Any) -> bytes:
    if isinstance(value, bytes | bytearray | memoryview):
        held = bytes(value)
        if len(held) == 1:
            return value if type(value) is bytes else held
    raise Mismatch(_describe(value), "byte: bytes of length 1")


def _to_character(value: Any) -> str:
    if isinstance(value, str) and _is_character(text := str.__str__(value)):
        return text
    raise Mismatch(_describe(value), "char: one character of ASCII")


def _convert_list(field: Field) -> Convert:
    convert_item = single_converter(field.type)

    def convert(value: Any) -> list[Any]:
        items = _list_of(value, field)
        _check_length(len(items), field)
        converted = _convert_items(items, convert_item)
        is_same = items is value and all(map(_is, items, converted))
        return items if is_same else converted

    return convert


def _is(one: object, other: object) -> bool:
    return one is other


def _convert_items(items: Sequence[Any], convert_item: Convert) -> list[Any]:
    converted: list[Any] = []
    try:
        for item in items:
            converted.append(convert_item(item))
    except Mismatch as wrong:
        raise wrong.within(f"[{len(converted)}]") from None
    return converted


def _list_of(value: Any, field: Field) -> list[Any]:
    """The items of anything that has some, in an order."""
    if type(value) is list:
        return value
    if isinstance(value, str | bytes | bytearray | memoryview):
        raise _no_list(value, field)
    if hasattr(type(value), "__array__"):
        found = _as_array(value, field.name)
        if found.ndim != 1:
            raise _no_list(value, field)
        return list(found)
    if not isinstance(value, Sequence | KeysView | ValuesView | array):
        raise _no_list(value, field)
    return list(value)


def _no_list(value: Any, field: Field) -> Mismatch:
    return Mismatch(_describe(value), f"{field.name}: a list, a tuple or an array")


def _check_length(length: int, field: Field) -> None:
    if field.size is not None and length != field.size:
        raise Mismatch(_items(length), f"{field.name}: exactly {_items(field.size)}")
    if field.bound is not None and length > field.bound:
        raise Mismatch(_items(length), f"{field.name}: at most {_items(field.bound)}")


def _items(number: int) -> str:
    return f"{number} item{'' if number == 1 else 's'}"


def buffer_converter(field: Field) -> Convert:
    code = field.type.code
    to_numbers = numbers_converter(field)

    def convert(value: Any) -> array[Any]:
        if type(value) is array and value.typecode == code:
            _check_length(len(value), field)
            return value
        found = to_numbers(value)
        if found.ndim != 1:
            raise _no_list(value, field)
        _check_length(len(found), field)
        return array(code, found.tobytes())

    return convert


def _convert_array(field: Field) -> Convert:
    dtype, shape = numpy.dtype(field.type.code), (field.size,)
    to_numbers = numbers_converter(field)

    def convert(value: Any) -> Any:
        if type(value) is numpy.ndarray and value.dtype == dtype and value.shape == shape:
            return value
        found = to_numbers(value)
        _check_length(found.size, field)
        # A matrix goes row by row, as ROS documents covariances.
        return numpy.array(found, dtype).reshape(-1)

    return convert


def numbers_converter(field: Field) -> Convert:
    """A function that makes an array of NumPy of the field's type from many numbers."""
    of, dtype = field.type, numpy.dtype(field.type.code)
    convert_item = single_converter(of)

    def convert(value: Any) -> Any:
        if isinstance(value, bytes | bytearray) and of.code == "B":
            return numpy.frombuffer(value, dtype)
        if isinstance(value, array | memoryview) or hasattr(type(value), "__array__"):
            found = _as_array(value, field.name)
            if found.dtype.kind in "biuf":
                return _cast(found, of, dtype)
            if found.ndim != 1:
                raise _no_list(value, field)
            value = list(found)
        return numpy.array(_convert_items(_list_of(value, field), convert_item), dtype)

    return convert


def _cast(found: Any, of: Type, dtype: Any) -> Any:
    if found.dtype == dtype:
        return found
    with numpy.errstate(all="ignore"):
        if of.sort is Sort.FLOAT:
            made = found.astype(dtype)
            is_wrong = numpy.isinf(made) & ~numpy.isinf(found)
        elif found.dtype.kind == "f":
            allowed, real = _range_of(of), found.astype(float)
            is_in_range = (real >= allowed[0]) & (real < float(allowed[-1] + 1))
            is_wrong = ~(is_in_range & (numpy.floor(real) == real))
            made = found.astype(dtype)
        else:
            allowed = _range_of(of)
            is_wrong = (found < allowed[0]) | (found > allowed[-1])
            made = found.astype(dtype)
    if is_wrong.any():
        place = int(numpy.argmax(is_wrong.reshape(-1)))
        try:
            single_converter(of)(found.reshape(-1)[place])
        except Mismatch as wrong:
            raise wrong.within(f"[{place}]") from None
    return made


def _range_of(of: Type) -> range:
    bits = 8 * struct.calcsize(of.code)
    is_signed = of.code.islower()
    return range(-(2 ** (bits - 1)), 2 ** (bits - 1)) if is_signed else range(2**bits)


def _describe(value: Any) -> str:
    """A value and its type, in one line."""
    if value is _NOTHING:
        return "nothing"
    kind = type(value)
    if hasattr(kind, "get_fields_and_field_types"):
        return f"a {kind.__module__.partition('.')[0]}/{kind.__name__}"
    name = kind.__qualname__
    if kind.__module__ != "builtins":
        name = f"{kind.__module__}.{name}"
    shown = _REPR.repr(value.item() if isinstance(value, numpy.generic) else value)
    in_one_line = " ".join(shown.split()).encode(errors="backslashreplace").decode()
    return f"{in_one_line} ({name})"
