"""The links of a converted model are where SDF says, also once the joints have moved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from kinematics import DrawnModel, models, moved
from neuros_robots.elements import Finder
from neuros_robots.sdf import convert_sdf

many = settings(
    max_examples=30,
    deadline=None,
    phases=(Phase.explicit, Phase.generate, Phase.shrink),  # explaining takes minutes
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def compiled(model: DrawnModel, folder: Path) -> Any:
    file = folder / "model.sdf"
    file.write_text(f'<sdf version="1.9">{model.text}</sdf>', "utf-8")
    return convert_sdf(file, Finder()).spec.compile()


def name_in_mujoco(name: str) -> str:
    return name.replace("::", "/")


@many
@given(model=models(), data=st.data())
def test_links_are_where_frames_and_joints_put_them(
    model: DrawnModel, data: st.DataObject, tmp_path: Path
) -> None:
    compiled_model = compiled(model, tmp_path)
    state = mujoco.MjData(compiled_model)
    positions = {joint.name: data.draw(st.floats(-2, 2)) for joint in model.joints}
    for name, position in positions.items():
        state.joint(name_in_mujoco(name)).qpos[0] = position
    mujoco.mj_kinematics(compiled_model, state)
    for name, place in moved(model, positions).items():
        body = state.body(name_in_mujoco(name))
        np.testing.assert_allclose(body.xpos, place[:3, 3], atol=1e-9)
        np.testing.assert_allclose(body.xmat.reshape(3, 3), place[:3, :3], atol=1e-9)


@many
@given(model=models())
def test_links_weigh_what_they_weighed(model: DrawnModel, tmp_path: Path) -> None:
    compiled_model = compiled(model, tmp_path)
    for name, (mass, inside, tensor) in model.inertias.items():
        body = compiled_model.body(name_in_mujoco(name))
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, body.iquat)
        turned = turned.reshape(3, 3)
        expected = inside[:3, :3] @ tensor @ inside[:3, :3].T
        np.testing.assert_allclose(body.mass[0], mass, rtol=1e-12)
        np.testing.assert_allclose(body.ipos, inside[:3, 3], atol=1e-12)
        np.testing.assert_allclose(turned @ np.diag(body.inertia) @ turned.T, expected, atol=1e-8)


@many
@given(model=models(), data=st.data())
def test_a_written_file_has_the_same_links_as_far_as_it_has_digits(
    model: DrawnModel, data: st.DataObject, tmp_path: Path
) -> None:
    compiled(model, tmp_path)
    xml = convert_sdf(tmp_path / "model.sdf", Finder()).spec.to_xml()
    again = mujoco.MjModel.from_xml_string(xml)
    state = mujoco.MjData(again)
    mujoco.mj_kinematics(again, state)
    for name, place in moved(model, {joint.name: 0.0 for joint in model.joints}).items():
        body = state.body(name_in_mujoco(name))
        np.testing.assert_allclose(body.xpos, place[:3, 3], atol=1e-4)
