"""Converts files of others, and compares what comes out with :mod:`tests.corpus.independent`."""

from __future__ import annotations

import time
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from neuros_robots.elements import finder
from neuros_robots.mjcf import Converted
from neuros_robots.sdf import convert_sdf
from neuros_robots.urdf import read_urdf

from neuros.errors import DescriptionError

from .fetching import HERE
from .independent import Description, NotRead, read, tree_of

_CONVERTERS = {".urdf": read_urdf, ".sdf": convert_sdf, ".world": convert_sdf}
_STEPS = 100
_NO_LIMIT = 1e15
_RELATIVE, _ABSOLUTE = 1e-6, 1e-9
_SINGLE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_INVALID = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQACC)


@dataclass
class Outcome:
    """What became of one file.

    Attributes:
        name: the package and the path of the file in it.
        refused: the first problem; empty if the file loads.
        silent: differences from what the file says that the converter does not list.
        said: how many differences it lists.
        apart_m: largest distance from a place that the file, or MuJoCo's own reader, gives.
        bodies, joints: how many were compared.
    """

    name: str
    refused: str = ""
    silent: list[str] = field(default_factory=list)
    said: int = 0
    bodies: int = 0
    joints: int = 0
    apart_m: float = 0.0
    seconds: float = 0.0

    @property
    def failures(self) -> list[str]:
        return [f"refused: {self.refused}"] if self.refused else self.silent


def files_of(folder: Path) -> list[Path]:
    """The descriptions in a package; of a thousand made by a generator, every fiftieth."""
    found = sorted(file for file in folder.rglob("*") if file.suffix in _CONVERTERS)
    made = [file for file in found if "random_urdfs" in file.parts]
    return [file for file in found if file not in {*made} - {*made[::50]}]


def check(file: Path, folder: Path) -> Outcome:
    """Convert a file of a package that is unpacked in a folder, compare it, and step it."""
    outcome = Outcome(f"{folder.name.partition('==')[0]}/{file.relative_to(folder)}")
    begin_s = time.perf_counter()
    packages = {each.parent.parent for each in folder.rglob("package.xml")}
    search = finder([*sorted(packages), *filter(Path.is_dir, sorted(folder.iterdir())), folder], {})
    try:
        converted = _CONVERTERS[file.suffix](file, search)
    except DescriptionError as error:
        outcome.refused = str(error.problems[0]).partition(f"{file.name}:")[2]
        return outcome
    with warnings.catch_warnings():  # the converter lists them
        warnings.simplefilter("ignore")
        model = converted.spec.compile()
    outcome.said = sum(note.count for note in converted.differences)
    try:
        said = read(file)
    except NotRead:
        pass  # it is loaded and stepped all the same
    else:
        outcome.bodies, outcome.joints = len(said.bodies), said.joints
        differences = [*_differences(said, model)]
        outcome.silent = [text for where, text in differences if not _is_listed(where, converted)]
        outcome.apart_m = _apart_m(said, model)
    if file.suffix == ".urdf":
        outcome.apart_m = max(outcome.apart_m, _apart_from_mujoco_m(file, model))
    if outcome.apart_m > _ABSOLUTE:
        outcome.silent.append(f"a body is {outcome.apart_m:.3g} m away from where it should be")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=_STEPS)
    if not np.isfinite(data.qpos).all() or any(data.warning[each].number for each in _INVALID):
        outcome.silent.append(f"it is unstable within {_STEPS} steps")
    outcome.seconds = time.perf_counter() - begin_s
    return outcome


def _is_listed(where: Sequence[str], converted: Converted) -> bool:
    """Whether the converter lists a difference with such a path and reason."""
    return any(
        fnmatchcase(f"/{path}: {note.why}", f"*/{pattern}")
        for note in converted.differences
        for path in note.paths
        for pattern in where
    )


def _differences(said: Description, model: Any) -> Iterator[tuple[Sequence[str], str]]:
    """Differences of a model from its description: how the converter may list each; a sentence."""
    found = {model.body(index).name for index in range(model.nbody)}
    for name, body in said.bodies.items():
        path = f"link[[]{name.rpartition('/')[2]}]"
        if name not in found:
            yield [], f"there is no body '{name}'"
            continue
        index = model.body(name).id
        repaired = [f"{path}*: *{word}*" for word in ("no mass", "no body has", "principal moment")]
        mass = model.body_mass[index]
        if index and not np.isclose(mass, body.mass, rtol=_RELATIVE, atol=0):
            yield repaired, f"the mass of '{name}' is {mass:g}, not {body.mass:g}"
        if index and body.mass:  # else it is the world, or nothing that moves
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.body_iquat[index])
            axes = rotation.reshape(3, 3)
            inertia = axes @ np.diag(model.body_inertia[index]) @ axes.T
            largest = max(float(np.abs(body.inertia).max()), _ABSOLUTE)
            if np.abs(inertia - body.inertia).max() > _RELATIVE * largest:
                yield repaired, f"the inertia of '{name}' is another one"
            if np.abs(model.body_ipos[index] - body.centre).max() > _ABSOLUTE:
                yield [], f"the centre of mass of '{name}' is elsewhere"
        for tag, group in (("collision", 3), ("visual", 2)):
            geoms = np.flatnonzero((model.geom_bodyid == index) & (model.geom_group == group))
            count = body.shapes.get(tag, 0)
            if len(geoms) != count:
                yield [f"{path}/{tag}*"], f"'{name}' has {len(geoms)} of {count} {tag}s"
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    joints = {model.joint(index).name: index for index in range(model.njnt)}
    for name, hinge in said.hinges.items():
        path = f"joint[[]{name.rpartition('/')[2]}]"
        if name not in joints:
            yield [f"{path}: closes a loop*"], f"there is no joint '{name}'"
            continue
        index = joints[name]
        joint = model.joint(index)
        sign = 1 if model.body(model.jnt_bodyid[index]).name == hinge.child else -1
        if np.abs(sign * data.xaxis[index] - hinge.axis).max() > _ABSOLUTE:
            yield [], f"'{name}' turns about another axis"
        beside = np.linalg.norm(np.cross(data.xanchor[index] - hinge.anchor, hinge.axis))
        if beside > _ABSOLUTE and hinge.kind != "prismatic":
            yield [], f"'{name}' turns about another point"
        limits = tuple(joint.range) if joint.limited[0] else (-np.inf, np.inf)
        clipped = np.clip([limits, hinge.limits], -_NO_LIMIT, _NO_LIMIT)
        if not np.allclose(*clipped, rtol=_RELATIVE, atol=_ABSOLUTE):
            yield [f"{path}*: *is locked*"], f"the limits of '{name}' are {limits}"
        effort = model.jnt_actfrcrange[index, 1] if model.jnt_actfrclimited[index] else np.inf
        if not np.isclose(*np.minimum([effort, hinge.effort], _NO_LIMIT)):
            yield [f"{path}*: an effort of 0*"], f"the effort of '{name}' is {effort:g}"
        dof = model.jnt_dofadr[index]
        more = model.dof_damping[dof], model.dof_frictionloss[dof]
        if not np.allclose(more, (hinge.damping, hinge.friction)):
            yield [path, f"{path}/*dynamics"], f"damping and friction of '{name}' are {more}"


