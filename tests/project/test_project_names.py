"""Namespaces and remapping rules: the same names as rclpy makes of them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.signals import SignalHandlerOptions

from neuros.errors import ProjectError
from neuros.project.load import load_project
from neuros.project.names import Names
from neuros.transport.messages import message_class

message_class("std_msgs/msg/Int32")  # loads parts of ROS that warn, where warnings are errors

WRITTEN = ("scan", "/scan", "~/scan", "lab/scan", "/lab/scan", "left")
RULES: tuple[tuple[tuple[str, str], ...], ...] = (
    (),
    (("scan", "other"),),
    (("/scan", "scan"),),
    (("~/scan", "~/private"), ("scan", "/public")),
    (("/left/scan", "/right/scan"), ("/right/scan", "/left/scan")),
    (("camera:scan", "one"), ("scan", "all")),
    (("somebody:scan", "one"),),
    (("lab/scan", "scan"), ("/lab/scan", "/scan")),
)


@pytest.fixture(scope="module")
def context() -> Iterator[rclpy.Context]:
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    yield context
    rclpy.shutdown(context=context)


@pytest.mark.parametrize("rules", RULES, ids=lambda rules: ",".join(old for old, _ in rules))
@pytest.mark.parametrize("namespace", ["", "/left"])
def test_names_are_those_of_rclpy(
    namespace: str, rules: tuple[tuple[str, str], ...], context: rclpy.Context
) -> None:
    names = Names(namespace, rules)
    node = rclpy.create_node(
        "camera",
        context=context,
        namespace=namespace,
        cli_args=names.ros_arguments,
        start_parameter_services=False,
    )
    found = {name: names.resolve(name, "camera") for name in WRITTEN}
    assert found == {name: node.resolve_topic_name(name) for name in WRITTEN}
    node.destroy_node()


def write(folder: Path, **keys: object) -> Path:
    node = {
        "name": "camera",
        "container": "neuros_python",
        "plugin": "camera.py",
        "outputs": [{"name": "x", "type": "std_msgs/msg/String"}],
        "inputs": [
            {"name": "x", "type": "std_msgs/msg/String"},
            {"name": "e", "type": "std_msgs/msg/String", "external_topic": "e"},
        ],
    }
    ends = dict(zip(("source_node", "source_output"), ("camera", "x"), strict=True))
    ends |= dict(zip(("destination_node", "destination_input"), ("camera", "x"), strict=True))
    (folder / "camera.py").touch()
    (folder / "project.json").write_text(
        json.dumps({"nodes": [node], "connections": [ends], **keys})
    )
    return folder


@pytest.mark.parametrize("written", ["/left", "left"])
def test_a_namespace_moves_the_topics_of_connections(written: str, tmp_path: Path) -> None:
    project = load_project(write(tmp_path, namespace=written), workspace=tmp_path).project
    assert project.names.namespace == "/left"
    assert project.connections[0].topic == "/left/neuros/camera/x/camera/x"


def test_the_command_line_goes_before_the_project(tmp_path: Path) -> None:
    write(tmp_path, namespace="/left", remap={"e": "project", "f": "kept"})
    names = load_project(
        tmp_path, workspace=tmp_path, namespace="/", remap=["e:=mine", "e:=late", "g:=/added"]
    ).project.names
    assert names == Names("", (("e", "mine"), ("g", "/added"), ("f", "kept")))
    assert names.resolve("e", "camera") == "/mine"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("x", "--remap x: character 1: /remap: is not a rule"),
        ("x=y", "is not a rule"),
        (":=y", "is not a rule"),
        ("__ns:=/x", "'__ns' is not remapped (use --namespace)"),
        ("camera:__node:=x", "'camera:__node' is not remapped"),
        ("x:=2y", "--remap x:=2y: character 4: /remap/x: '2y' is not allowed as new name"),
        ("x y:=z", "'x y' is not allowed as a name here"),
        ("camrea:x:=y", "there is no node 'camrea' (did you mean 'camera'?)"),
    ],
)
def test_a_rule_that_is_none_is_explained(text: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ProjectError) as error:
        load_project(write(tmp_path), workspace=tmp_path, remap=[text])
    assert complaint in str(error.value)


def test_a_namespace_that_is_none_is_explained(tmp_path: Path) -> None:
    for text in ("2", "a b", "a//b", "~", "a/"):
        with pytest.raises(ProjectError, match="is not allowed as namespace"):
            load_project(write(tmp_path), workspace=tmp_path, namespace=text)


def test_no_name_is_longer_than_dds_allows(tmp_path: Path) -> None:
    write(tmp_path)
    other = len("/neuros/camera/x/camera/x/data")
    longest = "/" + "n" * (247 - other - 1)
    project = load_project(tmp_path, workspace=tmp_path, namespace=longest).project
    assert len(f"{project.connections[0].topic}/data") == 247
    with pytest.raises(ProjectError, match="is longer than the 247 characters that ROS allows"):
        load_project(tmp_path, workspace=tmp_path, namespace=f"{longest}n")
