"""Checks of the values of a message against its definition, with conversion where they fit.

rclpy trusts the types of fields when it serialises: an ``int`` in a ``float64`` arrives as 1e-323,
300 in a ``uint8`` as 44. So each packet is checked once, when a hook has returned it, before it is
sent, recorded or digested on any back end. Values that fit are converted in place: a number to the
one of Python that the field can hold (rounded, for a ``float32``), a tuple to a list, and so on.
All others raise :class:`~neuros.errors.WrongValue`. Nothing changes a value afterwards.

Most messages need no conversion. :func:`_exactness` tells so for all fields together. Only the
others go field by field through the tables ``_SINGLE`` and ``_SEVERAL``, which convert or refuse.
"""

from __future__ import annotations

import numbers
import reprlib
import struct
import sys
from array import array
from collections.abc import Callable, KeysView, Sequence, ValuesView
from functools import cache, partial
from itertools import chain
from operator import attrgetter, is_
from typing import Any, NamedTuple, TypeAlias

import numpy

from neuros.errors import WrongValue
from neuros.project.message_types import ArrayType
from neuros.transport.schema import Field, Shape, Sort, Type, getter, schema

Check: TypeAlias = Callable[[Any], Any]
Convert: TypeAlias = Callable[[Any], Any]
IsExact: TypeAlias = Callable[[Any], bool]

_NOTHING = object()
_PLAIN = "?bBhHiIlLqQefd"  # numbers of NumPy that Python has, too
_FLOAT = struct.Struct("<f")
_RANGES = {code: range(2**bits) for code, bits in zip("BHIQ", (8, 16, 32, 64), strict=True)} | {
    code: range(-(2**bits), 2**bits) for code, bits in zip("bhiq", (7, 15, 31, 63), strict=True)
}
"""Values of an integer, by the code that ``struct`` has for its type."""
_REPR = reprlib.Repr()
_REPR.maxother = 60


@cache
def checker(kind: Any) -> Check:
    """The function that checks the messages of a class, or the arrays of a type.

    It returns the message, converted in place where need be, or one of that very class in place of
    one of a derived class. It raises :class:`~neuros.errors.WrongValue`.
    """
    if isinstance(kind, ArrayType):
        return _array_checker(kind)
    is_exact, convert = _exactness(kind).of_one, _message_converter(kind)

    def check(message: Any) -> Any:
        if type(message) is kind and is_exact(message):
            return message
        try:
            return convert(message)
        except Mismatch as wrong:
            raise WrongValue(wrong.path, wrong.found, wrong.allowed) from None

    layout = schema(kind)
    field = layout.leaves[0].field if len(layout.kinds) == len(layout.leaves) == 1 else None
    if field is None or _group(field) == _FLOATS:
        return check
    # Most of ``std_msgs`` have one field only: they are checked in half the time.
    slot, (expected, is_right) = field.slot, _exact(field)

    def check_field(message: Any) -> Any:
        value = getattr(message, slot, _NOTHING)
        is_typed = type(message) is kind and type(value) is expected
        return message if is_typed and (is_right is None or is_right(value)) else check(message)

    return check_field


class Mismatch(Exception):
    """A value that cannot be converted; ``path`` leads to it from the one being converted."""

    def __init__(self, found: str, allowed: str, path: str = "") -> None:
        super().__init__()
        self.found, self.allowed, self.path = found, allowed, path

    def within(self, step: str) -> Mismatch:
        """This error for the message or list that has the value being converted at ``step``."""
        is_first = not self.path or self.path.startswith("[")
        self.path = step + self.path if is_first else f"{step}.{self.path}"
        return self


# ---------------------------------------------------------------------- arrays
#
# Nothing is converted: an array of another type or shape is refused.


def _array_checker(kind: ArrayType) -> Check:
    dtype, shape = numpy.dtype(kind.dtype), kind.shape
    is_bool = dtype.kind == "b"

    def check(packet: Any) -> Any:
        is_plain = type(packet) is numpy.ndarray
        if not is_plain and isinstance(packet, numpy.ndarray):
            # The mask of a masked array would be lost. Other classes only look otherwise.
            is_plain = not isinstance(packet, numpy.ma.MaskedArray)
            packet = packet.view(numpy.ndarray) if is_plain else packet
        if not is_plain or packet.dtype != dtype or packet.shape != shape:
            raise WrongValue("", _describe_array(packet, kind), str(kind), "the array")
        if is_bool and (packet.view(numpy.uint8) > 1).any():  # other bytes are true, too
            return packet.view(numpy.uint8) != 0
        return packet

    return check


