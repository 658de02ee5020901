"""A packet has the same digest however it travels, and another one if anything in it differs."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import pytest
from sensor_msgs.msg import Image, Imu
from std_msgs.msg import String

from neuros.transport.carriers import message_carrier
from neuros.transport.digests import digest_for, digest_of
from neuros.transport.large_packets import LargeInput, LargeOutput, is_parcel
from neuros.transport.message_buffers import message_buffers

LARGE = 100_000


def image(size: int = LARGE, width: int = 0, last: int = 0) -> Image:
    made = Image(width=width, data=array("B", bytes(size)))
    made.data[-1] = last
    return made


def digest(packet: Any) -> int:
    """As a whole message has it."""
    return digest_for(type(packet))(packet, message_carrier(type(packet)).encode(packet))


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
    sent = message_carrier(String).encode(packet)
    arrived = sent + bytes(-len(sent) % 4)
    assert digest_for(String)(packet, arrived) == digest_for(String)(packet, sent)


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
    assert digest_for(Image)(packet, data) == whole
    assert digest_for(Image)(received, data) == whole
    assert received == packet
    assert digest_for(Image)(received, data) == whole, "also once its buffers have been fetched"
    receiver.close()
    sender.close()
