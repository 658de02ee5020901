"""Joints of SDF: types, limits, dynamics, loops, and what drives them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from describing import Folder, joint, link, positions

HINGE, SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
TWO = link("a") + link("b", pose="0 0 1 0 0 0")
AXIS = "<axis><xyz>1 0 0</xyz></axis><axis2><xyz>0 1 0</xyz></axis2>"


@pytest.mark.parametrize(
    ("kind", "more", "expected"),
    [
        ("revolute", "", {"joint": HINGE}),
        ("continuous", "", {"joint": HINGE}),
        ("prismatic", "", {"joint": SLIDE}),
        ("ball", "", {"joint": mujoco.mjtJoint.mjJNT_BALL}),
        ("universal", AXIS, {"joint/axis": HINGE, "joint/axis2": HINGE}),
        ("revolute2", AXIS, {"joint/axis": HINGE, "joint/axis2": HINGE}),
        ("screw", "", {"joint/turn": HINGE, "joint/slide": SLIDE}),
        ("fixed", "", {}),
    ],
)
def test_every_type_of_joint_has_its_degrees_of_freedom(folder, kind, more, expected) -> None:
    axis = "<xyz>1 0 0</xyz>" if not more and kind not in ("ball", "fixed") else ""
    model = folder.model(TWO + joint(kind, "a", "b", axis, more=more))
    found = {model.joint(index).name: model.joint(index).type for index in range(model.njnt)}
    assert found.pop("a/free") == mujoco.mjtJoint.mjJNT_FREE
    assert found == expected
    assert model.body("b").parentid == model.body("a").id


def test_limits_damping_friction_and_spring(folder: Folder) -> None:
    axis = (
        "<xyz>0 0.001 0</xyz><limit><lower>-1</lower><upper>0.5</upper><effort>7</effort></limit>"
        "<dynamics><damping>0.2</damping><friction>0.3</friction>"
        "<spring_stiffness>4</spring_stiffness><spring_reference>0.1</spring_reference></dynamics>"
    )
    model = folder.model(TWO + joint("revolute", "a", "b", axis))
    made = model.joint("joint")
    np.testing.assert_allclose(made.axis, [0, 1, 0])
    np.testing.assert_allclose(made.range, [-1, 0.5])
    np.testing.assert_allclose(model.jnt_actfrcrange[made.id], [-7, 7])
    assert made.damping[0] == 0.2
    assert made.frictionloss == 0.3
    assert np.ravel(made.stiffness)[0] == 4
    assert model.qpos_spring[made.qposadr[0]] == 0.1


def test_without_limits_a_joint_has_none(folder: Folder) -> None:
    axis = "<limit><lower>-1e16</lower><upper>1e16</upper></limit>"
    assert not folder.model(TWO + joint("revolute", "a", "b", axis)).joint("joint").limited
    axis = "<limit><lower>-1</lower><upper>1</upper></limit>"
    assert not folder.model(TWO + joint("continuous", "a", "b", axis)).joint("joint").limited


def test_axes_of_old_files_are_in_the_frame_of_the_model(folder: Folder) -> None:
    turned = link("b", pose="0 0 0 0 0 1.5707963267948966")
    text = link("a") + turned + joint("revolute", "a", "b", "<xyz>1 0 0</xyz>")
    np.testing.assert_allclose(
        folder.model(text, version="1.4").joint("joint").axis, [0, -1, 0], atol=1e-9
    )
    np.testing.assert_allclose(
        folder.model(text, version="1.5").joint("joint").axis, [1, 0, 0], atol=1e-9
    )


def test_the_world_holds_what_is_joined_to_it(folder: Folder) -> None:
    model = folder.model(TWO + joint("fixed", "world", "a") + joint("revolute", "a", "b", name="j"))
    assert model.nv == 1
    assert model.body("a").parentid == 0


FOUR_BARS = "".join(
    link(name, pose=f"{x} 0 {z} 0 0 0")
    for name, x, z in (("a", 0, 0), ("b", 0, 1), ("c", 1, 1), ("d", 1, 0))
)


def test_a_loop_of_hinges_holds_together_and_moves_in_one_way(folder: Folder) -> None:
    text = FOUR_BARS + joint("fixed", "world", "a", name="base")
    for parent, child in ("ab", "bc", "cd", "da"):
        text += joint("revolute", parent, child, "<xyz>0 1 0</xyz>", name=parent + child)
    converted = folder.convert(f'<model name="robot">{text}</model>')
    assert [note.path for note in converted.differences] == ["model[robot]/joint[cd]"]
    model = converted.spec.compile()
    assert (model.njnt, model.neq) == (3, 2)
    model.opt.gravity = 0
    data = positions(model)
    data.qvel[0] = 0.5
    gap_before = positions(model).body("d").xpos - data.body("c").xpos
    for _ in range(200):
        mujoco.mj_step(model, data)
    gap = data.body("d").xmat.reshape(3, 3).T @ (data.body("c").xpos - data.body("d").xpos)
    assert abs(data.qpos[0]) > 0.02
    np.testing.assert_allclose(np.linalg.norm(gap), np.linalg.norm(gap_before), atol=5e-3)


def test_a_weld_closes_a_loop_of_fixed_joints(folder: Folder) -> None:
    text = FOUR_BARS + "".join(
        joint("fixed", parent, child, name=parent + child)
        for parent, child in ("ab", "bc", "cd", "ad")
    )
    model = folder.model(text)
    assert model.neq == 1
    data = positions(model)
    np.testing.assert_allclose(data.efc_pos, 0, atol=1e-9)


def test_a_joint_follows_another_one(folder: Folder) -> None:
    mimic = '<mimic joint="lead"><multiplier>2</multiplier><offset>0.1</offset></mimic>'
    text = TWO + link("c") + joint("revolute", "world", "a", "<xyz>0 0 1</xyz>", name="lead")
    text += joint("revolute", "world", "b", f"<xyz>0 0 1</xyz>{mimic}", name="follow")
    text += joint("fixed", "world", "c", name="still")
    model = folder.model(text, version="1.11")
    data = positions(model)
    data.joint("lead").qpos[0], data.joint("follow").qpos[0] = 0.3, 0.7
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos, 0, atol=1e-12)


def controller(kind: str, more: str) -> str:
    return (
        f'<plugin filename="x" name="gz::sim::systems::{kind}"><joint_name>joint</joint_name>'
        f"{more}</plugin>"
    )


def test_joint_controllers_become_actuators(folder: Folder) -> None:
    driven = TWO + joint("revolute", "a", "b", "<xyz>0 0 1</xyz>")
    gains = "<p_gain>50</p_gain><d_gain>5</d_gain><cmd_min>-9</cmd_min><cmd_max>8</cmd_max>"
    servo = folder.model(driven + controller("JointPositionController", gains)).actuator("joint")
    assert servo.gainprm[0] == 50
    np.testing.assert_allclose(servo.biasprm[:3], [0, -50, -5])
    np.testing.assert_allclose(servo.forcerange, [-9, 8])
    wheel = folder.model(driven + controller("JointController", "<p_gain>3</p_gain>"))
    np.testing.assert_allclose(wheel.actuator("joint").biasprm[:3], [0, 0, -3])


def test_a_controller_of_an_unknown_joint_is_a_problem(folder: Folder) -> None:
    (problem,) = folder.problems(TWO + controller("JointController", ""))
    assert problem.endswith("there is no joint with one axis called 'joint'")


def test_what_a_servo_of_mujoco_lacks_is_listed(folder: Folder) -> None:
    driven = TWO + joint("revolute", "a", "b", "<xyz>0 0 1</xyz>")
    gains = "<p_gain>1</p_gain><d_gain>2</d_gain><cmd_offset>3</cmd_offset>"
    notes = folder.notes(driven + controller("JointController", gains))
    assert {path.rpartition("/")[2] for path in notes} >= {"d_gain", "cmd_offset"}
    notes = folder.notes(driven + controller("JointPositionController", gains.replace("3", "0")))
    assert not [path for path in notes if path.endswith(("d_gain", "cmd_offset"))]
