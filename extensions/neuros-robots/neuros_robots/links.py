"""Parts of links in MuJoCo: geoms of collisions and visuals, sensors, sites and lights.

A sensor becomes a site or camera called ``link/sensor``, which a node file names as the ``element``
of a sensor. MuJoCo's cameras show colours only; a lidar is one rangefinder per ray.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from neuros_robots.elements import HUGE, Element
from neuros_robots.frames import Joint, Link, Pose, Scope, Vector, from_quaternion, from_rpy
from neuros_robots.mjcf import Building, Triangles

_VISUAL_GROUP, _COLLISION_GROUP = 2, 3  # MuJoCo shows groups 0 to 2 unless told otherwise
_GEOMS = mujoco.mjtGeom
_WHOLE = re.compile(r"0x[0-9a-f]{1,8}|0|[1-9]\d{0,9}", re.ASCII | re.IGNORECASE)
_ALL_MASKS = 0xFFFF  # Gazebo's mask of a collision without one
_GREY = (0.7, 0.7, 0.7, 1.0)
# The diffuse colours of those materials of Gazebo that are plain colours.
_SCRIPTS: Mapping[str, tuple[float, float, float]] = {
    "Gazebo/Black": (0, 0, 0),
    "Gazebo/Blue": (0, 0, 1),
    "Gazebo/DarkGray": (0.175, 0.175, 0.175),
    "Gazebo/DarkGrey": (0.175, 0.175, 0.175),
    "Gazebo/FlatBlack": (0.1, 0.1, 0.1),
    "Gazebo/Gray": (0.7, 0.7, 0.7),
    "Gazebo/Green": (0, 1, 0),
    "Gazebo/Grey": (0.7, 0.7, 0.7),
    "Gazebo/Indigo": (0.33, 0, 0.5),
    "Gazebo/Orange": (1, 0.5088, 0.0468),
    "Gazebo/Purple": (1, 0, 1),
    "Gazebo/Red": (1, 0, 0),
    "Gazebo/Turquoise": (0, 1, 1),
    "Gazebo/White": (1, 1, 1),
    "Gazebo/Yellow": (1, 1, 0),
}
_SENSORS = mujoco.mjtSensor
_SIMPLE = {
    "altimeter": (
        ("position", _SENSORS.mjSENS_FRAMEPOS),
        ("velocity", _SENSORS.mjSENS_FRAMELINVEL),
    ),
    "magnetometer": (("field", _SENSORS.mjSENS_MAGNETOMETER),),
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
_MOST_PIXELS = 1 << 16
_CONE_SIDES = 64
_WIDEST_RAD = math.radians(150)  # of a pinhole camera that still shows its middle
_SAMPLES = {"horizontal": 640.0, "vertical": 1.0}  # default numbers of rays
_SITE = mujoco.mjtObj.mjOBJ_SITE
_LIGHTS = {
    "directional": mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
    "point": mujoco.mjtLightType.mjLIGHT_POINT,
    "spot": mujoco.mjtLightType.mjLIGHT_SPOT,
}


@dataclass
class _Shape:
    """A geometry in MuJoCo's terms: half lengths in metres; ``pose`` is seen from its owner.

    ``mesh`` is the name of a mesh, or of a height field.
    """

    type: Any
    size: list[float] = field(default_factory=list)
    mesh: str = ""
    pose: Pose = field(default_factory=Pose)


def add_shapes(building: Building, link: Link, *, is_solid: bool) -> None:
    """Add the geoms of a link; the mass of a solid one is computed from its collisions."""
    for element in link.element.each("collision"):
        geom = _add(building, link, element, is_solid=is_solid)
        if geom is not None:
            geom.group = _COLLISION_GROUP
            _read_surface(building, element, geom)
            building.geoms[id(element)] = geom
            if is_solid:
                geom.density = element.number("density", 1000.0, positive=True)
    for element in link.element.each("visual"):
        before = len(element.report.problems)
        geom = _add(building, link, element, is_solid=False)
        opacity = 1.0 - element.number("transparency", 0.0)
        material = element.child("material")
        red, green, blue, alpha = _GREY if material is None else _diffuse(material)
        is_wrong = element.report.listed(before)
        if geom is not None:
            geom.group, geom.contype, geom.conaffinity, geom.mass = _VISUAL_GROUP, 0, 0, 0
            geom.rgba = (red, green, blue, alpha * opacity)
            if is_wrong:
                building.spec.delete(geom)


def share_masks(building: Building) -> None:
    """Give geoms without a mask Gazebo's mask, if any geom has one of its own."""
    if building.masks:
        for key, geom in building.geoms.items():
            geom.contype = geom.conaffinity = building.masks.get(key, _ALL_MASKS)


