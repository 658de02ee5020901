"""A buffer of transforms looks up one frame seen from another."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.tf import TransformBuffer, TransformError, transform

SECOND = 1_000_000_000
QUARTER = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
"""A quarter turn to the left about the vertical."""


def place(stamped: Any) -> tuple[float, float, float]:
    moved = stamped.transform.translation
    return (moved.x, moved.y, moved.z)


def turn(stamped: Any) -> float:
    """The rotation about the vertical, in degrees."""
    q = stamped.transform.rotation
    return math.degrees(2 * math.atan2(q.z, q.w))


def matrix(stamped: Any) -> Any:
    """As a homogeneous 4 x 4 matrix."""
    q = stamped.transform.rotation
    x, y, z, w = q.x, q.y, q.z, q.w
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, 3] = place(stamped)
    return found


def filled(*stamped: Any, static: tuple[Any, ...] = ()) -> TransformBuffer:
    buffer = TransformBuffer()
    for each in stamped:
        buffer.add(each)
    for each in static:
        buffer.add(each, is_static=True)
    return buffer


def test_transforms_are_chained_through_static_ones() -> None:
    camera = transform("base", "camera", 0, (0.5, 0, 0.25))
    buffer = filled(transform("world", "base", SECOND, (3, 4, 0), QUARTER), static=(camera,))
    seen = buffer.lookup("world", "camera")
    assert place(seen) == pytest.approx((3, 4.5, 0.25))
    assert turn(seen) == pytest.approx(90)
    assert (seen.header.frame_id, seen.child_frame_id) == ("world", "camera")
    assert (seen.header.stamp.sec, seen.header.stamp.nanosec) == (1, 0)
    assert place(buffer.lookup("camera", "world")) == pytest.approx((-4.5, 3, -0.25))


def test_two_branches_meet_in_the_frame_that_both_are_in() -> None:
    left, right = (transform("base", name, SECOND, (0, y, 0)) for name, y in (("l", 1), ("r", -1)))
    assert place(filled(left, right).lookup("l", "r")) == pytest.approx((0, -2, 0))
    assert place(filled(left, right).lookup("l", "l")) == (0, 0, 0)


def test_between_two_times_it_is_interpolated_on_the_shorter_arc() -> None:
    q = tuple(-each for each in QUARTER)  # the same rotation
    buffer = filled(
        transform("world", "base", SECOND), transform("world", "base", 2 * SECOND, (2, 0, 0), q)
    )
    seen = buffer.lookup("world", "base", Time(sec=1, nanosec=SECOND // 2))
    assert place(seen) == pytest.approx((1, 0, 0))
    assert turn(seen) == pytest.approx(45)


def test_without_a_time_it_is_the_newest_that_all_on_the_way_have() -> None:
    base = [transform("world", "base", n * SECOND, (n, 0, 0)) for n in (1, 2, 3)]
    head = [transform("base", "head", n * SECOND) for n in (1, 2)]
    assert place(filled(*base, *head).lookup("world", "head")) == pytest.approx((2, 0, 0))


@pytest.mark.parametrize("sec", [0, 4])
def test_nothing_is_told_of_times_that_are_not_known(sec: int) -> None:
    base = [transform("world", "base", n * SECOND) for n in (1, 2, 3)]
    with pytest.raises(TransformError, match=rf"from 1\.000 s to 3\.000 s, and not at {sec}\.000"):
        filled(*base).lookup("world", "base", Time(sec=sec))


def test_what_is_older_than_the_cache_is_forgotten() -> None:
    buffer = TransformBuffer(cache_s=1.0)
    for n in range(5):
        buffer.add(transform("world", "base", n * SECOND))
    with pytest.raises(TransformError, match=r"from 3\.000 s to 4\.000 s"):
        buffer.lookup("world", "base", Time(sec=2))


def test_after_time_has_gone_back_nothing_of_what_lay_after_is_told() -> None:
    camera = transform("base", "camera", 9 * SECOND, (0, 0, 5))
    base = [transform("world", "base", n * SECOND, (n, 0, 0)) for n in range(10)]
    again = [transform("world", "base", n * SECOND, (100 + n, 0, 0)) for n in range(2)]
    buffer = filled(*base, static=(camera,))
    for each in again:
        buffer.add(each)
    seen = buffer.lookup("world", "camera")
    assert place(seen) == (101, 0, 5)
    assert seen.header.stamp.sec == 1
    assert place(buffer.lookup("world", "base", Time(sec=0))) == (100, 0, 0)
    with pytest.raises(TransformError, match=r"from 0\.000 s to 1\.000 s, and not at 5\.000"):
        buffer.lookup("world", "base", Time(sec=5))


def test_time_that_goes_back_for_one_frame_goes_back_for_all() -> None:
    both = ("base", "arm")
    buffer = filled(
        *(transform("world", f, n * SECOND, (n, 0, 0)) for n in (1, 2, 3) for f in both)
    )
    buffer.add(transform("world", "base", 2 * SECOND, (7, 0, 0)))
    assert place(buffer.lookup("base", "arm")) == (-5, 0, 0)  # at 2 s
    buffer.add(transform("world", "base", 0))
    with pytest.raises(TransformError, match="'arm' in 'world': nothing is known since time has"):
        buffer.lookup("world", "arm")
    buffer.add(transform("world", "arm", SECOND, (9, 0, 0)))
    assert place(buffer.lookup("world", "arm")) == (9, 0, 0)


def test_one_of_the_same_time_takes_the_place_of_the_one_before() -> None:
    buffer = filled(
        transform("world", "base", SECOND), transform("world", "base", SECOND, (4, 0, 0))
    )
    assert place(buffer.lookup("world", "base")) == (4, 0, 0)


def test_frames_that_are_unknown_or_apart_are_named() -> None:
    buffer = filled(transform("world", "base", SECOND), transform("table", "cup", SECOND))
    with pytest.raises(TransformError, match=r"'bse' is not known \(there are: base, cup, table"):
        buffer.lookup("world", "bse")
    with pytest.raises(TransformError, match="in two trees"):
        buffer.lookup("world", "cup")
    with pytest.raises(TransformError, match="none yet"):
        TransformBuffer().lookup("world", "base")


def test_a_rotation_that_is_none_is_refused() -> None:
    with pytest.raises(TransformError, match="length 0"):
        filled(transform("world", "base", SECOND, rotation=(0, 0, 0, 0)))


parts = st.floats(-1, 1)
rotations = st.tuples(parts, parts, parts, parts).filter(lambda q: math.hypot(*q) > 0.1)
poses = st.tuples(st.tuples(parts, parts, parts), rotations)


@settings(deadline=None)
@given(st.lists(poses, min_size=1, max_size=4), st.lists(poses, min_size=1, max_size=4))
def test_chains_are_products_of_matrices(left: list[Any], right: list[Any]) -> None:
    buffer = TransformBuffer()
    product = np.eye(4)
    for branch, chain in (("l", left), ("r", right)):
        whole = np.eye(4)
        for number, (moved, q) in enumerate(chain):
            length = math.hypot(*q)
            unit = tuple(each / length for each in q)
            parent = f"{branch}{number - 1}" if number else "root"
            stamped = transform(parent, f"{branch}{number}", SECOND, moved, unit)
            buffer.add(stamped)
            whole = whole @ matrix(stamped)
        product = np.linalg.inv(whole) if branch == "l" else product @ whole
    seen = buffer.lookup(f"l{len(left) - 1}", f"r{len(right) - 1}")
    assert np.allclose(matrix(seen), product, atol=1e-9)
