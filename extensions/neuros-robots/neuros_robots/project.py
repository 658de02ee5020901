"""A project around a robot: its model with drives, its sensors, and a brain that moves it a little.

A description does not say whether the base of the robot is free, nor how its joints are driven.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from neuros.distribution import PACKAGE
from neuros.errors import DescriptionError, Problem, UsageError
from neuros.ports import RobotChoices
from neuros_robots.mjcf import Converted, message_of, write_mjcf

_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_NARROW = 1e-3  # narrower ranges (rad or m) are those of locked joints
_STIFFEST = 20.0  # rad/s: of a servo without a load
_SAG = 0.05  # rad or m: how far a servo gives way to the weight, or to its largest force
_MOST_PIXELS = 640
_RATES_HZ = {"joints": 50, "imu": 50, "pose": 50, "lidar": 10, "camera": 10}

_ROBOT = '''\
"""The robot: MuJoCo steps itself at the pace of the clock, and sends what its sensors measure."""

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo


@neuros_initialise()
def start(node):
    sim = MuJoCo(node, "robot.xml")
    node.set_user_data(sim)
    sim.run_asynchronous()
'''
_OBEY = """

@neuros_function(inputs="command")
def obey(node, command):
    node.get_user_data().command("command", command)
"""
_BRAIN = '''\
"""The brain: moves every joint a little about where it was at first. Yours takes its place."""

import math

from neuros.hooks import neuros_function

SWING = 0.1  # rad or m
SPEED = 1.0  # rad/s or m/s, of joints that a velocity drives


class Brain:
    first = None


@neuros_function(inputs="joints", outputs="command")
def move(node, joints):
    if Brain.first is None:
        Brain.first = list(joints.position)
    time_s = joints.header.stamp.sec + joints.header.stamp.nanosec * 1e-9
    wave = math.sin(time_s)
    command = node.make_packet("command")
    command.name = joints.name
    # Each drive takes what it is made for: a position, a velocity, or an effort.
    command.position = [position + SWING * wave for position in Brain.first]
    command.velocity = [SPEED * wave] * len(joints.name)
    command.effort = [0.0] * len(joints.name)
    return command
'''


def make_project(
    converted: Converted, source: Path, folder: Path, choices: RobotChoices
) -> list[str]:
    """Write the project; returns lines that say what is in it.

    Raises:
        UsageError: the file does not say something that is not chosen either.
        DescriptionError: MuJoCo cannot compile the robot with that base.
        OSError: the folder cannot be written.
    """
    spec = converted.spec.copy()
    if not spec.keys:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # for stiff drives
    base = _set_base(spec, source, choices.base, may_move=converted.may_move)
    try:
        model = spec.copy().compile()
    except ValueError as error:
        problem = Problem(
            str(source), 1, 1, "/", f"as a robot with a free base: {message_of(error)}"
        )
        raise DescriptionError([problem]) from error
    if not spec.lights:
        spec.worldbody.add_light(name="lamp", pos=[0, 0, 4], dir=[0.2, 0.1, -1], castshadow=True)
    if base and not len(spec.worldbody.geoms):
        spec.body(base).pos[2] += _clearance_m(model)
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(
            name="floor", type=plane, size=[0, 0, 0.1], rgba=[0.5, 0.55, 0.6, 1]
        )
    drives = _add_drives(spec, model, choices.drive)
    _copy_files(spec, folder)
    write_mjcf(replace(converted, spec=spec), source, folder / "robot.xml")
    outputs = [*_outputs(model, drives, base)]
    _write_nodes(folder, source, outputs, drives)
    lines = [f"base: {f'free ({base})' if base else 'as in the file, or held by the world'}"]
    lines += [f"{kind} drives: {', '.join(names)}" for kind, names in _by_kind(drives).items()]
    lines += [f"output {row['name']}: {row['mujoco'].get('element', '')}" for row in outputs[1:]]
    return lines


def _set_base(spec: Any, source: Path, chosen: str | None, *, may_move: bool) -> str:
    """Give the robot a free joint if that is chosen; returns the name of its base, or ``""``."""
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    roots = list(spec.worldbody.bodies)
    if free or not may_move or len(spec.worldbody.geoms):
        return str(free[0].parent.name) if free else ""  # the file says it
    if chosen is None and sys.stdin is not None and sys.stdin.isatty():
        answer = input(
            f"Does '{roots[0].name}' move freely (wheels, legs), or is it held? [free/fixed] "
        )
        chosen = answer.strip().lower()
    if chosen not in ("free", "fixed"):
        raise UsageError(
            f"{source} does not say whether '{roots[0].name}' moves: --base free (it has wheels or"
            " legs, or flies) or --base fixed (an arm)"
        )
    if chosen == "fixed":
        return ""
    roots[0].add_freejoint(name=f"{roots[0].name}/free")
    return str(roots[0].name)


def _clearance_m(model: Any) -> float:
    """How far the robot must rise so that no collision is below the floor."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    lowest = math.inf
    for geom in np.flatnonzero(model.geom_contype):
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        up = data.geom_xmat[geom].reshape(3, 3)[2]
        middle = data.geom_xpos[geom][2] + up @ centre
        lowest = min(lowest, middle - float(np.abs(up) @ half))
    return 0.002 - lowest if math.isfinite(lowest) else 0.0


