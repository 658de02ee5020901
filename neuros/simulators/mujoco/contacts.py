"""What touches a geom or a body, and how hard.

========================  ==========================================================
message type              content
========================  ==========================================================
``std_msgs/Bool``         whether anything presses on the element
``std_msgs/Float64``      sum of the normal forces on it, newtons
``Float64MultiArray``     the same for each element of a list, in its order
``WrenchStamped``         total force on it (newtons) and torque (N m) about its own
                          origin, both along the axes of the world
========================  ==========================================================

A body stands for its own geoms, not for those of its children. Contacts between geoms of one
element do not count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

Vector: TypeAlias = "npt.NDArray[np.float64]"
"""Shape (3,)."""

_Fill: TypeAlias = Callable[[Any, Any, int], None]


class Touch:
    """The contacts of one geom or body."""

    def __init__(self, model: Any, what: str, index: int) -> None:
        self._model, self._is_geom, self._index = model, what == "geom", index
        geoms = np.arange(model.ngeom)
        self._mine = geoms == index if self._is_geom else model.geom_bodyid[geoms] == index

    def normal_force(self, data: Any) -> float:
        """Sum of the normal forces, newtons."""
        return float(sum(abs(force[0]) for _, _, force in self._contacts(data)))

    def wrench(self, data: Any) -> tuple[Vector, Vector]:
        """Total force (N) and torque (N m) about the element's origin, along the world's axes."""
        origin = (data.geom_xpos if self._is_geom else data.xpos)[self._index]
        total_force, total_torque = np.zeros(3), np.zeros(3)
        for contact, sign, local in self._contacts(data):
            axes = data.contact.frame[contact].reshape(3, 3)  # rows; the normal is the first
            force, torque = sign * (local[:3] @ axes), sign * (local[3:] @ axes)
            total_force += force
            total_torque += torque + np.cross(data.contact.pos[contact] - origin, force)
        return total_force, total_torque

    def _contacts(self, data: Any) -> Iterator[tuple[int, int, Vector]]:
        """Contact, sign, and force and torque (6,) in the contact's frame.

        MuJoCo gives what the first geom does to the second, so it counts negatively for the first.
        """
        if not data.ncon:
            return
        pairs = data.contact.geom  # (ncon, 2); -1 where a flex takes part
        mine = (pairs >= 0) & self._mine[pairs]
        for contact in np.flatnonzero(mine[:, 0] != mine[:, 1]).tolist():
            local = np.zeros(6)
            mujoco.mj_contactForce(self._model, data, contact, local)
            yield contact, (-1 if mine[contact, 0] else 1), local


def contact_filler(
    model: Any,
    elements: Sequence[tuple[str, int]],
    type_name: str,
    frame: str,
    set_time: Callable[[Any, int], None],
) -> _Fill:
    """A function that fills packets of ``type_name`` with what touches ``elements``."""
    touches = [Touch(model, what, index) for what, index in elements]

    def fill_bool(packet: Any, data: Any, time_ns: int) -> None:
        packet.data = touches[0].normal_force(data) > 0

    def fill_float(packet: Any, data: Any, time_ns: int) -> None:
        packet.data = touches[0].normal_force(data)

    def fill_floats(packet: Any, data: Any, time_ns: int) -> None:
        packet.data = [touch.normal_force(data) for touch in touches]

    def fill_wrench(packet: Any, data: Any, time_ns: int) -> None:
        set_time(packet.header.stamp, time_ns)
        packet.header.frame_id = frame
        force, torque = touches[0].wrench(data)
        for vector, values in ((packet.wrench.force, force), (packet.wrench.torque, torque)):
            vector.x, vector.y, vector.z = values.tolist()

    return {
        "std_msgs/msg/Bool": fill_bool,
        "std_msgs/msg/Float64": fill_float,
        "std_msgs/msg/Float64MultiArray": fill_floats,
        "geometry_msgs/msg/WrenchStamped": fill_wrench,
    }[type_name]
