"""Samples of the packets that pass a node, for observers that ask for them.

Each observer asks again and again (:meth:`Sampler.ask`): each time it gets what was sampled for it
since, and a few packets more are looked at, on the thread that sends them, when they pass anyway.
Without a question it costs nothing; with one, a node looks at so many packets at most, however
fast it sends. What is copied while a packet passes is bounded; it is encoded by the thread that
answers.

Fields are named by their paths: ``pose.position.x``, ``ranges[3]``. Pictures of images are small:
every k-th pixel of every k-th row, without any library.
"""

from __future__ import annotations

import base64
import math
import re
import time
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from neuros.control import WORLD
from neuros.node.instruments import Observe, Passage
from neuros.ports import Way, WorldLook
from neuros.time import to_seconds

FieldPath: TypeAlias = "tuple[str | int, ...]"

MOST_VALUES = 20
"""Packets per question of which chosen fields are read, or that are read whole."""
MOST_BYTES = 4_000_000
"""Of whole packets, per question and port; one packet may be larger."""
MOST_SPIKES = 20_000
"""Spikes per question; further ones are counted only."""
MOST_PACKETS = 4000
"""Packets per question of which spikes are gathered."""
MOST_ARRAYS = 20
"""Packets per question of which an array is read."""
LONGEST_ARRAY = 4096
MOST_FIELDS = 300
MOST_ELEMENTS = 12
WIDTH, HEIGHT = 320, 240
"""A picture is no larger than this."""

_LONGEST_TEXT = 200
_MOST_COMPRESSED_BYTES = 400_000
_STEP = re.compile(r"\.?([A-Za-z_]\w*)|\[(\d+)\]")
# Bytes per pixel, by the names of sensor_msgs/image_encodings.
PIXEL_BYTES = {"mono8": 1, "8UC1": 1, "mono16": 2, "16UC1": 2, "rgb8": 3, "bgr8": 3, "8UC3": 3}
PIXEL_BYTES |= {"rgba8": 4, "bgra8": 4, "32FC1": 4}


class _Part(Protocol):
    """What is read of the packets of a port.

    Attributes:
        is_full: whether no further packet is read, so that a page that nobody reads costs nothing.
    """

    @property
    def is_full(self) -> bool: ...
    def add(self, packet: Any, encode: Callable[[], bytes]) -> None:
        """Read a packet, of which anything may be wrong; ``encode`` serialises it."""

    def answer(self) -> Mapping[str, Any]:
        """What was read, ready for JSON; empty if no packet has passed."""


