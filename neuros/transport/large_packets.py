"""Large packets between processes of one machine: their buffers go through shared memory.

DDS copies a large message six or seven times on its way from one Python to another. Here the sender
copies each buffer once, into a slot of a :mod:`segment <neuros.transport.message_buffers>`, and
publishes on the data topic a *parcel*: the serialised message with empty buffers, and
behind it a note of where they are. The receiver copies them out as soon as the parcel arrives, and
so before it acknowledges anything.

A parcel is told from an ordinary serialised message by the two option bytes of its encapsulation
header, which are zero in the plain CDR of ROS (DDSI-RTPS 2.3, 10.5). A reader that knows nothing of
this sees a message with empty buffers; therefore parcels go only to receivers that have
announced that they can read them (:func:`machine_token`), on topics without other readers.
"""

from __future__ import annotations

import os
import platform
import struct
from array import array
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from neuros.errors import ProtocolError
from neuros.project.model import Connection, NodeFile
from neuros.transport.codecs import PARCEL_MARK, Decoder, Encoder, message_codec
from neuros.transport.message_buffers import (
    SHARED_MEMORY,
    BufferPlace,
    Buffers,
    Overwritten,
    SegmentReader,
    SegmentWriter,
    message_buffers,
)
from neuros.transport.messages import packet_kind

LARGE_BYTES = 64 * 1024
"""Buffers of together this size or more leave the message: below, DDS is as fast."""

_OPTIONS = slice(2, 4)
# Behind the message, and read from its end: lengths of the buffers, the name of the segment, and
# generation, size of a slot, slot, length of the message, number of buffers, length of the name.
_NOTE = struct.Struct("<QQIIHH")


class LargeOutput:
    """The packets that one output sends to receivers that can read parcels.

    Args:
        owner: as for :class:`SegmentWriter`.
        slots: of the segment; see :func:`slots_for`.
        warn: is told, once, when shared memory is full and all goes through DDS from then on.
    """

    def __init__(
        self,
        kind: Any,
        buffers: Buffers,
        *,
        owner: str,
        slots: int,
        warn: Callable[[str], object],
        folder: Path = SHARED_MEMORY,
    ) -> None:
        self._plain = message_codec(kind)
        self._buffers = buffers
        self._writer = SegmentWriter(owner, slots, folder)
        self._owner = owner
        self._warn = warn
        self._has_room = True
        self._counts: list[Callable[[], int]] = []

    def add_receiver(self, count_readers: Callable[[], int]) -> None:
        """One more connection; ``count_readers`` says how many read its topic now."""
        self._counts.append(count_readers)

    def encode(self, packet: Any) -> bytes:
        """The parcel of a large packet; any other, or what others read too, as a whole message."""
        buffers = self._buffers.of(packet) if self._has_room else None
        if buffers is None or not _is_large(buffers) or any(n() != 1 for n in self._counts):
            return self._plain.encode(packet)
        try:
            place = self._writer.write(buffers)
        except OSError as error:
            self._has_room = False
            self._warn(f"large packets of {self._owner} go through DDS, which is slower: {error}")
            return self._plain.encode(packet)
        return _parcel(self._buffers.encode_rest(packet), place)

    def close(self) -> None:
        """Remove the shared memory."""
        self._writer.close()


class LargeInput:
    """The packets that arrive on one connection, with their buffers.

    The sender of a reliable connection writes into their slot again only after the packet is
    acknowledged. On a connection of best effort, a packet that was overtaken counts as lost.
    """

    def __init__(
        self,
        kind: Any,
        buffers: Buffers,
        *,
        is_reliable: bool,
        folder: Path = SHARED_MEMORY,
    ) -> None:
        self._plain = message_codec(kind)
        self._buffers = buffers
        self._is_reliable = is_reliable
        self._reader = SegmentReader(folder)

    def decode(self, data: bytes) -> Any | None:
        """The next packet, from a parcel or a whole message.

        ``None`` if it was lost: its sender has ended and taken the segment along, or, on a
        connection of best effort, it was overtaken.

        Raises:
            ProtocolError: if the parcel is broken, its segment cannot be read, or its sender has
                overwritten it on a reliable connection.
        """
        if not is_parcel(data):
            return self._plain.decode(data)
        try:
            message, place = _contents(data)
            buffers = self._reader.read(place, self._buffers.typecodes)
        except Overwritten:
            if self._is_reliable:
                raise
            return None
        except (OSError, ValueError, struct.error) as error:
            raise ProtocolError(f"a large packet cannot be read: {error}") from error
        if buffers is None:
            return None
        return self._buffers.decode_with(message, buffers)

    def close(self) -> None:
        """Give up the shared memory."""
        self._reader.close()


