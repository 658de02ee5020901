"""Worlds, includes, sensors, lights, and computed inertias."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from describing import BOX, Folder, joint, link, positions

SHAPE = f'<collision name="hull">{BOX}</collision>'


def included(folder: Folder, name: str, inside: str) -> None:
    folder.write(f"{name}/model.config", f'<model><sdf version="1.9">{name}.sdf</sdf></model>')
    folder.write(
        f"{name}/{name}.sdf", f'<sdf version="1.9"><model name="{name}">{inside}</model></sdf>'
    )


def test_a_world_has_its_models_gravity_and_time_step(folder: Folder) -> None:
    included(folder, "ball", link("core", SHAPE, pose="0 0 1 0 0 0"))
    world = (
        "<gravity>0 0 -1.6</gravity><physics name='p' type='ode'>"
        "<max_step_size>0.004</max_step_size></physics>"
        "<include><uri>model://ball</uri><name>one</name><pose>5 0 0 0 0 0</pose></include>"
        "<include><uri>model://ball</uri><name>two</name><static>true</static></include>"
        f'<model name="three"><static>1</static>{link("core", SHAPE)}</model>'
    )
    model = folder.convert(f'<world name="moon">{world}</world>').spec.compile()
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -1.6])
    assert model.opt.timestep == 0.004
    np.testing.assert_allclose(positions(model).body("one/core").xpos, [5, 0, 1])
    assert [model.joint(index).name for index in range(model.njnt)] == ["one/core/free"]
    assert {"two/core", "three/core"} <= {model.body(index).name for index in range(model.nbody)}


def test_what_is_static_holds_for_the_models_inside(folder: Folder) -> None:
    inner = f'<model name="inner">{link("core")}</model>'
    assert folder.model(f"<static>true</static>{inner}").nv == 0


def test_a_merged_include_is_part_of_the_model_around_it(folder: Folder) -> None:
    arm = link("upper", pose="0 0 1 0 0 0") + '<frame name="tip" attached_to="upper"/>'
    included(folder, "arm", arm)
    text = link("base") + (
        '<include merge="true"><uri>model://arm</uri><pose>1 0 0 0 0 0</pose></include>'
        + joint("fixed", "base", "upper")
    )
    model = folder.model(text)
    np.testing.assert_allclose(positions(model).body("upper").xpos, [1, 0, 1])
    assert model.site("tip").bodyid == model.body("upper").id


def test_a_model_that_includes_itself_is_a_problem(folder: Folder) -> None:
    (problem,) = folder.problems("<include>\n<uri>model.sdf</uri></include>")
    assert problem.startswith("4:1: model[robot]/include/uri: the file includes itself: model.sdf")


def test_an_imu_measures_in_its_own_frame(folder: Folder) -> None:
    noise = '<noise type="gaussian"><stddev>0.01</stddev></noise>'
    imu = f"<imu><angular_velocity><x>{noise}</x></angular_velocity></imu>"
    sensor = f'<sensor name="imu" type="imu"><pose>0 0 0 {math.pi / 2!r} 0 0</pose>{imu}</sensor>'
    model = folder.model(link("base", sensor) + joint("fixed", "world", "base"))
    reading = positions(model).sensor("base/imu/accelerometer").data
    np.testing.assert_allclose(reading, [0, 9.81, 0], atol=1e-9)
    assert model.sensor("base/imu/gyro").noise == 0.01


def test_a_camera_looks_along_x_with_its_field_of_view(folder: Folder) -> None:
    image = "<image><width>640</width><height>480</height></image>"
    camera = f"<camera><horizontal_fov>1.57</horizontal_fov>{image}</camera>"
    sensor = f'<sensor name="eye" type="camera"><pose>1 0 0 0 0 0.5</pose>{camera}</sensor>'
    model = folder.model(link("base", sensor))
    axes = positions(model).camera("base/eye").xmat.reshape(3, 3)
    np.testing.assert_allclose(-axes[:, 2], [math.cos(0.5), math.sin(0.5), 0], atol=1e-9)
    np.testing.assert_allclose(axes[:, 1], [0, 0, 1], atol=1e-9)
    expected = 2 * math.atan(math.tan(1.57 / 2) * 480 / 640)
    assert model.camera("base/eye").fovy == pytest.approx(math.degrees(expected))


def test_a_lidar_has_a_ray_for_every_sample(folder: Folder) -> None:
    scan = "<samples>3</samples><min_angle>-1.5707963</min_angle><max_angle>1.5707963</max_angle>"
    lidar = (
        f"<lidar><scan><horizontal>{scan}</horizontal></scan><range><max>9</max></range></lidar>"
    )
    wall = link("wall", SHAPE, pose="0 4 0 0 0 0") + joint("fixed", "world", "wall", name="w")
    sensor = f'<sensor name="scan" type="gpu_lidar">{lidar}</sensor>'
    model = folder.model(wall + link("base", sensor) + joint("fixed", "world", "base"))
    data = positions(model)
    distances = [data.sensor(f"base/scan/{ray}").data[0] for ray in range(3)]
    np.testing.assert_allclose(distances, [-1, -1, 3], atol=1e-6)


def test_a_force_torque_sensor_feels_the_weight_below_its_joint(folder: Folder) -> None:
    sensor = '<sensor name="felt" type="force_torque"/>'
    text = link("base") + link("hand", mass=2) + joint("fixed", "world", "base", name="w")
    text += joint("fixed", "base", "hand", more=sensor)
    force = positions(folder.model(text)).sensor("joint/felt/force").data
    np.testing.assert_allclose(force, [0, 0, 2 * 9.81], atol=1e-9)
    assert "with the opposite sign in MuJoCo" in folder.notes(text).values()
    upwards = "<force_torque><measure_direction>parent_to_child</measure_direction></force_torque>"
    same = text.replace(sensor, f'<sensor name="felt" type="force_torque">{upwards}</sensor>')
    assert not folder.notes(same)


def test_lights_shine_where_they_shone(folder: Folder) -> None:
    light = '<light name="sun" type="directional"><pose>0 0 9 0 0 0</pose>'
    light += "<direction>1 0 -1</direction><diffuse>0.5 0.6 0.7 1</diffuse></light>"
    made = folder.convert(f'<world name="w">{light}</world>').spec.compile().light("sun")
    np.testing.assert_allclose(made.pos, [0, 0, 9])
    np.testing.assert_allclose(made.dir, np.array([1, 0, -1]) / math.sqrt(2))
    np.testing.assert_allclose(made.diffuse, [0.5, 0.6, 0.7])


def test_a_mass_can_be_computed_from_shapes(folder: Folder) -> None:
    box = f'<collision name="hull"><density>2</density>{BOX}</collision>'
    model = folder.model(f'<link name="base"><inertial auto="true"/>{box}</link>', version="1.11")
    assert model.body("base").mass == pytest.approx(2 * 1 * 2 * 3)


def test_a_link_without_gravity_floats(folder: Folder) -> None:
    model = folder.model(link("base", "<gravity>false</gravity>"))
    data = positions(model)
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qvel, 0)
