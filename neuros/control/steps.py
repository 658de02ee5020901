"""Stream of steps between a session and the process that holds all nodes of its run.

A step takes microseconds, so its messages are no lines of JSON with packets in base64. Each is a
frame: the lengths of its head and its body (two ``uint32``, little-endian), a head in JSON, and the
body, which is the bytes of its packets, one after the other. The head says how long each packet is.
"""

from __future__ import annotations

import json
import os
import select
import struct
import time
from collections.abc import Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

from neuros.errors import ControlError
from neuros.ports import ControlStream

_LENGTHS = struct.Struct("<II")
_READ = 1 << 16
_MOST_READ = 1 << 20
_SPIN_NS = 250_000
_MOST_SLEPT = 64
_to_json = json.JSONEncoder(check_circular=False, separators=(",", ":")).encode
_from_json = json.JSONDecoder().raw_decode


class Advance(NamedTuple):
    """While paused, take packets and run steps; then answer :class:`Advanced`, and pause.

    Attributes:
        number: of the question, repeated by its answer.
        rounds: so many steps.
        known: outputs whose packets are asked for, and the number of the newest known packet.
        packets: node, input and content of each packet of the session.
        end_sim_s: a simulated time at which no further step begins; each step waits for the one
            before then.
    """

    number: int
    rounds: int
    known: Mapping[str, int]
    packets: Sequence[tuple[str, str, bytes]]
    end_sim_s: float | None = None

    def to_frame(self) -> bytes:
        """The message as bytes."""
        sizes = [(node, name, len(content)) for node, name, content in self.packets]
        contents = [content for *_, content in self.packets]
        return _frame([self.number, self.rounds, self.known, sizes, self.end_sim_s], contents)

    @classmethod
    def from_frame(cls, head: Any, body: bytes) -> Advance:
        """The message of a frame. Raises ``ValueError`` or ``TypeError``."""
        number, rounds, known, sizes, end_sim_s = head
        _require(int, number, rounds, *known.values())
        _require(float, *(() if end_sim_s is None else (end_sim_s,)))
        _require(str, *(text for *texts, _ in sizes for text in texts))
        parts = _split(body, [size for *_, size in sizes])
        packets = [(node, name, part) for (node, name, _), part in zip(sizes, parts, strict=True)]
        return cls(number, rounds, known, packets, end_sim_s)


class Advanced(NamedTuple):
    """Nothing moves any more: answer to :class:`Advance`.

    Attributes:
        sim_times: simulated seconds by node, where they are known.
        packets: of the outputs asked for, those that have sent since: number of the newest packet,
            from 1, and its content.
    """

    number: int
    sim_times: Mapping[str, float]
    packets: Mapping[str, tuple[int, bytes]]

    def to_frame(self) -> bytes:
        """The message as bytes."""
        sizes = [(name, number, len(part)) for name, (number, part) in self.packets.items()]
        contents = [content for _, content in self.packets.values()]
        return _frame([self.number, self.sim_times, sizes], contents)

    @classmethod
    def from_frame(cls, head: Any, body: bytes) -> Advanced:
        """The message of a frame. Raises ``ValueError`` or ``TypeError``."""
        number, sim_times, sizes = head
        _require(int, number, *(number for _, number, _ in sizes))
        _require(float, *sim_times.values())
        _require(str, *(name for name, _, _ in sizes))
        parts = _split(body, [size for *_, size in sizes])
        packets = {name: (n, part) for (name, n, _), part in zip(sizes, parts, strict=True)}
        if len(packets) < len(sizes):
            raise ValueError("an output comes twice")
        return cls(number, sim_times, packets)


_Received = TypeVar("_Received", Advance, Advanced)


class StepLink(Generic[_Received]):
    """One end of the stream.

    Args:
        stream: what carries it.
        received: what comes from the other end.
        peer: the other end, for error messages.
    """

    def __init__(self, stream: ControlStream, received: type[_Received], peer: str) -> None:
        self._stream = stream
        self._received: type[_Received] = received
        self._peer = peer
        self._data = bytearray()

    def fileno(self) -> int:
        """For selectors."""
        return self._stream.fileno()

    def send(self, message: Advance | Advanced) -> bool:
        """Send one message; returns False if the other end is gone."""
        try:
            self._stream.sendall(message.to_frame())
        except OSError:
            return False
        return True

    def receive(self) -> list[_Received] | None:
        """The messages that have arrived, after one read; ``None`` once the other end is gone.

        Raises:
            ControlError: if one cannot be understood.
        """
        data = self._data
        missing = sum(_LENGTHS.unpack_from(data)) if len(data) >= _LENGTHS.size else 0
        try:
            read = self._stream.recv(min(max(missing, _READ), _MOST_READ))
        except OSError:
            return None
        if not read:
            return None
        data += read
        found = []
        while len(data) >= _LENGTHS.size:
            head_length, body_length = _LENGTHS.unpack_from(data)
            head_end = _LENGTHS.size + head_length
            end = head_end + body_length
            if len(data) < end:
                break
            found.append(self._message(data[_LENGTHS.size : head_end], bytes(data[head_end:end])))
            del data[:end]
        return found

    def close(self) -> None:
        """Hang up."""
        self._stream.close()

    def _message(self, head: bytearray, body: bytes) -> _Received:
        try:
            text = head.decode()
            values, end = _from_json(text)
            if end != len(text):
                raise ValueError("more than its values is in its head")
            found: _Received = self._received.from_frame(values, body)
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise ControlError(f"{self._peer} sent a frame that is no step: {error}") from None
        return found


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
        """Wait for this one, too."""
        self._poll.register(stream, select.POLLIN)

    def unregister(self, stream: Any) -> None:
        """Wait for it no more."""
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


def _frame(head: Any, contents: Sequence[bytes]) -> bytes:
    text = _to_json(head).encode()
    return b"".join((_LENGTHS.pack(len(text), sum(map(len, contents))), text, *contents))


def _split(body: bytes, sizes: Sequence[int]) -> list[bytes]:
    """The parts of a body, which have these sizes. Raises ``ValueError``."""
    _require(int, *sizes)
    if sum(sizes) != len(body) or min(sizes, default=0) < 0:
        raise ValueError(f"its packets of {list(sizes)} bytes are not its {len(body)} bytes")
    if len(sizes) == 1:
        return [body]
    parts, start = [], 0
    for size in sizes:
        parts.append(body[start : start + size])
        start += size
    return parts


def _require(kind: type, *values: Any) -> None:
    for value in values:
        if type(value) is not kind:
            raise TypeError(f"{value!r} is no {kind.__name__}")
