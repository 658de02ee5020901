"""The model's own sensors, laser scans, depth and transforms, against physics and geometry."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from simulated_node import SimulatedNode, stamp_ns
from trajectory_msgs.msg import JointTrajectoryPoint

from neuros.errors import ModelError
from neuros.simulators.mujoco import MuJoCo
from neuros.testing import PluginHarness

FLOAT, FLOATS = "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray"
VECTOR, WRENCH = "geometry_msgs/msg/Vector3Stamped", "geometry_msgs/msg/WrenchStamped"
G, MASS_KG = 9.81, 2.0

WORLD = """
<mujoco>
  <option timestep="0.01"/>
  <visual><map znear="0.001" zfar="20"/></visual>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 .1"/>
    <geom name="wall" type="box" pos="3 0 1" size=".5 9 1"/>
    <geom name="pole" type="box" pos="2 -.4 .3" size=".05 .05 .3"/>
    <camera name="high" pos="0 0 1" xyaxes="0 -1 0 0 0 1"/>
    <camera name="eye" pos="0 0 .3" xyaxes="0 -1 0 0 0 1"/>
    <camera name="lens" pos="0 0 .3" xyaxes="0 -1 0 0 0 1" resolution="80 60" sensorsize=".008 .006"
            focal=".01 .01" principal=".001 .0005"/>
    <camera name="flat" pos="0 0 1" projection="orthographic" fovy="2"/>
    <body name="base" pos="0 0 1">
      <body name="scanner" pos="0.5 0 0" euler="0 0 90">
        <geom name="housing" type="sphere" size=".05" mass="1"/>
        <site name="laser" euler="0 0 -90"/>
        <body name="arm" pos="0 0 .5">
          <joint name="swing" axis="0 0 1" pos="0 0 0"/>
          <geom type="box" size=".05 .05 .01" mass="2" contype="0" conaffinity="0" group="3"/>
          <site name="wrist"/>
        </body>
      </body>
    </body>
  </worldbody>
  <sensor>
    <force name="wrist_force" site="wrist"/>
    <torque name="wrist_torque" site="wrist"/>
    <accelerometer name="wrist_acceleration" site="wrist"/>
    <gyro name="wrist_gyro" site="wrist"/>
    <magnetometer name="compass" site="wrist" noise="0.1"/>
    <rangefinder name="ahead" site="wrist"/>
    <touch name="touch" site="wrist"/>
    <jointpos name="swing_angle" joint="swing"/>
    <jointvel name="swing_speed" joint="swing"/>
    <framepos name="wrist_at" objtype="site" objname="wrist"/>
    <framepos name="wrist_in_scanner" objtype="site" objname="wrist"
              reftype="site" refname="laser"/>
    <framequat name="wrist_turned" objtype="site" objname="wrist"/>
    <subtreecom name="middle" body="base"/>
    <clock name="time"/>
  </sensor>
