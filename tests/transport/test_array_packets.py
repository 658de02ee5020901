"""Arrays as packets: checked once, copied, and one ROS message wherever they leave NeuROS."""

from __future__ import annotations

import struct
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, UInt8MultiArray

from neuros.errors import WrongValue
from neuros.project.message_types import ArrayType, array_type, normalised, wrong_array
from neuros.project.model import Port
from neuros.transport.codecs import WrongBytes, message_codec
from neuros.transport.digests import digest_for, digest_of
from neuros.transport.large_packets import (
    LARGE_BYTES,
    LargeInput,
    LargeOutput,
    is_parcel,
    message_buffers,
)
from neuros.transport.messages import (
    RosPackets,
    checked,
    copy_packet,
    make_packet,
    message_class,
    packet_kind,
)
from neuros.transport.values import checker

DTYPES = (
    *("bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"),
    *("float32", "float64"),
)
HAND_MADE = "float64[2,3]"
NUMBERS = np.arange(6.0).reshape(2, 3)


@st.composite
def packets(draw: st.DrawFn) -> Any:
    shape = draw(arrays.array_shapes(max_dims=4, max_side=5))
    return draw(arrays.arrays(draw(st.sampled_from(DTYPES)), shape))


def kind_of(packet: Any) -> ArrayType:
    return ArrayType(packet.dtype.name, packet.shape)


def without_gaps(data: bytes, packet: Any) -> bytes:
    """The bytes of a message, but for those that align: rclpy leaves them as they are in memory."""
    kept = np.ones(len(data), bool)
    for place in range(packet.ndim):  # the label is a length and a NUL, and a number follows
        kept[8 + 16 * place + 5 : 8 + 16 * place + 8] = False
    lengths = 4 + 4 + 16 * packet.ndim + 8
    kept[lengths : len(data) - packet.nbytes] = False
    return np.frombuffer(data, np.uint8)[kept].tobytes()


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(packets())
def test_the_bytes_are_those_that_rclpy_makes_of_the_message(packet: Any) -> None:
    kind = kind_of(packet)
    message = message_class(str(kind))()
    message.layout.dim = [
        MultiArrayDimension(size=size, stride=int(np.prod(packet.shape[place:])))
        for place, size in enumerate(packet.shape)
    ]
    numbers = packet.astype(np.uint8) if packet.dtype == bool else packet
    message.data = array(numbers.dtype.char.replace("l", "q").replace("L", "Q"), numbers.tobytes())
    data, by_ros = message_codec(kind).encode(packet), serialize_message(message)
    assert without_gaps(data, packet) == without_gaps(by_ros, packet)
    assert deserialize_message(data, type(message)).layout == message.layout
    for each in (data, by_ros, data + bytes(-len(data) % 4)):
        arrived = message_codec(kind).decode(each)
        assert arrived.tobytes() == packet.tobytes()
        assert (arrived.dtype, arrived.shape) == (packet.dtype, packet.shape)
        assert arrived.flags.aligned
        assert not arrived.flags.writeable


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(packets(), st.sampled_from(["C", "F"]))
def test_a_copy_is_equal_and_read_only_and_shares_nothing(packet: Any, order: Any) -> None:
    packet = np.asarray(packet, order=order)
    copy = copy_packet(packet)
    assert copy.tobytes() == packet.tobytes()
    assert not np.shares_memory(copy, packet)
    with pytest.raises(ValueError, match="read-only"):
        copy[...] = 0
    packet[...] = 0  # the sender may keep its array


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_new_packet_is_zeros_that_may_be_changed(dtype: str) -> None:
    packet = make_packet(f"{dtype}[2,3]")
    assert (packet.dtype, packet.shape, packet.any()) == (np.dtype(dtype), (2, 3), False)
    packet[:] = 1