def _apart_m(said: Description, model: Any) -> float:
    """The largest distance of a body, or of a point 1 m along one of its axes, from its place."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = {model.body(index).name: index for index in range(model.nbody)}
    return max(
        (
            float(np.abs(np.column_stack((data.xmat[at].reshape(3, 3), data.xpos[at]))
                         - body.place[:3]).max())
            for name, body in said.bodies.items()
            if (at := found.get(name))
        ),
        default=0.0,
    )  # fmt: skip


def _apart_from_mujoco_m(file: Path, model: Any) -> float:
    """The same distance from where MuJoCo's own reader of URDF has a body, in a random posture."""
    try:
        other = by_mujoco(tree_of(file))
    except ValueError:
        return 0.0  # it reads less than the converter, whose result is compared with the file
    ours, theirs = mujoco.MjData(model), mujoco.MjData(other)
    chance = np.random.default_rng(0)
    theirs_by_name = {other.joint(index).name: index for index in range(other.njnt)}
    for index in range(model.njnt):
        joint = model.joint(index)
        if joint.type[0] in _SINGLE and joint.name in theirs_by_name:
            position = chance.uniform(-1, 1)
            ours.joint(joint.name).qpos[0] = theirs.joint(joint.name).qpos[0] = position
    mujoco.mj_kinematics(model, ours)
    mujoco.mj_kinematics(other, theirs)
    found = {other.body(index).name: index for index in range(other.nbody)}
    apart_m = 0.0
    for index in range(1, model.nbody):
        at = found.get(model.body(index).name)
        if at:
            apart_m = max(apart_m, float(np.abs(ours.xpos[index] - theirs.xpos[at]).max()))
            apart_m = max(apart_m, float(np.abs(ours.xmat[index] - theirs.xmat[at]).max()))
    return apart_m


def by_mujoco(root: ElementTree.Element) -> Any:
    """The model that MuJoCo's own reader makes of the links and joints alone."""
    bare = ElementTree.Element("robot", root.attrib)
    block = ElementTree.SubElement(bare, "mujoco")
    more = {"fusestatic": "false", "boundmass": "1e-6", "boundinertia": "1e-6"}
    ElementTree.SubElement(block, "compiler", {**more, "balanceinertia": "true"})
    for element in root:
        if element.tag == "link":
            link = ElementTree.SubElement(bare, "link", element.attrib)
            mass = 'mass value="1"', 'inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"'
            text = f"<inertial>{''.join(f'<{row}/>' for row in mass)}</inertial>"
            link.append(ElementTree.fromstring(text))
        elif element.tag == "joint":
            joint = ElementTree.SubElement(bare, "joint", element.attrib)
            kept = ("origin", "parent", "child", "axis")
            joint.extend(child for child in element if child.tag in kept)
            if element.get("type") in ("revolute", "prismatic"):
                ElementTree.SubElement(joint, "limit", {"lower": "-9", "upper": "9"})
    return mujoco.MjSpec.from_string(ElementTree.tostring(bare, "unicode")).compile()


@dataclass
class Listed:
    """A row of ``differences.txt``: a pattern of files, one of what is found, and the reason."""

    file: str
    what: str
    why: str
    uses: int = 0


def listed() -> list[Listed]:
    """The differences that are meant, from ``differences.txt``."""
    text = (HERE / "differences.txt").read_text("utf-8")
    rows = [line.split(" | ") for line in text.splitlines() if line and not line.startswith("#")]
    return [Listed(*(cell.strip() for cell in row)) for row in rows]


def unlisted(outcome: Outcome, known: Sequence[Listed]) -> list[str]:
    """What is found of a file, and in no row; rows that hold are counted."""
    result = []
    for text in outcome.failures:
        row = next(
            (r for r in known if fnmatchcase(outcome.name, r.file) and fnmatchcase(text, r.what)),
            None,
        )
        if row is None:
            result.append(f"{outcome.name}: {text}")
        else:
            row.uses += 1
    return result
