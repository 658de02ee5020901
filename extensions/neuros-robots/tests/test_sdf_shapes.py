"""Collisions and visuals of SDF as geoms of MuJoCo."""

from __future__ import annotations

import struct
import zlib

import mujoco
import numpy as np
import pytest
from describing import BOX, CUBE, Folder, link, positions
from neuros_robots.mjcf import write_mjcf

GEOM = mujoco.mjtGeom


@pytest.mark.parametrize(
    ("geometry", "kind", "size"),
    [
        ("<box><size>1 2 3</size></box>", GEOM.mjGEOM_BOX, [0.5, 1, 1.5]),
        ("<sphere><radius>2</radius></sphere>", GEOM.mjGEOM_SPHERE, [2]),
        (
            "<cylinder><radius>2</radius><length>3</length></cylinder>",
            GEOM.mjGEOM_CYLINDER,
            [2, 1.5],
        ),
        (
            "<capsule><radius>2</radius><length>3</length></capsule>",
            GEOM.mjGEOM_CAPSULE,
            [2, 1.5],
        ),
        ("<ellipsoid><radii>1 2 3</radii></ellipsoid>", GEOM.mjGEOM_ELLIPSOID, [1, 2, 3]),
    ],
)
def test_a_shape_keeps_its_size(folder: Folder, geometry, kind, size) -> None:
    shape = f'<collision name="hull"><geometry>{geometry}</geometry></collision>'
    geom = folder.model(link("base", shape)).geom("base/hull")
    assert geom.type == kind
    np.testing.assert_allclose(geom.size[: len(size)], size)


def test_only_collisions_collide_and_neither_changes_the_mass(folder: Folder) -> None:
    shapes = f'<collision name="hull">{BOX}</collision><visual name="skin">{BOX}</visual>'
    model = folder.model(link("base", shapes, mass=7))
    assert model.body("base").mass == 7
    assert (model.geom("base/hull").contype, model.geom("base/hull").group) == (1, 3)
    assert (model.geom("base/skin").contype, model.geom("base/skin").group) == (0, 2)
    assert model.geom("base/skin").conaffinity == 0


def test_a_visual_has_its_colour(folder: Folder) -> None:
    def visual(name: str, inside: str) -> str:
        return f'<visual name="{name}">{BOX}{inside}</visual>'

    model = folder.model(
        link(
            "base",
            visual("red", "<material><diffuse>1 0 0 0.5</diffuse></material>")
            + visual("glass", "<transparency>0.75</transparency>")
            + visual("gazebo", "<material><script><name>Gazebo/Blue</name></script></material>"),
        )
    )
    np.testing.assert_allclose(model.geom("base/red").rgba, [1, 0, 0, 0.5])
    assert model.geom("base/glass").rgba[3] == 0.25
    np.testing.assert_allclose(model.geom("base/gazebo").rgba, [0, 0, 1, 1])


def test_friction_and_masks_of_contacts(folder: Folder) -> None:
    def collision(name: str, surface: str) -> str:
        return f'<collision name="{name}">{BOX}<surface>{surface}</surface></collision>'

    slippery = "<friction><ode><mu>0.1</mu><mu2>0.1</mu2></ode></friction>"
    masked = "<contact><collide_bitmask>0x02</collide_bitmask></contact>"
    shapes = collision("ice", slippery) + collision("ghost", masked)
    model = folder.model(link("base", shapes))
    assert model.geom("base/ice").friction[0] == 0.1
    assert model.geom("base/ghost").contype == model.geom("base/ghost").conaffinity == 2
    assert model.geom("base/ice").contype == 0xFFFF


def test_a_plane_lies_along_its_normal_where_nothing_moves(folder: Folder) -> None:
    plane = "<geometry><plane><normal>1 0 0</normal><size>4 4</size></plane></geometry>"
    wall = link("wall", f'<collision name="side">{plane}</collision>')
    model = folder.model(f"<static>true</static>{wall}")
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.geom("wall/side").quat)
    np.testing.assert_allclose(axes.reshape(3, 3)[:, 2], [1, 0, 0], atol=1e-12)
    (why,) = folder.notes(wall).values()
    assert why == "MuJoCo has planes and height fields only where nothing moves"


def test_a_mesh_keeps_its_scale_and_stands_beside_the_file(folder: Folder) -> None:
    folder.write("meshes/cube.obj", CUBE)
    mesh = "<geometry><mesh><uri>meshes/cube.obj</uri><scale>1 2 3</scale></mesh></geometry>"
    model = folder.model(link("base", f'<visual name="skin">{mesh}</visual>'))
    np.testing.assert_allclose(sorted(np.abs(model.mesh_vert).max(axis=0)), [1, 2, 3])
    assert model.geom("base/skin").type == GEOM.mjGEOM_MESH


def test_a_mesh_that_mujoco_does_not_read_is_converted(folder: Folder) -> None:
    import trimesh

    box = trimesh.creation.box(extents=(2, 4, 6))
    (folder.path / "box.dae").write_bytes(box.export(file_type="dae"))
    (folder.path / "text.stl").write_text(box.export(file_type="stl_ascii"))
    for name in ("box.dae", "text.stl"):
        mesh = f"<geometry><mesh><uri>{name}</uri></mesh></geometry>"
        model = folder.model(link("base", f'<collision name="hull">{mesh}</collision>'))
        np.testing.assert_allclose(sorted(np.abs(model.mesh_vert).max(axis=0)), [1, 2, 3])