def _add(building: Building, link: Link, element: Element, *, is_solid: bool) -> Any:
    shape = _read(building, element, is_solid=is_solid)
    geometry = next(iter((element.child("geometry") or element).children), element)
    if shape is None or not _is_solid(geometry, shape.size):
        return None
    if shape.type in (_GEOMS.mjGEOM_PLANE, _GEOMS.mjGEOM_HFIELD) and not link.is_static:
        element.omit("MuJoCo has planes and height fields only where nothing moves")
        return None
    pose = link.scope.read_pose(element, link.pose) @ shape.pose
    name = f"{link.name}/{element.name}"
    noting = element if element.tag == "collision" else None  # node files do not name visuals
    geom = building.add("geom", link, pose, name, noting, type=shape.type)
    geom.size[: len(shape.size)] = shape.size
    if shape.type == _GEOMS.mjGEOM_HFIELD:
        geom.hfieldname = shape.mesh
    elif shape.mesh:
        geom.meshname = shape.mesh
        if geometry.tag != "cone" and element.tag == "collision":
            building.colliding_meshes[geom.name] = geometry
    return geom


def _read(building: Building, owner: Element, *, is_solid: bool) -> _Shape | None:
    geometry = owner.child("geometry")
    if geometry is None:
        owner.problem("<geometry> is missing")
        return None
    element = next(iter(geometry.children), None)
    if element is None:
        return None
    element.is_read = True
    match element.tag:
        case "empty":
            return None
        case "box":
            return _Shape(_GEOMS.mjGEOM_BOX, _halves(element, (1, 1, 1)))
        case "sphere":
            return _Shape(_GEOMS.mjGEOM_SPHERE, [element.number("radius", 1)])
        case "cylinder" | "capsule" as kind:
            size = [element.number("radius", 0.5), element.number("length", 1) / 2]
            return _Shape(getattr(_GEOMS, f"mjGEOM_{kind.upper()}"), size)
        case "cone":
            size = [element.number("radius", 0.5), element.number("length", 1)]
            if not _is_solid(element, size):
                return None
            triangles = _cone(*size)
            name = building.meshes.add(element, "cone", triangles, is_solid=is_solid)
            return _Shape(_GEOMS.mjGEOM_MESH, mesh=name)
        case "ellipsoid":
            radii = element.vector("radii", (1.0, 1.0, 1.0))
            return _Shape(_GEOMS.mjGEOM_ELLIPSOID, list(radii))
        case "plane":
            normal = np.array(element.vector("normal", (0.0, 0.0, 1.0)))
            if not normal.any():
                element.problem("the normal is zero")
                return None
            quaternion = np.zeros(4)
            mujoco.mju_quatZ2Vec(quaternion, normal / np.linalg.norm(normal))
            turned = from_quaternion((0, 0, 0), quaternion)
            return _Shape(_GEOMS.mjGEOM_PLANE, [*_halves(element, (1, 1)), 1.0], pose=turned)
        case "mesh":
            uri = element.child("uri")
            if uri is None or not uri.text:
                element.problem("<uri> is missing: which file is the mesh in?")
                return None
            scale = element.vector("scale", (1.0, 1.0, 1.0))
            found = building.meshes.add_file(uri, scale, is_solid=is_solid)
            return None if found is None else _Shape(_GEOMS.mjGEOM_MESH, mesh=found)
        case "polyline":
            outlines = [each for each in geometry.children if each.tag == "polyline"]
            extruded = _extruded(outlines)
            if extruded is None:
                return None
            name = building.meshes.add(element, "polyline", extruded, is_solid=is_solid)
            return _Shape(_GEOMS.mjGEOM_MESH, mesh=name)
        case "heightmap":
            return _heights(building, element)
    element.omit(f"MuJoCo has no geom for a <{element.tag}>")
    return None