def _add_drives(spec: Any, model: Any, chosen: str | None) -> dict[str, str]:
    """Add actuators to joints without one; returns the kind of drive of every driven joint."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    followers = {equality.name1 for equality in spec.equalities if equality.name2}
    named = {joint.name for joint in spec.joints}
    driven = {each.target: "model" for each in spec.actuators if each.target in named}
    if spec.keys:  # each has a control for every actuator of the file
        return driven
    for index in range(model.njnt):
        joint = model.joint(index)
        span = float(np.ptp(joint.range)) if joint.limited[0] else math.inf
        is_single = joint.type[0] in (_HINGE.value, _SLIDE.value)
        if not is_single or joint.name in {*driven, *followers} or span < _NARROW:
            continue
        kind = chosen or ("position" if joint.limited[0] else "velocity")
        if kind == "none":
            continue
        driven[joint.name] = kind
        actuator = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        dof = model.jnt_dofadr[index]
        inertia, load = float(model.dof_M0[dof]), abs(float(data.qfrc_bias[dof]))
        if model.jnt_actfrclimited[index]:
            load = max(load, float(model.jnt_actfrcrange[index, 1]))
        if kind == "position":
            stiffness = max(inertia * _STIFFEST**2, load / _SAG)
            stiffness = min(stiffness, inertia / model.opt.timestep**2)  # stable at this step
            actuator.set_to_position(kp=stiffness, kv=2 * math.sqrt(stiffness * inertia))
            if joint.limited[0]:
                actuator.ctrlrange, actuator.ctrllimited = joint.range, True
        elif kind == "velocity":
            actuator.set_to_velocity(kv=max(inertia * _STIFFEST, _push(model, index)))
        else:
            actuator.set_to_motor()
    return driven


def _push(model: Any, joint: int) -> float:
    """The damping with which a wheel holds the speed of the whole robot, in N m s/rad."""
    body = model.jnt_bodyid[joint]
    radii = model.geom_rbound[model.geom_bodyid == body]
    radius = min(float(radii.max(initial=0.0)), 1.0)
    return float(model.body_subtreemass[0]) * radius**2 * _STIFFEST / 2


def _copy_files(spec: Any, folder: Path) -> None:
    """Copy the files of meshes and pictures into the project, which is then complete."""
    target, copies = folder / "meshes", dict[str, Path]()
    for things in (spec.meshes, spec.hfields, spec.skins, spec.textures):
        for thing in things:
            if not thing.file:
                continue
            target.mkdir(parents=True, exist_ok=True)
            if thing.file not in copies:
                file = Path(thing.file)
                copies[thing.file] = target / f"{thing.name or file.stem}{file.suffix}"
                shutil.copyfile(file, copies[thing.file])
            thing.file = str(copies[thing.file].resolve())


def _outputs(model: Any, drives: dict[str, str], base: str) -> Iterable[dict[str, Any]]:
    """Outputs for joint states, every IMU, lidar and camera, and the pose of a free base."""

    def output(name: str, kind: str, message: str, **more: Any) -> dict[str, Any]:
        rate = _RATES_HZ["joints" if kind == "joint_states" else kind]
        declared = {"sensor": kind, **more, "rate": rate}
        return {"name": name, "type": f"{message}", "mujoco": declared}

    element = {"element": [*drives]} if drives else {}
    yield output("joints", "joint_states", "sensor_msgs/msg/JointState", **element)
    gyros = [
        model.sensor(index).name.removesuffix("/gyro")
        for index in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_GYRO.value)
    ]
    for name in gyros:
        yield output(_identifier(name), "imu", "sensor_msgs/msg/Imu", element=name)
    yield from (
        output(_identifier(name), "lidar", "sensor_msgs/msg/LaserScan", **more)
        for name, more in _lidars(model)
    )
    for index in range(model.ncam):
        name, (width, height) = model.camera(index).name, model.cam_resolution[index]
        scale = min(1.0, _MOST_PIXELS / max(width, height, 1))
        size = {"width": max(1, int(width * scale)), "height": max(1, int(height * scale))}
        message = "sensor_msgs/msg/Image"
        yield output(_identifier(name), "camera", message, element=name, **size)
    if base:
        yield output("pose", "pose", "geometry_msgs/msg/PoseStamped", element=base)


def _lidars(model: Any) -> Iterable[tuple[str, dict[str, Any]]]:
    """The name of each plane of rangefinders with a site, and the declaration of such a lidar."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rays: dict[str, list[int]] = {}
    for index in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER.value):
        rays.setdefault(model.sensor(index).name.rpartition("/")[0], []).append(int(index))
    sites = {model.site(index).name: index for index in range(model.nsite)}
    for name, sensors in rays.items():
        if name not in sites or len(sensors) < 2:
            continue
        axes = data.site_xmat[sites[name]].reshape(3, 3)
        beams = data.site_xmat[model.sensor_objid[sensors]].reshape(-1, 3, 3)[:, :, 2] @ axes
        angles = np.unwrap(np.arctan2(beams[:, 1], beams[:, 0]))
        declared = {"element": name, "beams": len(sensors)}
        declared |= {
            "angle_min": round(float(angles[0]), 6),
            "angle_max": round(float(angles[-1]), 6),
        }
        if most_m := float(model.sensor_cutoff[sensors[0]]):
            declared["range_max"] = most_m
        if angles[0] < angles[-1]:
            yield name, declared


