"""Large packets leave as parcels, arrive as messages, and are lost only where that is allowed."""

from __future__ import annotations

import dataclasses
import os
from array import array
from pathlib import Path

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image

from neuros.errors import ProtocolError
from neuros.testing.harness import wire
from neuros.transport.large_packets import (
    LARGE_BYTES,
    LargeInput,
    LargeOutput,
    machine_token,
    message_buffers,
    slots_for,
)
from neuros.transport.messages import message_class

BUFFERS = message_buffers(message_class("sensor_msgs/msg/Image"))
assert BUFFERS is not None


def image(number: int, size: int = LARGE_BYTES) -> Image:
    """An image that shows its number."""
    packet = Image(height=number, encoding="mono8")
    packet.data = array("B", bytes([number]) * size)
    return packet


@dataclasses.dataclass
class Ends:
    """An output, and as many inputs as a check wants."""

    folder: Path
    slots: int = 2
    warnings: list[str] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        assert BUFFERS is not None
        self.output = LargeOutput(
            Image,
            BUFFERS,
            owner="run_node_output",
            slots=self.slots,
            warn=self.warnings.append,
            folder=self.folder,
        )

    def input(self, *, is_reliable: bool = True) -> LargeInput:
        assert BUFFERS is not None
        return LargeInput(Image, BUFFERS, is_reliable=is_reliable, folder=self.folder)


@pytest.fixture
def ends(tmp_path: Path) -> Ends:
    return Ends(tmp_path)


def is_whole(data: bytes, packet: Image) -> bool:
    """Whether any ROS node gets the packet from these bytes."""
    return bool(deserialize_message(data, Image) == packet)


def test_a_large_packet_arrives_though_little_of_it_is_published(ends: Ends) -> None:
    data = ends.output.encode(image(1))
    assert len(data) < 500
    for receiver in (ends.input(), ends.input(is_reliable=False)):
        assert receiver.decode(data) == image(1)


def test_a_parcel_is_an_ordinary_message_to_others_only_without_its_buffer(ends: Ends) -> None:
    seen = deserialize_message(ends.output.encode(image(3)), Image)
    assert (seen.height, seen.encoding, len(seen.data)) == (3, "mono8", 0)


@pytest.mark.parametrize("length", range(9))
def test_a_parcel_needs_no_padding_by_rtps(ends: Ends, length: int) -> None:
    packet = image(1)
    packet.encoding = "x" * length
    data = ends.output.encode(packet)
    assert len(data) % 4 == 0
    assert ends.input().decode(data) == packet


def test_a_small_packet_is_published_whole(ends: Ends) -> None:
    packet = image(1, LARGE_BYTES - 1)
    data = ends.output.encode(packet)
    assert is_whole(data, packet)
    assert ends.input().decode(data) == packet
    assert not list(ends.folder.iterdir())


def test_a_packet_that_others_read_too_is_published_whole(ends: Ends) -> None:
    readers = [1, 1]
    for which in (0, 1):
        ends.output.add_receiver(lambda which=which: readers[which])  # type: ignore[misc]
    assert not is_whole(ends.output.encode(image(1)), image(1))
    readers[1] = 2
    assert is_whole(ends.output.encode(image(1)), image(1))
    readers[1] = 1
    assert not is_whole(ends.output.encode(image(1)), image(1))


def test_a_message_whose_end_looks_like_a_parcel_is_a_message(ends: Ends) -> None:
    data = ends.output.encode(image(1))
    packet = image(2)
    packet.data = array("B", bytes(LARGE_BYTES) + data)
    assert ends.input().decode(serialize_message(packet)) == packet


def test_when_shared_memory_is_full_all_goes_whole_and_it_is_said_once(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    assert is_whole(ends.output.encode(image(1)), image(1))
    monkeypatch.undo()
    assert is_whole(ends.output.encode(image(1)), image(1))
    assert len(ends.warnings) == 1
    assert "No space left" in ends.warnings[0]


def test_a_packet_is_whole_whatever_follows_it(ends: Ends) -> None:
    for receiver in (ends.input(), ends.input(is_reliable=False)):
        kept = [
            (number, size, receiver.decode(ends.output.encode(image(number, size))))
            for number, size in ((n, LARGE_BYTES if n % 3 else 10) for n in range(1, 12))
        ]
        assert all(packet == image(number, size) for number, size, packet in kept)


def test_a_sender_that_breaks_the_rules_is_an_error(ends: Ends) -> None:
    receiver = ends.input()
    first, *_ = [ends.output.encode(image(number)) for number in (1, 2, 3)]
    with pytest.raises(ProtocolError, match="overwritten"):
        receiver.decode(first)


def test_a_packet_outlives_both_ends(ends: Ends) -> None:
    receiver = ends.input()
    packet = receiver.decode(ends.output.encode(image(1)))
    ends.output.close()
    receiver.close()
    assert not list(ends.folder.iterdir())
    assert packet == image(1)


def test_a_packet_whose_sender_has_gone_with_its_memory_is_lost(ends: Ends) -> None:
    data = ends.output.encode(image(1))
    ends.output.close()
    assert ends.input().decode(data) is None


def test_a_parcel_that_makes_no_sense_is_an_error(ends: Ends) -> None:
    data = ends.output.encode(image(1))
    for broken in (data[:4], data[:-8], data[:-24] + bytes(24), data[:-1] + b"\xff"):
        with pytest.raises(ProtocolError, match="cannot be read"):
            ends.input().decode(broken)


def test_on_best_effort_an_overtaken_packet_is_lost(ends: Ends) -> None:
    receiver = ends.input(is_reliable=False)
    first, second, third = (ends.output.encode(image(number)) for number in (1, 2, 3))
    assert receiver.decode(first) is None
    assert receiver.decode(second) == image(2)
    assert receiver.decode(third) == image(3)


def test_slots_are_enough_for_what_is_outstanding() -> None:
    assert slots_for([wire("a.out -> b.in", 0)]) == 1
    assert slots_for([wire("a.out -> b.in", 4, queue_size=3)]) == 7
    assert slots_for([wire("a.out -> b.in")]) == 3
    assert slots_for([wire("a.out -> b.in", 0), wire("a.out -> c.in", 9)]) == 10


def test_the_token_tells_folders_and_users_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = machine_token()
    assert own
    assert machine_token(tmp_path) != own
    assert machine_token(tmp_path / "missing") == ""
    machine_token.cache_clear()
    monkeypatch.setattr(os, "getuid", lambda: 4711)
    assert machine_token() != own
    machine_token.cache_clear()