class _Fields:
    """Chosen numbers of each packet, behind the time when it passed (monotonic, seconds)."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = list(names)
        self._paths = [*map(parse_path, names)]
        self._values: list[list[float | None]] = []

    @property
    def is_full(self) -> bool:
        return len(self._values) >= MOST_VALUES

    def add(self, packet: Any, _: Callable[[], bytes]) -> None:
        values = [number_at(packet, path) for path in self._paths]
        self._values.append([time.monotonic(), *values])

    def answer(self) -> Mapping[str, Any]:
        return {"fields": self._names, "values": self._values} if self._values else {}


class _One:
    """One packet: ``read`` copies what is needed of it, and ``encode`` makes it ready for JSON."""

    def __init__(
        self, name: str, read: Callable[[Any], Any], encode: Callable[[Any], dict[str, Any]] = dict
    ) -> None:
        self._name = name
        self._read = read
        self._encode = encode
        self._found: Any = None
        self.is_full = False

    def add(self, packet: Any, _: Callable[[], bytes]) -> None:
        self.is_full = True
        self._found = self._read(packet)

    def answer(self) -> Mapping[str, Any]:
        return {} if self._found is None else {self._name: self._encode(self._found)}


class _Whole:
    """Packets as ROS serialises them, each with the time when it passed (monotonic, seconds)."""

    def __init__(self) -> None:
        self._packets: list[tuple[float, bytes]] = []
        self._room = MOST_BYTES

    @property
    def is_full(self) -> bool:
        return len(self._packets) >= MOST_VALUES or self._room <= 0

    def add(self, _: Any, encode: Callable[[], bytes]) -> None:
        data = encode()
        self._room -= len(data)
        self._packets.append((time.monotonic(), data))

    def answer(self) -> Mapping[str, Any]:
        return {"packets": self._packets} if self._packets else {}


class _Spikes:
    """Spikes of packets of type ``neuros_msgs/msg/Spikes``.

    ``senders`` (uint32) and ``times`` (float64, seconds) are base64 of little-endian numbers;
    ``count`` is that of all spikes that passed, ``size`` that of the neurons, ``stamp_s`` the stamp
    of the last packet, in seconds.
    """

    def __init__(self) -> None:
        self._senders, self._times = array("I"), array("d")
        self._size = self._count = self._packets = 0
        self._stamp_s = 0.0

    @property
    def is_full(self) -> bool:
        return self._packets >= MOST_PACKETS or self._count > 2 * MOST_SPIKES

    def add(self, packet: Any, _: Callable[[], bytes]) -> None:
        senders, times = packet.senders, packet.times
        self._packets += 1
        if len(senders) != len(times):
            raise ValueError(f"{len(senders)} senders do not fit {len(times)} times")
        self._count += len(senders)
        self._size = max(self._size, packet.size)
        self._stamp_s = to_seconds(packet)
        room = max(0, MOST_SPIKES - len(self._times))
        self._times.extend(array("d", times[:room]))
        self._senders.extend(array("I", senders[:room]))

    def answer(self) -> Mapping[str, Any]:
        if not self._packets:
            return {}
        known = min(len(self._times), len(self._senders))  # the other thread may be adding
        found = {"size": self._size, "count": self._count, "stamp_s": self._stamp_s}
        senders, times = _base64(self._senders[:known]), _base64(self._times[:known])
        return {"spikes": {**found, "senders": senders, "times": times}}


class _Arrays:
    """An array of each of a few packets.

    Of each packet: when it passed (monotonic, seconds), its numbers, base64 of float32, at most
    :data:`LONGEST_ARRAY`, and how many it has.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._path = parse_path(name)
        self._packets = 0
        self._rows: list[tuple[float, array[float], int]] = []

    @property
    def is_full(self) -> bool:
        return self._packets >= MOST_ARRAYS

    def add(self, packet: Any, _: Callable[[], bytes]) -> None:
        self._packets += 1
        numbers = _follow(packet, self._path)
        self._rows.append((time.monotonic(), array("f", numbers[:LONGEST_ARRAY]), len(numbers)))

    def answer(self) -> Mapping[str, Any]:
        rows = [[time_s, _base64(row), length] for time_s, row, length in self._rows]
        return {"arrays": {self._name: rows}} if rows else {}


class _Request:
    """A request for packets of one port, and its answer so far."""

    def __init__(self, wanted: Mapping[str, Any]) -> None:
        most = int(wanted.get("most_elements", 0))
        self._parts: list[_Part] = [*map(_Arrays, wanted.get("arrays", ()))]
        if wanted.get("fields"):
            self._parts.append(_Fields(wanted["fields"]))
        if wanted.get("spikes"):
            self._parts.append(_Spikes())
        if wanted.get("packets"):
            self._parts.append(_Whole())
        if wanted.get("all"):
            self._parts.append(_One("all", lambda packet: all_fields(packet, most)))
        if wanted.get("image"):
            self._parts.append(_One("image", preview, Preview.encode))
        self._fault: str | None = None

    @property
    def is_met(self) -> bool:
        """Whether no further packet is wanted."""
        return all(part.is_full for part in self._parts)

    def sample(self, packet: Any, encode: Callable[[], bytes]) -> None:
        """Sample a packet; what cannot be read of it is no fault of the node's."""
        for part in self._parts:
            if not part.is_full:
                try:
                    part.add(packet, encode)
                except Exception as error:  # a plugin may have put anything in there
                    self._fault = f"{type(error).__name__}: {error}"

    def answer(self) -> dict[str, Any]:
        """The answer, ready for JSON; empty if no packet has passed."""
        found: dict[str, Any] = {}
        for part in self._parts:
            for key, value in part.answer().items():
                found[key] = {**found[key], **value} if key == "arrays" and key in found else value
        return found if self._fault is None else {**found, "fault": self._fault}


