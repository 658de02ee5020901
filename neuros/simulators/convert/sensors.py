"""Sensors of links and joints: sites, cameras and MuJoCo's sensors.

What a node file can name as the ``element`` of a sensor is there afterwards: a site or camera
called ``link/sensor``. MuJoCo's cameras show colours only; a lidar is a rangefinder per ray.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from neuros.simulators.convert.building import Building, put
from neuros.simulators.convert.elements import Element
from neuros.simulators.convert.joints import anchor
from neuros.simulators.convert.scopes import Link, Scope
from neuros.simulators.convert.tree import Branch
from neuros.simulators.convert.values import Pose, number, text_of, vector

_KINDS = mujoco.mjtSensor
_SIMPLE = {
    "altimeter": (("position", _KINDS.mjSENS_FRAMEPOS), ("velocity", _KINDS.mjSENS_FRAMELINVEL)),
    "magnetometer": (("field", _KINDS.mjSENS_MAGNETOMETER),),
}
# SDF's cameras look along x, with z up; MuJoCo's along -z, with y up.
_TO_CAMERA = Pose(rotation=np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]))
_CAMERAS = {
    "camera": "",
    "wideanglecamera": "a pinhole camera in MuJoCo, without the wide angle lens",
    "wide_angle_camera": "a pinhole camera in MuJoCo, without the wide angle lens",
    "depth": "colours only, no depth",
    "depth_camera": "colours only, no depth",
    "rgbd": "colours only, no depth",
    "rgbd_camera": "colours only, no depth",
}
# A rangefinder of MuJoCo's looks along z.
_TO_RAY = Pose(rotation=np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]))
_MOST_RAYS = 1000
_SAMPLES = {"horizontal": 640.0, "vertical": 1.0}  # where nothing says how many
_SITE = mujoco.mjtObj.mjOBJ_SITE


def add_link_sensors(building: Building, link: Link) -> None:
    """Add the sensors of a link."""
    for element in link.element.each("sensor"):
        kind = element.attributes.get("type", "")
        pose = link.scope.read_pose(element, link.pose)
        if kind == "imu":
            _add_imu(building, link, element, pose)
        elif kind in _CAMERAS:
            _add_camera(building, link, element, pose)
        elif kind in ("ray", "lidar", "gpu_ray", "gpu_lidar"):
            _add_rays(building, link, element, pose)
        elif kind == "contact":
            how = '`"sensor": "contacts"`, `"element": "link/collision"`'
            building.report.note(element, f"declare it in the node file: {how}")
        elif kind in _SIMPLE:
            site = _add_site(building, link, element, pose)
            for what, sort in _SIMPLE[kind]:
                _add_sensor(building, f"{site}/{what}", sort, site, element)
            if kind == "altimeter":
                building.report.remark(element, "the whole position and velocity in MuJoCo")
            element.child(kind)  # now read; what is inside it is listed
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
    site = _add_site(building, link, element, pose)
    imu = element.child("imu")
    for what, sort, group in (
        ("gyro", _KINDS.mjSENS_GYRO, "angular_velocity"),
        ("accelerometer", _KINDS.mjSENS_ACCELEROMETER, "linear_acceleration"),
        ("orientation", _KINDS.mjSENS_FRAMEQUAT, ""),
    ):
        sensor = _add_sensor(building, f"{site}/{what}", sort, site, element)
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


def _add_force_torque(building: Building, branch: Branch, element: Element) -> None:
    joint, link, report = branch.joint, branch.link, building.report
    assert joint is not None
    settings = element.child("force_torque")
    frame = "child" if settings is None else text_of(settings, "frame") or "child"
    direction = "" if settings is None else text_of(settings, "measure_direction")
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
    site = _add_site(building, link, element, place, wanted=wanted)
    _add_sensor(building, f"{site}/force", _KINDS.mjSENS_FORCE, site, element)
    _add_sensor(building, f"{site}/torque", _KINDS.mjSENS_TORQUE, site, element)


def _add_camera(building: Building, link: Link, element: Element, pose: Pose) -> None:
    """Add the camera of a sensor, whose own pose in the world is ``pose``."""
    report = building.report
    kind = element.attributes.get("type", "")
    settings = element.child("camera")
    width, height, across = 320.0, 240.0, 1.047
    if settings is not None:
        pose = link.scope.read_pose(settings, pose)
        across = number(settings, "horizontal_fov", report, across, positive=True)
        image = settings.child("image")
        if image is not None:
            width = number(image, "width", report, width, positive=True)
            height = number(image, "height", report, height, positive=True)
    if across >= math.pi:
        report.problem(settings or element, f"a field of view is below pi, not {across:g}")
        return
    camera = building.body(link).add_camera(resolution=[int(width), int(height)])
    camera.name = building.name("camera", f"{link.name}/{element.name}", element)
    camera.fovy = math.degrees(2 * math.atan(math.tan(across / 2) * height / width))
    put(camera, pose @ _TO_CAMERA, link.pose)
    if _CAMERAS[kind]:
        report.remark(element, _CAMERAS[kind])


def _add_rays(building: Building, link: Link, element: Element, pose: Pose) -> None:
    """Add a site and a rangefinder for every ray of a sensor, row by row from below."""
    report = building.report
    settings = next((s for s in map(element.child, ("ray", "lidar")) if s is not None), element)
    (columns, yaws), (rows, pitches) = (
        _angles(building, settings, way) for way in ("horizontal", "vertical")
    )
    count = columns * rows
    if not 1 <= count <= _MOST_RAYS:
        report.note(
            element, f"{count} rays: MuJoCo has a sensor for each, and {_MOST_RAYS} at most"
        )
        return
    distance = settings.child("range")
    most = math.inf if distance is None else number(distance, "max", report, math.inf)
    if distance is not None:
        distance.take_all()
    for row, pitch in enumerate(pitches):
        for column, yaw in enumerate(yaws):
            ray = pose @ _turned(yaw, pitch) @ _TO_RAY
            suffix = f"/{row * columns + column}" if count > 1 else ""
            site = _add_site(building, link, element, ray, suffix)
            sensor = _add_sensor(building, site, mujoco.mjtSensor.mjSENS_RANGEFINDER, site, element)
            sensor.cutoff = most if math.isfinite(most) else 0
            if hasattr(mujoco, "mjtRayDataField"):  # since then it says what it measures
                sensor.intprm[0] = 1 << mujoco.mjtRayDataField.mjRAYDATA_DIST.value
    report.remark(element, f"{count} rangefinder(s) in MuJoCo, -1 where nothing is hit")


def _angles(building: Building, settings: Element, way: str) -> tuple[int, list[float]]:
    scan = settings.child("scan", way)
    if scan is None:
        return 1, [0.0]
    (samples,) = map(int, vector(scan, "samples", building.report, (_SAMPLES[way],)))
    (least,) = vector(scan, "min_angle", building.report, (0.0,))
    (most,) = vector(scan, "max_angle", building.report, (0.0,))
    if number(scan, "resolution", building.report, 1.0) != 1:
        building.report.remark(scan, "as many rays as samples; none between them")
    if samples > _MOST_RAYS:
        return samples, []
    return samples, [float(angle) for angle in np.linspace(least, most, max(samples, 0))]


def _turned(yaw: float, pitch: float) -> Pose:
    """Up by ``pitch``, then to the left by ``yaw``."""
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    return Pose(rotation=about_z @ about_y)


def add_frames(building: Building, scope: Scope) -> None:
    """A site for every ``<frame>``: a place with a name, as the tip of a tool."""
    for inner, element in scope.each("frame"):
        if inner.is_world or element.name not in inner.frames or element.name[:1] == "_":
            continue
        link = inner.body(element.name, element)
        if link is not None:
            site = building.body(link).add_site()
            site.name = building.name("site", inner.prefix + element.name, element)
            put(site, inner.pose @ inner.place(element.name, element), link.pose)


def _add_site(
    building: Building,
    link: Link,
    element: Element,
    pose: Pose,
    suffix: str = "",
    wanted: str = "",
) -> str:
    """Add a site to a link, where ``pose`` is in the world; returns its name."""
    site = building.body(link).add_site(group=4)
    name = building.name("site", (wanted or f"{link.name}/{element.name}") + suffix, element)
    site.name = name
    put(site, pose, link.pose)
    return name


def _add_sensor(building: Building, name: str, kind: Any, site: str, element: Element) -> Any:
    """Add a sensor of MuJoCo's that measures at a site."""
    unique = building.name("sensor", name, element)
    return building.spec.add_sensor(name=unique, type=kind, objtype=_SITE, objname=site)
