"""The project as a picture: all that it has is in there, and nothing is drawn outside."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from neuros_analysis.graph_picture import graph_svg

from neuros.project.load import load_project
from neuros.project.model import Connection, Node, Port, Project

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES, WORKSPACE = ROOT / "examples", ROOT / "workspace"
TEXT = "std_msgs/msg/String"
SVG = "{http://www.w3.org/2000/svg}"
PROJECT = Project(
    "a <b> & c",
    (
        Node("a", "one", Path("a.py"), outputs=(Port("o", TEXT), Port("out", TEXT, "/seen"))),
        Node("b", "two", Path("b.py"), inputs=(Port("x", TEXT), Port("heard", TEXT, "/cmd"))),
    ),
    (Connection("a", "o", "b", "x", 0), Connection("a", "o", "b", "y", 3, 2, 1)),
    Path("project.json"),
)


def texts(svg: str) -> list[str]:
    return [each.text or "" for each in ElementTree.fromstring(svg).iter(f"{SVG}text")]


def test_nodes_connections_and_topics_are_named() -> None:
    found = texts(graph_svg(PROJECT))
    assert {"a", "one", "b", "two", "/seen", "/cmd"} <= {*found}
    pairs = list(zip(found[::2], found[1::2], strict=True))
    assert ("o → x", "lossless") in pairs
    assert ("o → y", "discards <= 3, queue 2") in pairs
    assert ("out", "topic") in pairs
    assert ("heard", "topic") in pairs


def test_each_connection_is_one_line_from_its_sender_to_its_receiver() -> None:
    root = ElementTree.fromstring(graph_svg(PROJECT))
    lines = [path for path in root.iter(f"{SVG}path") if path.get("marker-end")]
    assert len(lines) == 4
    dashed = [line for line in lines if line.get("stroke-dasharray")]
    assert len(dashed) == 2  # the topics: whoever is there gets packets, or does not


def test_the_title_is_the_project_s_whatever_letters_it_has() -> None:
    assert ElementTree.fromstring(graph_svg(PROJECT)).findtext(f"{SVG}title") == "a <b> & c"


@pytest.mark.parametrize(
    "file", sorted(EXAMPLES.rglob("project.json")), ids=lambda f: f.parent.name
)
def test_nothing_of_an_example_is_outside_of_its_picture_or_over_something_else(file: Path) -> None:
    root = ElementTree.fromstring(graph_svg(load_project(file, workspace=WORKSPACE).project))
    width, height = float(root.attrib["width"]), float(root.attrib["height"])
    boxes = [
        tuple(float(box.attrib[key]) for key in ("x", "y", "width", "height"))
        for box in root.iter(f"{SVG}rect")
        if "x" in box.attrib
    ]
    for x, y, wide, high in boxes:
        assert 0 <= x <= x + wide <= width
        assert 0 <= y <= y + high <= height
    for number, (x, y, wide, high) in enumerate(boxes):
        for other_x, other_y, other_wide, other_high in boxes[:number]:
            is_apart = x + wide <= other_x or other_x + other_wide <= x
            assert is_apart or y + high <= other_y or other_y + other_high <= y
    for path in root.iter(f"{SVG}path"):
        if path.get("marker-end"):
            numbers = list(map(float, re.findall(r"-?\d+\.\d", path.attrib["d"])))
            assert all(0 <= x <= width for x in numbers[::2])
            assert all(0 <= y <= height for y in numbers[1::2])