class _ArrayMessage:
    """An array as the message that it is in ROS, without its layout.

    Attributes:
        data: its numbers, row by row.
    """

    def __init__(self, packet: Any) -> None:
        self.data = packet.reshape(-1)

    @staticmethod
    def get_fields_and_field_types() -> Sequence[str]:
        return ("data",)


class Sampler:
    """Samples packets for observers.

    Args:
        encode: serialises a packet.

    Attributes:
        requests: by port (an output's name, or the topic of an external input), what is wanted by
            each observer; empty without requests.
        look_at_world: shows the simulated world of the node, ``None`` where it has none.
    """

    def __init__(self, encode: Callable[[Any], bytes]) -> None:
        self._encode = encode
        self.requests: dict[str, list[_Request]] = {}
        self.look_at_world: WorldLook | None = None
        self._asked: dict[int, dict[str, _Request]] = {}
        self._passages: list[tuple[str, Passage, Observe]] = []

    def attach(self, passage: Passage) -> None:
        """Sample the packets of a passage while an observer asks for them."""
        if passage.way is not Way.RECEIVED:
            port = passage.port.external_topic if passage.way is Way.HEARD else passage.port.name
            name, is_array = str(port), passage.port.array is not None

            def observe(packet: Any, data: bytes | None) -> None:
                shown = _ArrayMessage(packet) if is_array else packet
                self.sample(name, shown, lambda: data or self._encode(packet))

            self._passages.append((name, passage, observe))

    def sample(self, port: str, packet: Any, encode: Callable[[], bytes] = bytes) -> None:
        """A packet passes; ``encode`` serialises it. The thread of the hooks only."""
        waiting = self.requests  # the next question, which may come meanwhile, brings another one
        requests = waiting.get(port)
        if requests is not None:
            for request in requests:
                request.sample(packet, encode)
            if all(request.is_met for request in requests):
                del waiting[port]

    def ask(self, wanted: Mapping[str, Mapping[str, Any]], asker: int = 0) -> dict[str, Any]:
        """What was found since the ``asker``'s last question; ``wanted`` is its next one.

        One thread only, which need not be that of the hooks.

        Of each port: ``fields``, paths like ``pose.position.x`` or ``data[3]``, read of up to
        :data:`MOST_VALUES` packets; ``all``, every field of one packet (of arrays the first
        ``most_elements``); ``image``, a small picture of one packet; ``spikes``, the spikes
        of all packets; ``arrays``, paths of arrays, read of a few packets; ``packets``, whole
        packets as ROS serialises them, each with the time at which it passed, up to
        :data:`MOST_VALUES` and :data:`MOST_BYTES`. ``#world`` stands for the simulated world of
        the node, which is shown at once.
        """
        asked = self._asked.get(asker, {})
        answers = {port: answer for port, request in asked.items() if (answer := request.answer())}
        if WORLD in wanted and self.look_at_world is not None:
            try:
                answers[WORLD] = dict(self.look_at_world(wanted[WORLD], asker))
            except Exception as error:  # that it cannot be shown is no fault of the node's
                answers[WORLD] = {"fault": f"{type(error).__name__}: {error}"}
        self._asked[asker] = {port: _Request(each) for port, each in wanted.items()}
        waiting: dict[str, list[_Request]] = {}
        for requests in self._asked.values():
            for port, request in requests.items():
                if not request.is_met:
                    waiting.setdefault(port, []).append(request)
        self.requests = waiting
        for name, passage, observe in self._passages:
            passage.remove(observe)
            if name in waiting:
                passage.add(observe)
        return answers


def parse_path(text: str) -> FieldPath:
    """The steps of a path, names of fields and places in sequences."""
    return tuple(
        name if name else int(place) for name, place in (m.groups() for m in _STEP.finditer(text))
    )


def _follow(packet: Any, path: FieldPath) -> Any:
    """What a path leads to. Raises ``AttributeError`` or ``LookupError`` if there is nothing."""
    for step in path:
        packet = packet[step] if isinstance(step, int) else getattr(packet, step)
    return packet


