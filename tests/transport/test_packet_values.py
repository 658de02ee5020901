"""Values of messages: what fits arrives alike on every way, anything else is refused."""

from __future__ import annotations

import copy
import enum
import fractions
import pickle
import re
import struct
from array import array
from collections.abc import Callable
from typing import Any

import numpy
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Pose, PoseArray, PoseStamped, Twist, TwistStamped, Vector3
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from message_values import is_empty, message_classes, parts, right_messages, wrong_messages
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Imu, JointState, LaserScan
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import (
    Bool,
    Byte,
    Float32,
    Float32MultiArray,
    Float64,
    Float64MultiArray,
    Header,
    Int32,
    String,
    UInt8,
    UInt64,
)
from unique_identifier_msgs.msg import UUID

from neuros.errors import WrongValue
from neuros.transport.codecs import message_codec
from neuros.transport.digests import digest_for, digest_of
from neuros.transport.messages import copy_packet
from neuros.transport.values import checker

KINDS = message_classes()

every_class = pytest.mark.parametrize(
    "kind", KINDS, ids=lambda kind: f"{kind.__module__.partition('.')[0]}/{kind.__name__}"
)
QUICKLY = settings(
    max_examples=3,
    deadline=None,
    phases=(Phase.generate, Phase.shrink),
    suppress_health_check=list(HealthCheck),
)


def checked(message: Any) -> Any:
    return checker(type(message))(message)


def refusal(message: Any) -> WrongValue:
    with pytest.raises(WrongValue) as caught:
        checked(message)
    return caught.value


WAYS: dict[str, Callable[[Any], Any]] = {
    "between processes": lambda m: message_codec(type(m)).decode(message_codec(type(m)).encode(m)),
    "within a process": copy_packet,
    "by rclpy": lambda m: deserialize_message(serialize_message(m), type(m)),
    "sent by rclpy, received here": lambda m: message_codec(type(m)).decode(serialize_message(m)),
    "sent here, received by rclpy": lambda m: deserialize_message(
        message_codec(type(m)).encode(m), type(m)
    ),
}


class TestEveryMessageClass:
    @every_class
    def test_what_fits_arrives_with_the_same_bits_on_every_way(self, kind: Any) -> None:
        @QUICKLY
        @given(right_messages(kind))
        def check(messages: tuple[Any, Any]) -> None:
            packet, expected = messages
            packet = checked(packet)
            assert parts(packet) == parts(expected)
            for way, carry in WAYS.items():
                assert parts(carry(packet)) == parts(expected), way
            assert checked(packet) is packet
            assert digest_of(packet) == digest_for(kind)(message_codec(kind).encode(packet), packet)

        check()

    @every_class
    def test_what_does_not_fit_is_refused_with_the_path_to_it(self, kind: Any) -> None:
        if is_empty(kind):
            return

        @QUICKLY
        @given(wrong_messages(kind))
        def check(wrong: Any) -> None:
            error = refusal(wrong.message)
            assert error.path == wrong.path
            assert wrong.allowed in error.allowed

        check()

    def test_a_new_message_is_right_as_it_is(self) -> None:
        for kind in KINDS:
            message = kind()
            before = parts(message)
            assert checked(message) is message
            assert parts(message) == before


class Colour(enum.IntEnum):
    RED = 3


class Name(str, enum.Enum):
    HIP = "hip"