class LargeCodecs:
    """The codecs of one node's large packets.

    A receiver tells with its registration which shared memory it sees (:func:`machine_token`); to
    one that sees that of the sender, the output sends parcels. All receivers of an output share its
    segment.

    Attributes:
        inputs: what receives on each connection whose packets can be large.
    """

    def __init__(self, file: NodeFile, warn: Callable[[str], object]) -> None:
        self._node = file.node
        self._connections = file.connections
        self._warn = warn
        self._outputs: dict[str, LargeOutput] = {}
        self.inputs: dict[Connection, LargeInput] = {}

    def decoder(self, connection: Connection) -> Decoder:
        """The decoder of a connection to this node."""
        kind = packet_kind(self._node.input(connection.destination_input).type)
        buffers = message_buffers(kind)
        if buffers is None:
            return message_codec(kind)
        decoder = LargeInput(kind, buffers, is_reliable=connection.is_reliable)
        self.inputs[connection] = decoder
        return decoder

    def note(self, connection: Connection) -> str:
        """The note from the receiver of a connection to its sender; empty: no parcels."""
        return machine_token() if connection in self.inputs or connection.is_zstd else ""

    def encoder(
        self, connection: Connection, note: str, count_readers: Callable[[], int]
    ) -> Encoder | None:
        """The encoder for a receiver that has sent ``note``; ``None``: :func:`message_codec`."""
        if not note or note != machine_token():
            return None
        kind = packet_kind(self._node.output(connection.source_output).type)
        buffers = message_buffers(kind)
        if buffers is None:
            return None
        name = connection.source_output
        if name not in self._outputs:
            run = os.environ.get("NEUROS_RUN_ID") or f"pid{os.getpid()}"
            self._outputs[name] = LargeOutput(
                kind,
                buffers,
                owner=f"{run}_{self._node.name}_{name}",
                slots=slots_for([each for each in self._connections if each.source_output == name]),
                warn=self._warn,
            )
        self._outputs[name].add_receiver(count_readers)
        return self._outputs[name]

    def close(self) -> None:
        """Remove what this node has in shared memory, and give up what it has mapped."""
        for output in self._outputs.values():
            output.close()
        for decoder in self.inputs.values():
            decoder.close()


def is_parcel(data: bytes) -> bool:
    """Whether these bytes are a parcel, and not a whole message."""
    return data[_OPTIONS] == PARCEL_MARK


def message_of(parcel: bytes) -> bytes:
    """The serialised message in a parcel, with empty buffers."""
    return _contents(parcel)[0]


@cache
def machine_token(folder: Path = SHARED_MEMORY) -> str:
    """A token that is equal in two processes with common shared memory and user.

    Empty where large packets had better go through DDS.
    """
    if platform.machine() not in ("x86_64", "AMD64"):  # see message_buffers on the order of stores
        return ""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
        users = os.stat("/proc/self/ns/user").st_ino
        shared = folder.stat()
    except OSError:
        return ""
    return f"{boot}:{shared.st_dev}:{shared.st_ino}:{users}:{os.getuid()}"


def slots_for(connections: Sequence[Connection]) -> int:
    """The slots that an output with these connections needs.

    What is outstanding on a reliable connection, its window; for one of best effort two more, since
    its sender does not wait for the copy.
    """
    return max(each.window + (0 if each.is_reliable else 2) for each in connections)


def _is_large(buffers: Sequence[array[Any]]) -> bool:
    size = 0
    for buffer in buffers:
        size += len(buffer) * buffer.itemsize
    return size >= LARGE_BYTES


def _parcel(message: bytes, place: BufferPlace) -> bytes:
    name = place.segment.encode()
    # RTPS pads to four bytes by itself, and the note must be found from the end.
    padding = bytes(-(len(message) + len(name)) % 4)
    lengths = struct.pack(f"<{len(place.lengths)}Q", *place.lengths)
    note = _NOTE.pack(
        place.generation,
        place.slot_bytes,
        place.slot,
        len(message),
        len(place.lengths),
        len(name),
    )
    return b"".join((message[:2], PARCEL_MARK, message[4:], padding, lengths, name, note))


def _contents(data: bytes) -> tuple[bytes, BufferPlace]:
    at = len(data) - _NOTE.size
    generation, slot_bytes, slot, length, count, name_length = _NOTE.unpack_from(data, at)
    name = data[at - name_length : at].decode()
    lengths = struct.unpack_from(f"<{count}Q", data, at - name_length - 8 * count)
    message = data[:2] + b"\0\0" + data[4:length]
    return message, BufferPlace(name, slot_bytes, slot, generation, lengths)