def _is_solid(element: Element, sizes: Sequence[float]) -> bool:
    """Whether every size is positive. A shape of no size is left out: nothing can touch it."""
    if not all(0 <= size < HUGE for size in sizes):
        element.problem(f"every size must be positive, and below {HUGE:g}")
    elif min(sizes, default=1.0) < mujoco.mjMINVAL:
        element.omit("left out: it has no size")
        return False
    return True


def _cone(radius: float, length: float) -> Triangles:
    """A cone about z with its middle in the origin and its point upwards."""
    angles = np.arange(_CONE_SIDES) * (2 * math.pi / _CONE_SIDES)
    rim = [(radius * math.cos(a), radius * math.sin(a), -length / 2) for a in angles]
    here, bottom, top = np.arange(_CONE_SIDES), _CONE_SIDES, _CONE_SIDES + 1
    after = np.roll(here, -1)
    sides = np.column_stack((here, after, np.full(_CONE_SIDES, top)))
    base = np.column_stack((after, here, np.full(_CONE_SIDES, bottom)))
    vertices = np.array([*rim, (0, 0, -length / 2), (0, 0, length / 2)])
    return vertices, np.concatenate((sides, base)).astype(np.int32)


def _extruded(outlines: Sequence[Element]) -> Triangles | None:
    """A ``<polyline>`` from z = 0 to its height; ``None`` after a problem."""
    element = outlines[0]
    for hole in outlines[1:]:
        hole.omit("a second outline is a hole in the first: it is filled")
    before = len(element.report.problems)
    points = [np.array(point.finite((0.0, 0.0))) for point in element.each("point")]
    height = element.number("height", 1.0, positive=True)
    if len(element.report.problems) > before:
        return None
    if len(points) > 1 and np.array_equal(points[0], points[-1]):
        points.pop()  # the outline is closed anyway
    count = len(points)
    following = zip(points, points[1:] + points[:1], strict=True)
    area = sum(float(a[0] * b[1] - a[1] * b[0]) for a, b in following)
    order = list(range(count))[:: 1 if area > 0 else -1]
    ring = [*order]
    caps = []
    while len(ring) > 2:
        ear = next((at for at in range(len(ring)) if _is_ear(points, ring, at)), None)
        if ear is None:
            element.problem("its points do not surround an area, or its sides cross")
            return None
        caps.append((ring[ear - 1], ring[ear], ring[(ear + 1) % len(ring)]))
        ring.pop(ear)
    if not caps:
        element.problem(f"an outline has 3 points at least, not {count}")
        return None
    faces = [(c, b, a) for a, b, c in caps] + [
        (a + count, b + count, c + count) for a, b, c in caps
    ]
    for a, b in zip(order, order[1:] + order[:1], strict=True):
        faces += [(a, b, b + count), (a, b + count, a + count)]
    vertices = [(*point, z) for z in (0.0, height) for point in points]
    return np.array(vertices), np.array(faces, np.int32)


def _is_ear(points: Sequence[Vector], ring: Sequence[int], at: int) -> bool:
    """Whether a corner of an anticlockwise ring can be cut off: it holds no other corner."""
    ends = ring[at - 1], ring[at], ring[(at + 1) % len(ring)]

    def side(a: Vector, b: Vector, c: Vector) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    a, b, c = (points[end] for end in ends)
    return side(a, b, c) > 0 and not any(
        min(side(a, b, p), side(b, c, p), side(c, a, p)) >= 0
        for p in (points[index] for index in ring if index not in ends)
    )


