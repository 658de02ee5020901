"""URDF in the MuJoCo node: names, meshes of packages, drives, and what is passed over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from describing import CUBE, Folder
from neuros_robots.elements import Finder
from neuros_robots.urdf import read_urdf

from neuros.errors import DescriptionError

MOMENTS = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'


def link(name: str, inside: str = "") -> str:
    return f'<link name="{name}"><inertial><mass value="1"/>{MOMENTS}</inertial>{inside}</link>\n'


def mesh(kind: str, uri: str) -> str:
    return f'<{kind}><geometry><mesh filename="{uri}" scale="1 2 3"/></geometry></{kind}>'


def joint(kind: str, name: str, parent: str, child: str, inside: str = "") -> str:
    limit = '<limit lower="-1" upper="1" effort="5" velocity="1"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="0 1 0"/>{limit}{inside}</joint>\n'
    )


ARM = (
    link("base")
    + link("upper", mesh("visual", "package://arm/meshes/cube.obj"))
    + link("plate")
    + joint("revolute", "shoulder", "base", "upper")
    + joint("fixed", "screwed", "upper", "plate")
)


def described(folder: Folder, inside: str) -> Any:
    folder.write("arm/meshes/cube.obj", CUBE)
    file = folder.write("arm/urdf/arm.urdf", f'<robot name="arm">\n{inside}</robot>')
    return read_urdf(file, Finder())


def test_all_links_are_there_and_a_mesh_of_the_package_is_found(folder: Folder) -> None:
    model = described(folder, ARM).spec.compile()
    assert [model.body(index).name for index in range(4)] == ["world", "base", "upper", "plate"]
    np.testing.assert_allclose(sorted(np.abs(model.mesh_vert).max(axis=0)), [1, 2, 3])
    assert model.geom(0).contype == 0


def test_a_block_for_mujoco_is_obeyed(folder: Folder) -> None:
    block = '<mujoco><compiler fusestatic="true"/></mujoco>'
    model = described(folder, block + ARM).spec.compile()
    assert model.nbody == 2


def test_all_missing_meshes_are_named(folder: Folder) -> None:
    two = link("a", mesh("visual", "package://arm/x.obj")) + link("b", mesh("collision", "y.obj"))
    with pytest.raises(DescriptionError) as caught:
        described(folder, two + joint("fixed", "j", "a", "b"))
    first, second = map(str, caught.value.problems)
    assert "arm.urdf:2:" in first
    assert "'package://arm/x.obj' cannot be found" in first
    assert "-I" in first
    assert "arm.urdf:3:" in second
    assert "robot[arm]/link[b]/collision/geometry/mesh" not in second  # the root has no part in it
    assert "link[b]/collision/geometry/mesh" in second


def test_a_mesh_in_collada_is_converted(folder: Folder) -> None:
    import trimesh

    box = trimesh.creation.box(extents=(2, 2, 2))
    (folder.path / "box.dae").write_bytes(box.export(file_type="dae"))
    model = described(folder, link("a", mesh("visual", "../../box.dae"))).spec.compile()
    np.testing.assert_allclose(sorted(np.abs(model.mesh_vert).max(axis=0)), [1, 2, 3])


def test_what_mujoco_passes_over_is_listed_and_mimic_is_made(folder: Folder) -> None:
    follows = '<mimic joint="shoulder" multiplier="2" offset="0.5"/>'
    extra = link("finger") + joint("revolute", "grip", "plate", "finger", follows)
    extra += '<transmission name="t"/>\n<gazebo reference="base"/>\n'
    result = described(folder, ARM + extra)
    assert [note.path for note in result.differences] == ["transmission[t]", "gazebo"]
    model = result.spec.compile()
    data = mujoco.MjData(model)
    data.joint("shoulder").qpos[0], data.joint("grip").qpos[0] = 0.2, 0.9
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos, 0, atol=1e-12)


def test_a_prefix_need_not_be_declared_as_for_others_that_read_urdf(folder: Folder) -> None:
    extra = "<gazebo><ignition:frame_id>a</ignition:frame_id></gazebo>"
    assert described(folder, ARM + extra).bodies == described(folder, ARM).bodies


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("<robot", "this is not XML"),
        ("<sdf/>", "a URDF file begins with <robot>, not with <sdf>"),
        ('<robot name="r"><joint name="j"/></robot>', "MuJoCo cannot compile it"),
    ],
)
def test_what_is_no_robot_is_said(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(text, "utf-8")
    with pytest.raises(DescriptionError, match=r"robot\.urdf:1:.*" + problem):
        read_urdf(file, Finder())
