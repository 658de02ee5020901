"""Sensors of links and joints: sites, cameras and MuJoCo's sensors.

What a node file can name as the ``element`` of a sensor is there afterwards: a site or camera
called ``link/sensor``.
"""

from __future__ import annotations

import mujoco
import numpy as np

from neuros.convert.axes import anchor
from neuros.convert.building import Building
from neuros.convert.cameras import CAMERAS, add_camera
from neuros.convert.elements import Element
from neuros.convert.numbers import number, word
from neuros.convert.poses import Pose
from neuros.convert.rays import add_rays
from neuros.convert.scopes import Link
from neuros.convert.sites import add_sensor, add_site
from neuros.convert.tree import Branch

_KINDS = mujoco.mjtSensor
_SIMPLE = {
    "altimeter": (("position", _KINDS.mjSENS_FRAMEPOS), ("velocity", _KINDS.mjSENS_FRAMELINVEL)),
    "magnetometer": (("field", _KINDS.mjSENS_MAGNETOMETER),),
}


def add_link_sensors(building: Building, link: Link) -> None:
    """Add the sensors of a link."""
    for element in link.element.each("sensor"):
        kind = element.attributes.get("type", "")
        pose = link.scope.read_pose(element, link.pose)
        if kind == "imu":
            _add_imu(building, link, element, pose)
        elif kind in CAMERAS:
            add_camera(building, link, element, pose)
        elif kind in ("ray", "lidar", "gpu_ray", "gpu_lidar"):
            add_rays(building, link, element, pose)
        elif kind == "contact":
            _note_contact(building, element)
        elif kind in _SIMPLE:
            site = add_site(building, link, element, pose)
            for what, sort in _SIMPLE[kind]:
                add_sensor(building, f"{site}/{what}", sort, site, element)
            if kind == "altimeter":
                building.report.remark(element, "the whole position and velocity in MuJoCo")
            _forget_inside(element, kind)
        else:
            building.report.note(element, f"MuJoCo has no sensor like '{kind}'")


def add_joint_sensors(building: Building, branch: Branch) -> None:
    """Add the sensors of the joint that a body hangs on."""
    joint = branch.joint
    if joint is None:
        return
    for element in joint.element.each("sensor"):
        if element.attributes.get("type") != "force_torque":
            building.report.note(element, "only a force_torque sensor belongs to a joint")
            continue
        _add_force_torque(building, branch, element)


def _add_imu(building: Building, link: Link, element: Element, pose: Pose) -> None:
    site = add_site(building, link, element, pose)
    imu = element.child("imu")
    for what, sort, group in (
        ("gyro", _KINDS.mjSENS_GYRO, "angular_velocity"),
        ("accelerometer", _KINDS.mjSENS_ACCELEROMETER, "linear_acceleration"),
        ("orientation", _KINDS.mjSENS_FRAMEQUAT, ""),
    ):
        sensor = add_sensor(building, f"{site}/{what}", sort, site, element)
        axes = imu.child(group) if imu is not None and group else None
        if axes is not None:
            sensor.noise = _deviation(building, axes)


def _deviation(building: Building, axes: Element) -> float:
    """The largest standard deviation of three axes; MuJoCo keeps one number, and adds no noise."""
    largest = 0.0
    for axis in axes.children:
        noise = axis.child("noise")
        if noise is not None and noise.attributes.get("type", "none") != "none":
            largest = max(largest, number(noise, "stddev", building.report, 0.0))
            building.report.note(noise, "the deviation becomes the covariance; no noise is added")
        axis.take_all()
    axes.taken = True
    return largest


def _note_contact(building: Building, element: Element) -> None:
    building.report.note(
        element,
        'declare it in the node file: `"sensor": "contacts"`, `"element": "link/collision"`',
    )


def _add_force_torque(building: Building, branch: Branch, element: Element) -> None:
    joint, link, report = branch.joint, branch.link, building.report
    assert joint is not None
    settings = element.child("force_torque")
    frame = "child" if settings is None else word(settings, "frame") or "child"
    direction = "" if settings is None else word(settings, "measure_direction")
    place = joint.scope.read_pose(element, anchor(joint))
    ends = {"child": joint.child, "parent": joint.parent}
    if frame in ends:
        end = ends[frame]
        place = Pose(place.position, np.eye(3) if end is None else end.pose.rotation)
    elif frame != "sensor":
        report.problem(settings or element, f"'{frame}' is none of child, parent and sensor")
    # MuJoCo measures the force on the body that hangs; SDF, unless told otherwise, what the child
    # does to the parent.
    if (direction == "parent_to_child") == branch.is_turned:
        report.remark(element, "with the opposite sign in MuJoCo")
    wanted = f"{joint.name}/{element.name}"
    site = add_site(building, link, element, place, wanted=wanted)
    add_sensor(building, f"{site}/force", _KINDS.mjSENS_FORCE, site, element)
    add_sensor(building, f"{site}/torque", _KINDS.mjSENS_TORQUE, site, element)


def _forget_inside(element: Element, kind: str) -> None:
    """Leave what is inside to be listed; the element of the kind itself is read."""
    element.child(kind)
