"""Messages become bytes that ROS understands, and are read as ROS reads them."""

from __future__ import annotations

import struct
from array import array
from typing import Any

import pytest
from geometry_msgs.msg import TwistStamped, Vector3
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, Imu, JointState, LaserScan, MagneticField
from std_msgs.msg import (
    Bool,
    Empty,
    Float32,
    Header,
    Int8,
    Int32,
    String,
    UInt64,
)

from neuros.transport.carriers import message_carrier
from neuros.transport.cdr import cdr
from neuros.transport.messages import message_class

QUICK = (
    Bool, Clock, Float32, Header, Image, Imu, Int8, Int32, JointState, LaserScan, MagneticField,
    String, TwistStamped, UInt64, Vector3,
)  # fmt: skip
LEFT_TO_ROS = (Empty,)

for _kind in (*QUICK, *LEFT_TO_ROS):  # ROS's first conversion of a type imports what warns
    message_class(f"{_kind.__module__.split('.')[0]}/msg/{_kind.__name__}")

_RANGES = {
    f"{sign}int{bits}": st.integers(
        0 if sign else -(2 ** (bits - 1)), (2**bits if sign else 2 ** (bits - 1)) - 1
    )
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
}
_TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))


def values(type_name: str, default: Any) -> st.SearchStrategy[Any]:
    """Values of a field."""
    if type_name.startswith("sequence<"):
        item = type_name[len("sequence<") : -1]
        return st.lists(values(item, None), max_size=5)
    if hasattr(default, "dtype"):
        numbers = st.floats(allow_nan=False)
        return st.lists(numbers, min_size=default.size, max_size=default.size)
    if type_name == "boolean":
        return st.booleans()
    if type_name in ("float", "double"):
        return st.floats(allow_nan=False, width=32 if type_name == "float" else 64)
    if type_name == "string":
        return _TEXT
    return _RANGES[type_name]


@st.composite
def messages(draw: st.DrawFn, kind: Any) -> Any:
    """Messages of a class with any values that ROS accepts."""
    message = kind()
    for name, type_name in kind.get_fields_and_field_types().items():
        default = getattr(message, name)
        if hasattr(default, "get_fields_and_field_types"):
            setattr(message, name, draw(messages(type(default))))
        else:
            setattr(message, name, draw(values(type_name, default)))
    return message


@pytest.mark.parametrize("kind", QUICK, ids=lambda kind: kind.__name__)
def test_what_is_written_and_read_is_what_ros_writes_and_reads(kind: Any) -> None:
    quick = cdr(kind)
    assert quick is not None
    encode, decode = quick

    @settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
    @given(messages(kind))
    def check(message: Any) -> None:
        data, by_ros = encode(message), serialize_message(message)
        # Not equal: rclpy fills neither the gaps between numbers nor all that it reserves.
        assert len(data) <= len(by_ros)
        for each in (data, by_ros):
            read, expected = decode(each), deserialize_message(each, kind)
            assert read == expected
            assert repr(read) == repr(expected)
            assert encode(read) == data

    check()


@pytest.mark.parametrize("kind", LEFT_TO_ROS, ids=lambda kind: kind.__name__)
def test_what_is_out_of_the_ordinary_is_left_to_ros(kind: Any) -> None:
    assert cdr(kind) is None
    carrier = message_carrier(kind)
    assert carrier.decode(carrier.encode(kind())) == kind()


@pytest.mark.parametrize(
    "text", ["before\0after", "\udc80"], ids=["a NUL within", "half of a surrogate pair"]
)
def test_text_that_ros_changes_or_refuses_is_changed_or_refused_alike(text: str) -> None:
    message, carrier = String(data=text), message_carrier(String)
    expected = outcome(lambda m: deserialize_message(serialize_message(m), String), message)
    assert outcome(lambda m: carrier.decode(carrier.encode(m)), message) == expected


def test_senders_of_the_other_byte_order_are_understood() -> None:
    data = b"\0\0\0\0" + struct.pack(">i", 7)
    assert message_carrier(Int32).decode(data) == Int32(data=7)


@pytest.mark.parametrize("size", [0, 3, 4, 7, 11, 20])
def test_bytes_that_break_off_are_no_message(size: int) -> None:
    data = serialize_message(Image(data=array("B", range(100))))[:size]
    carrier = message_carrier(Image)
    assert outcome(carrier.decode, data) == outcome(lambda d: deserialize_message(d, Image), data)


def test_text_that_is_no_utf_8_is_read_as_ros_reads_it() -> None:
    data = serialize_message(String(data="abcd")).replace(b"bc", b"\xff\xe4")
    assert message_carrier(String).decode(data) == deserialize_message(data, String)


def outcome(call: Any, argument: Any) -> Any:
    """What a call returns, or the type of what it raises."""
    try:
        return call(argument)
    except Exception as error:
        return type(error)
