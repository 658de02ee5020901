"""Collisions and visuals of SDF as geoms of MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from describing import BOX, CUBE, Folder, link

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
    assert why == "MuJoCo has planes only where nothing moves"


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
