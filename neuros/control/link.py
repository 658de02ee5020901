"""Ends of the control channel: typed messages over a stream of bytes.

Each message is MessagePack behind its length, a ``uint32`` (little-endian).
"""

from __future__ import annotations

import functools
import os
import re
import select
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, Union

import msgspec

from neuros.control import Message
from neuros.errors import ControlError
from neuros.ports import ControlStream

_LENGTH_BYTES = 4
_LONGEST_BYTES = 1 << 29
"""Text of another protocol, whose first four bytes count as a length, claims more than this."""
_READ_BYTES, _MOST_READ_BYTES = 1 << 16, 1 << 20
_LONGEST_SHOWN = 60
_SPIN_NS = 250_000
_MOST_SLEPT = 64
_PLAIN: tuple[type[Any], ...] = (str, float, int, dict)
_NO_CHARACTER = re.compile("[\ud800-\udfff]")
_Declared = TypeVar("_Declared")


def _plain(value: Any) -> Any:
    """A value of a class that derives from a plain one, as NumPy's numbers do, as that."""
    for kind in _PLAIN:
        if isinstance(value, kind):
            return kind(value)
    raise TypeError(f"{value!r} cannot be sent")


to_bytes = msgspec.msgpack.Encoder(enc_hook=_plain).encode


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
        self._received = bytearray()  # of a message whose end has not arrived

    def accept(self, accepted: Sequence[type[Message]]) -> None:
        self._decoder = decoder_of(tuple(accepted))

    def fileno(self) -> int:
        return self.stream.fileno()

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
            found = self.read()
        except BlockingIOError:
            return []
        return None if found is None else [self.decode(data) for data in found]

    def read(self) -> list[bytes] | None:
        """The whole messages that have arrived, after one read, each without its length.

        Returns ``None`` once the other end is gone.

        Raises:
            BlockingIOError: if the stream does not block, and there is nothing to read.
            ControlError: if what arrives is no control channel at all.
        """
        length = int.from_bytes(self._received[:_LENGTH_BYTES], "little")
        missing = length + _LENGTH_BYTES - len(self._received)  # of the first message
        size = max(_READ_BYTES, min(missing, _MOST_READ_BYTES))
        try:
            data = self.stream.recv(size)
        except BlockingIOError:
            raise
        except OSError:
            return None
        if not data:
            return None
        self._received += data
        return remove_messages(self._received, self.peer)

    def decode(self, data: bytes) -> Message:
        """A message that :meth:`read` has returned. Raises ``ControlError``."""
        return decode(data, self._decoder, self.peer)

    def close(self) -> None:
        self.stream.close()


class Arrivals:
    """Waits until one of several descriptors is readable.

    It takes about as long to wake a process that sleeps as to do half of a step. So it does not
    sleep for the first quarter of a millisecond. If that was in vain (the step is a long one, or
    its other end has no core to run on), the next wait sleeps at once; then the next three, the
    next seven, and so on.
    """

    def __init__(self) -> None:
        self._poll = select.poll()
        self._slept = self._to_sleep = 0

    def register(self, stream: Any) -> None:
        self._poll.register(stream, select.POLLIN)

    def unregister(self, stream: Any) -> None:
        self._poll.unregister(stream)

    def wait(self, timeout_ms: float | None) -> list[int]:
        """The descriptors that are readable or at their end; empty if none becomes so in time."""
        if self._to_sleep:
            self._to_sleep -= 1
        else:
            end_ns = time.monotonic_ns() + _SPIN_NS
            while time.monotonic_ns() < end_ns:
                if found := self._poll.poll(0):
                    self._slept = 0
                    return [number for number, _ in found]
                os.sched_yield()
            self._slept = self._to_sleep = min(2 * self._slept + 1, _MOST_SLEPT)
        return [number for number, _ in self._poll.poll(timeout_ms)]


def encode(message: Message) -> bytes:
    """A message behind its length."""
    try:
        data = to_bytes(message)
    except UnicodeEncodeError:
        # What is no character cannot be written anywhere: both ends see its escape in its place.
        plain = msgspec.to_builtins(message, builtin_types=(bytes,))
        escape = lambda match: f"\\u{ord(match[0]):04x}"  # noqa: E731
        data = to_bytes(with_texts(plain, lambda text: _NO_CHARACTER.sub(escape, text)))
    return framed(data)


def framed(data: bytes) -> bytes:
    """The bytes of a message behind their length."""
    return len(data).to_bytes(_LENGTH_BYTES, "little") + data


def with_texts(value: Any, change: Callable[[str], str]) -> Any:
    """A value of JSON or MessagePack with each text in it, keys of maps too, changed."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, dict):
        return {with_texts(k, change): with_texts(each, change) for k, each in value.items()}
    if isinstance(value, list | tuple):
        return [with_texts(each, change) for each in value]
    return value


def remove_messages(received: bytearray, peer: str) -> list[bytes]:
    """Remove the whole messages at the start of these bytes, and return them without their lengths.

    Raises:
        ControlError: if what follows is no message.
    """
    found, start = [], 0
    with memoryview(received) as view:
        while len(view) >= start + _LENGTH_BYTES:
            begin = start + _LENGTH_BYTES
            end = begin + int.from_bytes(view[start:begin], "little")
            if end - begin > _LONGEST_BYTES:
                shown = _shown(bytes(view[start : start + _LONGEST_SHOWN]))
                raise ControlError(f"{peer} sent something that is not a control message: {shown}")
            if end > len(view):
                break
            found.append(bytes(view[begin:end]))
            start = end
    del received[:start]
    return found


@functools.cache
def decoder_of(accepted: tuple[type[Message], ...]) -> msgspec.msgpack.Decoder[Message]:
    """Decodes these messages, and no others."""
    return msgspec.msgpack.Decoder(Union[accepted])  # noqa: UP007


def decode(data: bytes, decoder: msgspec.msgpack.Decoder[Message], peer: str) -> Message:
    """The message of these bytes, which are without their length; ``peer`` has sent it.

    Raises:
        ControlError: if it is none that may come, or a field is missing, unknown or of a wrong
            type.
    """
    try:
        return decoder.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise ControlError(
            f"{peer} sent a wrong control message: {error}: {_shown(data)}"
        ) from None


def read_as(declared: type[_Declared], content: Any) -> _Declared:
    """An object of a class from the JSON of another program.

    Raises:
        ControlError: if a field is missing or of a wrong type.
    """
    try:
        return msgspec.convert(content, declared)
    except (msgspec.ValidationError, UnicodeEncodeError) as error:  # a key may be a lone surrogate
        raise ControlError(str(error)) from None


def _shown(data: bytes) -> str:
    text = repr(data)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."
