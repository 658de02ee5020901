"""Policies in ONNX as nodes: what they are given, what they give, and what is refused."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from neuros_learn.policies import checks

import neuros
from neuros.api.loading import load_with_messages
from neuros.distribution import EXAMPLES
from neuros.errors import HookError, ProjectError, UsageError
from neuros.project.split import project_to_json
from neuros.testing import PluginHarness

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

EXAMPLE = EXAMPLES / "7_learning/cartpole/exported.json"
FLOAT, INT, DOUBLE = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64, onnx.TensorProto.DOUBLE
TEXT = onnx.TensorProto.STRING
JOINTS, NUMBER = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64"
TWIST, IMAGE = "geometry_msgs/msg/Twist", "sensor_msgs/msg/Image"
OBSERVED = ("joints.position[2]", "joints.velocity[2]")
Tensors = Sequence[tuple[str, int, Sequence[Any]]]


def write(
    file: Path,
    inputs: Tensors,
    outputs: Tensors,
    *steps: Sequence[Any],
    constants: Mapping[str, Any] = {},
    opset: int = 17,
    version: int = 8,
) -> Path:
    """A policy of steps (operator, its inputs, its outputs), for example ``"Add", "a b", "c"``."""
    helper = onnx.helper
    graph = helper.make_graph(
        [
            helper.make_node(kind, i.split(), o.split(), **dict(*more))
            for kind, i, o, *more in steps
        ],
        "policy",
        [helper.make_tensor_value_info(*each) for each in inputs],
        [helper.make_tensor_value_info(*each) for each in outputs],
        [onnx.numpy_helper.from_array(np.asarray(v), name) for name, v in constants.items()],
    )
    sets = [helper.make_opsetid("", opset)]
    onnx.save(helper.make_model(graph, opset_imports=sets, ir_version=version), file)
    return file


def linear(file: Path, *weights: float, batch: Any = "batch", **more: Any) -> Path:
    """A policy that sums its observations with these weights: ``obs -> act``."""
    return write(
        file,
        [("obs", FLOAT, [batch, len(weights)])],
        [("act", FLOAT, [batch, 1])],
        ("MatMul", "obs weights", "act"),
        constants={"weights": np.array(weights, np.float32)[:, None]},
        **more,
    )


def counting(file: Path, size: Any = 1) -> Path:
    """A policy with two states: it sums what it observes, and counts its calls."""
    return write(
        file,
        [("obs", FLOAT, [1, 1]), ("sum", FLOAT, [size, 1]), ("count", FLOAT, [1])],
        [("act", FLOAT, [1, 2]), ("next_sum", FLOAT, [size, 1]), ("next_count", FLOAT, [1])],
        ("Add", "obs sum", "next_sum"),
        ("Add", "count one", "next_count"),
        ("Reshape", "next_count row", "calls"),
        ("Concat", "next_sum calls", "act", {"axis": 1}),
        constants={"one": np.ones(1, np.float32), "row": np.array([1, 1])},
    )


def harness(
    policy: Path | str,
    inputs: Mapping[str, str],
    outputs: Mapping[str, str],
    folder: Path | None = None,
    copies: int | None = None,
    **parameters: Any,
) -> PluginHarness:
    """A node with the policy, whose file is beside it."""
    node = {
        "name": "policy",
        "container": "neuros_onnx",
        "policy": policy.name if isinstance(policy, Path) else policy,
        "inputs": [{"name": name, "type": kind} for name, kind in inputs.items()],
        "outputs": [{"name": name, "type": kind} for name, kind in outputs.items()],
        "parameters": parameters,
        **({} if copies is None else {"copies": copies}),
    }
    file = (policy.parent if isinstance(policy, Path) else folder or Path()) / "node.json"
    file.write_text(json.dumps(node))
    return PluginHarness.from_node_file(file)


def joints(node: PluginHarness, position: Sequence[float], velocity: Sequence[float]) -> Any:
    packet = node.make_packet("joints")
    packet.position, packet.velocity = position, velocity
    return packet


class TestMapping:
    """Which numbers of packets a policy is given, and where its actions go."""

    def test_the_numbers_of_a_list_are_joined_in_its_order(self, tmp_path: Path) -> None:
        file = linear(tmp_path / "p.onnx", 1, 10, 100, 1000)
        node = harness(file, {"joints": JOINTS}, {"force": NUMBER}, observation=OBSERVED)
        node.send("joints", joints(node, [1, 2], [3, 4]), joints(node, [4, 3], [2, 1]))
        node.run()
        assert [packet.data for packet in node.received("force")] == [4321.0, 1234.0]

    def test_without_a_list_all_numbers_of_the_ports_are_joined(self, tmp_path: Path) -> None:
        file = linear(tmp_path / "p.onnx", 1, 10, 100)
        node = harness(file, {"a": NUMBER, "b": "float32[2]"}, {"force": "float64[1]"})
        packet = node.make_packet("a")
        packet.data = 1.0
        node.send("a", packet)
        node.send("b", np.array([2, 3], np.float32))
        node.run()
        assert np.array_equal(node.received("force"), [[321.0]])

    def test_ports_with_the_names_of_inputs_and_outputs_are_theirs(self, tmp_path: Path) -> None:
        file = write(
            tmp_path / "p.onnx",
            [("left", DOUBLE, [2]), ("right", INT, [2])],
            [("sum", DOUBLE, [2]), ("same", INT, [2])],
            ("Cast", "right", "floats", {"to": DOUBLE}),
            ("Add", "left floats", "sum"),
            ("Identity", "right", "same"),
        )
        inputs = {"right": "int32[2]", "left": "float32[2]"}
        node = harness(file, inputs, {"same": "int64[2]", "sum": "float32[2]"})
        node.send("left", np.array([0.5, 1], np.float32))
        node.send("right", np.array([2, 3], np.int32))
        node.run()
        assert np.array_equal(node.received("sum"), [[2.5, 4.0]])
        assert np.array_equal(node.received("same"), [[2, 3]])

    def test_inputs_and_outputs_are_named_one_by_one(self, tmp_path: Path) -> None:
        file = write(
            tmp_path / "p.onnx",
            [("a.b", FLOAT, ["n", 1]), ("c", FLOAT, ["n", 1])],
            [("difference", FLOAT, ["n", 1]), ("value", FLOAT, ["n", 1])],
            ("Sub", "a.b c", "difference"),
            ("Add", "a.b c", "value"),
        )
        node = harness(
            file,
            {"twist": TWIST},
            {"force": NUMBER},
            observation={"c": "twist.linear.x", "a.b": "twist.angular.z"},
            action={"difference": "force"},
        )
        packet = node.make_packet("twist")
        packet.linear.x, packet.angular.z = 2.0, 7.0
        node.send("twist", packet)
        node.run()
        assert [each.data for each in node.received("force")] == [5.0]

    def test_one_message_holds_several_actions(self, tmp_path: Path) -> None:
        file = write(
            tmp_path / "p.onnx", [("o", FLOAT, [2])], [("a", FLOAT, [2])], ("Neg", "o", "a")
        )
        action = ("twist.linear.x", "twist.angular.z")
        node = harness(file, {"o": "float32[2]"}, {"twist": TWIST}, action=action)
        node.send("o", np.array([1, 2], np.float32))
        node.run()
        (twist,) = node.received("twist")
        assert (twist.linear.x, twist.linear.y, twist.angular.z) == (-1.0, 0.0, -2.0)

    def test_an_image_gets_its_colours_first_where_the_policy_wants_them_so(
        self, tmp_path: Path
    ) -> None:
        picked = {"starts": np.array([0, 2, 0, 1]), "ends": np.array([1, 3, 1, 2])}
        file = write(
            tmp_path / "p.onnx",
            [("image", onnx.TensorProto.UINT8, ["n", 3, 4, 5])],
            [("a", onnx.TensorProto.UINT8, [1, 1, 1, 1])],
            ("Slice", "image starts ends", "a"),  # blue, row 0, column 1
            constants=picked,
        )
        pixels = np.arange(60, dtype=np.uint8)
        observed = "camera.data[4,5,3]"
        node = harness(file, {"camera": IMAGE}, {"blue": "uint8[1]"}, observation=observed)
        packet = node.make_packet("camera")
        packet.data = pixels
        node.send("camera", packet)
        node.run()
        assert np.array_equal(node.received("blue"), [pixels.reshape(4, 5, 3)[0, 1, 2:]])

    def test_a_message_with_another_number_of_values_is_told(self, tmp_path: Path) -> None:
        file = linear(tmp_path / "p.onnx", 1, 1, 1, 1)
        node = harness(file, {"joints": JOINTS}, {"force": NUMBER}, observation=OBSERVED)
        node.send("joints", joints(node, [1, 2, 3], [4, 5]))
        with pytest.raises(HookError, match=r"joints\.position holds 3 numbers, not 2"):
            node.run()

    def test_an_action_that_is_no_number_is_not_sent(self, tmp_path: Path) -> None:
        file = write(
            tmp_path / "p.onnx", [("o", FLOAT, [1])], [("a", FLOAT, [1])], ("Log", "o", "a")
        )
        node = harness(file, {"o": "float32[1]"}, {"force": NUMBER})
        node.send("o", np.array([-1], np.float32))
        with pytest.raises(HookError, match=r"the policy gave \[nan\] as 'a'"):
            node.run()
        assert not node.received("force")

    def test_many_worlds_are_a_batch(self, tmp_path: Path) -> None:
        file = linear(tmp_path / "p.onnx", 1, 10)
        node = harness(file, {"obs": "float32[2]"}, {"act": "float32[1]"}, copies=3)
        node.send("obs", np.array([[1, 2], [3, 4], [5, 6]], np.float32))
        node.run()
        assert np.array_equal(node.received("act"), [[[21], [43], [65]]])


class TestTime:
    """When a policy is called, and what it remembers."""

    def test_it_waits_for_a_packet_of_each_input(self, tmp_path: Path) -> None:
        file = linear(tmp_path / "p.onnx", 1, 10)
        node = harness(file, {"a": "float32[1]", "b": "float32[1]"}, {"act": "float32[1]"})
        node.send("a", np.array([1], np.float32), np.array([2], np.float32))
        node.run()
        assert not node.received("act")
        node.send("b", np.array([3], np.float32), np.array([4], np.float32))
        node.run()
        assert np.array_equal(node.received("act"), [[31], [42]])

    def test_of_an_input_named_newest_it_uses_the_last_packet(self, tmp_path: Path) -> None:
        file = linear(tmp_path / "p.onnx", 1, 10)
        inputs = {"a": "float32[1]", "slow": "float32[1]"}
        node = harness(file, inputs, {"act": "float32[1]"}, newest="slow")
        for name, value in [("a", 1), ("slow", 2), ("a", 3), ("a", 4), ("slow", 5), ("a", 6)]:
            node.send(name, np.array([value], np.float32))
            node.run()
        # None before it has sent.
        assert np.array_equal(node.received("act"), [[23], [24], [56]])

    def test_a_state_is_an_output_of_the_call_before(self, tmp_path: Path) -> None:
        node = harness(counting(tmp_path / "p.onnx"), {"o": "float32[1]"}, {"a": "float32[2]"})
        node.send("o", *np.array([[1], [2], [5]], np.float32))
        node.run()
        assert np.array_equal(node.received("a"), [[1, 1], [3, 2], [8, 3]])

    def test_a_session_that_resets_begins_with_no_state(self, tmp_path: Path) -> None:
        counting(tmp_path / "p.onnx", "n")
        file = project(tmp_path, "p.onnx", {"o": "float32[1]"}, {"a": "float32[2]"})
        found = []
        with neuros.Project.from_file(file).session(backend="local", take_over=["policy.o"]) as s:
            for _ in range(2):
                s.reset()
                for value in (3, 4):
                    s.send("policy.o", np.array([value], np.float32))
                    s.step()
                found.append([packet.tolist() for packet in s["policy.a"].packets])
        assert found == [[[3, 1], [7, 2]]] * 2

    def test_which_output_a_state_is_can_be_said(self, tmp_path: Path) -> None:
        file = write(
            tmp_path / "p.onnx",
            [("o", FLOAT, [1]), ("h", FLOAT, [1])],
            [("a", FLOAT, [1]), ("value", FLOAT, [1]), ("n", FLOAT, [1])],
            ("Add", "o h", "n"),
            ("Neg", "n", "value"),
            ("Identity", "h", "a"),
        )
        node = harness(file, {"o": "float32[1]"}, {"a": "float32[1]"}, state={"h": "n"})
        node.send("o", *np.array([[1], [2], [0]], np.float32))
        node.run()
        assert np.array_equal(node.received("a"), [[0], [1], [3]])


def project(
    folder: Path,
    policy: str,
    inputs: Mapping[str, str],
    outputs: Mapping[str, str],
    **keys: Any,
) -> Path:
    """A project of one node, whose ports have external topics."""
    listed = {
        side: [{"name": n, "type": t, "external_topic": f"/{n}"} for n, t in ports.items()]
        for side, ports in (("inputs", inputs), ("outputs", outputs))
    }
    node = {"name": "policy", "container": "neuros_onnx", "policy": policy, **listed, **keys}
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}, indent=1))
    return folder / "project.json"


def problems(file: Path) -> list[str]:
    with pytest.raises(ProjectError) as caught:
        load_with_messages(file)
    assert all(each.line for each in caught.value.problems)
    shown = [(each.pointer, each.text, each.hint) for each in caught.value.problems]
    return [f"{pointer}: {text}" + (f" ({hint})" if hint else "") for pointer, text, hint in shown]


class TestBeforeTheStart:
    """What is wrong is told at once, with its place."""

    def test_a_policy_that_fits_is_a_plugin_with_the_file_in_its_environment(
        self, tmp_path: Path
    ) -> None:
        linear(tmp_path / "p.onnx", 1, 1)
        file = project(tmp_path, "p.onnx", {"obs": "float32[2]"}, {"act": "float32[1]"})
        loaded, _ = load_with_messages(file)
        (node,) = loaded.project.nodes
        assert not loaded.warnings
        assert (node.module, node.plugin_name) == ("neuros.policies.plugin", "p.onnx")
        assert node.environment == {"POLICY": str(tmp_path / "p.onnx")}
        (tmp_path / "again.json").write_text(json.dumps(project_to_json(loaded.project)))
        (again,) = load_with_messages(tmp_path / "again.json")[0].project.nodes
        assert (again.module, again.environment) == (node.module, node.environment)

    @pytest.mark.parametrize(
        ("content", "told"),
        [
            (b"", "p.onnx is not in ONNX, or is damaged (export or copy it again)"),
            (b"hello", "p.onnx is not in ONNX, or is damaged (export or copy it again)"),
            (
                b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n",
                "p.onnx is a pointer of Git LFS, not the policy itself"
                " (get it with `git lfs pull`)",
            ),
        ],
    )
    def test_a_file_that_is_no_policy(self, tmp_path: Path, content: bytes, told: str) -> None:
        (tmp_path / "p.onnx").write_bytes(content)
        file = project(tmp_path, "p.onnx", {"obs": "float32[2]"}, {"act": "float32[1]"})
        assert problems(file) == [f"/nodes/0/policy: {told}"]

    def test_a_truncated_one(self, tmp_path: Path) -> None:
        data = linear(tmp_path / "p.onnx", 1, 1).read_bytes()
        (tmp_path / "p.onnx").write_bytes(data[:-10])
        file = project(tmp_path, "p.onnx", {"obs": "float32[2]"}, {"act": "float32[1]"})
        (told,) = problems(file)
        assert "p.onnx is not in ONNX, or is damaged" in told

    def test_a_file_that_is_not_there(self, tmp_path: Path) -> None:
        linear(tmp_path / "walk.onnx", 1, 1)
        file = project(tmp_path, "wolk.onnx", {"obs": "float32[2]"}, {"act": "float32[1]"})
        assert problems(file) == [
            "/nodes/0/policy: there is no file 'wolk.onnx' (did you mean 'walk.onnx'?)"
        ]

    @pytest.mark.parametrize(
        ("newer", "told"),
        [
            ({"opset": 99}, r"p\.onnx needs opset 99 of ONNX, and .* up to \d+ \(export it with"),
            ({"version": 99}, r"p\.onnx has version 99 of ONNX's format, and .* up to \d+ \("),
        ],
    )
    def test_one_that_is_too_new(self, tmp_path: Path, newer: Any, told: str) -> None:
        linear(tmp_path / "p.onnx", 1, 1, **newer)
        file = project(tmp_path, "p.onnx", {"obs": "float32[2]"}, {"act": "float32[1]"})
        (found,) = problems(file)
        assert re.search(told, found)

    def test_one_with_an_operator_that_onnxruntime_does_not_have(self, tmp_path: Path) -> None:
        write(tmp_path / "p.onnx", [("o", FLOAT, [1])], [("a", FLOAT, [1])], ("Foo", "o", "a"))
        file = project(tmp_path, "p.onnx", {"obs": "float32[1]"}, {"act": "float32[1]"})
        (told,) = problems(file)
        assert told.startswith("/nodes/0/policy: p.onnx is refused by onnxruntime: ")
        assert "Foo" in told
        assert "/onnxruntime" not in told

    def test_all_mistakes_are_told_together(self, tmp_path: Path) -> None:
        linear(tmp_path / "p.onnx", 1, 1, 1, 1, 1)
        file = project(
            tmp_path,
            "p.onnx",
            {"joints": JOINTS, "spare": NUMBER},
            {"force": NUMBER, "more": NUMBER},
            parameters={
                "observation": ["joints.position[2]", "joints.speed[2]", "joint", "joints.effort"],
                "action": ["force", "forze"],
                "newest": ["camera"],
                "actions": "force",
            },
        )
        assert sorted(problems(file)) == [
            "/nodes/0/inputs: the policy does not use the input 'spare' (name it in 'observation',"
            " or remove it)",
            "/nodes/0/outputs: the policy does not use the output 'more' (name it in 'action', or"
            " remove it)",
            "/nodes/0/parameters/action: 'forze': the node has no output 'forze' (did you mean"
            " 'force'?)",
            "/nodes/0/parameters/actions: a policy has no parameter 'actions' (did you mean"
            " 'action'?)",
            "/nodes/0/parameters/newest: the node has no input 'camera' (it has 'joints' or"
            " 'spare')",
            "/nodes/0/parameters/observation: 'joint': the node has no input 'joint' (did you mean"
            " 'joints'?)",
            "/nodes/0/parameters/observation: 'joints.effort': the length of joints.effort is not"
            " known: name that alone, with its shape: 'joints.effort[3]'",
            "/nodes/0/parameters/observation: 'joints.speed[2]': there are no numbers of that name;"
            " there are joints.position, joints.velocity, joints.effort",
        ]

    def test_shapes_and_types_are_compared(self, tmp_path: Path) -> None:
        write(
            tmp_path / "p.onnx",
            [("few", FLOAT, [1, 3]), ("whole", INT, [2]), ("image", FLOAT, [1, 3, 4, 4])],
            [("a", FLOAT, [3])],
            ("ReduceSum", "few", "s", {"keepdims": 0}),
            ("Cast", "whole", "w", {"to": FLOAT}),
            ("ReduceSum", "w", "t", {"keepdims": 0}),
            ("ReduceSum", "image", "u", {"keepdims": 0}),
            ("Sum", "s t u", "v"),
            ("Expand", "v three", "a"),
            constants={"three": np.array([3])},
        )
        inputs = {"few": "float32[4]", "whole": "float64[2]", "image": "uint8[4,3,4]"}
        file = project(tmp_path, "p.onnx", inputs, {"a": "float32[3]"})
        assert sorted(problems(file)) == [
            "/nodes/0/inputs: 'few': 4 numbers, and the policy takes 3 ('few' float32[1,3])",
            "/nodes/0/inputs: 'image' has the shape (4, 3, 4), and the policy takes 'image'"
            " float32[1,3,4,4]",
            "/nodes/0/inputs: 'whole' has float64, and the policy takes 'whole' int64[2]",
        ]
        good = {"few": "float32[3]", "whole": "int32[2]", "image": "uint8[4,4,3]"}
        file = project(tmp_path, "p.onnx", good, {"force": NUMBER})
        assert problems(file) == [
            "/nodes/0/parameters/action: 'force': 1 numbers, and the policy gives 3 as 'a', [3]"
        ]

    @pytest.mark.parametrize(
        ("shape", "told"),
        [
            (["n", "m"], "takes 'o' float32[?,?]: only its first axis, the batch, may have any"),
            (["n", 3, "w"], "takes 'o' float32[?,3,?]: only its first axis, the batch, may have"),
        ],
    )
    def test_axes_of_any_size(self, tmp_path: Path, shape: list[Any], told: str) -> None:
        write(tmp_path / "p.onnx", [("o", FLOAT, shape)], [("a", FLOAT, shape)], ("Neg", "o", "a"))
        file = project(tmp_path, "p.onnx", {"o": "float32[2]"}, {"a": "float32[2]"})
        (found,) = problems(file)
        assert told in found

    def test_texts_are_no_observation(self, tmp_path: Path) -> None:
        steps = ("Identity", "o", "a")
        write(tmp_path / "p.onnx", [("o", TEXT, [1])], [("a", TEXT, [1])], steps)
        file = project(tmp_path, "p.onnx", {"o": "float32[1]"}, {"a": "float32[1]"})
        assert problems(file) == [
            "/nodes/0/inputs: the policy takes 'o' string[1], which holds no numbers",
            "/nodes/0/outputs: the policy gives 'a' string[1], which holds no numbers",
        ]

    def test_an_input_that_nothing_feeds(self, tmp_path: Path) -> None:
        write(
            tmp_path / "p.onnx",
            [("o", FLOAT, [1]), ("goal", FLOAT, [3])],
            [("a", FLOAT, [1])],
            ("ReduceSum", "goal", "g", {"keepdims": 0}),
            ("Add", "o g", "a"),
        )
        ports = {"o": "float32[1]"}, {"a": "float32[1]"}
        assert problems(project(tmp_path, "p.onnx", *ports)) == [
            "/nodes/0/policy: nothing feeds the input 'goal' float32[3] of the policy (name what it"
            " observes in 'observation', or, of a state, the output in 'state')"
        ]
        more = {"parameters": {"state": {"goal": "next", "gaol": "a"}}}
        assert problems(project(tmp_path, "p.onnx", *ports, **more)) == [
            "/nodes/0/parameters/state: the policy has no output 'next' that is free for the state"
            " 'goal' (free are none)",
            "/nodes/0/parameters/state: the policy has no state 'gaol' (did you mean 'goal'?)",
        ]

    def test_messages_that_the_project_builds_later_are_left_to_the_node(
        self, tmp_path: Path
    ) -> None:
        linear(tmp_path / "p.onnx", 1, 1)
        package = tmp_path / "workspace" / "pair_msgs"
        (package / "msg").mkdir(parents=True)
        (package / "msg" / "Pair.msg").write_text("float64 a\nfloat64 b\n")
        (package / "package.xml").write_text(
            '<package format="3"><name>pair_msgs</name><version>1.0.0</version>'
            "<description>Pairs</description><maintainer email='a@example.org'>A</maintainer>"
            "<license>MIT</license></package>"
        )
        pair = "pair_msgs/msg/Pair"
        load_with_messages(project(tmp_path, "p.onnx", {"obs": pair}, {"act": pair}))

    def test_copies_need_an_axis_and_no_state(self, tmp_path: Path) -> None:
        linear(tmp_path / "p.onnx", 1, 1, batch=1)
        ports = {"obs": "float32[2]"}, {"act": "float32[1]"}
        (told,) = problems(project(tmp_path, "p.onnx", *ports, copies=4))
        assert "'obs' float32[1,2], without an axis for 4 copies (export it with a first" in told

    def test_one_that_never_waits(self, tmp_path: Path) -> None:
        linear(tmp_path / "p.onnx", 1, 1)
        more = {"parameters": {"newest": "obs"}}
        file = project(tmp_path, "p.onnx", {"obs": "float32[2]"}, {"act": "float32[1]"}, **more)
        (told,) = problems(file)
        assert "the policy would never wait for an observation (leave one input out)" in told

    def test_without_onnxruntime_here_it_is_left_to_the_node(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(checks, "find_spec", lambda name: None)
        linear(tmp_path / "p.onnx", 1)
        file = project(tmp_path, "p.onnx", {"obs": "float32[2]"}, {"act": "float32[1]"})
        (warning,) = load_with_messages(file)[0].warnings
        assert warning.text == "the policy cannot be checked before the run"
        assert "onnx" in warning.hint

    def test_the_node_that_has_none_names_what_brings_it(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
        node = harness(linear(tmp_path / "p.onnx", 1), {"obs": "float32[1]"}, {"act": "float32[1]"})
        with pytest.raises(HookError, match=r"need onnxruntime, which is not installed: .*onnx"):
            node.run()


class TestRuns:
    """The record of a run, and its repetition."""

    def test_before_a_run_it_is_checked_without_rclpy(self, tmp_path: Path) -> None:
        """A launcher that takes no part in communication does not load the libraries of ROS."""
        program = (
            "import sys; from pathlib import Path; sys.modules['rclpy'] = None\n"
            "from neuros.api.loading import load_with_messages\n"
            f"load_with_messages(Path({str(EXAMPLE)!r}))"
        )
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr

    def test_the_policy_of_the_example_balances_and_its_packets_are_repeatable(
        self, tmp_path: Path
    ) -> None:
        runs = [
            neuros.Project.from_file(EXAMPLE).run(
                backend=backend, duration="10sim", record=True, output=tmp_path / name
            )
            for name, backend in (("a", "process"), ("b", "in-process"))
        ]
        for output, field in (("cart.joints", "position"), ("policy.force", "data")):
            one, other = (np.stack(run.bag[output].columns()[field]) for run in runs)
            assert len(one) == 500
            assert np.array_equal(one, other)
        assert np.abs(runs[0].bag["cart.joints"].columns()["position"][-1][1]) < 0.1

    def test_the_record_has_the_hash_of_the_file(self, tmp_path: Path) -> None:
        data = linear(tmp_path / "p.onnx", 1, 1).read_bytes()
        file = project(tmp_path, "p.onnx", {"obs": "float32[2]"}, {"act": "float32[1]"})
        run = neuros.Project.from_file(file).run(
            backend="in-process", duration="0.1", output=tmp_path / "run"
        )
        run.check()
        assert run.node_results["policy"]["policy_sha256"] == hashlib.sha256(data).hexdigest()


@pytest.fixture
def env() -> Any:
    import neuros.gym

    made = neuros.gym.make(
        EXAMPLE.with_name("project.json"),
        action="policy.force",
        observation=[f"cart.joints.{name}[2]" for name in ("position", "velocity")],
        reward=lambda: 1.0,
        model="cart.xml",
    )
    yield made
    made.close()


@pytest.mark.acceptance
class TestExport:
    """What PyTorch and Stable-Baselines3 have trained, as a node."""

    def force(self, node: Mapping[str, Any], folder: Path, seen: Any) -> float:
        """What the exported node answers to an observation."""
        (folder / "node.json").write_text(json.dumps(node))
        made = PluginHarness.from_node_file(folder / "node.json")
        made.send("joints", joints(made, seen[:2].tolist(), seen[2:].tolist()))
        made.run()
        (packet,) = made.received("force")
        return float(packet.data)

    def test_a_module_of_pytorch_is_a_node_with_the_limits_of_the_action_space(
        self, tmp_path: Path, env: Any
    ) -> None:
        torch = pytest.importorskip("torch")
        module = torch.nn.Linear(4, 1)
        node = neuros.gym.export_policy(module, tmp_path / "p.onnx", env)
        assert node["parameters"] == {
            "observation": ["joints.position[2]", "joints.velocity[2]"],
            "action": ["force"],
        }
        for seen in np.random.default_rng(1).normal(0.0, 2.0, (20, 4)):
            with torch.no_grad():
                (wanted,) = module(torch.tensor(seen, dtype=torch.float32)).clamp(-1, 1).tolist()
            assert self.force(node, tmp_path, seen) == pytest.approx(wanted, abs=1e-6)

    @pytest.mark.parametrize("algorithm", ["PPO", "SAC", "TD3"])
    def test_an_algorithm_is_a_node_with_its_normalisation(
        self, tmp_path: Path, env: Any, algorithm: str
    ) -> None:
        sb3 = pytest.importorskip("stable_baselines3")
        from gymnasium.wrappers import FlattenObservation
        from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

        normalised = VecNormalize(DummyVecEnv([lambda: FlattenObservation(env)]))
        model = getattr(sb3, algorithm)("MlpPolicy", normalised, seed=1, device="cpu")
        normalised.reset()
        for _ in range(20):
            normalised.step(normalised.action_space.sample()[None])
        node = neuros.gym.export_policy(model, tmp_path / "p.onnx")
        for seen in np.random.default_rng(1).normal(0.0, 0.1, (5, 4)):
            given = normalised.normalize_obs(seen)
            ((wanted,), _) = model.predict(given, deterministic=True)
            assert self.force(node, tmp_path, seen) == pytest.approx(float(wanted), abs=1e-5)

    def test_wrappers_that_change_observations_are_refused(self, tmp_path: Path, env: Any) -> None:
        sb3 = pytest.importorskip("stable_baselines3")
        from gymnasium.wrappers import FlattenObservation, FrameStackObservation

        stacked = FlattenObservation(FrameStackObservation(FlattenObservation(env), 3))
        model = sb3.PPO("MlpPolicy", stacked, device="cpu")
        with pytest.raises(UsageError, match="a wrapper that changes observations cannot be"):
            neuros.gym.export_policy(model, tmp_path / "p.onnx")


def test_an_environment_of_another_world_is_refused(tmp_path: Path) -> None:
    import neuros.gym

    with pytest.raises(UsageError, match=r"give the environment of neuros\.gym\.make"):
        neuros.gym.export_policy(object(), tmp_path / "p.onnx")


class TestLeRobot:
    """Policies of LeRobot; a module stands in for the library, which brings PyTorch."""

    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / "act").mkdir()
        config = {
            "type": "act",
            "input_features": {
                "observation.state": {"type": "STATE", "shape": [2]},
                "observation.images.front": {"type": "VISUAL", "shape": [3, 4, 5]},
            },
            "output_features": {"action": {"type": "ACTION", "shape": [1]}},
        }
        (tmp_path / "act" / "config.json").write_text(json.dumps(config))
        return tmp_path

    def file(self, folder: Path, **keys: Any) -> Path:
        parameters = {
            "observation": {
                "observation.state": ["state"],
                "observation.images.front": ["camera.data[4,5,3]"],
            },
            "task": "lift the cube",
        }
        inputs = {"state": "float64[2]", "camera": IMAGE}
        keys = {"parameters": parameters, **keys}
        return project(folder, "lerobot:act", inputs, {"action": "float64[1]"}, **keys)

    def test_its_features_are_compared_with_the_ports_without_the_library(
        self, folder: Path
    ) -> None:
        (warning,) = load_with_messages(self.file(folder))[0].warnings
        assert warning.text == "LeRobot is not installed here"
        wrong = {"observation": {"observation.state": ["state", "camera.data[4,5,3]"]}}
        told = sorted(problems(self.file(folder, parameters=wrong)))
        assert told == [
            "/nodes/0/parameters/observation/observation.state: 'state', 'camera.data': 62"
            " numbers, and the policy takes 2 ('observation.state' float32[2])",
            "/nodes/0/policy: nothing feeds the input 'observation.images.front' uint8[4,5,3] of"
            " the policy (name what it observes in 'observation', or, of a state, the output in"
            " 'state')",
        ]

    def test_the_library_is_given_what_its_datasets_hold(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        calls = stand_in(monkeypatch, json.loads((folder / "act/config.json").read_text()))
        node = harness(
            "lerobot:act",
            {"state": "float64[2]", "camera": IMAGE},
            {"action": "float64[1]"},
            folder,
            observation={
                "observation.state": "state",
                "observation.images.front": "camera.data[4,5,3]",
            },
            task="lift the cube",
        )
        node.send("state", np.array([1.0, 2.0]))
        packet = node.make_packet("camera")
        packet.data = np.full(60, 51, np.uint8)
        node.send("camera", packet)
        node.run()
        assert np.array_equal(node.received("action"), [[3.0]])
        opened, reset, batch = calls[0], calls[1], calls[-1]
        assert opened == ("open", str(folder / "act"), "cpu")
        assert reset == ("reset",)
        assert batch["task"] == "lift the cube"
        assert batch["observation.state"].shape == (1, 2)
        assert batch["observation.images.front"].shape == (1, 3, 4, 5)
        assert np.allclose(batch["observation.images.front"], 0.2)

    def test_without_the_library_the_node_names_it(self, folder: Path) -> None:
        ports = {"state": "float64[2]"}, {"action": "float64[1]"}
        node = harness("lerobot:act", *ports, folder)
        with pytest.raises(HookError, match="not installed: pip install lerobot"):
            node.run()


class _Array(np.ndarray):
    """As much of a tensor of PyTorch as policies need."""

    def type(self, kind: Any) -> Any:
        return self.astype(kind)

    def permute(self, *axes: int) -> Any:
        return self.transpose(axes)

    def unsqueeze(self, axis: int) -> Any:
        return np.expand_dims(self, axis).view(_Array)

    def numpy(self) -> Any:
        return np.asarray(self)


def stand_in(monkeypatch: pytest.MonkeyPatch, config: Any) -> list[Any]:
    """Modules in the place of LeRobot and PyTorch; the policy sums its state. Returns its calls."""
    from contextlib import nullcontext

    calls: list[Any] = []

    class Policy:
        @classmethod
        def from_pretrained(cls, place: str, config: Any) -> Policy:
            calls.append(("open", place, config.device))
            return cls()

        def reset(self) -> None:
            calls.append(("reset",))

        def select_action(self, batch: Any) -> Any:
            calls.append(batch)
            return batch["observation.state"].sum(axis=1, keepdims=True).view(_Array)

    def pretrained(place: str) -> Any:
        sides = ("input_features", "output_features")
        found = {side: {n: SimpleNamespace(**f) for n, f in config[side].items()} for side in sides}
        return SimpleNamespace(type=config["type"], device="cuda", **found)

    modules = {
        "torch": SimpleNamespace(
            float32=np.float32,
            from_numpy=lambda array: array.view(_Array),
            inference_mode=nullcontext,
            set_num_threads=lambda count: None,
        ),
        "lerobot": SimpleNamespace(__path__=[]),
        "lerobot.configs": SimpleNamespace(__path__=[]),
        "lerobot.configs.policies": SimpleNamespace(
            PreTrainedConfig=SimpleNamespace(from_pretrained=pretrained)
        ),
        "lerobot.policies": SimpleNamespace(__path__=[]),
        "lerobot.policies.factory": SimpleNamespace(
            get_policy_class=lambda kind: Policy,
            make_pre_post_processors=lambda config, pretrained_path: (lambda b: b, lambda a: a),
        ),
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)  # type: ignore[arg-type]
    return calls
