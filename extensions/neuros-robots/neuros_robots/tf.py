"""Transforms between frames, as ``/tf`` and ``/tf_static`` carry them, without ``tf2_ros``.

A plugin has the two topics as inputs or outputs of type ``tf2_msgs/msg/TFMessage`` with an
``external_topic``. :class:`TransformBuffer` keeps what arrives and answers where one frame is seen
from another; :func:`transform` makes a message to send::

    buffer = TransformBuffer()
    buffer.add(packet)                             # of /tf
    buffer.add(packet, is_static=True)             # of /tf_static
    seen = buffer.lookup("world", "camera")        # a geometry_msgs/msg/TransformStamped
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from neuros.time import to_nanoseconds, to_stamp

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""x, y, z, w, as in ROS."""

_STILL: Quaternion = (0.0, 0.0, 0.0, 1.0)


class TransformError(LookupError):
    """The transform between two frames is unknown; the text says why."""


@dataclass(frozen=True, order=True)
class _Pose:
    """Transform of a frame in its parent at a time."""

    at_ns: int
    translation: Vector = field(compare=False, default=(0.0, 0.0, 0.0))
    rotation: Quaternion = field(compare=False, default=_STILL)

    def within(self, parent: _Pose) -> _Pose:
        """This frame in the parent's parent."""
        moved = _rotate(parent.rotation, self.translation)
        x, y, z = (a + b for a, b in zip(parent.translation, moved, strict=True))
        return _Pose(self.at_ns, (x, y, z), _times(parent.rotation, self.rotation))

    def inverted(self) -> _Pose:
        """The transform of the parent in this frame."""
        x, y, z, w = self.rotation
        back = (-x, -y, -z, w)
        px, py, pz = _rotate(back, self.translation)
        return _Pose(self.at_ns, (-px, -py, -pz), back)