@pytest.mark.parametrize("packet", [NUMBERS, np.asfortranarray(NUMBERS), np.ones((4, 9))[::2, ::3]])
def test_an_array_of_the_type_is_sent_whatever_its_memory(packet: Any) -> None:
    assert checker(array_type(HAND_MADE))(packet) is packet
    arrived = RosPackets().decode(HAND_MADE, RosPackets.encode(packet))
    assert np.array_equal(arrived, packet)


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        (
            NUMBERS.tolist(),
            r"\[\[0\.0, .*\(list\): make it with numpy.asarray\(values, 'float64'\)",
        ),
        (3.0, r"3.0 \(float\): make it with"),
        (None, r"None \(NoneType\)"),
        (NUMBERS.astype("float32"), r"float32\[2,3\]: convert it, array.astype\('float64'\)"),
        (NUMBERS.astype(int), r"int64\[2,3\]: convert it"),
        (NUMBERS.astype(">f8"), r">f8\[2,3\]: convert it"),
        (NUMBERS.astype(complex), r"complex128\[2,3\]"),
        (NUMBERS.astype(object), r"object\[2,3\]"),
        (NUMBERS.ravel(), r"float64\[6\]: reshape it, array.reshape\(2, 3\)"),
        (NUMBERS.T, r"float64\[3,2\]: reshape it"),
        (NUMBERS[:1], r"float64\[1,3\]$"),
        (np.ma.masked_less(NUMBERS, 2), r"a masked float64\[2,3\]: fill it"),
    ],
)
def test_anything_else_is_refused_with_what_to_do(wrong: Any, found: str) -> None:
    with pytest.raises(WrongValue, match=rf"the array must be float64\[2,3\], but is {found}"):
        checker(array_type(HAND_MADE))(wrong)


def test_the_field_of_a_message_is_sent_as_a_plain_array() -> None:
    packet = make_packet("sensor_msgs/msg/Imu").orientation_covariance
    sent = checker(array_type("float64[9]"))(packet)
    assert type(sent) is np.ndarray
    assert np.array_equal(sent, packet)


def test_what_is_true_is_sent_as_one() -> None:
    packet = np.array([0, 1, 2, 255], np.uint8).view(bool)
    sent = checker(array_type("bool[4]"))(packet)
    assert sent.view(np.uint8).tolist() == [0, 1, 1, 1]


# ---------------------------------------------------------------------- of other programs


def message_of(*sizes: int, strides: tuple[int, ...] = (), offset: int = 0, count: int = 6) -> Any:
    message = Float64MultiArray(data=array("d", range(count)))
    message.layout.dim = [
        MultiArrayDimension(label="x", size=size, stride=stride)
        for size, stride in zip(sizes, strides or (0,) * len(sizes), strict=True)
    ]
    message.layout.data_offset = offset
    return message


@pytest.mark.parametrize(
    "message", [message_of(), message_of(2, 3), message_of(2, 3, strides=(6, 3))]
)
def test_messages_of_other_programs_may_name_dimensions_or_leave_them_out(message: Any) -> None:
    arrived = message_codec(array_type(HAND_MADE)).decode(serialize_message(message))
    assert np.array_equal(arrived, NUMBERS)
    assert not arrived.flags.writeable


def test_senders_of_the_other_byte_order_are_understood() -> None:
    data = b"\0\0\0\0" + struct.pack(">III4xd", 0, 0, 1, 1.5)
    assert message_codec(array_type("float64[1]")).decode(data).tolist() == [1.5]


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (message_of(3, 2), "its layout is 3,2"),
        (message_of(6), "its layout is 6"),
        (message_of(2, 3, strides=(1, 2)), "its strides are 1,2, not those of C"),
        (message_of(2, 3, offset=2, count=8), "its numbers begin at 2, not at 0"),
        (message_of(count=7), "it has 7 numbers"),
        (message_of(2, 3, count=5), "it has 5 numbers"),
    ],
)
def test_messages_of_another_shape_are_none(message: Any, why: str) -> None:
    with pytest.raises(WrongBytes, match=rf"bytes are not a float64\[2,3\]: {why}"):
        message_codec(array_type(HAND_MADE)).decode(serialize_message(message))


