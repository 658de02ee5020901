"""Projects that are too deep, too large or without an end are refused at once, with a place."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from neuros.errors import ProjectError
from neuros.project.load import load_project

NODE: dict[str, Any] = {"name": "a", "container": "neuros_python", "plugin": "p.py"}
PROMPT_S = 60.0  # a hang lasts for ever


def problems_of(folder: Path, content: Any = None, **override: str) -> str:
    """What is said of a project; it is said soon."""
    (folder / "p.py").touch()
    if content is not None:
        text = content if isinstance(content, str) else json.dumps(content)
        (folder / "project.json").write_text(text)
    begin_s = time.monotonic()
    with pytest.raises(ProjectError) as caught:
        load_project(folder / "project.json", workspace=folder, **override)  # type: ignore[arg-type]
    assert time.monotonic() - begin_s < PROMPT_S
    return str(caught.value)


def test_node_files_may_not_import_each_other_without_end(tmp_path: Path) -> None:
    for level in range(488):
        (tmp_path / f"{level}.json").write_text(json.dumps(f"{level + 1}.json"))
    (tmp_path / "488.json").write_text(json.dumps(NODE))
    text = problems_of(tmp_path, {"nodes": ["0.json"]})
    assert "49.json:1:1: /: more than 50 node files import one another in a row" in text


def test_node_files_may_not_import_each_other_over_and_over(tmp_path: Path) -> None:
    for level in range(10):
        (tmp_path / f"{level}.json").write_text(json.dumps([f"{level + 1}.json"] * 10))
    for leaf in (NODE, []):
        (tmp_path / "10.json").write_text(json.dumps(leaf))
        text = problems_of(tmp_path, {"nodes": ["0.json"]})
        assert "project.json:1:12: /nodes/0: the project has more than 10000 nodes" in text


@pytest.mark.parametrize("name", ["project.json", "node.json", "p.py"])
def test_a_pipe_in_the_place_of_a_file_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "node.json").write_text(json.dumps({**NODE, "name": "b"}))
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [NODE, "node.json"]}))
    (tmp_path / "p.py").touch()
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    begin_s = time.monotonic()
    with pytest.raises(ProjectError, match="not an ordinary file"):
        load_project(tmp_path / "project.json", workspace=tmp_path, reads_plugins=True)
    assert time.monotonic() - begin_s < PROMPT_S


def test_a_project_file_of_many_megabytes_is_not_read(tmp_path: Path) -> None:
    content = '{"nodes": [' + "0, " * (3 << 20) + "0]}"
    assert "cannot be read: it has more than 4 MiB" in problems_of(tmp_path, content)


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ('"environment": {"A": "\\ud800"}', r"half of a character, \ud800"),
        ('"environment": {"\\udfff": "a"}', r"half of a character, \udfff"),
        ('"parameters": {"a": "x\\udc00"}', r"half of a character, \udc00"),
        ('"resources": {"cpus": 1e400}', "the number is too large"),
        ('"resources": {"pids": 1' + 30 * "0" + "}", "must be at most 4194304"),
        ('"resources": {"memory": "1' + 30 * "0" + 'g"}', "is not allowed as memory"),
        ('"resources": {"memory": "1g\\n"}', "is not allowed as memory"),
        ('"affinity": [1' + 30 * "0" + "]", "must be at most 4095"),
        ('"devices": [' + '"/dev/a", {}, ' * 1500 + '"/dev/b"]', "has more than 1000 items"),
    ],
)
def test_values_that_no_run_could_use(tmp_path: Path, part: str, said: str) -> None:
    node = json.dumps(NODE).removesuffix("}") + f", {part}}}"
    assert said in problems_of(tmp_path, f'{{"nodes": [{node}]}}')


@pytest.mark.parametrize("key", ["queue_size", "discard_limit", "depth"])
def test_queues_have_a_largest_size(tmp_path: Path, key: str) -> None:
    port: dict[str, Any] = {"name": "x", "type": "std_msgs/msg/String"}
    heard = {"name": "y", "type": port["type"], "external_topic": "/y"}
    if key == "depth":
        heard["qos"] = {key: 10**30}
    node = {**NODE, "inputs": [port, heard], "outputs": [port]}
    ends = {"source_node": "a", "source_output": "x"}
    ends |= {"destination_node": "a", "destination_input": "x"}
    connection = ends | ({} if key == "depth" else {key: 10**30})
    text = problems_of(tmp_path, {"nodes": [node], "connections": [connection]})
    assert f"/{key}: must be at most 10000" in text


def test_half_a_character_cannot_be_set_either(tmp_path: Path) -> None:
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [NODE]}))
    text = problems_of(tmp_path, overrides=["nodes.a.environment.A=\udc80"])  # type: ignore[arg-type]
    assert r"half of a character, \udc80" in text


def test_thousands_of_mistakes_are_not_all_sought(tmp_path: Path) -> None:
    nodes = [{**NODE, "name": f"node{number}"} for number in range(2000)]
    wrong = {"source_node": "nobody", "source_output": "x", "destination_node": "none"}
    connections = [{**wrong, "destination_input": f"x{number}"} for number in range(10_000)]
    text = problems_of(tmp_path, {"nodes": nodes, "connections": connections})
    assert "there is no node 'nobody'" in text
    assert len(text.splitlines()) <= 400