def test_what_is_no_mesh_is_a_problem_with_its_line(folder: Folder) -> None:
    folder.write("broken.obj", "this is no mesh")
    mesh = "<geometry><mesh>\n<uri>broken.obj</uri></mesh></geometry>"
    (problem,) = folder.problems(link("base", f'<collision name="hull">{mesh}</collision>'))
    assert problem.startswith("4:1: model[robot]/link[base]/collision[hull]/geometry/mesh/uri: ")


@pytest.mark.parametrize("name", ["a.dae", "a.gltf", "a.ply", "a.glb"])
def test_a_damaged_mesh_of_another_kind_is_listed(folder: Folder, name: str) -> None:
    folder.write(name, "this is no mesh")
    mesh = f"<geometry><mesh><uri>{name}</uri></mesh></geometry>"
    notes = folder.notes(link("base", f'<visual name="skin">{mesh}</visual>'))
    assert "no triangles can be read from it (is it damaged?): convert it to OBJ" in notes.values()


def test_a_folder_is_no_mesh(folder: Folder) -> None:
    (folder.path / "a.stl").mkdir()
    mesh = "<geometry><mesh><uri>a.stl</uri></mesh></geometry>"
    (problem,) = folder.problems(link("base", f'<collision name="hull">{mesh}</collision>'))
    assert problem.endswith("'a.stl' is not a file")


def test_links_of_one_model_collide_only_if_it_says_so(folder: Folder) -> None:
    shape = f'<collision name="hull">{BOX}</collision>'
    two = link("a", shape) + link("b", shape)
    assert folder.model(two).nexclude == 1
    assert folder.model(f"<self_collide>true</self_collide>{two}").nexclude == 0


def outline(points: str, height: float = 2.0, more: str = "") -> str:
    rows = "".join(f"<point>{point}</point>" for point in points.split(", "))
    shape = f"<polyline>{rows}<height>{height}</height></polyline>{more}"
    return f'<inertial auto="true"/><collision name="c"><geometry>{shape}</geometry></collision>'


@pytest.mark.parametrize("turned", [1, -1])
def test_an_outline_is_extruded_upwards(folder: Folder, turned: int) -> None:
    # An L of 3 unit squares, whichever way round it is drawn.
    points = ["0 0", "2 0", "2 1", "1 1", "1 2", "0 2"][::turned]
    result = folder.convert(f'<model name="m">{link_of(outline(", ".join(points)))}</model>')
    model = result.spec.compile()
    assert model.body("l").mass == pytest.approx(3 * 2 * 1000)
    centre = [5 / 6, 5 / 6, 1]
    np.testing.assert_allclose(model.body("l").ipos, centre, atol=1e-6)
    assert [note.why for note in result.differences] == [
        "MuJoCo collides the convex hull of a mesh"
    ]


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        ("0 0, 1 1", "an outline has 3 points at least, not 2"),
        ("0 0, 1 1, 2 2", "its points do not surround an area, or its sides cross"),
        ("0 0, 1 1, 1 0, 0 1", "its points do not surround an area, or its sides cross"),
        ("0 0, 1 x, 1 0", "'x' is not a number"),
    ],
)
def test_an_outline_that_surrounds_nothing_is_a_problem(
    folder: Folder, points: str, problem: str
) -> None:
    (said,) = folder.problems(link_of(outline(points)))
    assert problem in said


def link_of(inside: str) -> str:
    return f'<link name="l">{inside}</link>'


def picture(rows: list[list[int]]) -> bytes:
    """A grey picture in PNG."""

    def part(kind: bytes, data: bytes) -> bytes:
        whole = kind + data
        return struct.pack(">I", len(data)) + whole + struct.pack(">I", zlib.crc32(whole))

    head = struct.pack(">IIBBBBB", len(rows[0]), len(rows), 8, 0, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + bytes(row) for row in rows))
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", data) + part(b"IEND", b"")


def terrain(inside: str) -> str:
    shape = f"<heightmap><uri>hill.png</uri>{inside}</heightmap>"
    collision = f'<collision name="c"><geometry>{shape}</geometry></collision>'
    return f"<static>true</static>{link_of(collision)}"


def test_a_height_map_is_a_height_field(folder: Folder) -> None:
    # 51 to 255 of 255: from 1 m to 5 m; the brightest row is the first, which is at +y.
    rows = [[255] * 5, [204] * 5, [153] * 5, [102] * 5, [51] * 5]
    (folder.path / "hill.png").write_bytes(picture(rows))
    inside = "<size>8 8 5</size><pos>0 0 10</pos>"
    model = folder.model(terrain(inside))
    data = positions(model)
    for y, height in ((-3.9, 1.05), (0, 3), (3.9, 4.95)):
        hit = mujoco.mj_ray(
            model, data, np.array([0.1, y, 99.0]), np.array([0, 0, -1.0]), None, 1, -1,
            np.zeros(1, np.int32),
        )  # fmt: skip
        assert 99 - hit == pytest.approx(10 + height, abs=1e-2)
    output = folder.path / "out" / "model.xml"
    write_mjcf(folder.convert(f'<model name="m">{terrain(inside)}</model>'), output, output)
    assert mujoco.MjModel.from_xml_path(str(output)).nhfield == 1


def test_a_height_map_that_cannot_be_read_is_a_problem(folder: Folder) -> None:
    (said,) = folder.problems(terrain(""))
    assert "'hill.png' cannot be found" in said
    folder.write("hill.png", "no picture")
    (said,) = folder.problems(terrain(""))
    assert "no heights can be read from it" in said
    assert "MuJoCo reads PNG" in said
