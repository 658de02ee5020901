"""The page "Life of a packet" lists the functions that a packet really passes."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from sensor_msgs.msg import Imu

from neuros.node.context import ContextSwitch
from neuros.node.node import NodeRuntime
from neuros.project.model import Folders, Node, NodeFile, Port
from neuros.testing.harness import ManualClock, StepLoop, Topics, Workbench, numbered, wire

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "life_of_a_packet.md").read_text("utf-8")
ROW = re.compile(r"^\| `([\w.]+)` \| \[[\w.]+\]\(\.\./([\w/.]+)\)", re.MULTILINE)
LINK = re.compile(r"\[`([\w.]+)`\]\(\.\./([\w/.]+)\)")

MOST_FUNCTIONS, MOST_FILES = 20, 8
IMU = "sensor_msgs/msg/Imu"
PLUGINS = {
    "a": """
from neuros.hooks import neuros_function

@neuros_function(outputs="out")
def send(node):
    packet = node.make_packet("out")
    node.set_user_data("made")
    return packet
""",
    "b": """
from neuros.hooks import neuros_function

@neuros_function(inputs="in")
def receive(node, packet):
    node.set_user_data((node.get_user_data() or 0) + 1)
""",
}


def section(title: str) -> str:
    return PAGE.partition(f"## {title}\n")[2].partition("\n## ")[0]


def names_in(tree: ast.AST, prefix: str = "") -> Iterator[str]:
    """Functions, classes and what is defined within them, with dots."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield f"{prefix}{node.name}"
            yield from names_in(node, f"{prefix}{node.name}.")
        else:
            yield from names_in(node, prefix)


@pytest.mark.parametrize(("name", "path"), sorted({*ROW.findall(PAGE), *LINK.findall(PAGE)}))
def test_what_the_page_names_exists(name: str, path: str) -> None:
    if path.endswith(".py") and not path.endswith(f"/{name}.py"):
        found = {*names_in(ast.parse((ROOT / path).read_text("utf-8")))}
        assert name in found or name in {each.rpartition(".")[2] for each in found}


def test_the_path_is_short() -> None:
    listed = ROW.findall(section("The path within one process"))
    assert len(listed) <= MOST_FUNCTIONS
    assert len({path for _, path in listed}) <= MOST_FILES
    assert f"{len(listed)} functions in {len({path for _, path in listed})} files" in PAGE


class TwoNodes:
    """``a`` sends to ``b``, losslessly, in one process that goes step by step."""

    def __init__(self, folder: Path) -> None:
        connections = tuple(numbered([wire("a.out -> b.in", 0)]))
        self._loop = StepLoop(ManualClock())
        middleware = Workbench(self._loop, Topics(), [])
        contexts = ContextSwitch()
        self.failures: list[Exception] = []
        self.nodes = []
        for name, text in PLUGINS.items():
            (folder / name).mkdir()
            plugin = folder / f"{name}.py"
            plugin.write_text(text)
            ports = (
                {"outputs": (Port("out", IMU),)} if name == "a" else {"inputs": (Port("in", IMU),)}
            )
            node = Node(name=name, container="neuros_python", plugin=plugin, **ports)
            self.nodes.append(
                NodeRuntime(
                    NodeFile(node, connections, Folders(folder, folder, folder)),
                    middleware,
                    contexts,
                    tell=lambda *_, **__: None,
                    fail=lambda _, error: self.failures.append(error),
                    log_file=None,
                    duration_sim_s=None,
                )
            )
        for each in self.nodes:
            each.load()
        for each in self.nodes:
            each.start()
        self._leave = contexts.leave

    def receive(self, count: int) -> None:
        """Until so many packets have been received."""
        for _ in range(100 * count):
            if (self.nodes[1].handle.get_user_data() or 0) >= count:
                return
            self._loop.step()
        raise AssertionError(f"not received; failures: {self.failures}")

    def close(self) -> None:
        for each in self.nodes:
            each.finalise()
        self._leave()


def has_packet(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return any(map(has_packet, value))
    return isinstance(value, Imu)


def passed_functions(nodes: TwoNodes, last: int) -> set[tuple[str, str]]:
    """The functions that have a packet as an argument, a result or a variable."""
    passed: set[tuple[str, str]] = set()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        code = frame.f_code
        path = Path(code.co_filename)
        if not path.is_relative_to(ROOT / "neuros") or event not in ("call", "return"):
            return
        values = [*frame.f_locals.values(), argument]
        if any(map(has_packet, values)):
            name = code.co_qualname.replace(".<locals>", "")
            passed.add((name, str(path.relative_to(ROOT))))

    sys.setprofile(note)
    try:
        nodes.receive(last)
    finally:
        sys.setprofile(None)
    return passed


@pytest.mark.skipif(sys.version_info < (3, 11), reason="code objects know no qualified name")
def test_a_packet_passes_the_functions_that_the_page_lists(tmp_path: Path) -> None:
    nodes = TwoNodes(tmp_path)
    try:
        nodes.receive(
            3
        )  # what is worked out for the first packet of a class is no part of the path
        passed = passed_functions(nodes, 6)
    finally:
        nodes.close()
    assert not nodes.failures
    making = {"make_packet", "_factory.make", "RosPackets.make", "NodeHandle.make_packet"}
    found = {(name, path) for name, path in passed if name not in making}
    assert found == {*ROW.findall(section("The path within one process"))}
