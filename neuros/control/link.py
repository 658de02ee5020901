"""Ends of the control channel: typed messages, as lines, over a stream of bytes."""

from __future__ import annotations

import functools
import json
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints, is_typeddict

from neuros.control import Message
from neuros.errors import ControlError
from neuros.ports import ControlStream


class ControlLink:
    """One end of a control channel.

    Args:
        stream: what carries it.
        accepted: the messages that may come from the other end.
        peer: the other end, for error messages: "the supervisor", "node 'a'".

    Attributes:
        unsent: what :meth:`flush` is to write.
    """

    def __init__(self, stream: ControlStream, accepted: Sequence[type[Message]], peer: str) -> None:
        self.stream = stream
        self.peer = peer
        self.accept(accepted)
        self.unsent = bytearray()
        self._parts: list[bytes] = []  # of a line whose end has not arrived

    def accept(self, accepted: Sequence[type[Message]]) -> None:
        """Take these messages, and no others, from now on."""
        self._accepted = {kind_of(each): each for each in accepted}

    def fileno(self) -> int:
        """For selectors."""
        return self.stream.fileno()

    @property
    def unfinished_bytes(self) -> int:
        """How much has arrived of a line whose end has not."""
        return sum(map(len, self._parts))

    def send(self, message: Message) -> bool:
        """Send one message; returns False if the other end is gone."""
        try:
            self.stream.sendall(encode(message))
        except OSError:
            return False
        return True

    def flush(self) -> bool:
        """Write what goes through now, on a stream that does not block; False if nobody is there.

        An error shows again when the link is read.
        """
        try:
            while self.unsent:
                del self.unsent[: self.stream.send(self.unsent)]
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True

    def receive(self) -> list[Message] | None:
        """The messages that have arrived, after one read; ``None`` once the other end is gone.

        Raises:
            ControlError: if one cannot be understood.
        """
        try:
            lines = self.read_lines()
        except BlockingIOError:
            return []
        return None if lines is None else [self.decode(line) for line in lines]

    def read_lines(self) -> list[bytes] | None:
        """The whole lines that have arrived, after one read; ``None`` once the other end is gone.

        Raises:
            BlockingIOError: if the stream does not block, and there is nothing to read.
        """
        try:
            data = self.stream.recv(1 << 16)
        except BlockingIOError:
            raise
        except OSError:
            return None
        if not data:
            return None
        end = data.rfind(b"\n")
        if end < 0:
            self._parts.append(data)
            return []
        lines = b"".join([*self._parts, data[:end]]).split(b"\n")
        self._parts = [data[end + 1 :]]
        return lines

    def decode(self, line: bytes) -> Message:
        """The message of a line. Raises ``ControlError``."""
        return decode(line, self._accepted, self.peer)

    def close(self) -> None:
        """Hang up."""
        self.stream.close()


_NO_CHARACTER = re.compile("[\ud800-\udfff]")
_LONGEST_SHOWN = 60
_Declared = TypeVar("_Declared")