def number_at(packet: Any, path: FieldPath) -> float | None:
    """The number there; ``None`` if there is nothing, or no (finite) number."""
    try:
        number = float(_follow(packet, path))
    except (AttributeError, LookupError, TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def all_fields(packet: Any, most_elements: int = 0) -> dict[str, Any]:
    """Every field, by its path: numbers, texts, and how long sequences are (``data.length``).

    Args:
        most_elements: of a sequence of numbers, so many are listed; 0: :data:`MOST_ELEMENTS`.
    """
    found: dict[str, Any] = {}
    for path, value in _walk(packet, "", most_elements or MOST_ELEMENTS):
        found[path] = value
        if len(found) >= max(MOST_FIELDS, most_elements):
            break
    return found


def _walk(value: Any, path: str, most: int) -> Iterator[tuple[str, Any]]:
    if hasattr(value, "get_fields_and_field_types"):
        for name in value.get_fields_and_field_types():
            yield from _walk(getattr(value, name), f"{path}.{name}" if path else name, most)
    elif isinstance(value, str):
        yield path, value[:_LONGEST_TEXT]
    elif isinstance(value, bool | int):
        yield path, value
    elif hasattr(value, "__len__"):
        yield f"{path}.length", len(value)
        for place, each in enumerate(value[:most]):
            yield from _walk(each, f"{path}[{place}]", most)
    else:
        try:
            number = float(value)
        except (TypeError, ValueError):
            return
        yield path, number if math.isfinite(number) else str(number)


@dataclass(frozen=True)
class Preview:
    """A picture in the making: what was copied while the packet passed.

    Attributes:
        rows: of the pixels that are kept and those between them.
        stride: every so many pixels one is kept.
        pixel_bytes: 0 for what is compressed already, which is then the only row.
    """

    encoding: str
    width: int
    height: int
    rows: tuple[bytes, ...]
    stride: int
    pixel_bytes: int

    def encode(self) -> dict[str, Any]:
        """The picture, ready for JSON: ``width``, ``height``, ``encoding``, ``data`` (base64)."""
        size = self.pixel_bytes
        if not size:
            data = self.rows[0]
            width, height = self.width, self.height
        else:
            width, height = -(-self.width // self.stride), len(self.rows)
            picture = bytearray(width * height * size)
            for y, row in enumerate(self.rows):
                begin = y * width * size
                for byte in range(size):
                    picture[begin + byte : begin + width * size : size] = row[
                        byte :: size * self.stride
                    ]
            data = bytes(picture)
        return {
            "width": width,
            "height": height,
            "of": [self.width, self.height],
            "encoding": self.encoding,
            "data": _base64(data),
        }


def preview(packet: Any) -> Preview:
    """Copy what a picture needs from a ``sensor_msgs`` Image or CompressedImage.

    Raises:
        ValueError: if it is none that can be shown.
    """
    if hasattr(packet, "format"):
        data = bytes(packet.data)
        if len(data) > _MOST_COMPRESSED_BYTES:
            raise ValueError(f"a compressed image of {len(data)} bytes is too large to be shown")
        return Preview(packet.format, 0, 0, (data,), 1, 0)
    size = PIXEL_BYTES.get(packet.encoding)
    if size is None:
        raise ValueError(f"images with encoding '{packet.encoding}' are not shown")
    width, height, step = packet.width, packet.height, packet.step or packet.width * size
    pixels = memoryview(packet.data).cast("B")
    if not (width and height) or step < width * size or len(pixels) < step * height:
        raise ValueError(
            f"{len(pixels)} bytes are not an image of {width} x {height}, {step} per row"
        )
    stride = max(1, -(-width // WIDTH), -(-height // HEIGHT))
    rows = tuple(
        bytes(pixels[y * step : y * step + width * size]) for y in range(0, height, stride)
    )
    return Preview(packet.encoding, width, height, rows, stride, size)


def _base64(content: bytes | array[Any]) -> str:
    return base64.b64encode(content).decode()
