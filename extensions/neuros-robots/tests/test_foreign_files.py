"""SDF and URDF as others write them: only what changes physics refuses, the rest is listed."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from describing import Folder, link, positions
from neuros_robots.elements import Finder, finder
from neuros_robots.sdf import Converted, convert_sdf
from neuros_robots.urdf import read_urdf

from neuros.errors import DescriptionError

SDF = '<sdf version="1.9"><model name="m"><link name="l"/></model></sdf>'
LAMP = (
    '<sdf version="1.6"><light name="lamp" type="directional"><pose>0 0 8 0 0 0</pose>'
    "<diffuse>.7 .6 .5 1</diffuse><direction>0 0 -1</direction></light></sdf>"
)


def world(folder: Folder, inside: str, **environ: str) -> Converted:
    file = folder.write("hall.world", f'<sdf version="1.6"><world name="w">{inside}</world></sdf>')
    return convert_sdf(file, finder((), {"HOME": str(folder.path / "home"), **environ}))


@pytest.mark.parametrize(
    "text",
    [
        "<!-- run: tool --fast --loud -->" + SDF,
        "<!-- one\n- --- two --->\n" + SDF,
        '\n \t\n<?xml version="1.0"?>\n' + SDF,
        '<!-- a -- licence -->\n<?xml version="1.0"?>\n' + SDF,
        "\ufeff" + SDF,
        SDF + "\0",
    ],
)
def test_what_readers_of_gazebo_accept_is_read(folder: Folder, text: str) -> None:
    model = convert_sdf(folder.write("model.sdf", text), Finder()).spec.compile()
    assert model.body("l").id == 1


def test_lines_are_those_of_the_file_all_the_same(folder: Folder) -> None:
    text = '\n\n<?xml version="1.0"?>\n<!-- a -- b\n -->' + SDF.replace("<link", "<link/>\n<link")
    with pytest.raises(DescriptionError, match=r"model\.sdf:5:\d+: model\[m\]/link: .* no name"):
        convert_sdf(folder.write("model.sdf", text), Finder())
    broken = "\n\n<?xml version='1.0'?>\n<sdf>\n<model></sdf>"
    with pytest.raises(DescriptionError, match=r"model\.sdf:5:.*not XML: mismatched tag"):
        convert_sdf(folder.write("model.sdf", broken), Finder())


def test_characters_of_another_encoding_are_read(folder: Folder) -> None:
    file = folder.path / "arm.urdf"
    file.write_bytes('<robot name="r"><!-- 90° --><link name="Hüfte"/></robot>'.encode("latin-1"))
    assert read_urdf(file, Finder()).spec.compile().body("Hüfte").id == 1


def test_two_dashes_outside_of_comments_stay(folder: Folder) -> None:
    text = SDF.replace('"l"', '"a--b"')
    assert convert_sdf(folder.write("m.sdf", text), Finder()).spec.compile().body("a--b").id == 1


# ---- includes


def test_a_light_is_included_like_a_model(folder: Folder) -> None:
    folder.write("lamp/model.sdf", LAMP)
    move = "<name>upper</name><pose>1 2 3 0 0 0</pose>"
    include = "<include><uri>model://lamp</uri>{}</include>"
    result = world(folder, include.format("") + include.format(move))
    model = result.spec.compile()
    assert model.light("lamp").pos.tolist() == [0, 0, 8]
    np.testing.assert_allclose(model.light("lamp").diffuse, [0.7, 0.6, 0.5])
    assert model.light("upper").pos.tolist() == [1, 2, 3]
    assert not result.differences


def test_the_sun_and_the_ground_of_gazebo_are_always_there(folder: Folder) -> None:
    sun = "<include><uri>model://sun</uri></include>"
    ground = "<include><uri>model://ground_plane</uri></include>"
    ball = (
        '<collision name="c"><geometry><sphere><radius>.1</radius></sphere></geometry></collision>'
    )
    ball = f'<model name="ball">{link("l", ball, pose="0 0 0.3 0 0 0")}</model>'
    model = world(folder, sun + ground + ball).spec.compile()
    assert model.nlight == 1
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=2000)
    assert data.body("ball/l").xpos[2] == pytest.approx(0.1, abs=2e-3)


def test_an_actor_is_listed(folder: Folder) -> None:
    folder.write("walker/model.sdf", '<sdf version="1.6"><actor name="walker"/></sdf>')
    (note,) = world(folder, "<include><uri>model://walker</uri></include>").differences
    assert note.why == "MuJoCo has no animated actors"


def test_a_file_without_anything_to_include_is_named(folder: Folder) -> None:
    folder.write("empty/model.sdf", '<sdf version="1.6"/>')
    with pytest.raises(DescriptionError, match="holds no <model>, <light>, <actor>"):
        world(folder, "<include><uri>model://empty</uri></include>")


FUEL = "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Garden Lamp"


@pytest.mark.parametrize("cache", ["home/.gz/fuel", "home/.ignition/fuel", "own"])
@pytest.mark.parametrize(
    ("uri", "height_m"),
    [(FUEL, 10), (f"{FUEL}/tip", 10), (f"{FUEL}/2", 2), (FUEL.replace(" ", "%20"), 10)],
)
def test_a_model_of_fuel_comes_from_the_cache_of_gazebo(
    folder: Folder, cache: str, uri: str, height_m: float
) -> None:
    kept = f"{cache}/fuel.gazebosim.org/openrobotics/models/garden lamp"
    for version in (2, 10):
        text = LAMP.replace("0 0 8", f"0 0 {version}")
        folder.write(f"{kept}/{version}/model.sdf", text)
    environ = {"GZ_FUEL_CACHE_PATH": str(folder.path / "own")}
    model = world(folder, f"<include><uri>{uri}</uri></include>", **environ).spec.compile()
    assert model.light("lamp").pos[2] == height_m


def test_a_mesh_of_fuel_comes_from_the_cache_too(folder: Folder) -> None:
    kept = "home/.gz/fuel/fuel.ignitionrobotics.org/openrobotics/models/box/3"
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    folder.write(f"{kept}/meshes/box.obj", corners)
    address = "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Box"
    for uri in (f"{address}/3/files/meshes/box.obj", f"{address}/tip/files/meshes/box.obj"):
        mesh = f"<geometry><mesh><uri>{uri}</uri></mesh></geometry>"
        shape = f'<collision name="c">{mesh}</collision>'
        model = world(folder, f'<model name="m">{link("l", shape)}</model>').spec.compile()
        assert model.nmesh == 1
    inside = f'<link name="l"><collision name="c">{mesh}</collision></link>'
    inside = inside.replace(uri, "model://Box/meshes/box.obj")
    folder.write(f"{kept}/model.sdf", f'<sdf version="1.9"><model name="b">{inside}</model></sdf>')
    assert world(folder, f"<include><uri>{address}</uri></include>").spec.compile().nmesh == 1


def test_what_is_not_in_the_cache_has_a_hint(folder: Folder) -> None:
    with pytest.raises(DescriptionError) as caught:
        world(folder, f"<include><uri>{FUEL}</uri></include>")
    assert "is on the network" in str(caught.value)
    assert f"`gz fuel download -u '{FUEL}'`" in str(caught.value)


# ---- shapes, cameras and inertias


def test_a_cone_is_a_mesh(folder: Folder) -> None:
    cone = "<geometry><cone><radius>1</radius><length>3</length></cone></geometry>"
    shape = f'<collision name="c">{cone}</collision>'
    model = folder.model(f'<link name="l"><inertial auto="true"/>{shape}</link>')
    assert model.geom("l/c").type == mujoco.mjtGeom.mjGEOM_MESH
    # Its volume, a third of the cylinder's, and its centre, a quarter above the base.
    assert model.body("l").mass == pytest.approx(1000 * math.pi, rel=0.01)
    assert model.body("l").ipos == pytest.approx([0, 0, -0.75], abs=1e-3)
    assert positions(model).geom("l/c").xpos[2] == pytest.approx(-0.75, abs=1e-3)


@pytest.mark.parametrize("kind", ["camera", "wideanglecamera"])
def test_a_camera_that_sees_more_than_half_of_everything(folder: Folder, kind: str) -> None:
    wide = "<camera><horizontal_fov>3.5</horizontal_fov></camera>"
    text = link("l", f'<sensor name="eye" type="{kind}">{wide}</sensor>')
    assert 90 < folder.model(text).camera("l/eye").fovy < 180
    why = folder.notes(text)["3 link[l]/sensor[eye]/camera"]
    assert why == "MuJoCo's pinhole camera cannot see 3.5 rad: it sees 2.62 rad"


def test_a_moving_link_without_mass_is_named(folder: Folder) -> None:
    text = '<link name="l"><inertial><mass>0</mass></inertial></link>'
    assert folder.model(text).body("l").mass < 1e-8
    assert "'l' moves, and has no mass" in folder.notes(text)["3 link[l]"]
    assert not folder.notes(f"<static>true</static>{text}")


@pytest.mark.parametrize("name", ["robot.xml", "robot.mjcf"])
def test_urdf_under_another_name_is_urdf(tmp_path: Path, name: str) -> None:
    from simulated_node import SimulatedNode

    from neuros.errors import ModelError
    from neuros.simulators.mujoco import MuJoCo

    shape = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    text = (
        f'<?xml version="1.0"?><!-- a > b --><robot name="r"><link name="a">{shape}</link></robot>'
    )
    (tmp_path / name).write_text(text, "utf-8")
    assert MuJoCo(SimulatedNode(folder=tmp_path), name).model.body("a").mass == 0
    with pytest.raises(ModelError, match=r"this is URDF; write it to a file"):
        MuJoCo(SimulatedNode(folder=tmp_path), text)


def test_xacro_is_said_to_be_xacro(tmp_path: Path) -> None:
    from simulated_node import SimulatedNode

    from neuros.errors import ModelError
    from neuros.simulators.mujoco import MuJoCo

    (tmp_path / "arm.urdf.xacro").write_text('<robot name="r">\n<xacro:arm/></robot>', "utf-8")
    wanted = r"arm\.urdf\.xacro:2:1: .*not expanded \(`xacro arm\.urdf\.xacro > robot\.urdf`"
    with pytest.raises(ModelError, match=wanted):
        MuJoCo(SimulatedNode(folder=tmp_path), "arm.urdf.xacro")
