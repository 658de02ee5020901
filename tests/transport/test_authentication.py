"""Tags of messages: only who has the key of a connection can make them, each for one message."""

from __future__ import annotations

import struct

import pytest
from rclpy.serialization import deserialize_message

from neuros.transport.codecs import PARCEL_MARK, message_codec
from neuros.transport.envelope import DataTags, Positions, signed, verified
from neuros.transport.large_packets import is_parcel
from neuros.transport.messages import message_class

Int32 = message_class("std_msgs/msg/Int32")
Numbers = message_class("std_msgs/msg/UInt64MultiArray")

KEY, OTHER = "00" * 16, "01" * 16
PLAIN = b"\0\1\0\0" + bytes(8)


def tagged(count: int, data: bytes = PLAIN) -> list[bytes]:
    sender = DataTags(KEY)
    return [sender.add(data) for _ in range(count)]


def test_packets_arrive_as_they_were_sent() -> None:
    receiver = DataTags(KEY)
    for number, data in enumerate(tagged(2000), 1):
        assert receiver.remove(data, number) == PLAIN


def test_the_next_packet_is_taken_after_one_that_was_lost() -> None:
    first, _, third = tagged(3)
    receiver = DataTags(KEY)
    assert receiver.remove(first, 1) == PLAIN
    assert receiver.remove(third, 3) == PLAIN


def test_parcels_stay_parcels() -> None:
    parcel = PLAIN[:2] + PARCEL_MARK + PLAIN[4:]
    (data,) = tagged(1, parcel)
    found = DataTags(KEY).remove(data, 1)
    assert found == parcel
    assert is_parcel(found)


def test_what_has_no_tag_or_that_of_another_key_is_foreign() -> None:
    plain = sum(DataTags(KEY).remove(PLAIN, number) is None for number in range(1, 1001))
    others = DataTags(OTHER)
    foreign = [others.add(PLAIN) for _ in range(1000)]
    wrong = sum(DataTags(KEY).remove(d, n) is None for n, d in enumerate(foreign, 1))
    assert plain >= 999  # one tag in 16,384 is nothing
    assert wrong >= 999


@pytest.mark.parametrize("number", [1, 2, 4])
def test_a_tag_is_of_no_use_for_another_number_or_again(number: int) -> None:
    first, second, third = tagged(3)
    receiver = DataTags(KEY)
    assert receiver.remove(first, 1)
    assert receiver.remove(second, 2)
    assert receiver.remove(second, number) is None
    assert receiver.remove(third, 3) == PLAIN, "a foreign packet takes no number"


def test_ros_reads_a_tagged_packet() -> None:
    sender, codec = DataTags(KEY), message_codec(Int32)
    for value in range(50):
        assert deserialize_message(sender.add(codec.encode(Int32(data=value))), Int32).data == value


def test_the_bits_that_count_padding_stay_zero() -> None:
    assert not any(data[3] & 3 for data in tagged(1000))


def test_acknowledgements_need_a_tag_of_their_position() -> None:
    tags = Positions(KEY)
    fifth = tags.encode(5)
    assert Positions(KEY).decode(fifth) == 5
    assert Positions(KEY).decode(fifth) == 5, "it may come again: it is cumulative"
    assert Positions(OTHER).decode(fifth) is None
    assert tags.decode(fifth.replace(b"\5", b"\6", 1)) is None
    for malformed in (b"", b"\0", fifth[:12], fifth + bytes(4)):
        assert tags.decode(malformed) is None


def test_another_launcher_has_no_keys() -> None:
    assert Positions(None).decode(Positions(None).encode(5)) == 5
    assert Positions(KEY).decode(Positions(None).encode(5)) is None
    assert Positions(None).decode(b"\0") is None


def test_ros_reads_a_tagged_acknowledgement() -> None:
    position, tag = deserialize_message(Positions(KEY).encode(7), Numbers).data
    assert position == 7
    assert tag


def test_an_acknowledgement_of_the_other_byte_order_is_read() -> None:
    *start, position, tag = struct.unpack("<4s3I4xQ8s", Positions(KEY).encode(7))
    assert (
        Positions(KEY).decode(struct.pack(">4s3I4xQ8s", bytes(4), *start[1:], position, tag)) == 7
    )


def test_registrations_are_signed() -> None:
    text = signed("ready machine:1", KEY)
    assert verified(text, KEY) == "ready machine:1"
    assert verified(text, OTHER) is None
    assert verified(text.replace("1", "2", 1), KEY) is None
    for malformed in ("", "ready", "ready ", " " * 9, "\ud800 x"):
        assert verified(malformed, KEY) is None
