"""``neuros new`` and ``neuros example`` make folders that can be run and changed."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

from neuros.cli.main import main
from neuros.distribution import EXAMPLES, PACKAGE


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_all_examples_are_listed_in_learning_order(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["example"]) == 0
    said = capsys.readouterr().out
    names = [line.split()[0] for line in said.splitlines() if "  " in line]
    assert {*names} == {file.parent.name for file in EXAMPLES.glob("*/*/project.json")}
    assert names[0] == "clock"
    assert "whiskeye           A spiking network in NEST tracks the heading of a robot" in said
    assert main(["example", "--format", "json"]) == 0
    assert [each["name"] for each in json.loads(capsys.readouterr().out)] == names


def test_a_copy_is_valid_and_finds_the_schema(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["example", "tennis"]) == 0
    assert "the next command: neuros launch tennis\n" in capsys.readouterr().out
    assert main(["validate", "tennis"]) == 0
    copied = json.loads((tmp_path / "tennis" / "project.json").read_text("utf-8"))
    schema = Path(copied["$schema"].removeprefix("file://"))
    assert schema.samefile(PACKAGE / "schema" / "project.schema.json")


def test_the_page_of_a_copy_has_the_commands_that_work_beside_it(tmp_path: Path) -> None:
    assert main(["example", "rover", "lab/my rover"]) == 0
    page = (tmp_path / "lab" / "my rover" / "README.md").read_text("utf-8")
    assert "neuros launch lab/my rover" in page
    assert "launch.py" not in page
    assert ".venv" not in page


def test_variants_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["example", "elevator"]) == 0
    said = capsys.readouterr().out
    assert "as neuros launch elevator/asynchronous.json" in said
    assert "controller.json" not in said, "it is a node"


def test_a_mistyped_name_is_answered_with_the_one_that_was_meant(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["example", "wiskeye"]) == 2
    said = capsys.readouterr().err
    assert said == "neuros: there is no example 'wiskeye' (did you mean 'whiskeye'?)\n"


@pytest.mark.parametrize("command", [["new", "mine"], ["example", "clock", "mine"]])
def test_nothing_is_overwritten(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("of mine")
    assert main(command) == 2
    assert capsys.readouterr().err == "neuros: mine exists already: name another folder\n"
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_a_folder_that_cannot_be_made_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["new", "file/mine"]) == 2
    said = capsys.readouterr().err
    assert said == "neuros: file/mine cannot be made (Not a directory): name another folder\n"


def test_a_new_project_is_valid_and_its_test_passes(tmp_path: Path) -> None:
    assert main(["new", "mine"]) == 0
    assert main(["validate", "mine"]) == 0
    tests = runpy.run_path(str(tmp_path / "mine" / "test_brain.py"))
    tests["test_the_brain_turns_back"]()
    assert (tmp_path / "mine" / ".gitignore").is_file()
