"""Spikes and arrays of packets, gathered between two questions of an observer."""

from __future__ import annotations

import base64
from array import array
from types import SimpleNamespace
from typing import Any

from std_msgs.msg import Float64MultiArray, String

from neuros.node.sampling import LONGEST_ARRAY, MOST_ARRAYS, MOST_PACKETS, MOST_SPIKES, Sampler


def spikes(senders: list[int], times: list[float], stamp_s: int = 0, size: int = 60) -> Any:
    """A packet with the fields of neuros_msgs/msg/Spikes."""
    header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp_s, nanosec=500_000_000))
    return SimpleNamespace(
        header=header, size=size, senders=array("I", senders), times=array("d", times)
    )


def numbers(text: str, code: str) -> list[float]:
    found = array(code)
    found.frombytes(base64.b64decode(text))
    return found.tolist()


def asked(wanted: dict[str, Any], *packets: Any) -> dict[str, Any]:
    """What a sampler answers of these packets."""
    sampler = Sampler(bytes)
    sampler.ask({"out": wanted})
    for packet in packets:
        sampler.sample("out", packet)
    return dict(sampler.ask({}).get("out", {}))


def test_the_spikes_of_all_packets_are_gathered() -> None:
    found = asked(
        {"spikes": True}, spikes([1, 2], [0.1, 0.2]), spikes([], []), spikes([3], [0.9], 7)
    )
    assert numbers(found["spikes"]["senders"], "I") == [1, 2, 3]
    assert numbers(found["spikes"]["times"], "d") == [0.1, 0.2, 0.9]
    assert (found["spikes"]["size"], found["spikes"]["count"]) == (60, 3)
    assert found["spikes"]["stamp_s"] == 7.5


def test_silence_is_told_apart_from_no_packets() -> None:
    assert asked({"spikes": True}, spikes([], [], 3))["spikes"]["stamp_s"] == 3.5
    assert asked({"spikes": True}) == {}


def test_of_too_many_spikes_the_first_ones_are_shown_and_the_others_counted() -> None:
    many = spikes([1] * MOST_SPIKES, [0.5] * MOST_SPIKES)
    found = asked({"spikes": True}, spikes([0], [0.0]), many)["spikes"]
    assert len(numbers(found["times"], "d")) == MOST_SPIKES
    assert found["count"] == MOST_SPIKES + 1


def test_after_a_page_was_left_packets_are_looked_at_no_longer() -> None:
    sampler = Sampler(bytes)
    sampler.ask({"out": {"spikes": True}})
    for _ in range(MOST_PACKETS):
        sampler.sample("out", spikes([], []))
    assert not sampler.requests
    sampler.ask({"out": {"arrays": ["data"]}})
    for _ in range(MOST_ARRAYS):
        sampler.sample("out", String())
    assert not sampler.requests


def test_arrays_are_read_by_their_path_and_cut() -> None:
    packet = Float64MultiArray(data=[0.5] * (LONGEST_ARRAY + 3))
    ((_, text, length),) = asked({"arrays": ["data"]}, packet)["arrays"]["data"]
    assert numbers(text, "f") == [0.5] * LONGEST_ARRAY
    assert length == LONGEST_ARRAY + 3


def test_what_is_no_array_or_no_spikes_is_told() -> None:
    assert "AttributeError" in asked({"arrays": ["rates"]}, Float64MultiArray())["fault"]
    assert "TypeError" in asked({"arrays": ["data"]}, String(data="abc"))["fault"]
    assert asked({"spikes": True}, spikes([1], []))["fault"] == (
        "ValueError: 1 senders do not fit 0 times"
    )
