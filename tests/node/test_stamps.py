"""Stamps of ROS as numbers, and back; no page and no plugin of ours reckons them by hand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from builtin_interfaces.msg import Duration, Time
from hypothesis import given
from hypothesis import strategies as st
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_msgs.msg import String

from neuros.time import to_nanoseconds, to_seconds, to_stamp

ROOT = Path(__file__).resolve().parents[2]


@given(st.integers(-(1 << 31) * 10**9, (1 << 31) * 10**9 - 1))
def test_a_stamp_is_exact_there_and_back(time_ns):
    stamp = to_stamp(nanoseconds=time_ns)
    assert 0 <= stamp.nanosec < 10**9
    assert to_nanoseconds(stamp) == time_ns


@given(st.integers(0, 10**6 * 10**9))
def test_so_are_seconds_for_eleven_days(time_ns):
    assert to_nanoseconds(to_stamp(to_seconds(to_stamp(nanoseconds=time_ns)))) == time_ns


def test_whatever_has_a_stamp_may_be_asked():
    imu, clock = Imu(), Clock()
    imu.header.stamp = clock.clock = to_stamp(1.25)
    assert to_seconds(imu) == to_seconds(clock) == to_seconds(Time(sec=1, nanosec=250_000_000))
    assert to_seconds(imu) == 1.25
    assert to_seconds(Duration(sec=-1, nanosec=500_000_000)) == -0.5


def test_what_has_none_is_named():
    with pytest.raises(TypeError, match="String has no stamp"):
        to_seconds(String())


def test_a_time_that_no_stamp_can_hold_is_refused():
    with pytest.raises(ValueError, match="4000000000 s do not fit"):
        to_stamp(4e9)


def test_nothing_reckons_a_stamp_by_hand():
    by_hand = re.compile(r"\.nanosec\b(?!`)\s*[*+=,]|\+\s*[\w.]*\.nanosec\b")
    folders = ("docs", "examples", "workspace", "benchmarks", "neuros")
    files = [f for each in folders for f in (ROOT / each).rglob("*") if f.suffix in (".py", ".md")]
    files = [f for f in files if "build" not in f.relative_to(ROOT).parts]  # docs that were made
    found = [str(f) for f in files if f.name != "time.py" and by_hand.search(f.read_text("utf-8"))]
    assert files
    assert not found, "use neuros.time"