def _describe_array(value: Any, kind: ArrayType) -> str:
    """Type and shape of what is no array of a type, and how to make one of it."""
    if not isinstance(value, numpy.ndarray):
        return f"{_describe(value)}: make it with numpy.asarray(values, '{kind.dtype}')"
    found = f"{value.dtype}[{','.join(map(str, value.shape))}]"
    if isinstance(value, numpy.ma.MaskedArray):
        return f"a masked {found}: fill it, array.filled(0)"
    if value.dtype != numpy.dtype(kind.dtype) and value.dtype.kind in "biuf":
        return f"{found}: convert it, array.astype('{kind.dtype}')"
    if value.size == kind.size:
        return f"{found}: reshape it, array.reshape({', '.join(map(str, kind.shape))})"
    return found


# ---------------------------------------------------------------------- messages to leave as is


class _Exactness(NamedTuple):
    """Tells whether messages of a class hold what a receiver would see, and need no conversion.

    Numbers for ``float32`` are rounded on the way: most need that, in simulators.
    """

    of_one: IsExact
    of_all: Callable[[list[Any]], bool]


@cache
def _exactness(kind: Any) -> _Exactness:
    layout = schema(kind)
    # Sorted so that single integers and float32 are one slice of all values.
    leaves = sorted(layout.leaves, key=lambda leaf: _group(leaf.field))
    groups = [_group(leaf.field) for leaf in leaves]
    rules = [_exact(leaf.field) for leaf in leaves]
    get = getter([*layout.places[1:], *(leaf.path for leaf in leaves)])
    classes = (*layout.kinds[1:], *(found for found, _ in rules))
    begin = len(layout.kinds) - 1
    first_float = begin + groups.count(_INTEGERS)
    end = first_float + groups.count(_FLOATS)
    packed = struct.Struct("<" + "".join(leaf.field.type.code for leaf in leaves[: end - begin]))
    pack, unpack = packed.pack, packed.unpack
    float_slots = [
        (attrgetter(".".join(path)) if path else None, slot)
        for *path, slot in (leaf.path for leaf in leaves[first_float - begin : end - begin])
    ]
    checks = tuple(
        (place, check)
        for place, (_, check) in enumerate(rules, begin)
        if check is not None and place >= end
    )
    has_conditions = bool(end > begin or checks)

    def meets_conditions(message: Any, found: tuple[Any, ...]) -> bool:
        """Whether values of the right classes are right, too."""
        try:
            data = pack(*found[begin:end])
        except (struct.error, OverflowError):
            return False
        if float_slots and (rounded := unpack(data)) != found[begin:end]:
            floats = rounded[first_float - begin :]
            for (holder, slot), value in zip(float_slots, floats):  # noqa: B905, it costs time
                setattr(holder(message) if holder else message, slot, value)
        for place, check in checks:  # noqa: SIM110, a generator takes thrice as long
            if not check(found[place]):
                return False
        return True

    def is_exact(message: Any) -> bool:
        try:
            found = get(message)
        except AttributeError:
            return False
        if tuple(map(type, found)) != classes:
            return False
        return not has_conditions or meets_conditions(message, found)

    def are_exact(messages: list[Any]) -> bool:
        try:
            found = list(map(get, messages))
        except AttributeError:
            return False
        if list(map(type, chain.from_iterable(found))) != [*classes] * len(messages):
            return False
        return not has_conditions or all(map(meets_conditions, messages, found))

    return _Exactness(is_exact, are_exact)


_INTEGERS, _FLOATS, _OTHERS = range(3)


def _group(field: Field) -> int:
    if field.shape is Shape.SINGLE and field.type.sort is Sort.INTEGER:
        return _INTEGERS
    return _FLOATS if field.shape is Shape.SINGLE and field.type.code == "f" else _OTHERS


def _exact(field: Field) -> tuple[type, IsExact | None]:
    """Class of the values that need no conversion; which of that class do not, ``None``: all."""
    of, bound = field.type, field.bound
    if field.shape is Shape.SINGLE:
        return _exact_single(of)
    if field.shape is Shape.BUFFER:
        code = of.code
        return (
            array,
            lambda value: value.typecode == code and (bound is None or len(value) <= bound),
        )
    if field.shape is Shape.ARRAY:
        dtype, shape = numpy.dtype(of.code), (field.size,)
        return (
            numpy.ndarray,
            lambda value: (value.dtype is dtype or value.dtype == dtype) and value.shape == shape,
        )
    item, is_exact_item = _exact_single(of)
    classes: tuple[set[type], ...] = ({item}, set())
    least, most = field.size or 0, field.size or bound or sys.maxsize
    are_exact = _exactness(item).of_all if of.sort is Sort.MESSAGE else None

    def is_exact(values: list[Any]) -> bool:
        if set(map(type, values)) not in classes or not least <= len(values) <= most:
            return False
        if are_exact is not None:
            return are_exact(values)
        if is_exact_item is _is_text:
            return _is_text("".join(values))
        return is_exact_item is None or all(map(is_exact_item, values))

    return list, is_exact


