"""Large packets between processes of one machine: their buffers go through shared memory.

DDS copies a large message six or seven times on its way from one Python to another. Here the
sender copies each buffer once, into a slot of a *segment*, and publishes on the data topic a
*parcel*: the serialised message with empty buffers, and behind it a note of where they are. The
receiver copies them out as soon as the parcel arrives, and so before it acknowledges anything.

A parcel is told from an ordinary serialised message by the two option bytes of its encapsulation
header, which are zero in the plain CDR of ROS (DDSI-RTPS 2.3, 10.5). A reader that knows nothing of
this sees a message with empty buffers; therefore parcels go only to receivers that have
announced that they can read them (:func:`machine_token`), on topics without other readers.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import platform
import re
import stat
import struct
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from neuros.errors import ProtocolError
from neuros.project.message_types import ArrayType
from neuros.project.model import Connection, NodeFile
from neuros.transport.codecs import (
    PARCEL_MARK,
    Decoder,
    Encoder,
    WrongBytes,
    array_codec,
    message_codec,
)
from neuros.transport.messages import packet_kind
from neuros.transport.schema import Shape, getter, schema

SHARED_MEMORY = Path("/dev/shm")
NAME_PREFIX = "neuros"
"""Prefix of the names of segments: ``neuros_<run id>_``; a run's own are removed by that."""

_NAME = re.compile(rf"{NAME_PREFIX}_[\w.-]+")
_ALIGNMENT = 64  # a cache line: buffers begin where vector instructions like it
_HEADER_BYTES = _ALIGNMENT  # the generation, as 8 bytes
_GROWTH = 1.5  # at least, from a segment to its successor

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
        message = self._buffers.encode_rest(packet)
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

    def close(self) -> None:
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
    if platform.machine() not in ("x86_64", "AMD64"):  # see below on the order of stores
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


def _contents(data: bytes) -> tuple[bytes, BufferPlace]:
    at = len(data) - _NOTE.size
    generation, slot_bytes, slot, length, count, name_length = _NOTE.unpack_from(data, at)
    name = data[at - name_length : at].decode()
    lengths = struct.unpack_from(f"<{count}Q", data, at - name_length - 8 * count)
    message = data[:2] + b"\0\0" + data[4:length]
    return message, BufferPlace(name, slot_bytes, slot, generation, lengths)


# ---------------------------------------------------------------------- buffers of a message
#
# Pixels, points and scans are fields of the kind ``uint8[]`` or ``float32[]``: sequences without a
# bound, which Python holds as ``array.array``. Which fields of a message type those are is found
# out once, from its class: its own, and those of messages within it (not of *sequences* of
# messages).


class MessageBuffers:
    """The buffers of a message class: found in a message, left out, and put back.

    Attributes:
        fields: the names that lead to each, ``"image.data"``, in the order of the message.
        typecodes: what each holds, as ``array`` calls it.
    """

    def __init__(self, kind: type) -> None:
        self._layout = schema(kind)
        self._leaves = [
            place
            for place, leaf in enumerate(self._layout.leaves)
            if leaf.field.shape is Shape.BUFFER and leaf.field.bound is None
        ]
        found = [self._layout.leaves[place] for place in self._leaves]
        self._paths = [leaf.path for leaf in found]
        self.fields = tuple(".".join(slot[1:] for slot in path) for path in self._paths)
        self.typecodes = tuple(leaf.field.type.code for leaf in found)
        self._kind = kind
        self._get = getter(self._paths)

    def of(self, packet: Any) -> Sequence[array[Any]] | None:
        """The buffers of a message; ``None`` if one is not the array that ROS makes of it."""
        if not isinstance(packet, self._kind):
            return None
        try:
            values = self._get(packet)
        except AttributeError:  # a plugin put something else where a message belongs
            return None
        found: list[array[Any]] = []
        for value, typecode in zip(values, self.typecodes, strict=True):
            if type(value) is not array or value.typecode != typecode:
                return None
            found.append(value)
        return found

    def views(self, packet: Any) -> Sequence[memoryview]:
        """The bytes of the buffers of a message, where they lie; of what is no buffer, none."""
        return [memoryview(buffer).cast("B") for buffer in self.of(packet) or ()]

    def leave_out(self, packet: Any) -> Any:
        """A message like this one with empty buffers, which shares all else with it."""
        values = list(self._layout.values(packet))
        for place, typecode in zip(self._leaves, self.typecodes, strict=True):
            values[place] = array(typecode)
        return self._layout.make(values)

    def encode_rest(self, packet: Any) -> bytes:
        """A message with empty buffers, serialised."""
        return message_codec(self._kind).encode(self.leave_out(packet))

    def decode_with(self, rest: bytes, buffers: Sequence[array[Any]]) -> Any:
        """The inverse of :meth:`encode_rest`, with these buffers. Raises ``WrongBytes``."""
        packet = message_codec(self._kind).decode(rest)
        self.put_back(packet, buffers)
        return packet

    def put_back(self, packet: Any, buffers: Sequence[array[Any]]) -> None:
        for (*path, slot), buffer in zip(self._paths, buffers, strict=True):
            holder = packet
            for each in path:
                holder = getattr(holder, each)
            setattr(holder, slot, buffer)


