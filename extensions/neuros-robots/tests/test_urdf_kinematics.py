"""Robots in URDF are where their joints put them; ``tests/corpus`` compares those of others."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from kinematics import axes, poses
from neuros_robots.elements import Finder
from neuros_robots.urdf import read_urdf

from neuros.errors import DescriptionError, Problem
from tests.corpus.independent import matrix_of, shift, turn

many = settings(
    max_examples=30,
    deadline=None,
    phases=(Phase.explicit, Phase.generate, Phase.shrink),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
WORDS = (
    *("0", "-1", "nan", "inf", "1e400", "x", "é", "0 0 0", "${a}", "fixed", "floating", "planar"),
    *("world", "link0", "joint1", "revolute", "spherical"),
)


def origin(pose: list[float]) -> str:
    numbers = [*map(repr, map(float, pose))]
    return f'<origin xyz="{" ".join(numbers[:3])}" rpy="{" ".join(numbers[3:])}"/>'


@st.composite
def robots(draw: Any) -> tuple[str, list[Any]]:
    """The text of a random tree, and its joints: type, parent, child, pose, axis, inertia."""
    count = draw(st.integers(1, 5))
    joints = []
    for child in range(1, count + 1):
        kind = draw(st.sampled_from(["revolute", "continuous", "prismatic", "fixed"]))
        parent = draw(st.integers(0, child - 1))
        joints.append((kind, parent, child, draw(poses), draw(axes)))
    inertials = [(draw(st.floats(0.1, 9)), draw(poses)) for _ in range(count + 1)]
    rows = [
        f'<link name="link{index}"><inertial>{origin(pose)}<mass value="{mass!r}"/>'
        '<inertia ixx="1" iyy="1.25" izz="1.5" ixy="0.1"/></inertial></link>'
        for index, (mass, pose) in enumerate(inertials)
    ]
    rows += [
        f'<joint name="joint{child}" type="{kind}">{origin(pose)}<parent link="link{parent}"/>'
        f'<child link="link{child}"/><axis xyz="{" ".join(map(repr, axis))}"/>'
        '<limit lower="-9" upper="9" effort="1" velocity="1"/></joint>'
        for kind, parent, child, pose, axis in joints
    ]
    text = f'<robot name="r">{"".join(draw(st.permutations(rows)))}</robot>'
    return text, [joints, inertials]


@many
@given(robot=robots(), data=st.data())
def test_links_are_where_joints_put_them_and_weigh_what_they_weigh(
    robot: tuple[str, Any], data: st.DataObject, tmp_path: Path
) -> None:
    text, (joints, inertials) = robot
    file = tmp_path / "robot.urdf"
    file.write_text(text, "utf-8")
    model = read_urdf(file, Finder()).spec.compile()
    state = mujoco.MjData(model)
    places = {0: np.eye(4)}
    for kind, parent, child, pose, axis in joints:
        places[child] = places[parent] @ matrix_of(pose)
        if kind == "fixed":
            continue
        position = data.draw(st.floats(-2, 2))
        state.joint(f"joint{child}").qpos[0] = position
        direction = np.array(axis) / np.linalg.norm(axis)
        is_slide = kind == "prismatic"
        motion = shift(direction * position) if is_slide else turn(direction, position)
        places[child] = places[child] @ motion
    mujoco.mj_kinematics(model, state)
    for index, place in places.items():
        body = state.body(f"link{index}")
        np.testing.assert_allclose(body.xpos, place[:3, 3], atol=1e-9)
        np.testing.assert_allclose(body.xmat.reshape(3, 3), place[:3, :3], atol=1e-9)
        mass, pose = inertials[index]
        assert model.body(f"link{index}").mass[0] == mass
        np.testing.assert_allclose(body.xipos, (place @ matrix_of(pose))[:3, 3], atol=1e-9)


@many
@given(st.data())
def test_no_change_ends_in_anything_but_a_model_or_problems(
    tmp_path: Path, data: st.DataObject
) -> None:
    root = ElementTree.fromstring(data.draw(robots())[0])
    for _ in range(data.draw(st.integers(1, 3))):
        element = data.draw(st.sampled_from([*root.iter()]))
        key = data.draw(st.sampled_from([*sorted(element.attrib), "name", "type", "link"]))
        element.set(key, data.draw(st.sampled_from(WORDS)))
        if len(element) and data.draw(st.booleans()):
            element.append(element[0])
    file = tmp_path / "changed.urdf"
    ElementTree.ElementTree(root).write(file)
    problems: list[Problem] = []
    try:
        read_urdf(file, Finder()).spec.compile()
    except DescriptionError as error:
        problems += error.problems
    assert all(problem.line >= 1 and problem.text for problem in problems)