def _exact_single(of: Type) -> tuple[type, IsExact | None]:
    """:func:`_exact` for a field, or an item, of a type."""
    bound = of.bound
    if of.sort is Sort.MESSAGE:
        return of.message, None
    if of.sort in (Sort.TEXT, Sort.WIDE_TEXT):
        if bound is None:
            return str, _is_text
        return str, lambda text: len(text) <= bound and _is_text(text)
    return {
        Sort.BOOL: (bool, None),
        Sort.INTEGER: (int, _RANGES[of.code].__contains__ if of.code in _RANGES else None),
        Sort.FLOAT: (float, None),
        Sort.BYTE: (bytes, lambda value: len(value) == 1),
        Sort.CHARACTER: (str, _is_character),
    }[of.sort]


def _is_text(text: str) -> bool:
    """Whether text arrives as it is: it does not with NUL, or halves of surrogate pairs."""
    if "\0" in text:
        return False
    try:
        return text.isascii() or bool(text.encode())
    except UnicodeEncodeError:
        return False


def _is_character(value: str) -> bool:
    return len(value) == 1 and value.isascii()


# ---------------------------------------------------------------------- converted, or refused
#
# Each function returns a value that a field can hold, the same one if there is nothing to convert,
# or raises a Mismatch.


def converter(field: Field) -> Convert:
    """The function that converts a value of a field. It raises :class:`Mismatch`."""
    if field.shape is Shape.SINGLE:
        return single_converter(field.type)
    return partial(_SEVERAL[field.shape], field)


def single_converter(of: Type) -> Convert:
    """As :func:`converter`, for one value of a type."""
    if of.sort is Sort.MESSAGE:
        return _message_converter(of.message)
    return partial(_SINGLE[of.sort], of)


@cache
def _message_converter(kind: Any) -> Convert:
    converters = [(field.slot, converter(field)) for field in schema(kind).fields]
    return partial(_to_message, kind, converters)


def _to_message(kind: Any, converters: list[tuple[str, Convert]], message: Any) -> Any:
    if type(message) is not kind:
        if not isinstance(message, kind):
            raise Mismatch(_describe(message), schema(kind).name)
        derived, message = message, object.__new__(kind)
        for slot in kind.__slots__:
            if hasattr(derived, slot):
                setattr(message, slot, getattr(derived, slot))
    for slot, convert in converters:
        value = getattr(message, slot, _NOTHING)
        try:
            converted = convert(value)
        except Mismatch as wrong:
            raise wrong.within(slot[1:]) from None
        if converted is not value:
            setattr(message, slot, converted)
    return message


def _to_bool(of: Type, value: Any) -> bool:
    allowed = "bool: True or False"
    if type(value) is bool:
        return value
    if isinstance(value, numpy.bool_ | numpy.ndarray) and value.size == 1:
        found = _as_array(value, allowed)
        if found.dtype.kind == "b":
            return bool(found.reshape(-1)[0])
    raise Mismatch(_describe(value), allowed)


def _to_integer(of: Type, value: Any) -> int:
    allowed = _RANGES[of.code]
    text = f"{of.name}: {allowed[0]} to {allowed[-1]}"
    number = value if type(value) is int else _number(value, text)
    if type(number) is float:
        if not number.is_integer():
            raise Mismatch(_describe(value), f"{text} without a fraction")
        number = int(number)
    if number not in allowed:
        raise Mismatch(_describe(value), text)
    return int(number)


def _to_float(of: Type, value: Any) -> float:
    is_single = of.code == "f"
    if isinstance(value, float) and not is_single:  # numpy.float64 is one
        return float(value)
    try:
        number = float(_number(value, of.name))
        return _FLOAT.unpack(_FLOAT.pack(number))[0] if is_single else number
    except OverflowError:
        largest = (2 - 2**-23) * 2.0**127 if is_single else sys.float_info.max  # IEEE 754
        allowed = f"{of.name}: {-largest:.8g} to {largest:.8g}"
        raise Mismatch(_describe(value), allowed) from None