def _heights(building: Building, element: Element) -> _Shape | None:
    """A ``<heightmap>``: the brightness of a picture, whose top is at +y, as height."""
    uri, place = element.child("uri"), Pose(np.array(element.vector("pos", (0.0, 0.0, 0.0))))
    across, along, up = element.vector("size", (1.0, 1.0, 1.0))
    for part in element.children:
        if part.tag in ("texture", "blend", "use_terrain_paging", "sampling"):
            part.omit("MuJoCo shows a height field in one colour")
    if uri is None or not uri.text:
        element.problem("<uri> is missing: which picture has the heights?")
        return None
    found = building.meshes.add_heights(uri, (across / 2, along / 2, up))
    if found is None or not _is_solid(element, (across, along, up)):
        return None
    name, lowest = found
    offset = Pose(np.array([0.0, 0.0, lowest * up]))
    return _Shape(_GEOMS.mjGEOM_HFIELD, mesh=name, pose=place @ offset)


def _halves(element: Element, default: tuple[float, ...]) -> list[float]:
    return [length / 2 for length in element.vector("size", default)]


def _read_surface(building: Building, collision: Element, geom: Any) -> None:
    surface = collision.child("surface")
    if surface is None:
        return
    friction = surface.child("friction", "ode")
    if friction is not None:
        along = friction.number("mu", 1.0, least=0.0)
        across = friction.number("mu2", along)
        geom.friction[0] = min(along, 1e6)
        if along > 1:
            # A pyramidal cone this wide is so soft along its axis that things fall through.
            building.spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        if across != along:
            friction.remark(f"MuJoCo's friction is {along:g} in every direction")
    contact = surface.child("contact")
    if contact is None:
        return
    if contact.is_true("collide_without_contact"):
        contact.remark("MuJoCo cannot detect a contact without a force: the element collides")
    mask = contact.child("collide_bitmask")
    if mask is not None:
        if _WHOLE.fullmatch(mask.text):
            building.masks[id(collision)] = int(mask.text, 0) & 0x7FFFFFFF
        else:
            mask.problem(f"'{mask.text}' is not a whole number")


def _diffuse(material: Element) -> tuple[float, ...]:
    """Red, green, blue and opacity of a material, each from 0 to 1."""
    base = _GREY
    script = material.child("script")
    if script is not None:
        name = script.text_of("name")
        if name in _SCRIPTS:
            script.mark_all_read()
            base = (*_SCRIPTS[name], 1.0)
        else:
            script.omit("a material script of Gazebo's")
    element = material.child("diffuse")
    if element is None:
        return base
    try:
        values = [float(word) for word in element.text.split()]
    except ValueError:
        values = []
    if len(values) not in (3, 4) or not all(map(math.isfinite, values)):
        element.problem("a colour is red, green, blue and opacity, each from 0 to 1")
        return base
    return (*values, 1.0)[:4]


def add_link_sensors(building: Building, link: Link) -> None:
    for element in link.element.each("sensor"):
        kind = element.type
        pose = link.scope.read_pose(element, link.pose)
        if kind == "imu":
            _add_imu(building, link, element, pose)
        elif kind in _CAMERAS:
            _add_camera(building, link, element, pose)
        elif kind in ("ray", "lidar", "gpu_ray", "gpu_lidar"):
            _add_rays(building, link, element, pose)
        elif kind == "contact":
            how = '`"sensor": "contacts"`, `"element": "link/collision"`'
            element.omit(f"declare it in the node file: {how}")
        elif kind in _SIMPLE:
            site = _add_site(building, link, element, pose)
            for what, sort in _SIMPLE[kind]:
                _add_sensor(building, f"{site}/{what}", sort, site, element)
            if kind == "altimeter":
                element.remark("the whole position and velocity in MuJoCo")
            element.child(kind)  # marks it as read; its content is listed
        else:
            element.omit(f"MuJoCo has no sensor like '{kind}'")


