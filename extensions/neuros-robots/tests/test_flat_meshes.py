"""A floor or a wall is often a mesh of two triangles, of which MuJoCo has no convex hull."""

from __future__ import annotations

from itertools import product

import mujoco
import numpy as np
import pytest
from describing import CUBE, Folder, link, positions
from hypothesis import given
from hypothesis import strategies as st
from neuros_robots.elements import Finder
from neuros_robots.frames import from_rpy
from neuros_robots.mjcf import _convex_hull, write_mjcf
from neuros_robots.urdf import read_urdf

CORNERS = np.array([(-2, -1, 0), (2, -1, 0), (2, 1, 0), (-2, 1, 0)], float)
FACES = "f 1 2 3\nf 1 3 4\n"
UPWARDS, BOTH = FACES, FACES + "f 3 2 1\nf 4 3 1\n"
L_SHAPED = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0)]
STATIC = "<static>true</static>"
WHY = "MuJoCo cannot collide a flat mesh: a box of 4 x 2 x 0.01 m stands in its place"


def obj(corners, faces: str = UPWARDS) -> str:
    return "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in np.asarray(corners).tolist()) + faces


def shape(tag: str, name: str, file: str, more: str = "") -> str:
    mesh = f"<mesh><uri>{file}</uri>{more}</mesh>"
    return f'<{tag} name="{name}"><geometry>{mesh}</geometry></{tag}>'


def test_a_flat_collision_becomes_a_box_behind_its_face_and_is_listed(folder: Folder) -> None:
    folder.write("floor.obj", obj(CORNERS))
    both = shape("collision", "hull", "floor.obj") + shape("visual", "skin", "floor.obj")
    inside = STATIC + link("floor", both)
    model = folder.model(inside)
    box, skin = model.geom("floor/hull"), model.geom("floor/skin")
    assert box.type == mujoco.mjtGeom.mjGEOM_BOX
    assert sorted(box.size) == pytest.approx([0.005, 1, 2])
    assert box.pos == pytest.approx([0, 0, -0.005])
    assert skin.type == mujoco.mjtGeom.mjGEOM_MESH  # what is seen stays as it is
    assert skin.contype == 0
    assert folder.notes(inside)["3 link[floor]/collision[hull]/geometry/mesh"] == WHY


@pytest.mark.parametrize("seed", range(5))
def test_the_box_has_the_corners_of_the_mesh_wherever_it_lies(folder: Folder, seed: int) -> None:
    numbers = np.random.default_rng(seed)
    place = from_rpy(*numbers.uniform(-3, 3, 6))
    corners = CORNERS @ place.rotation.T + place.position
    folder.write("wall.obj", obj(corners))
    scaled = shape("collision", "hull", "wall.obj", "<scale>3 3 3</scale>")
    model = folder.model(STATIC + link("wall", scaled, pose="1 2 3 0 0 0"))
    data = positions(model)
    axes = data.geom_xmat[0].reshape(3, 3)
    top = [
        data.geom_xpos[0] + axes @ (model.geom_size[0] * (x, y, 1))
        for x, y in product((-1, 1), repeat=2)
    ]
    expected = 3 * corners + (1, 2, 3)
    distances = np.linalg.norm(expected[:, None] - top, axis=2)
    assert distances.min(axis=0) == pytest.approx(np.zeros(4), abs=1e-5)
    assert distances.min(axis=1) == pytest.approx(np.zeros(4), abs=1e-5)


def test_a_ball_lies_on_it(folder: Folder) -> None:
    folder.write("floor.obj", obj(CORNERS))
    ball = (
        '<collision name="c"><geometry><sphere><radius>0.1</radius></sphere></geometry></collision>'
    )
    model = folder.convert(
        f'<world name="w"><model name="floor">{STATIC}'
        f"{link('floor', shape('collision', 'hull', 'floor.obj'))}</model>"
        f'<model name="ball">{link("ball", ball, pose="1.5 0.5 0.3 0 0 0")}</model></world>'
    ).spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=3000)
    assert data.body("ball/ball").xpos == pytest.approx([1.5, 0.5, 0.1], abs=2e-3)


