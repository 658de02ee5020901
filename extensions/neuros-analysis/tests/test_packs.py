"""``neuros pack`` and ``neuros verify FILE``: a run in one file, which is run again from it."""

from __future__ import annotations

import json
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from launching import EXAMPLES, launch
from neuros_analysis import packs

from neuros.cli.main import main

STRICT = EXAMPLES / "2_synchronisation/tennis"
CHANCE = """
import os
from neuros.hooks import neuros_function, neuros_initialise
@neuros_initialise(outputs="ball")
def serve(node):
    packet = node.make_packet("ball")
    packet.data = int.from_bytes(os.urandom(4), "little") // 2
    return packet
@neuros_function(inputs="back")
def catch(node, back):
    node.shutdown("caught")
"""


def project_of_chance(folder: Path) -> Path:
    """A node that sends itself another number in every run."""
    folder.mkdir()
    (folder / "chance.py").write_text(CHANCE)
    port = {"type": "std_msgs/msg/Int32"}
    node = {"name": "dice", "container": "neuros_python", "plugin": "chance.py"}
    node |= {"inputs": [{"name": "back", **port}], "outputs": [{"name": "ball", **port}]}
    ends = {"source_node": "dice", "source_output": "ball", "discard_limit": 0}
    ends |= {"destination_node": "dice", "destination_input": "back"}
    file = folder / "project.json"
    file.write_text(json.dumps({"nodes": [node], "connections": [ends]}))
    return folder


def run_of(project: Path, folder: Path, *options: str) -> Path:
    finished = launch(project, "-o", str(folder), *options, cwd=folder.parent)
    assert finished.exit_code == 0, finished.output
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_of(STRICT, tmp_path_factory.mktemp("runs") / "first")


@pytest.fixture(scope="module")
def packed(run: Path) -> Path:
    file = run.parent / "first.crate.zip"
    assert main(["pack", str(run), "-o", str(file)]) == 0
    return file


@pytest.fixture
def this_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """This Python in place of a new environment, which takes a minute."""
    monkeypatch.setattr(packs, "_environment", lambda folder, version: Path(sys.executable))


def metadata_of(file: Path) -> Mapping[str, Mapping[str, Any]]:
    """The entities of a crate by their ids."""
    with zipfile.ZipFile(file) as archive:
        graph = json.loads(archive.read(packs.METADATA))["@graph"]
    return {entity["@id"]: entity for entity in graph}


def rewritten(packed: Path, file: Path, changes: Mapping[str, bytes]) -> Path:
    with zipfile.ZipFile(packed) as old, zipfile.ZipFile(file, "w") as new:
        contents = {name: old.read(name) for name in old.namelist()}
        for name, data in {**contents, **changes}.items():
            new.writestr(name, data)
    return file


def test_a_pack_is_a_crate_with_the_project_the_run_and_all_packages(packed: Path) -> None:
    entities = metadata_of(packed)
    with zipfile.ZipFile(packed) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
        requirements = archive.read("requirements.txt").decode().split()
    assert {"project/project.json", "run/run.json", "lib/neuros/__init__.py"} <= names
    assert any(name.endswith(".digests") for name in names)
    assert {name for name, each in entities.items() if each["@type"] == "File"} == names - {
        packs.METADATA
    }
    assert entities["#run"]["object"] == {"@id": "project/project.json"}
    assert entities["#run"]["actionStatus"] == {"@id": "http://schema.org/CompletedActionStatus"}
    assert {each.partition("==")[0] for each in requirements} > {"msgspec", "ros-rclpy", "numpy"}
    assert not any(each.startswith(("neuros", "pytest")) for each in requirements)


@pytest.mark.usefixtures("this_python")
def test_the_packed_run_is_run_again_and_is_identical(
    packed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(packed)]) == 0
    assert capsys.readouterr().out == "identical: 10 packets\n"


@pytest.mark.usefixtures("this_python")
def test_a_project_that_does_something_else_again_is_found_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(project_of_chance(tmp_path / "dice"), tmp_path / "thrown", "--record")
    assert main(["pack", str(run), "-o", str(tmp_path / "dice.zip")]) == 0
    capsys.readouterr()
    assert main(["verify", str(tmp_path / "dice.zip"), "--format", "json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "different"
    assert found["difference"].startswith("dice.ball -> dice.back: packet 1 differs")


@pytest.mark.parametrize(
    "changes", [{"project/player.py": b"another plugin"}, {"lib/neuros/more.py": b"a new file"}]
)
def test_a_pack_that_was_changed_is_refused(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, bytes]
) -> None:
    file = rewritten(packed, tmp_path / "changed.zip", changes)
    assert main(["verify", str(file)]) == 2
    (name,) = changes
    assert f"was changed after it was packed: {name}" in capsys.readouterr().err


@pytest.mark.parametrize("text", [b"", b"PK\x03\x04 half of a file"])
def test_another_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: bytes
) -> None:
    (tmp_path / "notes.zip").write_bytes(text)
    assert main(["verify", str(tmp_path / "notes.zip")]) == 2
    assert "is not what `neuros pack` writes: BadZipFile" in capsys.readouterr().err


def test_one_run_folder_is_not_enough_for_verify(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(run)]) == 2
    assert "name another run folder after it, or a file of `neuros pack`" in capsys.readouterr().err


def test_a_run_whose_project_was_changed_is_not_packed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = project_of_chance(tmp_path / "dice")
    run = run_of(project, tmp_path / "thrown")
    text = (project / "project.json").read_text()
    (project / "project.json").write_text(text.replace("neuros_python", "neuros_nest"))
    assert main(["pack", str(run), "-o", str(tmp_path / "dice.zip")]) == 2
    assert "project.json was changed after the run" in capsys.readouterr().err
    (project / "project.json").unlink()
    assert main(["pack", str(run), "-o", str(tmp_path / "dice.zip")]) == 2
    assert "its project file is gone" in capsys.readouterr().err
    assert not (tmp_path / "dice.zip").exists()


def test_no_file_is_overwritten(
    packed: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["pack", str(run), "-o", str(packed)]) == 2
    assert "exists already: name a new file" in capsys.readouterr().err


@pytest.mark.acceptance
def test_it_is_run_again_in_an_environment_of_its_own(
    packed: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(packed)]) == 0
    out, err = capfd.readouterr()
    assert out == "identical: 10 packets\n"
    assert "making an environment of Python" in err
