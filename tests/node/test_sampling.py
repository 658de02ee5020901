"""Observers see a few packets, as many as they ask for."""

from __future__ import annotations

import base64
import math
from array import array

import numpy as np
import pytest
from geometry_msgs.msg import Point, Polygon, PoseStamped
from sensor_msgs.msg import Image, Imu
from std_msgs.msg import Bool, Float64MultiArray

from neuros.control import WORLD
from neuros.node.instruments import Passage
from neuros.node.sampling import (
    MOST_ELEMENTS,
    MOST_VALUES,
    Sampler,
    all_fields,
    number_at,
    parse_path,
)
from neuros.ports import Way
from neuros.project.model import Port


def imu(z: float) -> Imu:
    packet = Imu()
    packet.angular_velocity.z = z
    return packet


def test_what_nobody_asks_for_is_not_looked_at() -> None:
    sampler = Sampler(bytes)
    assert not sampler.requests
    sampler.sample("imu", object())
    assert sampler.ask({}) == {}


def test_a_simulated_world_is_shown_at_once_to_who_asks_for_it() -> None:
    sampler = Sampler(bytes)
    assert sampler.ask({WORLD: {}}) == {}  # this node has none
    sampler.look_at_world = lambda wanted, asker: {"seen": [wanted, asker]}
    assert sampler.ask({"imu": {}}) == {}
    assert sampler.ask({WORLD: {"frames": True}}, 7) == {WORLD: {"seen": [{"frames": True}, 7]}}
    assert not sampler.requests


def test_a_world_that_cannot_be_shown_is_told_and_ends_no_run() -> None:
    sampler = Sampler(bytes)
    sampler.look_at_world = lambda wanted, asker: {"z": 1 / 0}
    assert "ZeroDivisionError" in sampler.ask({WORLD: {}})[WORLD]["fault"]


def test_chosen_fields_are_read_of_each_packet_up_to_a_limit() -> None:
    sampler = Sampler(bytes)
    wanted = {"imu": {"fields": ["angular_velocity.z", "angular_velocity.w"]}}
    sampler.ask(wanted)
    for number in range(MOST_VALUES + 5):
        sampler.sample("imu", imu(number))
        sampler.sample("other", object())
    assert not sampler.requests  # from here on a packet costs nothing
    sample = sampler.ask(wanted)["imu"]
    assert sample["fields"] == wanted["imu"]["fields"]
    assert [row[1:] for row in sample["values"]] == [[float(n), None] for n in range(MOST_VALUES)]
    times = [row[0] for row in sample["values"]]
    assert times == sorted(times)
    assert sampler.requests
    assert sampler.ask({}) == {}


def test_each_observer_gets_what_it_asked_for() -> None:
    sampler = Sampler(bytes)
    sampler.ask({"imu": {"fields": ["angular_velocity.z"]}}, asker=1)
    sampler.sample("imu", imu(1.0))
    sampler.ask({"imu": {"all": True}, "camera": {"image": True}}, asker=2)
    sampler.sample("imu", imu(2.0))
    assert [row[1] for row in sampler.ask({}, asker=1)["imu"]["values"]] == [1.0, 2.0]
    answers = sampler.ask({}, asker=2)
    assert list(answers) == ["imu"]
    assert answers["imu"]["all"]["angular_velocity.z"] == 2.0
    assert "values" not in answers["imu"]


def test_a_question_that_comes_while_a_packet_is_looked_at_counts_from_the_next_one() -> None:
    class Asking:
        @property
        def z(self) -> float:
            sampler.ask({"camera": {"image": True}})
            return 1.0

    sampler = Sampler(bytes)
    sampler.ask({"imu": {"all": True, "fields": ["z"]}})
    for _ in range(MOST_VALUES - 1):
        sampler.sample("imu", Imu())
    sampler.sample("imu", Asking())
    assert list(sampler.requests) == ["camera"]


