"""Stamps of ROS as seconds or nanoseconds, and back::

    from neuros.time import to_seconds, to_stamp

    age_s = to_seconds(node.now()) - to_seconds(imu)   # of imu.header.stamp
    packet.header.stamp = to_stamp(1.25)

They take a ``builtin_interfaces/msg/Time`` or ``Duration``, a message with a header, or a
``rosgraph_msgs/msg/Clock``.
"""

from __future__ import annotations

from typing import Any

_SECOND_NS = 1_000_000_000


def to_nanoseconds(stamped: Any) -> int:
    """The stamp in nanoseconds, exactly. Raises ``TypeError`` for what has none."""
    stamp = stamped
    if hasattr(stamped, "header"):
        stamp = stamped.header.stamp
    elif hasattr(stamped, "clock"):
        stamp = stamped.clock
    try:
        return int(stamp.sec) * _SECOND_NS + int(stamp.nanosec)
    except AttributeError:
        raise TypeError(
            f"a {type(stamped).__name__} has no stamp: give a Time or a Duration, a message with a"
            " header, or a Clock"
        ) from None


def to_seconds(stamped: Any) -> float:
    """The stamp in seconds: the ``float`` nearest to it. Raises as :func:`to_nanoseconds`."""
    return to_nanoseconds(stamped) / _SECOND_NS


def to_stamp(seconds: float = 0.0, *, nanoseconds: int = 0) -> Any:
    """A ``builtin_interfaces/msg/Time``: ``seconds``, rounded to a nanosecond, and ``nanoseconds``.

    Raises:
        ValueError: if ROS cannot hold it: 32 bits of seconds, from -68 to 68 years.
    """
    from builtin_interfaces.msg import Time

    stamp = Time()
    set_stamp(stamp, round(seconds * _SECOND_NS) + nanoseconds)
    return stamp


def set_stamp(stamp: Any, nanoseconds: int) -> None:
    """Set a ``Time`` that exists, such as ``packet.header.stamp``. Raises as :func:`to_stamp`."""
    sec, nanosec = divmod(nanoseconds, _SECOND_NS)
    if not -(1 << 31) <= sec < 1 << 31:
        raise ValueError(f"a stamp has 32 bits for its seconds: {sec} s do not fit")
    stamp.sec, stamp.nanosec = sec, nanosec