def _identifier(name: str) -> str:
    """A name of an output, from that of an element."""
    word = "".join(letter if letter.isalnum() and letter.isascii() else "_" for letter in name)
    return word if word[:1].isalpha() else f"sensor_{word}"


def _by_kind(drives: dict[str, str]) -> dict[str, list[str]]:
    kinds: dict[str, list[str]] = {}
    for name, kind in drives.items():
        kinds.setdefault(kind, []).append(name)
    return kinds


def _write_nodes(
    folder: Path, source: Path, outputs: list[dict[str, Any]], drives: dict[str, str]
) -> None:
    message = "sensor_msgs/msg/JointState"
    robot: dict[str, Any] = {"name": "robot", "container": "neuros_mujoco", "plugin": "robot.py"}
    if drives:
        command = {"name": "command", "type": message, "mujoco": {"actuators": "all"}}
        robot["inputs"] = [command]
    robot["outputs"] = outputs
    nodes, connections = [robot], list[dict[str, Any]]()
    if drives:
        ports = {"joints": "inputs", "command": "outputs"}
        brain: dict[str, Any] = {"name": "brain", "container": "neuros_python"}
        brain["plugin"] = "brain.py"
        brain |= {way: [{"name": name, "type": message}] for name, way in ports.items()}
        nodes.append(brain)
        for name, ends in (("joints", ("robot", "brain")), ("command", ("brain", "robot"))):
            link = {"source_node": ends[0], "source_output": name}
            connections.append({**link, "destination_node": ends[1], "destination_input": name})
        (folder / "brain.py").write_text(_BRAIN, "utf-8")
    project = {
        "$schema": (PACKAGE / "schema" / "project.schema.json").as_uri(),
        "description": f"The robot of {source.name}",
        "nodes": nodes,
        "connections": connections,
    }
    (folder / ".gitignore").write_text("/runs/\n__pycache__/\n", "utf-8")
    (folder / "robot.py").write_text(_ROBOT + (_OBEY if drives else ""), "utf-8")
    (folder / "project.json").write_text(json.dumps(project, indent=4) + "\n", "utf-8")
