"""What observers are shown of a MuJoCo world: its geometry, and poses while they ask for them."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from simulated_node import SimulatedNode

from neuros.simulators.mujoco import MuJoCo
from neuros.simulators.mujoco.scene import WorldView, geometry

ALL = """
<mujoco>
  <asset>
    <mesh name="tetra" vertex="0 0 0  1 0 0  0 1 0  0 0 1"
          face="0 2 1  0 1 3  0 3 2  1 2 3"/>
    <hfield name="hill" nrow="3" ncol="2" size="1 2 .5 .1" elevation="0 0 1 0 0 0"/>
    <texture name="tiles" type="2d" builtin="checker" width="8" height="4" rgb1="1 0 0"
             rgb2="0 0 1"/>
    <texture name="wood" type="cube" builtin="flat" width="4" height="4" rgb1="0 1 0"
             rgb2="0 1 0"/>
    <material name="tiled" texture="tiles" texrepeat="3 5"/>
    <material name="red" rgba="1 0 0 1"/>
  </asset>
  <worldbody>
    <light pos="0 0 5" type="directional"/>
    <geom type="plane" size="1 1 .1" material="tiled"/>
    <geom type="hfield" hfield="hill"/>
    <geom type="sphere" size="1" rgba="1 1 1 0"/>
    <geom type="sphere" size="1" group="3"/>
    <body name="fixed" pos="1 2 3"><geom type="box" size=".1 .2 .3"/></body>
    <body name="target" mocap="true"><geom type="ellipsoid" size=".1 .2 .3"/></body>
    <body name="arm" pos="0 0 1"><joint name="turn" axis="0 0 1"/>
      <geom type="capsule" size=".1 .5" material="red"/>
      <geom type="cylinder" size=".1 .5" material="red" rgba="0 0 1 1"/>
      <body name="hand" pos="0 0 1"><geom type="mesh" mesh="tetra"/><site name="tip"/>
        <camera name="eye"/></body>
    </body>
    <camera name="tracker" mode="targetbody" target="arm" pos="3 0 2"/>
  </worldbody>
</mujoco>"""
TURNING = """
<mujoco><worldbody><geom type="plane" size="1 1 1"/>
  <body name="ball" pos="0 0 .099"><freejoint/><geom size=".1" rgba="1 0 0 1"/></body>
</worldbody></mujoco>"""


def array(text: str, kind: str) -> Any:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), kind)


def poses(frame: list[Any]) -> Any:
    return np.frombuffer(base64.b64decode(frame[2]), "<f4").reshape(-1, 7)


@pytest.fixture(scope="module")
def shown() -> dict[str, Any]:
    return json.loads(json.dumps(geometry(mujoco.MjModel.from_xml_string(ALL))))


def test_every_shape_is_shown_but_what_is_invisible_or_hidden(shown: dict[str, Any]) -> None:
    assert [geom["shape"] for geom in shown["geoms"]] == [
        *("plane", "mesh", "box", "ellipsoid", "capsule", "cylinder", "mesh")
    ]
    assert [light["type"] for light in shown["lights"]] == [1]


def test_a_geom_has_its_own_colour_or_that_of_its_material(shown: dict[str, Any]) -> None:
    capsule, cylinder = shown["geoms"][4:6]
    assert capsule["rgba"] == [1, 0, 0, 1]
    assert cylinder["rgba"] == [0, 0, 1, 1]


def test_what_moves_are_joints_mocap_bodies_and_what_hangs_on_them(shown: dict[str, Any]) -> None:
    names = [body["name"] for body in shown["bodies"]]
    assert [names[body] for body in shown["moving"]] == ["target", "arm", "hand"]
    assert [names[body] for body in shown["roots"]] == ["arm", "target"]
    assert [shown["cameras"][each]["name"] for each in shown["moving_cameras"]] == ["tracker"]
    assert shown["bodies"][names.index("fixed")]["pos"] == [1, 2, 3]


def test_a_camera_follows_what_joints_carry_from_so_far_as_that_extends() -> None:
    carried = geometry(
        mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody>
          <body name="slide_x"><joint type="slide"/>
            <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
            <body name="slide_y"><joint type="slide"/>
              <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
              <body name="robot" pos="5 0 1"><geom size="0.5"/>
                <body pos="2 0 0"><geom size="0.1"/></body>
              </body>
            </body>
          </body>
        </worldbody></mujoco>""")
    )
    (root,) = carried["roots"]
    assert carried["bodies"][root]["name"] == "robot"
    assert carried["reaches"] == pytest.approx([2.1])


def test_a_mesh_has_the_surface_of_the_model(shown: dict[str, Any]) -> None:
    mesh = shown["meshes"][shown["geoms"][-1]["mesh"]]
    points = array(mesh["position"], "<f4").reshape(-1, 3)[array(mesh["index"], "<u4")]
    normals = array(mesh["normal"], "<f4").reshape(-1, 3)
    assert len(points) == 12
    assert len(normals) == len(array(mesh["position"], "<f4")) / 3
    a, b, c = points.reshape(-1, 3, 3).transpose(1, 0, 2)
    volume = np.einsum("ij,ij", a, np.cross(b, c)) / 6  # of faces that look outwards
    assert volume == pytest.approx(1 / 6, rel=1e-5)


def test_a_height_field_is_a_surface(shown: dict[str, Any]) -> None:
    mesh = shown["meshes"][shown["geoms"][1]["mesh"]]
    points = array(mesh["position"], "<f4").reshape(3, 2, 3)
    assert points[:, :, 2].tolist() == [[0, 0], [0.5, 0], [0, 0]]
    assert points[0, 0, :2].tolist() == [-1, -2]
    assert points[2, 1, :2].tolist() == [1, 2]
    assert len(array(mesh["index"], "<u4")) == 3 * 2 * 2


