"""Stubs of messages: a type checker knows the fields of packets, and so does an editor."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from message_values import message_classes
from mypy import api as mypy
from needs import COMPILER, require

from neuros.cli.main import main
from neuros.messages.stubs import write_stubs

ROOT = Path(__file__).resolve().parents[2]
WHISKEYE = ROOT / "examples/4_neurorobotics/whiskeye/custom_messages.json"
PLUGIN = """
import neuros
import numpy as np
from geometry_msgs.msg import Vector3
from neuros.hooks import neuros_function
from sensor_msgs.msg import Image, Imu, JointState
from std_msgs.srv import Nothing
from whiskeye_msgs.msg import BodyToBrain

@neuros_function(inputs=["imu", "body"], outputs="joints")
def integrate(node: neuros.NodeHandle, imu: Imu, body: BodyToBrain) -> JointState:
    joints: JointState = node.make_packet("joints")
    joints.position = [imu.angular_velocity.z, 2.0]
    joints.velocity = np.zeros(2)
    joints.name = ["left", "right"]
    joints.header.stamp.sec = 1
    imu.orientation_covariance[0] = 1.0
    imu.linear_acceleration = Vector3(x=1.0, y=float(joints.position[0]))
    image: Image = body.left_camera
    image.data = bytes(image.height * image.step)
    return joints
"""
WRONG = {
    "imu.angular_velocity.z": ("imu.angular_velocty.z", '"Imu" has no attribute "angular_velocty"'),
    "stamp.sec = 1": ("stamp.sec = 1.5", 'variable has type "int"'),
    'make_packet("joints")': ('make_paket("joints")', '"NodeHandle" has no attribute "make_paket"'),
    "Vector3(x=1.0": ("Vector3(u=1.0", 'Unexpected keyword argument "u" for "Vector3"'),
    "body.left_camera": ("body.left_eye", '"BodyToBrain" has no attribute "left_eye"'),
}


@pytest.fixture
def checked(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., list[str]]:
    """What mypy says is wrong with files, where the stubs are in a folder."""
    cache = tmp_path_factory.getbasetemp() / "mypy_cache"  # of all tests here

    def check(*paths: Path, stubs: Path) -> list[str]:
        monkeypatch.setenv("MYPYPATH", f"{stubs}:{ROOT}")
        options = ["--strict", "--config-file=", "--follow-imports=silent", f"--cache-dir={cache}"]
        output, errors, _ = mypy.run([*options, *map(str, paths)])
        assert not errors
        return re.findall(r"error: .*", output)

    return check


@pytest.fixture(scope="module")
def typings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    require(*COMPILER)
    folder = tmp_path_factory.mktemp("stubs") / "typings"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.path", [*sys.path])  # the command adds built messages
        assert main(["types", str(WHISKEYE), "-o", str(folder)]) == 0
    return folder


def test_a_plugin_with_annotations_is_checked(
    typings: Path, tmp_path: Path, checked: Callable[..., list[str]]
) -> None:
    plugin = tmp_path / "plugin.py"
    plugin.write_text(PLUGIN)
    assert checked(plugin, stubs=typings) == []


def test_what_a_message_does_not_have_is_named(
    typings: Path, tmp_path: Path, checked: Callable[..., list[str]]
) -> None:
    text = PLUGIN
    for right, (wrong, _) in WRONG.items():
        assert right in text
        text = text.replace(right, wrong)
    plugin = tmp_path / "plugin.py"
    plugin.write_text(text)
    found = checked(plugin, stubs=typings)
    assert len(found) == len(WRONG), found
    for _, said in WRONG.values():
        assert any(said in each for each in found), (said, found)


def test_every_message_of_ros_has_a_stub_that_is_right(
    tmp_path: Path, checked: Callable[..., list[str]]
) -> None:
    types = {
        "/".join((*each.__module__.split(".")[:2], each.__name__)) for each in message_classes()
    }
    files = write_stubs(types, tmp_path)
    found = {
        f"{file.parent.parent.name}/msg/{name}"
        for file in files
        for name in re.findall(r"^class (\w+):", file.read_text(), re.MULTILINE)
    }
    assert types <= found
    assert checked(*files, stubs=tmp_path) == []


def test_pyright_finds_services_beside_the_stubs_and_no_import_without_use(tmp_path: Path) -> None:
    write_stubs(["sensor_msgs/msg/Imu"], tmp_path)
    assert (tmp_path / "sensor_msgs/srv/__init__.pyi").is_file()
    assert not (tmp_path / "builtin_interfaces/srv").exists()
    for file in tmp_path.rglob("msg/__init__.pyi"):
        text = file.read_text()
        for name in re.findall(r"^(?:from .+ )?import ([\w.]+)(?: as np)?$", text, re.MULTILINE):
            used = {"numpy": "np"}.get(name, name)
            assert re.search(rf"(?<![\w.]){re.escape(used)}[\[.\],]", text), (file, name)


def test_a_folder_that_cannot_be_written_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").touch()
    assert main(["types", str(ROOT / "examples/1_tick/clock"), "-o", str(tmp_path / "taken")]) == 2
    assert "taken: cannot be written (Not a directory)" in capsys.readouterr().err