class TransformBuffer:
    """Keeps transforms for a while and chains them.

    Time may go back, as at the reset of a simulator: a transform with an earlier stamp than the
    last one of its frame removes all later transforms of every frame, but for static ones.

    Args:
        cache_s: how long transforms of ``/tf`` are kept behind the newest one of the frame.
    """

    def __init__(self, cache_s: float = 10.0) -> None:
        self._cache_ns = round(cache_s * 1e9)
        self._parents: dict[str, str] = {}
        self._poses: dict[str, list[_Pose]] = {}
        self._static: set[str] = set()

    def add(self, message: Any, *, is_static: bool = False) -> None:
        """Add the transforms of a ``TFMessage``, or one ``TransformStamped``.

        Args:
            is_static: whether it is valid at any time, as those of ``/tf_static``.
        """
        for stamped in getattr(message, "transforms", (message,)):
            frame, parent = _plain(stamped.child_frame_id), _plain(stamped.header.frame_id)
            moved, turned = _parts(stamped.transform)
            pose = _Pose(to_nanoseconds(stamped), moved, turned)
            if is_static or self._parents.get(frame) != parent:
                self._poses[frame] = []
            self._parents[frame] = parent
            self._static.add(frame) if is_static else self._static.discard(frame)
            poses = self._poses[frame]
            if poses and pose < poses[-1]:
                for other, later in self._poses.items():
                    if other not in self._static:
                        del later[bisect_right(later, pose) :]
            if poses and poses[-1] == pose:  # of the same time
                del poses[-1]
            poses.append(pose)
            while poses[-1].at_ns - poses[0].at_ns > self._cache_ns:
                del poses[0]

    def lookup(self, target: str, source: str, at: Any = None) -> Any:
        """Look up ``source`` seen from ``target``: a ``geometry_msgs/msg/TransformStamped``.

        Its rotation and translation take a point from ``source`` to ``target``.

        Args:
            at: a ``builtin_interfaces/msg/Time``; transforms before and after it are interpolated.
                ``None``: the newest time at which all transforms between the frames are known.

        Raises:
            TransformError: if the frames are not connected, or not at that time.
        """
        down, up = self._way(target, source)
        moving = [frame for frame in (*down, *up) if frame not in self._static]
        for frame in moving:
            if not self._poses[frame]:
                raise TransformError(
                    f"'{frame}' in '{self._parents[frame]}': nothing is known since time has gone"
                    " back"
                )
        if at is None:
            at_ns = min((self._poses[frame][-1].at_ns for frame in moving), default=0)
        else:
            at_ns = to_nanoseconds(at)
        pose = self._chain(up, at_ns)
        if down:
            pose = pose.within(self._chain(down, at_ns).inverted())
        return transform(target, source, at_ns, pose.translation, pose.rotation)

    def _way(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """The frames from the target, and from the source, up to their common ancestor."""
        target, source = _plain(target), _plain(source)
        known = {*self._parents, *self._parents.values()}
        for frame in (target, source):
            if frame not in known:
                there = ", ".join(sorted(known)) or "none yet"
                raise TransformError(f"frame '{frame}' is not known (there are: {there})")
        of_target, of_source = list(self._ancestors(target)), list(self._ancestors(source))
        for place, frame in enumerate(of_source):
            if frame in of_target:
                return of_target[: of_target.index(frame)], of_source[:place]
        raise TransformError(f"'{target}' and '{source}' are in two trees of frames")

    def _ancestors(self, frame: str) -> Iterator[str]:
        """The frame, its parent, and so on."""
        seen: set[str] = set()
        at: str | None = frame
        while at is not None and at not in seen:
            seen.add(at)
            yield at
            at = self._parents.get(at)

    def _chain(self, frames: Sequence[str], at_ns: int) -> _Pose:
        """The transform of the first frame in the parent of the last one."""
        pose = _Pose(at_ns)
        for frame in frames:
            pose = pose.within(self._pose(frame, at_ns))
        return pose

    def _pose(self, frame: str, at_ns: int) -> _Pose:
        poses = self._poses[frame]
        if frame in self._static:
            return poses[0]
        place = bisect_left(poses, _Pose(at_ns))
        if place < len(poses) and poses[place].at_ns == at_ns:
            return poses[place]
        if not 0 < place < len(poses):
            raise TransformError(
                f"'{frame}' in '{self._parents[frame]}' is known from {poses[0].at_ns / 1e9:.3f} s"
                f" to {poses[-1].at_ns / 1e9:.3f} s, and not at {at_ns / 1e9:.3f} s"
            )
        return _between(poses[place - 1], poses[place], at_ns)


def transform(
    parent: str,
    child: str,
    stamp: Any,
    translation: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: Sequence[float] = _STILL,
) -> Any:
    """A ``geometry_msgs/msg/TransformStamped``: where ``child`` is in ``parent``.

    Args:
        stamp: a ``builtin_interfaces/msg/Time``, or nanoseconds.
        translation: x, y, z in metres.
        rotation: a quaternion x, y, z, w.
    """
    from geometry_msgs.msg import TransformStamped

    made = TransformStamped()
    made.header.frame_id, made.child_frame_id = parent, child
    made.header.stamp = to_stamp(nanoseconds=stamp) if isinstance(stamp, int) else stamp
    for axis, value in zip("xyz", translation, strict=True):
        setattr(made.transform.translation, axis, float(value))
    for axis, value in zip("xyzw", rotation, strict=True):
        setattr(made.transform.rotation, axis, float(value))
    return made


def _parts(message: Any) -> tuple[Vector, Quaternion]:
    moved, turned = message.translation, message.rotation
    length = math.hypot(turned.x, turned.y, turned.z, turned.w)
    if not length:
        raise TransformError(
            "a quaternion of length 0 is not a rotation: is its w missing? (no rotation: w = 1)"
        )
    x, y, z, w = (each / length for each in (turned.x, turned.y, turned.z, turned.w))
    return (moved.x, moved.y, moved.z), (x, y, z, w)


def _plain(frame: str) -> str:
    """A name without the leading slash of ROS 1."""
    return frame.removeprefix("/")


def _times(a: Quaternion, b: Quaternion) -> Quaternion:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _rotate(q: Quaternion, v: Vector) -> Vector:
    x, y, z, w = q
    back = (-x, -y, -z, w)
    return _times(_times(q, (*v, 0.0)), back)[:3]


def _between(a: _Pose, b: _Pose, at_ns: int) -> _Pose:
    """Interpolate: linearly in translation, on the shorter arc in rotation (Shoemake, 1985)."""
    share = (at_ns - a.at_ns) / (b.at_ns - a.at_ns)
    x, y, z = (p + share * (q - p) for p, q in zip(a.translation, b.translation, strict=True))
    cosine = sum(p * q for p, q in zip(a.rotation, b.rotation, strict=True))
    sign, angle = math.copysign(1.0, cosine), math.acos(min(1.0, abs(cosine)))
    if angle < 1e-9:
        return _Pose(at_ns, (x, y, z), a.rotation)
    of_a = math.sin((1 - share) * angle) / math.sin(angle)
    of_b = sign * math.sin(share * angle) / math.sin(angle)
    qx, qy, qz, qw = (of_a * p + of_b * q for p, q in zip(a.rotation, b.rotation, strict=True))
    return _Pose(at_ns, (x, y, z), (qx, qy, qz, qw))