def test_of_all_fields_and_of_images_one_packet_is_enough() -> None:
    sampler = Sampler(bytes)
    image = Image(width=2, height=1, step=2, encoding="mono8", data=array("B", b"\x01\x02"))
    sampler.ask({"camera": {"all": True, "image": True}})
    sampler.sample("camera", image)
    image.data[0] = 9  # the sender's again: what was sampled is a copy
    assert not sampler.requests
    sample = sampler.ask({})["camera"]
    assert sample["all"]["encoding"] == "mono8"
    assert (sample["image"]["width"], sample["image"]["data"]) == (2, "AQI=")


def test_an_array_is_looked_at_as_the_message_that_ros_sees() -> None:
    sampler = Sampler(bytes)
    passage = Passage(Way.SENT, Port("state", "float64[2,3]"))
    sampler.attach(passage)
    sampler.ask({"state": {"all": True, "fields": ["data[4]"], "arrays": ["data"]}})
    packet = np.arange(6.0).reshape(2, 3)
    for observe in passage.observers:
        observe(packet, None)
    packet[:] = 0  # the sender's again
    sample = sampler.ask({})["state"]
    assert sample["values"][0][1:] == [4.0]
    assert sample["all"] == {"data.length": 6, **{f"data[{n}]": n for n in range(6)}}
    assert base64.b64decode(sample["arrays"]["data"][0][1]) == array("f", range(6)).tobytes()


def test_what_cannot_be_read_is_told_and_harms_nobody() -> None:
    sampler = Sampler(bytes)
    sampler.ask({"camera": {"image": True}})
    sampler.sample("camera", Image(encoding="yuv422"))
    assert "encoding 'yuv422' are not shown" in sampler.ask({})["camera"]["fault"]


@pytest.mark.parametrize(("width", "height"), [(0, 0), (4, 0), (0, 4)])
def test_an_image_without_pixels_is_told(width: int, height: int) -> None:
    sampler = Sampler(bytes)
    sampler.ask({"camera": {"image": True}})
    sampler.sample("camera", Image(width=width, height=height, step=4 * width, encoding="rgba8"))
    assert f"are not an image of {width} x {height}" in sampler.ask({})["camera"]["fault"]


@pytest.mark.parametrize(
    ("path", "number"),
    [
        ("pose.position.x", 1.5),
        ("header.stamp.sec", 3.0),
        ("header.frame_id", None),
        ("pose.nothing", None),
        ("pose", None),
    ],
)
def test_a_path_leads_to_a_number_or_to_nothing(path: str, number: float | None) -> None:
    packet = PoseStamped()
    packet.pose.position.x = 1.5
    packet.header.stamp.sec = 3
    assert number_at(packet, parse_path(path)) == number


def test_paths_lead_into_sequences() -> None:
    packet = Polygon(points=[])
    assert number_at(packet, parse_path("points[0].x")) is None
    numbers = Float64MultiArray(data=[1.0, math.nan])
    assert number_at(numbers, parse_path("data[0]")) == 1.0
    assert number_at(numbers, parse_path("data[1]")) is None
    assert number_at(Bool(data=True), parse_path("data")) == 1.0


def test_all_fields_have_their_paths() -> None:
    packet = imu(2.0)
    packet.header.frame_id = "head"
    fields = all_fields(packet)
    assert fields["header.frame_id"] == "head"
    assert fields["angular_velocity.z"] == 2.0
    assert fields["orientation_covariance.length"] == 9
    assert fields["orientation_covariance[8]"] == 0.0


def test_of_long_sequences_the_first_elements_are_listed() -> None:
    fields = all_fields(Float64MultiArray(data=[0.5] * 1000))
    assert fields["data.length"] == 1000
    assert sum(path.startswith("data[") for path in fields) == MOST_ELEMENTS
    assert len(all_fields(Float64MultiArray(data=[0.5] * 1000), 1000)) == 1000


def test_fields_that_are_no_finite_numbers_can_go_through_json() -> None:
    assert all_fields(Point(x=math.inf))["x"] == "inf"