def add_joint_sensors(building: Building, link: Link, joint: Joint, *, is_turned: bool) -> None:
    for element in joint.element.each("sensor"):
        if element.type != "force_torque":
            element.omit("only a force_torque sensor belongs to a joint")
            continue
        settings = element.child("force_torque") or element.made("force_torque")
        frame = settings.text_of("frame") or "child"
        place = joint.scope.read_pose(element, joint.anchor)
        ends = {"child": joint.child, "parent": joint.parent}
        if frame in ends:
            end = ends[frame]
            place = Pose(place.position, np.eye(3) if end is None else end.pose.rotation)
        elif frame != "sensor":
            settings.problem(f"'{frame}' is not child, parent or sensor")
        # MuJoCo measures the force on the child body; SDF, by default, that of the child on the
        # parent.
        if (settings.text_of("measure_direction") == "parent_to_child") == is_turned:
            element.remark("with the opposite sign in MuJoCo")
        site = _add_site(building, link, element, place, f"{joint.name}/{element.name}")
        _add_sensor(building, f"{site}/force", _SENSORS.mjSENS_FORCE, site, element)
        _add_sensor(building, f"{site}/torque", _SENSORS.mjSENS_TORQUE, site, element)


def _add_imu(building: Building, link: Link, element: Element, pose: Pose) -> None:
    site = _add_site(building, link, element, pose)
    imu = element.child("imu")
    for what, sort, group in (
        ("gyro", _SENSORS.mjSENS_GYRO, "angular_velocity"),
        ("accelerometer", _SENSORS.mjSENS_ACCELEROMETER, "linear_acceleration"),
        ("orientation", _SENSORS.mjSENS_FRAMEQUAT, ""),
    ):
        sensor = _add_sensor(building, f"{site}/{what}", sort, site, element)
        axes = imu.child(group) if imu is not None and group else None
        if axes is not None:
            # The largest standard deviation of the axes: MuJoCo keeps one number.
            sensor.noise = 0.0
            for axis in axes.children:
                noise = axis.child("noise")
                if noise is not None and noise.attributes.get("type", "none") != "none":
                    sensor.noise = max(sensor.noise, noise.number("stddev", 0.0))
                    noise.omit("the deviation becomes the covariance; no noise is added")
                axis.mark_all_read()
            axes.is_read = True


def _add_camera(building: Building, link: Link, element: Element, pose: Pose) -> None:
    """Add the camera of a sensor with the pose ``pose`` in the world."""
    settings = element.child("camera") or element.made("camera")
    image = settings.child("image") or element.made("image")
    pose = link.scope.read_pose(settings, pose)
    across = settings.number("horizontal_fov", 1.047, positive=True)
    width = image.number("width", 320.0, positive=True)
    height = image.number("height", 240.0, positive=True)
    if max(width, height) > _MOST_PIXELS:
        settings.problem(f"an image has at most {_MOST_PIXELS} pixels a side")
        return
    if across >= math.pi:
        settings.remark(
            f"MuJoCo's pinhole camera cannot see {across:g} rad: it sees {_WIDEST_RAD:.3g} rad"
        )
        across = _WIDEST_RAD
    name, size = f"{link.name}/{element.name}", [int(width), int(height)]
    camera = building.add("camera", link, pose @ _TO_CAMERA, name, element, resolution=size)
    camera.fovy = math.degrees(2 * math.atan(math.tan(across / 2) * height / width))
    if remark := _CAMERAS[element.type]:
        element.remark(remark)


def _add_rays(building: Building, link: Link, element: Element, pose: Pose) -> None:
    """Add a site and a rangefinder for every ray of a sensor, row by row from below."""
    settings = next((s for s in map(element.child, ("ray", "lidar")) if s is not None), element)
    (columns, yaws), (rows, pitches) = (
        _angles(settings, way) for way in ("horizontal", "vertical")
    )
    count = columns * rows
    if count > 1 and rows == 1:
        _add_site(building, link, element, pose)  # where a node file may declare a lidar
    if not 1 <= count <= _MOST_RAYS:
        element.omit(f"{count} rays: MuJoCo has a sensor for each, and {_MOST_RAYS} at most")
        return
    distance = settings.child("range")
    most = math.inf if distance is None else distance.number("max", math.inf, least=0.0)
    if distance is not None:
        distance.mark_all_read()
    for row, pitch in enumerate(pitches):
        for column, yaw in enumerate(yaws):
            ray = pose @ from_rpy(0, 0, 0, 0, -pitch, yaw) @ _TO_RAY
            suffix = f"/{row * columns + column}" if count > 1 else ""
            site = _add_site(building, link, element, ray, f"{link.name}/{element.name}{suffix}")
            sensor = _add_sensor(building, site, _SENSORS.mjSENS_RANGEFINDER, site, element)
            sensor.cutoff = most if math.isfinite(most) else 0
            sensor.intprm[0] = 1 << mujoco.mjtRayDataField.mjRAYDATA_DIST.value
    element.remark(f"{count} rangefinder(s) in MuJoCo, -1 where nothing is hit")


