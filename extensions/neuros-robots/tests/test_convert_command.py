"""``neuros convert`` as a user runs it."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from neuros.cli.main import main

LINK = """\
    <link name="base">
      <inertial><mass>2</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial>
      <visual name="skin"><geometry><mesh><uri>model://robot/SKIN</uri></mesh></geometry></visual>
    </link>
"""
SDF = f"""\
<sdf version="1.9">
  <model name="robot">
{LINK}    <plugin name="p"/>
  </model>
</sdf>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a robot with a mesh; the working folder is above it."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "robot"
    folder.mkdir()
    (folder / "model.sdf").write_text(SDF.replace("SKIN", "skin.obj"), "utf-8")
    (folder / "skin.obj").write_text(TETRAHEDRON, "ascii")
    return folder


def test_the_file_stands_beside_the_description_and_says_what_it_lacks(robot, capsys) -> None:
    assert main(["convert", "robot/model.sdf"]) == 0
    model = mujoco.MjModel.from_xml_path(str(robot / "model.xml"))
    assert (model.nbody, model.nmesh) == (2, 1)
    assert model.body("base").mass == 2
    said = capsys.readouterr()
    assert "robot/model.sdf:7  model[robot]/plugin[p]" in said.out
    assert "robot/model.xml: bodies: 1, joints: 1" in said.out
    assert said.err.startswith("warning: 1 thing was not converted")
    comment = (robot / "model.xml").read_text("utf-8").partition("-->")[0]
    assert "made by `neuros convert` from model.sdf" in comment
    assert "model[robot]/plugin[p]: code that runs inside Gazebo" in comment


def test_meshes_are_named_relative_to_a_file_elsewhere(robot, tmp_path) -> None:
    assert main(["convert", "robot", "-o", "elsewhere/robot.xml"]) == 0
    assert 'file="../robot/skin.obj"' in (tmp_path / "elsewhere/robot.xml").read_text("utf-8")


def test_a_mesh_that_mujoco_does_not_read_is_written_beside_the_file(robot, capsys) -> None:
    import trimesh

    box = trimesh.creation.box(extents=(1, 1, 1))
    (robot / "skin.dae").write_bytes(box.export(file_type="dae"))
    (robot / "model.sdf").write_text(SDF.replace("SKIN", "skin.dae"), "utf-8")
    assert main(["convert", "robot/model.sdf", "-o", "robot/new.xml"]) == 0
    assert (robot / "new_meshes/skin.obj").is_file()
    assert mujoco.MjModel.from_xml_path(str(robot / "new.xml")).nmesh == 1
    assert "1 mesh beside it" in capsys.readouterr().out


def test_a_robot_in_urdf_is_converted_with_its_meshes(robot, capsys) -> None:
    import trimesh

    box = trimesh.creation.box(extents=(1, 1, 1))
    (robot / "box.dae").write_bytes(box.export(file_type="dae"))
    shapes = "".join(
        f'<visual><geometry><mesh filename="package://robot/{name}"/></geometry></visual>'
        for name in ("skin.obj", "box.dae")
    )
    moments = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    links = f'<link name="a"><inertial><mass value="1"/>{moments}</inertial>{shapes}</link>'
    (robot / "arm.urdf").write_text(f'<robot name="arm">{links}<gazebo/></robot>', "utf-8")
    assert main(["convert", "robot/arm.urdf"]) == 0
    model = mujoco.MjModel.from_xml_path(str(robot / "arm.xml"))
    assert (model.nbody, model.nmesh) == (2, 2)
    assert "robot/arm.xml: bodies: 1, joints: 0, 1 mesh beside it" in capsys.readouterr().out


def test_models_are_looked_up_in_folders_that_are_named(robot, tmp_path, capsys) -> None:
    (tmp_path / "far/away").mkdir(parents=True)
    file = tmp_path / "far/away/world.sdf"
    include = "<include><uri>model://robot</uri></include>"
    file.write_text(f'<sdf version="1.9"><world name="w">{include}</world></sdf>', "utf-8")
    (tmp_path / "models").mkdir()
    robot.rename(tmp_path / "models/robot")
    assert main(["convert", str(file)]) == 3
    assert "'model://robot' cannot be found (name its folder with -I, or in" in (
        capsys.readouterr().err
    )
    assert main(["convert", str(file), "-I", str(tmp_path / "models")]) == 0


def test_a_broken_file_leaves_nothing_behind(robot, capsys) -> None:
    text = SDF.replace("SKIN", "skin.obj").replace("<mass>2", "<mass>two")
    (robot / "model.sdf").write_text(text.replace("<ixx>1", "<ixx>one"), "utf-8")
    assert main(["convert", "robot/model.sdf"]) == 3
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("robot/model.sdf:4:17: model[robot]/link[base]/inertial/mass: ")
    assert lines[1].startswith("robot/model.sdf:4:42: ")
    assert lines[2] == "2 problems; nothing was written"
    assert sorted(path.name for path in robot.iterdir()) == ["model.sdf", "skin.obj"]


def test_a_file_of_somebody_else_is_not_overwritten(robot, capsys) -> None:
    (robot / "model.xml").write_text("<mujoco/>", "utf-8")
    assert main(["convert", "robot/model.sdf"]) == 2
    assert (robot / "model.xml").read_text("utf-8") == "<mujoco/>"
    assert "--force" in capsys.readouterr().err
    assert main(["convert", "robot/model.sdf", "--force"]) == 0
    assert main(["convert", "robot/model.sdf"]) == 0  # now it is its own


@pytest.mark.parametrize("arguments", [["nothing.sdf"], ["robot", "-I", "nowhere"], ["."]])
def test_what_cannot_be_meant_is_said(robot, capsys, arguments) -> None:
    assert main(["convert", *arguments]) == 2
    assert capsys.readouterr().err.startswith("neuros: ")


def test_a_folder_that_cannot_be_written_to(robot, capsys) -> None:
    assert main(["convert", "robot/model.sdf", "-o", "/proc/nothing/model.xml"]) == 4
    assert "cannot be written" in capsys.readouterr().err
