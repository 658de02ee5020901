"""What one node does to a packet is never seen by another, whatever references are kept."""

from __future__ import annotations

import gc
import weakref
from array import array
from collections.abc import Callable
from typing import Any

import numpy
import pytest
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Path
from sensor_msgs.msg import Image, Imu, JointState
from std_msgs.msg import Float64MultiArray, Header, String

from neuros.transport.messages import copy_packet, message_class
from neuros.transport.ownership import unheld, unshared_check


def image() -> Image:
    return Image(header=Header(frame_id="eye"), data=array("B", range(12)))


def imu() -> Imu:
    return Imu(orientation_covariance=numpy.arange(9.0))


def path() -> Path:
    return Path(poses=[PoseStamped(header=Header(frame_id="a")), PoseStamped()])


def joints() -> JointState:
    return JointState(name=["a", "b"], position=array("d", [1.0, 2.0]))


MAKERS = [image, imu, path, joints, PoseStamped, Vector3Stamped, Float64MultiArray]


@pytest.fixture(autouse=True, scope="module")
def loaded_classes() -> None:
    """As a transport loads them, which keeps ROS's deprecation warnings to itself."""
    for kind in {type(make()) for make in MAKERS} | {String}:
        message_class(f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}")


def handed_over(box: list[Any]) -> list[Any]:
    """What receivers get for the result of a hook, by the rule of the transport in memory."""
    given_up = unheld(box)
    result = box.pop()
    packets = result if isinstance(result, tuple | list) else [result]
    return [
        packet
        if any(packet is each for each in given_up) and unshared_check(type(packet))(packet)
        else copy_packet(packet)
        for packet in packets
    ]


def parts(value: Any) -> list[Any]:
    """Everything of a packet that can change, the packet itself included."""
    if hasattr(value, "get_fields_and_field_types"):
        fields = [getattr(value, f"_{name}") for name in value.get_fields_and_field_types()]
        return [value, *(part for field in fields for part in parts(field))]
    if isinstance(value, list):
        return [value, *(part for item in value for part in parts(item))]
    return [value] if isinstance(value, array | numpy.ndarray) else []


WAYS: list[Callable[[Any], Any]] = [
    lambda part: part,
    lambda part: [part],
    lambda part: {"kept": (part,)},
    lambda part: lambda: part,
    lambda part: iter([part]),
    lambda part: numpy.asarray(part) if isinstance(part, array | numpy.ndarray) else part,
    lambda part: memoryview(part) if isinstance(part, array | numpy.ndarray) else part,
    lambda part: part[1:3] if isinstance(part, numpy.ndarray) else part,
    lambda part: weakref.ref(part) if isinstance(part, array | numpy.ndarray) else part,
]


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(MAKERS), st.sampled_from(WAYS), st.data())
def test_nothing_that_is_kept_in_any_way_is_handed_over(
    make: Callable[[], Any], keep: Callable[[Any], Any], data: st.DataObject
) -> None:
    packet = make()
    everything = parts(packet)
    kept = keep(everything[data.draw(st.integers(0, len(everything) - 1))])
    identities = {id(part) for part in everything}
    box = [packet]
    del packet, everything
    (received,) = handed_over(box)
    assert kept is not None
    assert received == make()
    assert identities.isdisjoint(id(part) for part in parts(received))


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize("wrap", [lambda p: p, lambda p: (p,), lambda p: [p, None]])
def test_what_nobody_keeps_is_handed_over_itself(make: Any, wrap: Any) -> None:
    box = [wrap(make())]
    found = unheld(box)
    assert len(found) == 1
    assert unshared_check(type(found[0]))(found[0])


def test_a_packet_that_was_kept_for_a_while_is_unshared_again_once_it_is_let_go() -> None:
    packet = image()
    view = memoryview(packet.data)
    assert not unshared_check(type(packet))(packet)
    view.release()
    del view
    gc.collect()
    assert unshared_check(type(packet))(packet)


def test_a_packet_for_two_outputs_is_not_given_up() -> None:
    packet = imu()
    box = [(packet, packet)]
    del packet
    assert unheld(box) == []


def test_a_list_that_the_hook_returns_again_and_again_is_not_given_up() -> None:
    results = [imu()]
    box = [results]
    assert unheld(box) == []
    assert results == [imu()]


def test_an_array_that_shows_the_memory_of_another_is_not_handed_over() -> None:
    numbers = numpy.arange(20.0)
    packet = Imu()
    packet._orientation_covariance = numbers[:9]  # the setter of some releases copies
    del numbers  # the view holds it: who else does cannot be told
    assert not unshared_check(type(packet))(packet)


def test_an_array_that_cannot_be_written_to_is_not_handed_over() -> None:
    packet = Imu()
    packet._orientation_covariance.flags.writeable = False
    assert not unshared_check(type(packet))(packet)


def test_a_class_of_the_users_own_is_not_handed_over() -> None:
    class Labelled(String):  # type: ignore[misc]
        pass

    assert not unshared_check(Labelled)(Labelled())