class ArrayBuffers:
    """The buffer of an array, in the place of :class:`MessageBuffers`: its numbers.

    Attributes:
        typecodes: what it holds, as ``array`` calls it.
    """

    def __init__(self, kind: ArrayType) -> None:
        self._kind, self._codec = kind, array_codec(kind)
        self.typecodes = (self._codec.typecode,)

    def of(self, packet: Any) -> Sequence[Any]:
        """The numbers, row by row."""
        return [packet.reshape(-1)]

    def views(self, packet: Any) -> Sequence[memoryview]:
        return [memoryview(packet.reshape(-1)).cast("B")]

    def encode_rest(self, packet: Any) -> bytes:
        """The message without its numbers, serialised."""
        return self._codec.rest

    def decode_with(self, rest: bytes, buffers: Sequence[array[Any]]) -> Any:
        """The array of these numbers. Raises ``WrongBytes``."""
        (numbers,) = buffers
        if rest != self._codec.rest or len(numbers) != self._kind.size:
            raise WrongBytes(self._kind, rest, f"{len(numbers)} numbers came beside them")
        return self._codec.of_numbers(numbers, 0)


Buffers: TypeAlias = "MessageBuffers | ArrayBuffers"


@cache
def message_buffers(kind: Any) -> Buffers | None:
    """The buffers of a message class, ``None`` if it has none; or those of an array type."""
    if isinstance(kind, ArrayType):
        return ArrayBuffers(kind)
    buffers = MessageBuffers(kind)
    return buffers if buffers.fields else None


# ---------------------------------------------------------------------- shared memory
#
# A ring of slots in shared memory, by which a large packet reaches other processes in one copy.
#
# A *segment* is a file in ``/dev/shm`` that its sender writes and its receivers map. It is divided
# into slots of equal size, used in turn, so that a slot keeps its content until as many packets
# have followed. Each slot begins with its *generation*, the number of the packet in it: 0 while
# the slot is being written. A reader looks at it before and after its copy, and so never takes a
# packet that was written meanwhile for the one that it wanted.
#
# That needs stores and loads to be seen in the order of the program, which x86 guarantees for
# ordinary memory (Intel SDM, volume 3, "Memory Ordering"); elsewhere it is not used
# (:func:`machine_token`).


@dataclass(frozen=True)
class BufferPlace:
    """Place of the buffers of one packet; ``lengths`` are theirs, in bytes."""

    segment: str
    slot_bytes: int
    slot: int
    generation: int
    lengths: tuple[int, ...]


class Overwritten(ProtocolError):
    """A slot holds a later packet than the one that was asked for."""