def _to_byte(of: Type, value: Any) -> bytes:
    if isinstance(value, bytes | bytearray | memoryview):
        held = bytes(value)
        if len(held) == 1:
            return value if type(value) is bytes else held
    raise Mismatch(_describe(value), "byte: bytes of length 1")


def _to_character(of: Type, value: Any) -> str:
    if isinstance(value, str) and _is_character(text := str.__str__(value)):
        return text
    raise Mismatch(_describe(value), "char: one character of ASCII")


def _to_text(of: Type, value: Any) -> str:
    if not isinstance(value, str):
        raise Mismatch(_describe(value), of.name)
    text = str.__str__(value)
    if of.bound is not None and len(text) > of.bound:
        allowed = f"{of.name}: at most {of.bound} characters"
        raise Mismatch(f"{_REPR.repr(text)}: {len(text)} characters", allowed)
    if not _is_text(text):
        reason = "without NUL" if "\0" in text else "without halves of surrogate pairs"
        raise Mismatch(_describe(value), f"{of.name} {reason}")
    return text


_SINGLE: dict[Sort, Callable[[Type, Any], Any]] = {
    Sort.BOOL: _to_bool,
    Sort.INTEGER: _to_integer,
    Sort.FLOAT: _to_float,
    Sort.BYTE: _to_byte,
    Sort.CHARACTER: _to_character,
    Sort.TEXT: _to_text,
    Sort.WIDE_TEXT: _to_text,
}


def _to_buffer(field: Field, value: Any) -> array[Any]:
    code = field.type.code
    if type(value) is array and value.typecode == code:
        _check_length(len(value), field)
        return value
    found = to_numbers(field, value)
    if found.ndim != 1:
        raise _no_list(value, field)
    _check_length(len(found), field)
    return array(code, found.tobytes())


def _to_array(field: Field, value: Any) -> Any:
    dtype = numpy.dtype(field.type.code)
    if type(value) is numpy.ndarray and value.dtype == dtype and value.shape == (field.size,):
        return value
    found = to_numbers(field, value)
    _check_length(found.size, field)
    # A matrix goes row by row, as ROS documents covariances.
    return numpy.array(found, dtype).reshape(-1)


def _to_list(field: Field, value: Any) -> list[Any]:
    items = _list_of(value, field)
    _check_length(len(items), field)
    converted = _convert_items(items, field.type)
    is_same = items is value and all(map(is_, items, converted))
    return items if is_same else converted


_SEVERAL: dict[Shape, Callable[[Field, Any], Any]] = {
    Shape.BUFFER: _to_buffer,
    Shape.ARRAY: _to_array,
    Shape.LIST: _to_list,
}


def to_numbers(field: Field, value: Any) -> Any:
    """An array of NumPy of the field's type from many numbers, of any shape and length."""
    of, dtype = field.type, numpy.dtype(field.type.code)
    if isinstance(value, bytes | bytearray) and of.code == "B":
        return numpy.frombuffer(value, dtype)
    if isinstance(value, array | memoryview) or hasattr(type(value), "__array__"):
        found = _as_array(value, field.name)
        if found.dtype.kind in "biuf":
            return _cast(found, of, dtype)
        if found.ndim != 1:
            raise _no_list(value, field)
        value = list(found)
    return numpy.array(_convert_items(_list_of(value, field), of), dtype)


def _cast(found: Any, of: Type, dtype: Any) -> Any:
    if found.dtype == dtype:
        return found
    with numpy.errstate(all="ignore"):
        made = found.astype(dtype)
        if of.sort is Sort.FLOAT:
            is_wrong = numpy.isinf(made) & ~numpy.isinf(found)
        else:
            least, most = _RANGES[of.code][0], _RANGES[of.code][-1]
            if found.dtype.kind == "f":
                real = found.astype(float)
                is_in_range = (real >= least) & (real < float(most + 1))
                is_wrong = ~(is_in_range & (numpy.floor(real) == real))
            else:
                is_wrong = (found < least) | (found > most)
    if is_wrong.any():
        place = int(numpy.argmax(is_wrong.reshape(-1)))
        try:
            single_converter(of)(found.reshape(-1)[place])
        except Mismatch as wrong:
            raise wrong.within(f"[{place}]") from None
    return made


def _convert_items(items: Sequence[Any], of: Type) -> list[Any]:
    convert, converted = single_converter(of), []
    try:
        for item in items:
            converted.append(convert(item))
    except Mismatch as wrong:
        raise wrong.within(f"[{len(converted)}]") from None
    return converted


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
