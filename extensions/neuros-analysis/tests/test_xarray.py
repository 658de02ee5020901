"""Recorded packets as frames, and as xarray's datasets."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from neuros_analysis import frames
from recordings import ALSO, ANSWER, answer, number, plan, record, spool
from rosbags.typesys import Stores, get_typestore

import neuros.bag
from neuros.errors import UsageError
from neuros.recording.recording_plan import RecordedStream, RecordingPlan, Topic

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types


def dataset(run: Path, messages: list[Any], *, has_simulated_time: bool = True) -> Any:
    """Record messages of one type, a tenth of a second apart, and read them back."""
    kind = messages[0].__msgtype__
    topic = Topic("/t", kind)
    streams = {"a": (RecordedStream("sent", "t", (0,)),)}
    times = [(10**9 + place, place * 10**8) for place in range(len(messages))]
    packets = [
        (wall, sim if has_simulated_time else None, bytes(STORE.serialize_cdr(message, kind)))
        for (wall, sim), message in zip(times, messages, strict=True)
    ]
    spool(run, "a", packets)
    owner = "a" if has_simulated_time else None
    record(run, RecordingPlan((topic,), streams, time_owner=owner))
    with neuros.bag.open(run) as bag:
        return bag["/t"].xarray()


def header() -> Any:
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](1, 2), "body")


def image(pixels: Any, encoding: str, padding: int = 0, *, is_bigendian: bool = False) -> Any:
    """An image whose rows end with some bytes that are no pixels."""
    height, width = pixels.shape[:2]
    rows = np.frombuffer(pixels.tobytes(), np.uint8).reshape(height, -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    return TYPES["sensor_msgs/msg/Image"](
        header(), height, width, encoding, int(is_bigendian), data.shape[1], data.ravel()
    )


def test_a_frame_has_a_column_for_each_element(tmp_path: Path) -> None:
    spool(tmp_path, "b", [(10, None, answer()), (30, None, answer())])
    record(tmp_path, plan())
    with neuros.bag.open(tmp_path) as bag:
        frame = bag["/answer"].frame()
    assert list(frame) == ["log_time_ns", "publish_time_ns", "data"]
    assert frame["data"].tolist() == [0.0, 0.0]
    assert frame.index.name == "time"
    assert frame.index.astype("int64").tolist() == [10, 30]
    assert str(frame.index.tz) == "UTC"


def test_a_frame_of_a_topic_without_packets_has_its_columns(tmp_path: Path) -> None:
    record(tmp_path, plan())
    with neuros.bag.open(tmp_path) as bag:
        assert list(bag["/answer"].frame()) == ["log_time_ns", "publish_time_ns", "data"]


def test_a_frame_by_simulated_time_has_it_as_its_index(tmp_path: Path) -> None:
    spool(tmp_path, "b", [(10, 2_000, answer()), (30, 4_000, answer())])
    record(tmp_path, plan(time_owner="b"))
    with neuros.bag.open(tmp_path) as bag:
        frame = bag[ANSWER.name].frame(clock="sim")
    assert frame.index.name == "time"
    assert frame.index.total_seconds().tolist() == [2e-6, 4e-6]


def test_a_frame_by_simulated_time_that_a_run_lacks_says_so(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(1))])
    record(tmp_path, plan())
    with neuros.bag.open(tmp_path) as bag, pytest.raises(UsageError, match="no simulated time"):
        bag[ALSO.name].frame(clock="sim")


def test_fields_are_variables_along_simulated_seconds_with_their_units(tmp_path: Path) -> None:
    vector, covariance = TYPES["geometry_msgs/msg/Vector3"], np.zeros(9)
    still = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    imus = [
        TYPES["sensor_msgs/msg/Imu"](
            *(header(), still, covariance, vector(0.0, 0.0, rate), covariance),
            *(vector(0.0, 0.0, 9.81), covariance),
        )
        for rate in (0.5, 0.25, 0.0)
    ]
    found = dataset(tmp_path, imus)
    assert found["time"].values.tolist() == [0.0, 0.1, 0.2]
    assert found["time"].attrs == {"units": "s", "long_name": "simulated time"}
    assert str(found["wall_time"].values[0]) == "1970-01-01T00:00:01.000000000"
    turning = found["angular_velocity.z"]
    assert (turning.dims, turning.attrs) == (("time",), {"units": "rad/s"})
    assert turning.sel(time=0.1).item() == 0.25
    assert found["linear_acceleration.x"].attrs == {"units": "m/s^2"}
    assert found["orientation_covariance"].dims == ("time", "orientation_covariance_0")
    assert found["orientation.w"].attrs == {}
    assert found.attrs == {"topic": "/t", "type": "sensor_msgs/msg/Imu"}


def test_the_unit_of_a_message_within_a_message_is_that_of_its_type(tmp_path: Path) -> None:
    vector = TYPES["geometry_msgs/msg/Vector3"](1.0, 0.0, 0.0)
    twist = TYPES["geometry_msgs/msg/Twist"](vector, vector)
    found = dataset(tmp_path, [TYPES["geometry_msgs/msg/TwistStamped"](header(), twist)])
    assert found["twist.linear.x"].attrs == {"units": "m/s"}
    assert found["twist.angular.x"].attrs == {"units": "rad/s"}


def test_without_simulated_time_seconds_count_from_the_first_packet_of_the_bag(
    tmp_path: Path,
) -> None:
    numbers = [TYPES["std_msgs/msg/Int32"](value) for value in (4, 5)]
    found = dataset(tmp_path, numbers, has_simulated_time=False)
    assert found["time"].values.tolist() == [0.0, 1e-9]
    assert found["time"].attrs["long_name"] == "wall time since the first packet of the bag"
    assert found["data"].values.tolist() == [4, 5]


def test_a_field_with_the_name_of_a_coordinate_keeps_its_values() -> None:
    columns = {name: np.array([5]) for name in ("log_time_ns", "publish_time_ns", "time")}
    topic = SimpleNamespace(
        name="/t", type="lab/msg/Lap", connection=None, columns=lambda: columns, is_virtual=False
    )
    made = frames.dataset(topic, {"lab/msg/Lap": ([], [("time", (None, ("int64", 0)))])}, 5)
    assert (made["time"].item(), made["time_"].item()) == (0.0, 5)


@pytest.mark.parametrize(
    ("encoding", "shape", "kind"),
    [
        ("rgb8", (2, 3, 3), "<u1"),
        ("bgra8", (2, 3, 4), "<u1"),
        ("mono8", (2, 3), "<u1"),
        ("mono16", (2, 3), "<u2"),
        ("mono16", (2, 3), ">u2"),
        ("32FC1", (2, 3), "<f4"),
    ],
)
@pytest.mark.parametrize("padding", [0, 4])
def test_images_have_rows_columns_and_channels(
    tmp_path: Path, encoding: str, shape: tuple[int, ...], kind: str, padding: int
) -> None:
    first = np.arange(np.prod(shape)).reshape(shape).astype(kind)
    pictures = [first, (first + 1).astype(kind)]
    is_bigendian = kind[0] == ">"
    messages = [image(each, encoding, padding, is_bigendian=is_bigendian) for each in pictures]
    found = dataset(tmp_path, messages)["data"]
    assert found.dims == ("time", "y", "x", "channel")[: 1 + len(shape)]
    assert np.array_equal(found.values, pictures)
    if len(shape) == 3:
        assert found["channel"].values.tolist() == list(encoding[:-1])


def test_images_of_other_pixels_or_several_sizes_stay_bytes(tmp_path: Path) -> None:
    square, wide = np.zeros((2, 2), np.uint8), np.zeros((2, 3), np.uint8)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    unknown = dataset(tmp_path / "one", [image(square, "yuv422")])
    assert unknown["data"].dims == ("time", "data_0")
    several = dataset(tmp_path / "two", [image(square, "mono8"), image(wide, "mono8")])
    assert [len(row) for row in several["data"].values] == [4, 6]