def kind_of(message: type[Message]) -> str:
    """The name of a class of messages in the channel: ``first_hook`` of :class:`FirstHook`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", message.__name__).lower()


def encode(message: Message) -> bytes:
    """A message as one line."""
    content = {"kind": kind_of(type(message)), **vars(message)}
    text = json.dumps(content, ensure_ascii=False, default=_plain)
    if not text.isascii():
        # What is no character cannot be written anywhere: both ends see its escape in its place.
        text = _NO_CHARACTER.sub(lambda match: f"\\\\u{ord(match[0]):04x}", text)
    return text.encode() + b"\n"


def decode(line: bytes, accepted: Mapping[str, type[Message]], peer: str) -> Message:
    """The message of a line.

    Args:
        accepted: the messages that may come, by kind.
        peer: who has sent it.

    Raises:
        ControlError: if it is none of them, or a field is missing, unknown or of a wrong type.
    """
    try:
        content = json.loads(line)
        kind = content.pop("kind")
    except (ValueError, AttributeError, TypeError, KeyError, RecursionError):
        raise ControlError(
            f"{peer} sent something that is not a control message: {_shown(line)}"
        ) from None
    message = accepted.get(kind) if isinstance(kind, str) else None
    if message is None:
        raise ControlError(f"{peer} sent a control message of the unknown kind {_shown(kind)}")
    try:
        return read_as(message, content)
    except ControlError as error:
        raise ControlError(f"{peer} sent a wrong control message '{kind}': {error}") from None


def read_as(declared: type[_Declared], content: Any) -> _Declared:
    """An object of a dataclass from JSON that somebody else has written.

    Raises:
        ControlError: if a field is missing, unknown or of a wrong type.
    """
    read: _Reader = _reader(declared)  # type: ignore[arg-type]
    try:
        found: _Declared = read(content)
    except _WrongField as error:
        raise ControlError(str(error)) from None
    return found


class _WrongField(Exception):
    """A field that does not fit its class; the path to it grows from the inside."""

    def __init__(self, problem: str, path: str = "") -> None:
        self.problem = problem
        self.path = path

    def inside(self, step: str) -> _WrongField:
        """The error, seen from what holds it."""
        self.path = step + self.path
        return self

    def __str__(self) -> str:
        return f"field {self.path.lstrip('.')} {self.problem}"


def _plain(value: Any) -> Any:
    return value.value if isinstance(value, Enum) else vars(value)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


_Reader = Callable[[Any], Any]
"""Makes a value of its declared type from JSON. Raises :class:`_WrongField`."""


@functools.cache
def _reader(declared: Any) -> _Reader:
    """The reader of a declared type."""
    origin, arguments = get_origin(declared), get_args(declared)
    if declared is Any:
        return lambda value: value
    if origin in (Union, types.UnionType):
        (some,) = (each for each in arguments if each is not types.NoneType)
        read_some = _reader(some)
        return lambda value: None if value is None else read_some(value)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return functools.partial(_read_list, _reader(arguments[0]))
        return functools.partial(_read_tuple, tuple(map(_reader, arguments)))
    if is_typeddict(declared):
        return _read_object
    if origin is Mapping or origin is dict:
        return functools.partial(_read_mapping, _reader(arguments[1]))
    if is_dataclass(declared):
        return _dataclass_reader(declared)
    if issubclass(declared, Enum):
        return functools.partial(_read_enum, declared)
    return functools.partial(_read_scalar, declared)


def _read_scalar(kind: type, value: Any) -> Any:
    """A value of this type; ``bool`` is no number, and an ``int`` may stand for a ``float``."""
    if type(value) is kind or (kind is float and type(value) is int):
        return value
    raise _must_be(kind.__name__, value)


def _read_object(value: Any) -> dict[str, Any]:
    if type(value) is dict:
        return value
    raise _must_be("an object", value)


def _read_list(read: _Reader, value: Any) -> tuple[Any, ...]:
    if type(value) is not list:
        raise _must_be("a list", value)
    return _read_tuple([read] * len(value), value)


def _read_tuple(readers: Sequence[_Reader], value: Any) -> tuple[Any, ...]:
    if type(value) is not list or len(value) != len(readers):
        raise _must_be(f"a list of {len(readers)}", value)
    found: list[Any] = []
    try:
        for read, each in zip(readers, value, strict=True):
            found.append(read(each))
    except _WrongField as error:
        raise error.inside(f"[{len(found)}]") from None
    return tuple(found)


def _read_mapping(read: _Reader, value: Any) -> dict[str, Any]:
    found = {}
    for key, each in _read_object(value).items():
        try:
            found[key] = read(each)
        except _WrongField as error:
            raise error.inside(f"[{key!r}]") from None
    return found


def _read_enum(kind: type[Enum], value: Any) -> Enum:
    try:
        return kind(value)
    except ValueError:
        raise _must_be(f"one of {', '.join(str(each.value) for each in kind)}", value) from None


def _dataclass_reader(declared: Any) -> _Reader:
    """Reads a dataclass; fields with a default may be missing."""
    hints = get_type_hints(declared)
    readers = {each.name: _reader(hints[each.name]) for each in fields(declared)}
    required = {
        each.name
        for each in fields(declared)
        if each.default is MISSING and each.default_factory is MISSING
    }

    def read(value: Any) -> Any:
        given = _read_object(value)
        if missing := required - given.keys():
            raise _WrongField("is missing", f".{min(missing)}")
        if unknown := given.keys() - readers.keys():
            raise _WrongField("is unknown", f".{min(unknown)}")
        found = {}
        for name, each in given.items():
            try:
                found[name] = readers[name](each)
            except _WrongField as error:
                raise error.inside(f".{name}") from None
        return declared(**found)

    return read


def _must_be(expected: str, value: Any) -> _WrongField:
    return _WrongField(f"is {_shown(value)}, and must be {expected}")