def _angles(settings: Element, way: str) -> tuple[int, list[float]]:
    scan = settings.child("scan", way)
    if scan is None:
        return 1, [0.0]
    (samples,) = map(int, scan.vector("samples", (_SAMPLES[way],)))
    (least,) = scan.vector("min_angle", (0.0,))
    (most,) = scan.vector("max_angle", (0.0,))
    if scan.number("resolution", 1.0) != 1:
        scan.remark("there is one ray for each sample, and no interpolation between them")
    if samples > _MOST_RAYS:
        return samples, []
    return samples, [float(angle) for angle in np.linspace(least, most, max(samples, 0))]


def add_frames(building: Building, scope: Scope) -> None:
    for inner, element in scope.each("frame"):
        if inner.is_world or element.name not in inner.frames or element.name[:1] == "_":
            continue
        link = inner.body(element.name, element)
        if link is not None:
            pose = inner.pose @ inner.place(element.name, element)
            building.add("site", link, pose, inner.prefix + element.name, element)


def _add_site(
    building: Building, link: Link, element: Element, pose: Pose, wanted: str = ""
) -> str:
    """Add a site to a link, with its pose in the world; returns its name."""
    name = wanted or f"{link.name}/{element.name}"
    return str(building.add("site", link, pose, name, element, group=4).name)


def _add_sensor(building: Building, name: str, kind: Any, site: str, element: Element) -> Any:
    """Add a sensor of MuJoCo's that measures at a site."""
    unique = building.name("sensor", name, element)
    return building.spec.add_sensor(name=unique, type=kind, objtype=_SITE, objname=site)


def add_lights(building: Building, scope: Scope) -> None:
    """Add the lights of a world, of models and of links."""
    for inner in scope.and_models():
        for link in (None, *inner.links.values()):
            owner = inner if link is None else link
            for element in owner.element.each("light"):
                _add_light(building, element, inner.read_pose(element, owner.pose), link)


def _add_light(building: Building, element: Element, pose: Pose, link: Link | None) -> None:
    kind = element.attributes.get("type", "point")
    if kind not in _LIGHTS:
        element.problem(f"'{kind}' is not a light", f"there are: {', '.join(_LIGHTS)}")
        return
    light = building.add("light", link, pose, element.name, element, type=_LIGHTS[kind])
    direction = np.array(element.vector("direction", (0.0, 0.0, -1.0)))
    if direction.any():
        turned = pose.rotation @ (direction / np.linalg.norm(direction))
        light.dir = turned if link is None else link.pose.rotation.T @ turned
    light.diffuse = _light_colour(element, "diffuse", 1.0)
    light.specular = _light_colour(element, "specular", 0.1)
    light.castshadow = element.is_true("cast_shadows")
    attenuation = element.child("attenuation")
    if attenuation is not None:
        defaults = {"constant": 1.0, "linear": 0.0, "quadratic": 0.0}
        light.attenuation = [attenuation.number(*each) for each in defaults.items()]
        light.range = attenuation.number("range", 10.0, positive=True)
    spot = element.child("spot")
    if spot is not None and kind == "spot":
        light.cutoff = math.degrees(spot.number("outer_angle", 0.0)) or 45.0
        light.exponent = spot.number("falloff", 0.0)


def _light_colour(owner: Element, tag: str, default: float) -> tuple[float, ...]:
    """Red, green and blue of a light."""
    count = 3 if len(owner.text_of(tag).split()) == 3 else 4  # with opacity
    return owner.vector(tag, (default, default, default, 1.0)[:count])[:3]
