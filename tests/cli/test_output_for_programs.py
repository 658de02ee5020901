"""``--format json``: one JSON value on standard output, and the exit code as ever."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from run_folders import accounting, run_folder

from neuros.backends.sessions import RunOnThisMachine
from neuros.cli import live
from neuros.cli.main import main

WIRE = "a.out -> b.in"


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Any:
    """What a command says, and its exit code."""

    def run(*command: str) -> tuple[Any, int]:
        code = main([*command, "--format", "json"])
        return json.loads(capsys.readouterr().out), code

    return run


def recorded(folder: Path, **more: Any) -> str:
    folder.mkdir()
    nodes: Mapping[str, Any] = {"a": accounting(executing={"f": 1.0}), "b": None}
    return str(run_folder(folder, {WIRE: 0}, nodes, **more))


@pytest.fixture
def sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        RunOnThisMachine(
            "a" * 16, "demo", "process", ("x", "y"), "/runs/1", 5.0, (0, 1), namespace="/left"
        ),
        RunOnThisMachine("b" * 16, "other", "docker", ("x",), "/runs/2", 6.0, (0, 1)),
    ]
    monkeypatch.setattr(live, "sessions", lambda: found)


@pytest.mark.usefixtures("sessions")
def test_ps_has_an_object_for_each_node(said: Any) -> None:
    rows, code = said("ps")
    assert code == 0
    assert [(row["run"], row["node"]) for row in rows] == [
        ("a" * 16, "/left/x"),
        ("a" * 16, "/left/y"),
        ("b" * 16, "x"),
    ]
    assert rows[2].keys() == {
        *("run", "user", "project", "node", "backend", "since", "state", "folder")
    }
    assert (rows[2]["since"], rows[2]["state"]) == (6.0, "not running")


@pytest.mark.usefixtures("sessions")
def test_ps_filters_as_docker_does(said: Any, capsys: pytest.CaptureFixture[str]) -> None:
    rows, _ = said("ps", "--filter", "backend=docker", "-f", "project=oth")
    assert [row["run"] for row in rows] == ["b" * 16]
    assert main(["ps", "-q", "-f", "run=aaaa"]) == 0
    assert capsys.readouterr().out == "aaaaaaaa\n"
    assert main(["ps", "-f", "state=running"]) == 0
    assert capsys.readouterr().out == "no running node matches\n"
    for wrong in ("colour=red", "run", "=x"):
        assert main(["ps", "-f", wrong]) == 2
        assert f"--filter {wrong}: it must be KEY=VALUE" in capsys.readouterr().err


def test_validate_lists_problems_with_their_places(said: Any, tmp_path: Path) -> None:
    project = tmp_path / "project.json"
    project.write_text('{"nodes": [{"name": "a", "container": "neuros_python"}]}')
    found, code = said("validate", str(project))
    assert code == 3
    assert not found["is_valid"]
    (problem,) = found["problems"]
    assert problem["pointer"] == "/nodes/0"
    assert (problem["line"], problem["column"]) == (1, 12)
    assert "needs exactly one of 'plugin', 'network' or 'policy'" in problem["text"]


def test_verify_has_its_verdict(said: Any, tmp_path: Path) -> None:
    a, b = recorded(tmp_path / "a"), recorded(tmp_path / "b")
    found, code = said("verify", a, b)
    assert (found["verdict"], code) == ("unknown", 2)
    assert found.keys() == {
        *("verdict", "packets", "difference", "consumed_differently", "not_compared"),
        *("likely_cause", "notes"),
    }
    assert found["not_compared"] == [WIRE]


def test_compare_has_numbers(said: Any, tmp_path: Path) -> None:
    a = recorded(tmp_path / "a", wall_s=3.0)
    b = recorded(tmp_path / "b", wall_s=4.5)
    found, code = said("compare", a, b)
    assert code == 0
    assert len(found["runs"]) == len(found["missing"]) == 2
    assert found["figures"]["wall time / s"] == [3.0, 4.5]


@pytest.mark.process
def test_doctor_lists_what_it_has_found(said: Any) -> None:
    found, code = said("doctor", "--no-delivery")
    assert (code == 0) is all(each["state"] != "bad" for each in found)
    python = next(each for each in found if each["subject"] == "Python")
    assert python["state"] == "good"
    assert python.keys() == {"state", "subject", "text", "remedy"}
