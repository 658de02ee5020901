"""A packet has the same digest however it travels, and another one if anything in it differs."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import pytest
from sensor_msgs.msg import Image, Imu
from std_msgs.msg import String

from neuros.transport.codecs import message_codec
from neuros.transport.digests import TriedDigest, digest_for, digest_of
from neuros.transport.large_packets import LargeInput, LargeOutput, is_parcel, message_buffers

LARGE = 100_000


def image(size: int = LARGE, width: int = 0, last: int = 0) -> Image:
    made = Image(width=width, data=array("B", bytes(size)))
    made.data[-1] = last
    return made


def digest(packet: Any) -> int:
    """As a whole message has it."""
    return digest_for(type(packet))(message_codec(type(packet)).encode(packet), packet)


@pytest.mark.parametrize("packet", [String(data="a"), Imu(), image(100), image()])
def test_serialised_or_not_a_packet_has_one_digest(packet: Any) -> None:
    assert digest(packet) == digest_of(packet)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (String(data="a"), String(data="b")),
        (image(100), image(100, last=1)),
        (image(), image(last=1)),
        (image(), image(width=1)),
        (image(), image(LARGE + 1)),
    ],
)
def test_packets_that_differ_have_different_digests(one: Any, other: Any) -> None:
    assert digest(one) != digest(other)


@pytest.mark.parametrize("text", ["", "a", "ab", "abc", "abcd"])
def test_the_padding_with_which_a_message_arrives_does_not_count(text: str) -> None:
    packet = String(data=text)
    sent = message_codec(String).encode(packet)
    arrived = sent + bytes(-len(sent) % 4)
    assert digest_for(String)(arrived, packet) == digest_for(String)(sent, packet)


@pytest.mark.parametrize("is_reliable", [True, False])
def test_a_parcel_has_the_digest_of_the_whole_message_at_both_ends(
    tmp_path: Path, is_reliable: bool
) -> None:
    buffers = message_buffers(Image)
    sender = LargeOutput(Image, buffers, owner="o", slots=3, warn=pytest.fail, folder=tmp_path)
    receiver = LargeInput(Image, buffers, is_reliable=is_reliable, folder=tmp_path)
    packet = image(width=7, last=3)
    data = sender.encode(packet)
    assert is_parcel(data)
    received = receiver.decode(data)
    whole = digest(packet)
    assert digest_for(Image)(data, packet) == whole
    assert digest_for(Image)(data, received) == whole
    assert received == packet
    receiver.close()
    sender.close()


class Sender:
    """Digests one packet after another, with a clock of its own."""

    def __init__(self, digest_ns: int, between_ns: int, stumbles: bool = False) -> None:
        self._now_ns = self._count = 0
        self._costs = digest_ns, between_ns, stumbles
        self.tried = TriedDigest(self._digest, lambda: self._now_ns, lambda: self._now_ns)

    def _digest(self, packet: int) -> int:
        digest_ns, _, stumbles = self._costs
        self._count += 1
        stumble_ns = 10_000_000 if stumbles and self._count == 30 else 0
        self._now_ns += 1_000_000 if self._count == 1 else digest_ns + stumble_ns
        return packet

    def send(self, packets: int) -> list[int | None]:
        found = []
        for number in range(packets):
            found.append(self.tried(number))
            self._now_ns += self._costs[1]
        return found


def test_digests_that_are_cheap_are_kept_of_all_packets() -> None:
    assert Sender(digest_ns=15_000, between_ns=1_000_000).send(200) == [*range(200)]


def test_digests_that_are_dear_are_given_up_soon() -> None:
    found = Sender(digest_ns=15_000, between_ns=100_000).send(200)
    assert found[:60] == [*range(60)]
    assert found[70:] == [None] * 130


def test_one_digest_that_was_interrupted_does_not_make_them_dear() -> None:
    sender = Sender(digest_ns=15_000, between_ns=1_000_000, stumbles=True)
    assert None not in sender.send(200)