class TestNumbers:
    @pytest.mark.parametrize(
        "value",
        [1, True, numpy.float32(1), numpy.float64(1), numpy.int8(1), numpy.array([[1.0]]),
         numpy.array(1), numpy.longdouble(1), fractions.Fraction(2, 2), numpy.bool_(True)],
    )  # fmt: skip
    def test_any_number_in_a_float_is_the_float(self, value: Any) -> None:
        twist = Twist()
        twist.linear.x = value
        assert type(checked(twist).linear.x) is float
        assert twist.linear.x == 1.0

    def test_a_float32_holds_the_nearest_one(self) -> None:
        assert checked(Float32(data=0.1)).data == struct.unpack("<f", struct.pack("<f", 0.1))[0]

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), -0.0])
    def test_special_floats_stay(self, value: float) -> None:
        for kind in (Float32, Float64):
            message = kind(data=value)
            assert struct.pack("<d", checked(message).data) == struct.pack("<d", value)

    @pytest.mark.parametrize("value", [3.0, numpy.float32(3), Colour.RED, numpy.array([3])])
    def test_a_whole_number_in_an_integer_is_the_int(self, value: Any) -> None:
        assert type(checked(Int32(data=value)).data) is int
        assert checked(Int32(data=value)).data == 3

    @pytest.mark.parametrize(
        ("message", "text"),
        [
            (UInt8(data=300), "uint8: 0 to 255, but is 300 (int)"),
            (UInt8(data=-1), "uint8: 0 to 255, but is -1 (int)"),
            (UInt8(data=numpy.int64(300)), "uint8: 0 to 255, but is 300 (numpy.int64)"),
            (UInt8(data=1.5), "uint8: 0 to 255 without a fraction, but is 1.5 (float)"),
            (UInt64(data=1e20), f"uint64: 0 to {2**64 - 1}, but is 1e+20 (float)"),
            (UInt64(data=2.0**64), f"uint64: 0 to {2**64 - 1}, but is {2.0**64} (float)"),
            (Float64(data="fast"), "float64, but is 'fast' (str)"),
            (Float64(data=None), "float64, but is None (NoneType)"),
            (Float64(data=Vector3()), "float64, but is a geometry_msgs/Vector3"),
            (
                Float32(data=1e39),
                "float32: -3.4028235e+38 to 3.4028235e+38, but is 1e+39 (float)",
            ),
            (Bool(data="yes"), "bool: True or False, but is 'yes' (str)"),
        ],
        ids=lambda value: value if isinstance(value, str) else "",
    )
    def test_any_other_is_refused_in_words(self, message: Any, text: str) -> None:
        assert str(refusal(message)) == f"field 'data' must be {text}"

    def test_an_error_can_be_printed_whatever_the_value_says_of_itself(self) -> None:
        class Odd:
            def __repr__(self) -> str:
                return "half \ud83d\nof a pair"

        assert refusal(Float64(data=Odd())).found.startswith("half \\ud83d of a pair (")

    def test_a_masked_number_is_none(self) -> None:
        assert "masked" in str(refusal(Float64(data=numpy.ma.masked)))


class TestTexts:
    @pytest.mark.parametrize("value", [numpy.str_("hip"), Name.HIP])
    def test_text_of_any_class_is_text(self, value: Any) -> None:
        assert type(checked(String(data=value)).data) is str
        assert checked(String(data=value)).data == "hip"

    @pytest.mark.parametrize(
        ("value", "text"),
        [
            (b"hip", "string, but is b'hip' (bytes)"),
            ("a\0b", r"string without NUL, but is 'a\x00b' (str)"),
            ("\ud83d", r"string without halves of surrogate pairs, but is '\ud83d' (str)"),
        ],
    )
    def test_text_that_would_not_arrive_is_refused(self, value: Any, text: str) -> None:
        assert str(refusal(String(data=value))) == f"field 'data' must be {text}"

    def test_a_byte_is_bytes_of_length_one(self) -> None:
        assert checked(Byte(data=bytearray(b"\7"))).data == b"\7"
        status = DiagnosticStatus(level=2)
        assert str(refusal(status)) == (
            "field 'level' must be byte: bytes of length 1, but is 2 (int)"
        )


class TestSequences:
    def test_names_may_be_a_tuple_or_the_keys_of_a_dictionary(self) -> None:
        for names in (("a", "b"), {"a": 1, "b": 2}.keys(), numpy.array(["a", "b"])):
            message = JointState()
            message.name = names
            assert parts(checked(message).name) == parts(["a", "b"])

    def test_a_matrix_goes_row_by_row(self) -> None:
        message = CameraInfo()
        message._k = numpy.arange(9.0).reshape(3, 3)
        assert checked(message).k.tolist() == list(range(9))

    @pytest.mark.parametrize(
        ("path", "value", "text"),
        [
            ("name", "hip", "string[]: a list, a tuple or an array, but is 'hip' (str)"),
            ("name", {"a"}, "string[]: a list, a tuple or an array, but is {'a'} (set)"),
            ("name[1]", ["a", 5], "string, but is 5 (int)"),
            ("position[1]", [0.5, "up"], "float64, but is 'up' (str)"),
            ("position[0]", [[0.5]], "float64, but is [0.5] (list)"),
            (
                "position",
                numpy.zeros((1, 2)),
                "float64[]: a list, a tuple or an array, but is array([[0., 0.]]) (numpy.ndarray)",
            ),
        ],
    )
    def test_anything_else_is_refused_with_its_place(
        self, path: str, value: Any, text: str
    ) -> None:
        message = JointState()
        setattr(message, f"_{path.partition('[')[0]}", value)
        assert str(refusal(message)) == f"field '{path}' must be {text}"

    def test_lengths_and_bounds_are_kept(self) -> None:
        imu, box = Imu(), SolidPrimitive()
        imu.orientation_covariance = numpy.zeros(8)
        box.dimensions = [1.0] * 4
        assert str(refusal(imu)) == (
            "field 'orientation_covariance' must be float64[9]: exactly 9 items, but is 8 items"
        )
        assert str(refusal(box)) == (
            "field 'dimensions' must be float64[<=3]: at most 3 items, but is 4 items"
        )

    def test_numbers_that_an_array_would_change_are_named_with_their_place(self) -> None:
        scan = LaserScan()
        scan._ranges = numpy.array([1.0, 1e300])
        assert refusal(scan).path == "ranges[1]"
        scan._ranges = array("d", [0.1])
        assert parts(checked(scan).ranges) == parts(array("f", [0.1]))