def test_a_mesh_with_two_faces_has_its_box_around_it(folder: Folder) -> None:
    place = from_rpy(0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    folder.write("wall.obj", obj(CORNERS @ place.rotation.T + place.position, BOTH))
    model = folder.model(STATIC + link("wall", shape("collision", "hull", "wall.obj")))
    assert model.geom("wall/hull").pos == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)


def test_a_box_that_covers_more_than_the_mesh_is_listed_as_such(folder: Folder) -> None:
    folder.write("l.obj", obj(L_SHAPED, "f 1 2 3\nf 1 3 4\nf 1 4 6\nf 4 5 6\n"))
    (why,) = folder.notes(STATIC + link("floor", shape("collision", "hull", "l.obj"))).values()
    assert why.endswith("stands in its place, which is more than the mesh covers")


def test_the_mass_of_a_flat_link_is_that_of_the_box(folder: Folder) -> None:
    folder.write("plate.obj", obj(CORNERS))
    plate = shape("collision", "hull", "plate.obj")
    model = folder.model(f'<link name="plate"><inertial auto="true"/>{plate}</link>')
    assert model.body("plate").mass == pytest.approx(1000 * 4 * 2 * 0.01, rel=1e-4)


def test_a_flat_mesh_that_had_to_be_converted_is_not_written(folder: Folder) -> None:
    rows = "\n".join(f"{x} {y} {z}" for x, y, z in CORNERS)
    folder.write("floor.off", f"OFF\n4 2 0\n{rows}\n3 0 1 2\n3 0 2 3\n")
    floor = STATIC + link("floor", shape("collision", "hull", "floor.off"))
    converted = folder.convert(f'<model name="robot">{floor}</model>')
    output = folder.path / "robot.xml"
    assert write_mjcf(converted, folder.path / "model.sdf", output) == [output]
    model = mujoco.MjModel.from_xml_path(str(output))
    assert model.geom("floor/hull").type == mujoco.mjtGeom.mjGEOM_BOX


def test_the_same_in_urdf(folder: Folder) -> None:
    folder.write("floor.obj", obj(CORNERS))
    mesh = '<geometry><mesh filename="floor.obj"/></geometry>'
    file = folder.write(
        "hall.urdf",
        f"""<robot name="hall">
        <link name="floor"><visual>{mesh}</visual><collision>{mesh}</collision></link>
        </robot>""",
    )
    converted = read_urdf(file, Finder(()))
    model = converted.spec.compile()
    (note,) = converted.differences
    assert note.path == "link[floor]/collision/geometry/mesh"
    assert note.why == WHY
    assert sorted(model.geom_type) == [mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH]


def test_another_mesh_that_cannot_be_used_is_still_an_error(folder: Folder) -> None:
    folder.write("floor.obj", obj(CORNERS))
    folder.write("line.obj", obj([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]))
    folder.write("cube.obj", CUBE)
    shapes = (shape("collision", name, f"{name}.obj") for name in ("floor", "line", "cube"))
    (problem,) = folder.problems(STATIC + link("floor", "".join(shapes)))
    assert "collision[line]/geometry/mesh/uri: MuJoCo cannot use the mesh" in problem


@given(st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), min_size=3, unique=True))
def test_all_points_are_within_the_convex_hull(points) -> None:
    array = np.array(points, float)
    hull = _convex_hull(array)
    edges = np.roll(hull, -1, axis=0) - hull
    for corner, (x, y) in zip(hull, edges, strict=True):
        inside = x * (array[:, 1] - corner[1]) - y * (array[:, 0] - corner[0])
        assert inside.min() >= 0
    assert {tuple(corner) for corner in hull} <= set(map(tuple, array))