class SegmentWriter:
    """The sender's end: creates segments, and a larger one when a packet does not fit.

    Args:
        owner: what the name tells people that look into the folder: run, node, output.
        slots: how many packets, the newest ones, stay readable.
    """

    def __init__(self, owner: str, slots: int, folder: Path = SHARED_MEMORY) -> None:
        self._owner = owner
        self._slots = slots
        self._folder = folder
        self._generation = 0
        self._current: _Mapping | None = None
        # With the generation from which on no receiver opens it any more.
        self._former: list[tuple[int, _Mapping]] = []

    def write(self, buffers: Sequence[array[Any]]) -> BufferPlace:
        """Copy the buffers into the next slot.

        Raises:
            OSError: if there is no room for a segment.
        """
        lengths = tuple(len(buffer) * buffer.itemsize for buffer in buffers)
        mapping = self._with_room_for(_span(lengths))
        self._generation += 1
        while self._former and self._former[0][0] < self._generation:
            self._remove(self._former.pop(0)[1])
        slot = self._generation % self._slots
        start = slot * mapping.slot_bytes
        mapping.generations[start // 8] = 0
        at = start + _HEADER_BYTES
        for buffer, length in zip(buffers, lengths, strict=True):
            mapping.bytes[at : at + length] = memoryview(buffer).cast("B")
            at += _aligned(length)
        mapping.generations[start // 8] = self._generation
        return BufferPlace(mapping.name, mapping.slot_bytes, slot, self._generation, lengths)

    def close(self) -> None:
        mappings = [mapping for _, mapping in self._former]
        if self._current is not None:
            mappings.append(self._current)
        self._current, self._former = None, []
        for mapping in mappings:
            self._remove(mapping)

    def _with_room_for(self, slot_bytes: int) -> _Mapping:
        current = self._current
        if current is not None:
            if slot_bytes <= current.slot_bytes:
                return current
            slot_bytes = max(slot_bytes, int(current.slot_bytes * _GROWTH))
        created = _create(self._folder, self._owner, self._slots, slot_bytes)
        if current is not None:
            self._former.append((self._generation + self._slots, current))
        self._current = created
        return created

    def _remove(self, mapping: _Mapping) -> None:
        mapping.release()
        (self._folder / mapping.name).unlink(missing_ok=True)


class SegmentReader:
    """A receiver's end: maps the segment that its sender writes to now."""

    def __init__(self, folder: Path = SHARED_MEMORY) -> None:
        self._folder = folder
        self._mapping: _Mapping | None = None

    def read(self, place: BufferPlace, typecodes: Sequence[str]) -> list[array[Any]] | None:
        """Copies of the buffers at a place, of these types.

        ``None`` if the whole segment is gone: its sender has ended, or uses a larger one.

        Raises:
            Overwritten: if the slot has been used again.
            OSError: if the segment cannot be mapped.
            ValueError: if the place is not within the segment.
        """
        mapping = self._mapping
        if mapping is None or mapping.name != place.segment:
            try:
                mapping = self._mapping = _open(self._folder, place)
            except FileNotFoundError:
                return None
        start = place.slot * place.slot_bytes
        if start + _span(place.lengths) > mapping.bytes.nbytes:
            raise ValueError(f"{place} ends beyond its segment")
        found: list[array[Any]] = []
        at = start + _HEADER_BYTES
        was_there = mapping.generations[start // 8] == place.generation
        for typecode, length in zip(typecodes, place.lengths, strict=True):
            buffer = array(typecode)
            buffer.frombytes(mapping.bytes[at : at + length])
            found.append(buffer)
            at += _aligned(length)
        if not was_there or mapping.generations[start // 8] != place.generation:
            raise Overwritten(f"packet {place.generation} of {place.segment} has been overwritten")
        return found

    def close(self) -> None:
        self._mapping = None


class _Mapping:
    """A segment in this process's memory."""

    def __init__(self, name: str, memory: mmap.mmap, slot_bytes: int) -> None:
        self.name = name
        self.slot_bytes = slot_bytes
        self.bytes = memoryview(memory)
        self.generations = self.bytes.cast("Q")
        self._memory = memory

    def release(self) -> None:
        self.generations.release()
        self.bytes.release()
        self._memory.close()


def _create(folder: Path, owner: str, slots: int, slot_bytes: int) -> _Mapping:
    name = f"{NAME_PREFIX}_{owner}_{os.urandom(4).hex()}"
    slot_bytes = -(-slot_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
    size = slots * slot_bytes
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    descriptor = os.open(folder / name, flags, 0o600)
    try:
        # Until this process unmaps it, or ends: the search for leftovers sees it.
        fcntl.flock(descriptor, fcntl.LOCK_SH)
        # Room that is only promised would be missed later, by a SIGBUS in the midst of a copy.
        os.posix_fallocate(descriptor, 0, size)
        memory = mmap.mmap(descriptor, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
    except OSError:
        (folder / name).unlink()
        raise
    finally:
        os.close(descriptor)
    return _Mapping(name, memory, slot_bytes)


def _open(folder: Path, place: BufferPlace) -> _Mapping:
    if not _NAME.fullmatch(place.segment):
        raise ValueError(f"'{place.segment}' is the name of no segment")
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    descriptor = os.open(folder / place.segment, flags)
    try:
        status = os.fstat(descriptor)
        if status.st_uid != os.getuid() or not stat.S_ISREG(status.st_mode):
            raise PermissionError(f"{place.segment} in shared memory is somebody else's")
        if status.st_size % 8:
            raise ValueError(f"{place.segment} has {status.st_size} bytes")
        memory = mmap.mmap(
            descriptor,
            status.st_size,
            flags=mmap.MAP_SHARED | mmap.MAP_POPULATE,
            prot=mmap.PROT_READ,
        )
    finally:
        os.close(descriptor)
    return _Mapping(place.segment, memory, place.slot_bytes)


def _span(lengths: Sequence[int]) -> int:
    """Bytes of a slot that buffers of these lengths need."""
    return _HEADER_BYTES + sum(map(_aligned, lengths))


def _aligned(length: int) -> int:
    return -(-length // _ALIGNMENT) * _ALIGNMENT
