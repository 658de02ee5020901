"""`neuros topic` reads what the nodes of a run were told, in folders that they can write to."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from neuros.backends.sessions import RunOnThisMachine
from neuros.cli import live
from neuros.cli.main import main
from neuros.project.model import Connection, Folders, Node, NodeFile, Port
from neuros.project.split import node_file_text


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the only node of the only run has its ``node.json``."""
    session = RunOnThisMachine("a" * 16, "demo", "docker", ("eye",), str(tmp_path), 0.0, (1, 1))
    monkeypatch.setattr(live, "sessions", lambda: [session])
    (tmp_path / "eye").mkdir()
    return tmp_path / "eye" / "node.json"


def holding(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text)


@pytest.mark.parametrize(
    ("leave", "said"),
    [
        (os.mkfifo, "cannot be read (it is not an ordinary file)"),
        (lambda path: path.symlink_to("/dev/zero"), "cannot be read (it is not an ordinary file)"),
        (os.mkdir, "cannot be read (Is a directory)"),
        (holding("{"), "is broken (Expecting property name"),
        (holding("[]"), "is broken: it holds no object"),
        (holding("{}"), "is broken: $: "),
    ],
)
@pytest.mark.parametrize("action", [["list", "aaaa"], ["echo", "aaaa", "x"]])
def test_what_is_no_description_of_a_node_is_named(
    told: Path,
    capsys: pytest.CaptureFixture[str],
    leave: Callable[[Path], object],
    said: str,
    action: list[str],
) -> None:
    leave(told)
    assert main(["topic", *action]) == 4
    error = capsys.readouterr().err
    assert f"{told} {said}" in error
    assert "`neuros topic` needs it: launch the project again" in error


def test_a_connection_of_no_port_is_named(
    tmp_path: Path, told: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    node = Node(
        "eye", "neuros_python", Path("/eye.py"), outputs=(Port("out", "std_msgs/msg/Empty"),)
    )
    made = NodeFile(node, (Connection("eye", "out", "ear", "in"),), Folders(*[tmp_path] * 3))
    told.write_text(node_file_text(made))
    assert main(["topic", "list", "aaaa"]) == 0
    told.write_text(node_file_text(replace(made, node=replace(made.node, outputs=()))))
    assert main(["topic", "list", "aaaa"]) == 4
    assert f"{told} is broken: it has no port 'out'" in capsys.readouterr().err


def test_where_the_run_folder_has_gone_it_is_said(
    told: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["topic", "list", "aaaa"]) == 4
    said = f"{told} is not there: the run is ending, or somebody has removed its files"
    assert said in capsys.readouterr().err