def with_ranges(values: Any) -> Any:
    scan = LaserScan()
    scan.ranges = values
    return scan


class TestArraysThatSettersMake:
    """Those of ROS would change these values before a packet is checked."""

    @pytest.mark.parametrize(
        ("values", "text"),
        [
            ([300] * 16, "[0]' must be uint8: 0 to 255, but is 300 (int)"),
            ([numpy.int64(300)] * 16, "[0]' must be uint8: 0 to 255, but is 300 (numpy.int64)"),
            (numpy.full(16, 300), "[0]' must be uint8: 0 to 255, but is 300 (numpy.int64)"),
            ([[0] * 3, [1, -1, 1]], "[1]' must be uint8: 0 to 255, but is -1 (int)"),
            ([0, 1.5], "[1]' must be uint8: 0 to 255 without a fraction, but is 1.5 (float)"),
            ([0, "12"], "[1]' must be uint8: 0 to 255, but is '12' (str)"),
            (numpy.array(["12"]), "[0]' must be uint8: 0 to 255, but is '12' (numpy.str_)"),
            ("12", "' must be uint8[16]: a list, a tuple or an array, but is '12' (str)"),
        ],
    )
    def test_a_fixed_number_of_integers_is_not_cut_off(self, values: Any, text: str) -> None:
        for make in (lambda: UUID(uuid=values), lambda: setattr(UUID(), "uuid", values)):
            with pytest.raises(WrongValue, match=re.escape(f"field 'uuid{text}")):
                make()

    @pytest.mark.parametrize("value", ["12", None, 1j, numpy.complex128(1), 10**400])
    def test_a_fixed_number_of_floats_takes_real_numbers_alone(self, value: Any) -> None:
        with pytest.raises(
            WrongValue, match=r"field 'orientation_covariance\[8\]' must be float64"
        ):
            Imu(orientation_covariance=[*[0.5] * 8, value])

    @pytest.mark.parametrize(
        "values",
        [
            [0.5, 1e39],
            (0.5, 1e39),
            [1, 10**39],
            [0.5, numpy.float64(1e39)],
            numpy.array([0.5, 1e39]),
            array("d", [0.5, 1e39]),
            (value for value in (0.5, 1e39)),
            [float("inf"), -1e39],
        ],
    )
    def test_no_float32_becomes_infinite(self, values: Any) -> None:
        values = values if hasattr(values, "__len__") else [*values]
        for make in (with_ranges, lambda values: LaserScan(ranges=values)):
            with pytest.raises(WrongValue, match=r"field 'ranges\[1\]' must be float32"):
                make(values)

    @pytest.mark.parametrize("values", [["1"], [None], [1j], [numpy.complex128(1)], "1", 5])
    def test_what_is_no_real_number_is_refused_in_sequences(self, values: Any) -> None:
        for kind in (Float32MultiArray, Float64MultiArray):
            with pytest.raises(WrongValue, match=r"field 'data(\[0\])?' must be float"):
                kind(data=values)

    @pytest.mark.parametrize(
        "values",
        [
            [0.5, 2],
            (0.5, 2),
            {0.5: "a", 2: "b"}.keys(),
            iter([0.5, 2.0]),
            numpy.array([0.5, 2]),
            array("d", [0.5, 2]),
            array("f", [0.5, 2]),
            array("f", [0.5, 2]).tobytes(),
            [numpy.float32(0.5), numpy.array([2])],
        ],
    )
    def test_what_fits_becomes_what_ros_makes_of_it(self, values: Any) -> None:
        assert parts(with_ranges(values).ranges) == parts(array("f", [0.5, 2]))

    def test_infinite_values_stay_infinite(self) -> None:
        ends = [float("inf"), -float("inf"), 1.0]
        assert with_ranges(ends).ranges.tolist() == ends
        assert with_ranges(numpy.array(ends)).ranges.tolist() == ends

    def test_what_is_assigned_is_copied_and_a_matrix_keeps_its_shape(self) -> None:
        given = numpy.eye(3)
        camera = CameraInfo(k=given)
        given[0, 0] = 5.0
        assert camera.k[0, 0] == 1.0
        camera.k = [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
        assert camera.k[2, 0] == 7.0
        assert checked(camera).k.tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]

    @pytest.mark.parametrize("value", [300, -1, numpy.int64(300), 1.5, "12", None, [0, 300]])
    def test_an_element_of_a_fixed_number_of_them_is_refused_too(self, value: Any) -> None:
        uuid = UUID()
        place = slice(0, 2) if isinstance(value, list) else 3
        for numbers in (uuid.uuid, uuid.uuid[:8], uuid.uuid.reshape(4, 4).reshape(-1)):
            with pytest.raises(WrongValue, match="field 'uuid"):
                numbers[place] = value
        assert uuid == UUID()

    def test_an_element_is_converted_as_a_field_is(self) -> None:
        imu, uuid = Imu(), UUID()
        imu.orientation_covariance[0] = 0.1
        imu.orientation_covariance.reshape(3, 3)[1, 1] = numpy.float32(0.5)
        imu.orientation_covariance[[2, 8]] = 2
        uuid.uuid[3] = 7.0
        assert imu.orientation_covariance.tolist() == [0.1, 0, 2, 0, 0.5, 0, 0, 0, 2]
        assert uuid.uuid[3] == 7
        assert checked(imu) is imu

    def test_what_a_plugin_computes_from_a_field_is_its_own(self) -> None:
        halves = UUID().uuid + 1
        halves[0] = 2.5
        assert (type(halves), halves[0]) == (numpy.ndarray, 2)
        own = UUID().uuid.copy()
        own[0] = 2.5
        assert own[0] == 2
        assert type(UUID().uuid.sum()) is numpy.uint64
        assert copy.deepcopy(UUID(uuid=[1] * 16).uuid).tolist() == [1] * 16
        assert pickle.loads(pickle.dumps(UUID().uuid)).tolist() == [0] * 16
        assert repr(UUID().uuid) == repr(numpy.zeros(16, numpy.uint8))

    def test_a_message_within_another_keeps_the_rule(self) -> None:
        odometry = Odometry()
        with pytest.raises(WrongValue, match="field 'covariance'"):
            odometry.pose.covariance[0] = "12"

    def test_ros_own_checks_are_made_where_the_user_has_asked_for_them(self) -> None:
        with pytest.raises(AssertionError):
            LaserScan(check_fields=True).ranges = ["1"]


