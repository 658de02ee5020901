"""URDF in the MuJoCo node: names, meshes of packages, drives, and what is passed over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from describing import CUBE, Folder, positions
from neuros_robots.elements import Finder
from neuros_robots.mjcf import write_mjcf
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
    two = link("a", mesh("collision", "package://arm/x.obj"))
    two += link("b", mesh("collision", "y.obj"))
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
    notes = {note.path: note.why for note in result.differences}
    assert [*notes] == ["joint[shoulder]/limit", "transmission[t]", "gazebo"]
    assert notes["joint[shoulder]/limit"] == "MuJoCo does not limit the velocity of a joint"
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
        ('<robot name="r"><joint name="j"/></robot>', "there is no <link> in it"),
    ],
)
def test_what_is_no_robot_is_said(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(text, "utf-8")
    with pytest.raises(DescriptionError, match=r"robot\.urdf:1:.*" + problem):
        read_urdf(file, Finder())


# ---- what URDF defines, in the place of MuJoCo's defaults


def inertial(mass: float = 1, moments: str = 'ixx="1" iyy="1" izz="1"') -> str:
    return f'<inertial><mass value="{mass}"/><inertia {moments}/></inertial>'


def read(folder: Folder, inside: str) -> tuple[Any, dict[str, str]]:
    """The compiled model of a robot, and the reasons of its notes by line and path."""
    file = folder.write("robot.urdf", f'<robot name="robot">\n{inside}</robot>')
    result = read_urdf(file, Finder())
    notes = {f"{n.place.rpartition(':')[2]} {n.path}": n.why for n in result.differences}
    return result.spec.compile(), notes


def problems(folder: Folder, inside: str) -> list[str]:
    with pytest.raises(DescriptionError) as caught:
        read(folder, inside)
    return [str(problem).partition("robot.urdf:")[2] for problem in caught.value.problems]


BOX = '<geometry><box size="1 1 1"/></geometry>'
HINGE = '<joint name="j" type="{}"><parent link="a"/><child link="b"/>{}</joint>\n'


def two(kind: str, inside: str = "", below: str = "") -> str:
    return link("a") + f'<link name="b">{inertial()}{below}</link>\n' + HINGE.format(kind, inside)


def test_a_link_weighs_what_the_file_says_whatever_its_shapes(folder: Folder) -> None:
    shapes = f"<visual>{BOX}</visual><collision>{BOX}</collision>"
    still = f'<link name="tray">{shapes}</link>' + joint("fixed", "t", "b", "tray")
    model, notes = read(folder, two("continuous", below=shapes) + still)
    assert model.body_mass.tolist() == [0, 1, 1, 0]
    assert not notes


@pytest.mark.parametrize("given", ["", inertial(0, ""), inertial(0, 'ixx="0" iyy="0" izz="0"')])
def test_a_moving_link_without_mass_is_named(folder: Folder, given: str) -> None:
    arm = '<link name="a"/>\n' + f'<link name="ghost">{given}</link>\n<link name="tip"/>'
    arm += joint("revolute", "j", "a", "ghost") + joint("fixed", "k", "ghost", "tip")
    model, notes = read(folder, arm)
    assert model.body_mass.sum() < 1e-8
    assert notes["3 link[ghost]"].startswith("'ghost' moves, and has no mass")
    assert not any("tip" in path for path in notes)


def test_the_mass_of_a_link_that_is_fixed_to_it_is_enough(folder: Folder) -> None:
    arm = '<link name="a"/>\n<link name="b"/>' + link("tip")
    arm += joint("revolute", "j", "a", "b") + joint("fixed", "k", "b", "tip")
    model, notes = read(folder, arm)
    assert model.body_mass.sum() == 1
    assert not any("mass" in why for why in notes.values())


@pytest.mark.parametrize(
    ("limit", "path", "why"),
    [
        ('<limit lower="0" upper="0" effort="9"/>', "joint[j]/limit", "both its limits are 0"),
        ('<limit effort="9"/>', "joint[j]/limit", "both its limits are 0 (URDF's default)"),
        ("", "joint[j]", "both its limits are 0 (URDF's default)"),
        ('<limit lower="0.5" upper="0.5"/>', "joint[j]/limit", "both its limits are 0.5"),
    ],
)
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_joint_whose_limits_are_equal_is_locked(
    folder: Folder, kind: str, limit: str, path: str, why: str
) -> None:
    model, notes = read(folder, two(kind, f'<axis xyz="0 1 0"/><origin xyz="0 0 1"/>{limit}'))
    assert notes[f"4 {path}"] == f"'j' is locked: {why}"
    data = mujoco.MjData(model)
    data.qpos[0] = at = 0.5 if "0.5" in limit else 0.0
    data.qfrc_applied[0] = 3
    mujoco.mj_step(model, data, nstep=1000)
    assert data.qpos[0] == pytest.approx(at, abs=0.01)
    again = mujoco.MjModel.from_xml_path(str(written(folder)))
    assert again.jnt_limited[0]


def written(folder: Folder) -> Path:
    """The file that ``neuros convert`` makes of the robot."""
    source, output = folder.path / "robot.urdf", folder.path / "robot.xml"
    write_mjcf(read_urdf(source, Finder()), source, output)
    return output


def test_limits_effort_damping_and_friction_are_those_of_the_file(folder: Folder) -> None:
    inside = '<limit lower="-1" upper="2" effort="7"/><dynamics damping="0.2" friction="0.3"/>'
    model, notes = read(folder, two("revolute", inside))
    made = model.joint("j")
    assert (made.range.tolist(), made.damping[0], made.frictionloss[0]) == ([-1, 2], 0.2, 0.3)
    assert model.jnt_actfrcrange[0].tolist() == [-7, 7]
    assert made.axis.tolist() == [1, 0, 0]  # URDF's default
    assert not notes
    assert not read(folder, two("continuous", inside))[0].jnt_limited[0]


def test_an_effort_of_nothing_is_listed(folder: Folder) -> None:
    model, notes = read(folder, two("revolute", '<limit lower="-1" upper="1" effort="0"/>'))
    assert not model.jnt_actfrclimited[0]
    assert "an effort of 0" in notes["4 joint[j]/limit"]


def test_a_mimic_is_one_constraint(folder: Folder) -> None:
    follow = joint("continuous", "follow", "a", "c", '<mimic joint="j" multiplier="-2"/>')
    assert read(folder, two("continuous") + link("c") + follow)[0].neq == 1


def test_who_follows_a_joint_that_does_not_move_is_held(folder: Folder) -> None:
    follow = joint("continuous", "follow", "a", "c", '<mimic joint="j" offset="0.2"/>')
    model, _ = read(folder, two("fixed") + link("c") + follow)
    assert model.eq_data[0, 0] == 0.2
    assert model.eq_obj2id[0] == -1


def test_who_follows_no_joint_is_listed_by_name(folder: Folder) -> None:
    model, notes = read(folder, two("continuous", '<mimic joint="lost"/>'))
    assert model.neq == 0
    assert notes["4 joint[j]/mimic"] == "'j' follows 'lost', and there is no such joint"


@pytest.mark.parametrize(
    ("moments", "expected", "why"),
    [
        ('ixx="4" iyy="1" izz="1"', [2, 2, 2], "its largest principal moment, 4 kg m², exceeds"),
        ('ixx="1" iyy="1" izz="1" ixy="1.2"', [1, 1, 1], "its smallest principal moment is -0.2"),
        ('ixx="0" iyy="2" izz="2"', [2e-6, 2, 2], "the body is a rod"),
        ('ixx="0" iyy="0" izz="0"', [2e-6] * 3, "the body is a point"),
        ("", [2e-6] * 3, "the body is a point"),
    ],
)
def test_an_inertia_that_no_body_has_is_repaired_and_listed(
    folder: Folder, moments: str, expected: list[float], why: str
) -> None:
    text = f'<link name="a"/>\n<link name="b">{inertial(2, moments)}</link>\n'
    model, notes = read(folder, text + HINGE.format("continuous", ""))
    assert sorted(model.body("b").inertia) == pytest.approx(expected)
    (note,) = notes.values()
    assert why in note
    assert [*notes] == ["3 link[b]/inertial/inertia"]


def test_the_inertia_of_a_flat_body_survives_the_digits_of_a_written_file(folder: Folder) -> None:
    x, y = 0.0123456789, 0.0456789123
    moments = f'ixx="{x}" iyy="{y}" izz="{x + y}"'
    _, notes = read(folder, two("continuous").replace('ixx="1" iyy="1" izz="1"', moments))
    assert not notes
    again = mujoco.MjModel.from_xml_path(str(written(folder)))
    assert sorted(again.body("b").inertia) == pytest.approx([x, y, x + y], rel=1e-4)


def test_a_negative_moment_is_a_mistake(folder: Folder) -> None:
    (problem,) = problems(folder, two("continuous").replace('ixx="1"', 'ixx="-1"', 1))
    assert "no body has this inertia: its principal moments are -1, 1 and 1 kg m²" in problem


def test_a_link_and_a_joint_may_have_one_name(folder: Folder) -> None:
    text = two("continuous").replace('joint name="j"', 'joint name="b"')
    assert read(folder, text)[0].joint("b").id == 0


def test_the_world_is_no_body(folder: Folder) -> None:
    floor = f'<link name="world"><collision>{BOX}</collision></link>' + link("b")
    model, _ = read(folder, floor + HINGE.format("floating", "").replace('"a"', '"world"'))
    assert [model.body(index).name for index in range(model.nbody)] == ["world", "b"]
    assert model.geom("world/collision").bodyid == 0
    assert model.joint("j").type == mujoco.mjtJoint.mjJNT_FREE


def test_a_floating_joint_is_free_wherever_it_is(folder: Folder) -> None:
    model, _ = read(folder, two("floating", '<origin xyz="0 0 2"/>'))
    assert model.nv == 6
    assert positions(model).body("b").xpos.tolist() == [0, 0, 2]
    carried = two("continuous") + link("c") + joint("floating", "k", "b", "c")
    model, _ = read(folder, carried)
    assert model.nv == 7
    assert {"k/x", "k/y", "k/z", "k/turn"} < {model.joint(i).name for i in range(model.njnt)}


def test_a_planar_joint_moves_across_its_axis_and_turns_about_it(folder: Folder) -> None:
    model, _ = read(folder, two("planar", '<axis xyz="0 2 0"/>'))
    axes = {name: model.joint(f"j/{name}").axis for name in ("x", "y", "turn")}
    np.testing.assert_allclose(axes["turn"], [0, 1, 0], atol=1e-12)
    assert abs(axes["x"][1]) < 1e-12
    assert abs(axes["y"][1]) < 1e-12


def test_links_of_a_robot_collide_with_each_other_only_if_gazebo_lets_them(folder: Folder) -> None:
    shape = f"<collision>{BOX}</collision>"
    robot = f'<link name="a">{shape}</link>' + f'<link name="b">{inertial()}{shape}</link>'
    robot += HINGE.format("continuous", "")
    assert read(folder, robot)[0].nexclude == 1
    wish = "<gazebo><self_collide>true</self_collide></gazebo>"
    assert read(folder, robot + wish)[0].nexclude == 0


# ---- colours, textures and meshes


def test_a_visual_has_the_colour_of_its_material(folder: Folder) -> None:
    visuals = "".join(f'<visual>{BOX}<material name="{name}"/></visual>' for name in ("red", "no"))
    red = '<material name="red"><color rgba="1 0 0 0.5"/></material>\n'
    model, notes = read(folder, f"{red}\n<link name='a'>{visuals}</link>")
    assert model.geom_rgba[0].tolist() == [1, 0, 0, 0.5]
    assert notes == {"4 link[a]/visual/material[no]": "there is no material 'no': it is grey"}


def test_a_missing_texture_is_listed_as_such(folder: Folder) -> None:
    red = '<material name="red"><color rgba="1 0 0 1"/>\n<texture filename="x.png"/></material>'
    model, notes = read(folder, f'<link name="a"><visual>{BOX}{red}</visual></link>')
    assert model.geom_rgba[0].tolist() == [1, 0, 0, 1]
    why = notes["3 link[a]/visual/material[red]/texture"]
    assert why == "the texture is missing: 'x.png' cannot be found"


def test_what_is_only_seen_may_be_wrong_and_is_listed(folder: Folder) -> None:
    folder.write("broken.stl", "this is no mesh")
    visuals = (
        '<visual><geometry><mesh filename="lost.stl"/></geometry></visual>\n'
        '<visual><geometry><mesh filename="broken.stl"/></geometry></visual>\n'
        "<visual><geometry><box/></geometry></visual>\n<visual/>\n"
        '<visual><geometry><sphere radius="-1"/></geometry></visual>\n'
    )
    model, notes = read(folder, f'<link name="a">\n{visuals}</link>')
    assert model.ngeom == 0
    mesh = "link[a]/visual/geometry/mesh"
    assert "'lost.stl' cannot be found" in notes[f"3 {mesh}"]
    assert "MuJoCo cannot use the mesh" in notes[f"4 {mesh}"]
    assert notes["5 link[a]/visual/geometry/box"] == "size is missing"
    assert notes["6 link[a]/visual"] == "<geometry> is missing"
    assert (
        notes["7 link[a]/visual/geometry/sphere"] == "every size must be positive, and below 1e+15"
    )
    found = problems(folder, f'<link name="a">\n{visuals}</link>'.replace("visual", "collision"))
    assert [problem.partition(":")[0] for problem in found] == ["3", "5", "6", "7"]


def test_a_shape_of_no_size_touches_nothing(folder: Folder) -> None:
    point = '<collision><geometry><sphere radius="0"/></geometry></collision>'
    model, notes = read(folder, f'<link name="a">{point}</link>')
    assert model.ngeom == 0
    assert notes == {"2 link[a]/collision/geometry/sphere": "left out: it has no size"}


def test_a_pointer_of_git_lfs_is_no_mesh(folder: Folder) -> None:
    folder.write("part.stl", "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    shape = '<{0}><geometry><mesh filename="part.stl"/></geometry></{0}>'
    _, notes = read(folder, f'<link name="a">{shape.format("visual")}</link>')
    (why,) = notes.values()
    assert why.startswith("'part.stl' is a Git LFS pointer, not the file itself")
    (problem,) = problems(folder, f'\n<link name="a">{shape.format("collision")}</link>')
    assert problem.startswith("3:")
    assert "(run `git lfs pull` in its repository)" in problem


def test_a_description_may_be_a_pointer_of_git_lfs_itself(folder: Folder) -> None:
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
    file = folder.write("arm.urdf", pointer)
    with pytest.raises(DescriptionError, match=r"arm\.urdf:1:1: /: it is a Git LFS pointer"):
        read_urdf(file, Finder())


# ---- what is wrong is said by name and line


@pytest.mark.parametrize(
    ("inside", "wanted"),
    [
        ('\n<link name="a"><visual>\n<origin xyz="0 0 ${h}"/></visual></link>', "4:1: link[a]/v"),
        ('\n\n<xacro:arm name="left"/>', "4:1: xacro:arm[left]: "),
        ('<link name="$(arg name)"/>', "2:1: link[$(arg name)]: "),
    ],
)
def test_xacro_that_was_not_expanded_is_named(folder: Folder, inside: str, wanted: str) -> None:
    (problem,) = problems(folder, inside)
    assert problem.startswith(wanted)
    assert "this is xacro that was not expanded (`xacro robot.urdf.xacro > robot.urdf`" in problem


def test_every_mistake_in_the_tree_is_named_with_its_line(folder: Folder) -> None:
    lines = [
        '<link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/>',
        '<joint name="one" type="fixed"><parent link="a"/><child link="z"/></joint>',
        '<joint name="two" type="hinge"><parent link="a"/><child link="b"/></joint>',
        '<joint name="three" type="fixed"><parent link="a"/><child link="b"/></joint>',
        '<joint name="four" type="fixed"><parent link="c"/><child link="b"/></joint>',
        '<joint name="five" type="fixed"><parent link="d"/><child link="e"/></joint>',
        '<joint name="six" type="fixed"><parent link="e"/><child link="d"/></joint>',
        '<joint name="six" type="fixed"><child link="c"/></joint>',
        '<joint type="fixed"><child link="c"/></joint>',
        '<link name="a"/>',
    ]
    found = problems(folder, "\n".join(lines))
    wanted = [
        (2, "'d' is below itself: the joints form a circle"),
        (2, "'e' is below itself: the joints form a circle"),
        (3, "the child of joint 'one' is 'z', and there is no such link (there are: a, b, c,"),
        (4, "'hinge' is not a type of joint"),
        (6, "the link 'b' has two parents: in URDF it has one (see joint 'three' in"),
        (9, "the name 'six' occurs twice"),
        (10, "the <joint> has no name"),
        (11, "the name 'a' occurs twice"),
    ]
    assert len(found) == len(wanted)
    for problem, (line, text) in zip(found, wanted, strict=True):
        assert problem.startswith(f"{line}:")
        assert text in problem


def test_a_second_root_stands_in_the_world_and_is_listed(folder: Folder) -> None:
    model, notes = read(folder, link("a") + link("b"))
    assert model.nv == 0
    assert notes == {"3 link[b]": "'b' has no joint: it stands in the world, as the root"}


@pytest.mark.parametrize(
    ("inside", "problem"),
    [
        ('<axis xyz="0 0 0"/>', "the axis has no direction: its length is zero"),
        ('<axis xyz="0 1"/>', "xyz: 3 numbers must stand here, not 2"),
        ('<origin rpy="0 0 x"/>', "rpy: 'x' is not a number"),
        ('<limit lower="2" upper="1"/>', "the lower limit 2 is above the upper one, 1"),
    ],
)
def test_a_wrong_number_is_named(folder: Folder, inside: str, problem: str) -> None:
    limit = "" if "limit" in inside else '<limit lower="0" upper="1"/>'
    (found,) = problems(folder, two("revolute", limit + inside))
    assert found.startswith("4:")
    assert problem in found


def test_a_wrong_setting_for_mujoco_is_named(folder: Folder) -> None:
    (problem,) = problems(folder, '\n<mujoco><option timestep="x"/></mujoco>' + link("a"))
    assert problem.startswith("3:1: mujoco: MuJoCo cannot read it: ")


# ---- Gazebo's extensions that SDF has, too


def test_sensors_of_gazebo_are_those_of_sdf(folder: Folder) -> None:
    eye = '<sensor name="eye" type="camera"><camera><horizontal_fov>1</horizontal_fov></camera>'
    sensors = f'{eye}<plugin name="p"/></sensor>\n<sensor name="imu" type="imu"/>'
    felt = '<gazebo reference="j"><sensor name="felt" type="force_torque"/></gazebo>'
    block = f'<gazebo reference="b">{sensors}\n<kp>1</kp></gazebo>{felt}\n<gazebo reference="b"/>'
    model, notes = read(folder, two("continuous") + block)
    assert model.camera("b/eye").id == 0
    names = {model.sensor(index).name for index in range(model.nsensor)}
    assert {"b/imu/gyro", "b/imu/accelerometer", "j/felt/force"} < names
    assert notes["7 gazebo/kp"] == "an extension for Gazebo"
    assert notes["8 gazebo"] == "an extension for Gazebo"
    assert "5 gazebo/sensor[eye]/plugin[p]" in notes


def test_friction_and_gravity_of_gazebo(folder: Folder) -> None:
    shape = f"<collision>{BOX}</collision>"
    block = "<mu1>0.2</mu1><mu2>0.2</mu2><turnGravityOff>true</turnGravityOff>"
    text = two("continuous", below=shape) + f'<gazebo reference="b">{block}</gazebo>'
    model, notes = read(folder, text)
    assert model.geom_friction[0, 0] == 0.2
    assert model.body_gravcomp[2] == 1
    assert not notes