def test_numbers_other_than_0_and_1_are_no_bool() -> None:
    data = serialize_message(UInt8MultiArray(data=array("B", [0, 1, 2])))
    assert message_codec(array_type("uint8[3]")).decode(data).tolist() == [0, 1, 2]
    with pytest.raises(WrongBytes, match="numbers other than 0 and 1"):
        message_codec(array_type("bool[3]")).decode(data)


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_changed_bytes_are_an_array_or_none(data: st.DataObject) -> None:
    codec = message_codec(array_type(HAND_MADE))
    changed = bytearray(codec.encode(NUMBERS))
    del changed[data.draw(st.integers(0, len(changed))) :]
    if changed:
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    try:
        arrived = codec.decode(bytes(changed))
    except WrongBytes:
        return
    assert (arrived.dtype, arrived.shape) == (np.dtype(float), (2, 3))


# ---------------------------------------------------------------------- digests, large packets


@pytest.mark.parametrize("shape", [(18,), (480, 640, 3), (LARGE_BYTES,), (LARGE_BYTES - 1,)])
def test_the_digest_does_not_depend_on_the_way(shape: tuple[int, ...], tmp_path: Path) -> None:
    packet = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    kind, buffers = kind_of(packet), message_buffers(kind_of(packet))
    assert buffers is not None
    output = LargeOutput(kind, buffers, owner="o", slots=1, warn=pytest.fail, folder=tmp_path)
    output.add_receiver(lambda: 1)
    data = output.encode(packet)
    assert is_parcel(data) == (packet.nbytes >= LARGE_BYTES)
    arrived = LargeInput(kind, buffers, is_reliable=True, folder=tmp_path).decode(data)
    output.close()
    assert np.array_equal(arrived, packet)
    assert arrived.shape == shape
    assert not arrived.flags.writeable
    whole = message_codec(kind).encode(packet)
    digest = digest_for(kind)
    assert {digest(data, packet), digest(data, arrived), digest(whole, packet)} == {
        digest_of(packet)
    }


# ---------------------------------------------------------------------- ports


@pytest.mark.parametrize(
    ("written", "name", "message"),
    [
        ("float64[18]", "float64[18]", "std_msgs/msg/Float64MultiArray"),
        ("uint8[480, 640 ,3]", "uint8[480,640,3]", "std_msgs/msg/UInt8MultiArray"),
        ("bool [4]", "bool[4]", "std_msgs/msg/UInt8MultiArray"),
        ("int16[007]", "int16[7]", "std_msgs/msg/Int16MultiArray"),
    ],
)
def test_a_type_has_one_name_and_one_message(written: str, name: str, message: str) -> None:
    assert normalised(written) == name
    assert Port("x", name).ros_type == message


@given(st.sampled_from(DTYPES), st.lists(st.integers(1, 9), min_size=1, max_size=5))
def test_every_type_and_shape_is_understood_as_it_is_written(dtype: str, shape: list[int]) -> None:
    name = str(ArrayType(dtype, tuple(shape)))
    assert normalised(name) == name
    assert array_type(name) == ArrayType(dtype, tuple(shape))
    assert wrong_array(name) is None
    assert make_packet(name).nbytes == array_type(name).nbytes


@given(st.text(st.characters(codec="ascii"), max_size=12), st.text("0123456789, []-", max_size=12))
def test_any_other_text_is_a_message_or_wrong(dtype: str, shape: str) -> None:
    written = f"{dtype}[{shape}]"
    if array_type(written) is None:
        assert normalised(written) is None
    else:
        assert wrong_array(written) is None


def test_a_program_sends_arrays_of_the_type_only() -> None:
    port = Port("action", HAND_MADE)
    assert checked(port, NUMBERS) is NUMBERS
    make = r"make an array of it, numpy.asarray\(values, 'float64'\)"
    with pytest.raises(TypeError, match=rf"'action' takes float64\[2,3\], not \[\[0.*: {make}"):
        checked(port, NUMBERS.tolist())
    with pytest.raises(ValueError, match=r"'action': the array must be .* float64\[3\]"):
        checked(port, NUMBERS[0])
    assert packet_kind(HAND_MADE) == ArrayType("float64", (2, 3))