def test_a_texture_has_its_pixels_and_how_often_it_is_repeated(shown: dict[str, Any]) -> None:
    plane = shown["geoms"][0]
    tiles = shown["textures"][plane["texture"]]
    assert (plane["repeat"], plane["is_uniform"]) == ([3, 5], False)
    pixels = array(tiles["rgba"], "u1").reshape(4, 8, 4)
    assert pixels[0, 0].tolist() == [255, 0, 0, 255]
    assert pixels[0, 4].tolist() == [0, 0, 255, 255]
    wood = next(each for each in shown["textures"] if each["kind"] == "cube")
    assert wood["mean"] == [0, 1, 0, 1]
    assert wood["rgba"] == ""


class Stepped:
    """A view of a ball that falls, on a clock of ours."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(TURNING)
        self.data = mujoco.MjData(self.model)
        self.now_s = 100.0
        self.view = WorldView(lambda: (self.model, self.data, self.data.time), lambda: self.now_s)
        mujoco.mj_forward(self.model, self.data)

    def step(self, count: int, wall_s: float) -> None:
        for _ in range(count):
            mujoco.mj_step(self.model, self.data)
            self.now_s += wall_s
            if self.view.is_watched:
                self.view.record()

    def look(self, asker: int = 1, **wanted: bool) -> dict[str, Any]:
        return self.view.observe(wanted, asker)

    def frames(self, asker: int = 1) -> list[list[Any]]:
        frames: list[list[Any]] = self.look(asker, frames=True)["frames"]
        return frames


def test_frames_are_noted_only_while_somebody_asks_for_them() -> None:
    world = Stepped()
    world.look()
    world.step(10, 0.05)
    assert not world.view.is_watched
    world.frames()
    world.step(4, 0.05)
    assert len(world.frames()) == 4
    world.step(100, 0.05)
    assert not world.view.is_watched


def test_there_are_at_most_30_frames_per_second() -> None:
    world = Stepped()
    world.frames()
    world.step(1000, 0.001)
    frames = world.frames()
    assert 28 <= len(frames) <= 31
    assert np.diff([frame[0] for frame in frames]).min() > 0.03
    assert frames[-1][1] == pytest.approx(world.data.time, abs=0.08)


def test_each_observer_gets_each_frame_once() -> None:
    world = Stepped()
    world.frames(1), world.frames(2)
    world.step(3, 0.05)
    first = world.frames(1)
    world.step(2, 0.05)
    assert [len(first), len(world.frames(1)), len(world.frames(2))] == [3, 2, 5]


def test_a_world_that_stands_still_is_shown_as_it_is_now() -> None:
    world = Stepped()
    world.step(100, 0.01)
    (frame,) = world.frames()
    assert poses(frame)[0] == pytest.approx([*world.data.qpos[:3], *world.data.qpos[3:]], abs=1e-3)


def test_nothing_is_read_while_a_step_may_be_under_way() -> None:
    world = Stepped()
    world.view.is_stepping = True
    assert world.frames() == []


def test_contacts_come_on_request() -> None:
    world = Stepped()
    (without,) = world.frames()
    (frame,) = world.look(frames=True, contacts=True)["frames"]
    assert len(without) == 3
    point, normal = np.frombuffer(base64.b64decode(frame[3]), "<f4").reshape(-1, 2, 3)[0]
    assert point == pytest.approx([0, 0, 0], abs=0.01)
    assert np.abs(normal) == pytest.approx([0, 0, 1])


def test_the_version_tells_of_changed_colours_and_of_another_model() -> None:
    world = Stepped()
    versions = [world.look()["version"], world.look()["version"]]
    world.model.geom_rgba[1] = (0, 1, 0, 1)
    versions.append(world.look()["version"])
    world.model = mujoco.MjModel.from_xml_string(ALL)
    world.data = mujoco.MjData(world.model)
    versions.append(world.look()["version"])
    assert versions[0] == versions[1]
    assert len({*versions}) == 3
    told = world.look(geometry=True)
    assert json.loads(told["geometry"])["version"] == told["version"] == versions[-1]


@pytest.mark.parametrize("is_watched", [False, True])
def test_the_simulation_is_the_same_with_and_without_a_view(
    tmp_path: Path, is_watched: bool
) -> None:
    node = SimulatedNode(folder=tmp_path)
    sim = MuJoCo(node, TURNING)
    look = node.look_at_world
    assert look is not None
    for _ in range(20):
        if is_watched:
            look({"frames": True, "contacts": True, "geometry": True}, 1)
        sim.step_synchronous(5)
    alone = mujoco.MjData(sim.model)
    mujoco.mj_step(sim.model, alone, nstep=100)
    assert sim.data.qpos.tolist() == alone.qpos.tolist()
    frames = look({"frames": True}, 1)["frames"]
    assert poses(frames[-1])[0, 2] == pytest.approx(sim.data.xpos[1, 2])


def test_an_entity_that_is_spawned_is_shown(tmp_path: Path) -> None:
    (tmp_path / "cube.xml").write_text(
        "<mujoco><worldbody><body name='b'><freejoint/><geom type='box' size='1 1 1'/></body>"
        "</worldbody></mujoco>"
    )
    node = SimulatedNode(folder=tmp_path)
    sim = MuJoCo(node, TURNING)
    look = node.look_at_world
    assert look is not None
    before = look({"frames": True}, 1)["version"]
    sim.spawn_entity(str(tmp_path / "cube.xml"), (0, 0, 5), "cube")
    told = look({"frames": True}, 1)
    assert told["version"] != before
    assert len(poses(told["frames"][-1])) == 2
    sim.close()