class TestMessages:
    def test_a_message_in_a_list_is_named_with_its_place(self) -> None:
        poses = PoseArray(poses=[Pose() for _ in range(5)])
        poses.poses[3].position.y = "up"
        error = refusal(poses)
        assert (error.path, error.allowed, error.found) == (
            "poses[3].position.y", "float64", "'up' (str)",
        )  # fmt: skip

    def test_a_message_of_another_type_is_refused(self) -> None:
        pose = PoseStamped()
        pose.pose = Twist()
        assert str(refusal(pose)) == (
            "field 'pose' must be geometry_msgs/Pose, but is a geometry_msgs/Twist"
        )
        stamped = TwistStamped(header=Header())
        stamped.twist.linear = None
        assert refusal(stamped).path == "twist.linear"

    def test_one_of_a_derived_class_is_sent_as_one_of_its_class(self) -> None:
        class Labelled(Float64):  # type: ignore[misc]
            pass

        sent = checker(Float64)(Labelled(data=2))
        assert type(sent) is Float64
        assert sent.data == 2.0

    def test_a_field_that_was_deleted_is_named(self) -> None:
        message = Float64()
        del message._data
        assert str(refusal(message)) == "field 'data' must be float64, but is nothing"

    @given(st.lists(st.floats() | st.integers(-5, 5)))
    def test_a_list_that_was_right_stays_the_list_that_it_was(self, numbers: list[Any]) -> None:
        poses = PoseArray(poses=[Pose() for _ in numbers])
        held = poses.poses
        for pose, number in zip(poses.poses, numbers, strict=True):
            pose.position.x = number
        assert checked(poses).poses is held
        assert all(type(pose.position.x) is float for pose in held)