</mujoco>
"""


def output(sensor, type_, element=None, **keys):
    element = {} if element is None else {"element": element}
    return type_, {"sensor": sensor, "rate": 10, **element, **keys}


def reading(name, type_):
    return output("reading", type_, name)


def read(**outputs):
    """The packets after 0.1 s, of an arm that has turned with 2 rad/s."""
    node = SimulatedNode(outputs)
    sim = MuJoCo(node, WORLD)
    sim.data.qvel[:] = 2.0
    sim.step_to_next()
    packets = {name: sim.read(name) for name in outputs}
    node.close()
    return packets if len(packets) > 1 else next(iter(packets.values()))


def problems_of(**outputs):
    with pytest.raises(ModelError) as caught:
        MuJoCo(SimulatedNode(outputs), WORLD)
    return str(caught.value)


def xyz(vector):
    return [vector.x, vector.y, vector.z]


# ---- sensors of the model


def test_a_force_sensor_feels_the_weight_it_carries():
    """What the arm does to the scanner: it pulls downwards, along the axes of the site."""
    wrench = read(force=reading("wrist_force", WRENCH))
    assert xyz(wrench.wrench.force) == pytest.approx([0, 0, MASS_KG * G], abs=1e-6)
    assert xyz(wrench.wrench.torque) == [0, 0, 0]
    assert (wrench.header.frame_id, stamp_ns(wrench)) == ("wrist", 100_000_000)


def test_a_wrench_of_a_torque_sensor_has_the_torque_only():
    wrench = read(torque=reading("wrist_torque", WRENCH)).wrench
    assert xyz(wrench.force) == [0, 0, 0]
    assert xyz(wrench.torque) == pytest.approx([0, 0, 0], abs=1e-9)


def test_three_numbers_are_a_vector_in_the_frame_in_which_they_are_measured():
    packets = read(
        gyro=reading("wrist_gyro", VECTOR),
        at=reading("wrist_at", VECTOR),
        relative=reading("wrist_in_scanner", "geometry_msgs/msg/PointStamped"),
        middle=reading("middle", "geometry_msgs/msg/PointStamped"),
        bare=reading("wrist_acceleration", "geometry_msgs/msg/Vector3"),
    )
    assert xyz(packets["gyro"].vector) == pytest.approx([0, 0, 2])
    assert packets["gyro"].header.frame_id == "wrist"
    assert xyz(packets["at"].vector) == pytest.approx([0.5, 0, 1.5])
    assert packets["at"].header.frame_id == "world"
    assert xyz(packets["relative"].point) == pytest.approx([0, 0, 0.5])
    assert packets["relative"].header.frame_id == "laser"
    assert packets["middle"].header.frame_id == "world"
    assert xyz(packets["bare"]) == pytest.approx([0, 0, G])


def test_one_number_is_a_float_and_a_quaternion_has_its_real_part_last():
    packets = read(
        angle=reading("swing_angle", FLOAT),
        touch=reading("touch", FLOAT),
        turned=reading("wrist_turned", "geometry_msgs/msg/QuaternionStamped"),
    )
    assert packets["angle"].data == pytest.approx(0.2)
    assert packets["touch"].data == 0.0
    turned = packets["turned"].quaternion  # by a quarter (the scanner), and 0.2 rad of the arm
    half = (math.pi / 2 + 0.2) / 2
    assert [turned.w, *xyz(turned)] == pytest.approx([math.cos(half), 0, 0, math.sin(half)])


def test_a_range_finder_that_sees_nothing_says_infinity_and_a_compass_its_variance():
    packets = read(
        ahead=reading("ahead", "sensor_msgs/msg/Range"),
        raw=reading("ahead", FLOAT),
        compass=reading("compass", "sensor_msgs/msg/MagneticField"),
    )
    assert (packets["ahead"].range, packets["raw"].data) == (math.inf, -1.0)  # it looks up
    assert packets["compass"].magnetic_field_covariance[4] == pytest.approx(0.01)


def test_any_sensors_are_a_list_of_numbers():
    names = ["time", "wrist_gyro", "swing_speed", "wrist_turned"]
    found = list(read(all=reading(names, FLOATS)).data)
    assert found[:5] == pytest.approx([0.1, 0, 0, 2, 2])
    assert len(found) == 9


def test_what_does_not_fit_is_named_with_what_does():
    text = problems_of(gyro=reading("wrist_gyro", FLOAT), angle=reading("swing_angle", WRENCH))
    assert (
        "/outputs/0/mujoco/element: the gyro 'wrist_gyro' measures 3 numbers, which fill"
        " geometry_msgs/msg/Vector3 or geometry_msgs/msg/Vector3Stamped or"
        " std_msgs/msg/Float64MultiArray, but output 'gyro' is a std_msgs/msg/Float64" in text
    )
    assert "the jointpos 'swing_angle' measures 1 number, which fill std_msgs/msg/Float64" in text


def test_a_sensor_that_is_not_there_is_told_with_the_nearest():
    text = problems_of(gyro=reading("wrist_giro", VECTOR))
    assert "the model has no sensor 'wrist_giro' (did you mean 'wrist_gyro'?)" in text


# ---- distances


def test_a_scan_goes_counter_clockwise_from_x_and_sees_the_wall():
    scan = read(
        scan=output(
            *("lidar", "sensor_msgs/msg/LaserScan", "laser"),
            beams=5,
            angle_min=-math.pi / 2,
            angle_max=math.pi / 2,
            range_max=8,
        )
    )
    # The site looks along x, 2 m before the wall, which is 18 m long.
    assert scan.ranges.tolist() == pytest.approx([math.inf, 2 * 2**0.5, 2, 2 * 2**0.5, math.inf])
    assert (scan.angle_increment, scan.range_max) == (pytest.approx(math.pi / 4), 8)
    assert (scan.header.frame_id, stamp_ns(scan)) == ("laser", 100_000_000)
    assert scan.scan_time == pytest.approx(0.1)


def test_of_a_body_it_looks_along_the_axes_of_that():
    """The scanner is turned by 90 degrees to the left: the wall is to its right."""
    keys = {"beams": 3, "angle_min": -math.pi / 2, "angle_max": math.pi / 2, "range_max": 8}
    scan = read(scan=output("lidar", "sensor_msgs/msg/LaserScan", "scanner", **keys))
    assert scan.ranges.tolist() == pytest.approx([2, math.inf, math.inf])


def test_what_is_too_close_is_minus_infinity():
    keys = {"beams": 2, "angle_min": 0.0, "angle_max": 0.1, "range_min": 2.5}
    scan = read(scan=output("lidar", "sensor_msgs/msg/LaserScan", "laser", **keys))
    assert scan.ranges.tolist() == [-math.inf, -math.inf]


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"beams": 1}, "/beams: 1 is not a number of beams from 2 to 100000"),
        ({"angle_min": 4}, "/angle_max: 3.14159 is not above angle_min, which is 4"),
        ({"range_max": -1}, "/range_max: -1 is not a distance in metres"),
        ({"width": 3}, "/width: unknown key"),
    ],
)
def test_a_scan_that_makes_no_sense_is_refused(keys, text):
    assert text in problems_of(scan=output("lidar", "sensor_msgs/msg/LaserScan", "laser", **keys))


def test_the_geometry_of_a_camera_is_that_of_a_pinhole():
    keys = {"width": 80, "height": 60}
    info = read(info=output("camera_info", "sensor_msgs/msg/CameraInfo", "eye", **keys))
    focal = 30 / math.tan(math.radians(45) / 2)
    assert info.k.tolist() == pytest.approx([focal, 0, 39.5, 0, focal, 29.5, 0, 0, 1])
    assert info.p.tolist() == pytest.approx([focal, 0, 39.5, 0, 0, focal, 29.5, 0, 0, 0, 1, 0])
    assert (info.width, info.height, info.distortion_model) == (80, 60, "plumb_bob")
    assert info.header.frame_id == "eye"


def test_an_orthographic_camera_is_none():
    text = problems_of(info=output("camera_info", "sensor_msgs/msg/CameraInfo", "flat"))
    assert "an orthographic camera is no pinhole" in text


@pytest.mark.needs("OpenGL")
@pytest.mark.parametrize("camera", ["eye", "lens"])
def test_points_of_a_depth_image_lie_on_the_wall_and_on_the_floor(camera):
    keys = {"width": 80, "height": 60}
    packets = read(
        depth=output("depth", "sensor_msgs/msg/Image", camera, **keys),
        points=output("depth", "sensor_msgs/msg/PointCloud2", camera, **keys),
        info=output("camera_info", "sensor_msgs/msg/CameraInfo", camera, **keys),
    )
    image, cloud, k = packets["depth"], packets["points"], packets["info"].k
    assert (image.encoding, image.step, cloud.point_step, cloud.row_step) == ("32FC1", 320, 12, 960)
    assert not cloud.is_dense
    depth = np.frombuffer(image.data, np.float32).reshape(60, 80)
    points = np.frombuffer(cloud.data, np.float32).reshape(60, 80, 3)
    rows, columns = np.mgrid[:60, :80]
    seen = np.isfinite(depth)
    assert np.isnan(points[~seen]).all()
    x, y, z = points[seen].T
    assert x == pytest.approx((columns[seen] - k[2]) * z / k[0], rel=1e-5, abs=1e-6)
    assert y == pytest.approx((rows[seen] - k[5]) * z / k[4], rel=1e-5, abs=1e-6)
    # The wall is 2.5 m away, the floor 0.3 m below (y points down), the pole 0.4 m to the right.
    on_wall, on_floor = np.abs(z - 2.5) < 0.01, np.abs(y - 0.3) < 0.01
    on_pole = (np.abs(x - 0.4) < 0.06) & (np.abs(z - 2) < 0.06)
    assert (on_wall | on_floor | on_pole).all()
    assert min(on_wall.sum(), on_floor.sum()) > 500
    assert on_pole.sum() > 50


@pytest.mark.needs("OpenGL")
def test_where_nothing_is_depth_is_infinite():
    image = read(depth=output("depth", "sensor_msgs/msg/Image", "high", width=8, height=80))
    column = np.frombuffer(image.data, np.float32).reshape(80, 8)[:, 0]
    assert column[0] == np.inf  # above the wall
    assert column[-1] == pytest.approx(1 / math.tan(math.radians(45) / 2 * 79 / 80), rel=0.01)


# ---- transforms


def transforms(monkeypatch, **keys):
    made = SimpleNamespace(transforms=[])
    monkeypatch.setattr(SimulatedNode, "make_packet", lambda self, output: made)
    read(tf=output("tf", "tf2_msgs/msg/TFMessage", **keys))
    return {t.child_frame_id: t for t in made.transforms}


def test_each_named_body_is_in_the_one_above_it(monkeypatch):
    found = transforms(monkeypatch)
    assert {name: t.header.frame_id for name, t in found.items()} == {
        "base": "world",
        "scanner": "base",
        "arm": "scanner",
    }
    arm = found["arm"].transform
    assert xyz(arm.translation) == pytest.approx([0, 0, 0.5])
    assert [arm.rotation.w, arm.rotation.z] == pytest.approx([math.cos(0.1), math.sin(0.1)])
    assert stamp_ns(found["arm"]) == 100_000_000


def test_elements_that_are_named_are_in_the_nearest_of_them(monkeypatch):
    found = transforms(monkeypatch, element=["base", "laser", "eye"])
    assert [t.header.frame_id for t in found.values()] == ["world", "base", "world"]
    laser = found["laser"].transform
    assert xyz(laser.translation) == pytest.approx([0.5, 0, 0])
    assert laser.rotation.w == pytest.approx(1)
    # The eye looks along x: its z axis is the world's x, its x axis the world's -y.
    w, x, y, z = (getattr(found["eye"].transform.rotation, axis) for axis in "wxyz")
    assert [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)] == pytest.approx(
        [1, 0, 0]
    )
    assert [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)] == pytest.approx(
        [0, -1, 0]
    )


# ---- the page


def test_the_rover_of_the_page_turns_its_head_and_sees_the_wall_from_there(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "simulators.md").read_text("utf-8")
    for name, text in re.findall(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```", page, re.M | re.S):
        (tmp_path / name).write_text(text)
    with PluginHarness.from_node_file(tmp_path / "rover.json", run_folder=tmp_path) as rover:
        rover.send("goal", JointTrajectoryPoint(positions=[0.5]))
        rover.run(executions=150)
        scans, gyros = rover.received("scan"), rover.received("gyro")
    assert 25 <= len(scans) < len(gyros)
    ranges = scans[-1].ranges
    # The wall is 2.5 m ahead of the rover, and 0.5 rad to the right of its head.
    assert len(ranges) == 181
    assert int(np.argmin(ranges)) - 90 == pytest.approx(math.degrees(-0.5), abs=2)
    assert min(ranges) == pytest.approx(2.5, rel=1e-3)
    assert sum(packet.vector.z for packet in gyros) / 50 == pytest.approx(0.5, abs=0.05)
