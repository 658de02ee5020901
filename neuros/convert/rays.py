"""Lidars and other rays: a rangefinder of MuJoCo's for each."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from neuros.convert.building import Building
from neuros.convert.elements import Element
from neuros.convert.numbers import number, vector
from neuros.convert.poses import Pose
from neuros.convert.scopes import Link
from neuros.convert.sites import add_sensor, add_site

# A rangefinder of MuJoCo's looks along z.
_TO_RAY = Pose(rotation=np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]))

_MOST_RAYS = 1000
_SAMPLES = {"horizontal": 640.0, "vertical": 1.0}  # where nothing says how many


def add_rays(building: Building, link: Link, element: Element, pose: Pose) -> None:
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
            site = add_site(building, link, element, ray, suffix)
            sensor = add_sensor(building, site, mujoco.mjtSensor.mjSENS_RANGEFINDER, site, element)
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
