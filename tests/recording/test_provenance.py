"""What a run was made of."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import psutil
import pytest
from deadlines import wait_until
from needs import require

from neuros.project.model import Node
from neuros.recording.provenance import (
    GitState,
    installed_packages,
    note_versions,
    provenance,
    seeds,
)


def node(name: str, **environment: str) -> Node:
    return Node(name, "neuros_python", Path("plugin.py"), environment=environment)


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=Test", "-c", "user.email=test@example.org"]
    done = subprocess.run(
        ["git", *identity, "-C", str(folder), *arguments],
        check=True,
        capture_output=True,
        text=True,
    )
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    require("git")
    git(tmp_path, "init", "-q")
    (tmp_path / "project").mkdir()
    (tmp_path / "project/project.json").write_text("{}")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "First")
    return tmp_path


def test_seeds_are_found_in_the_environment_of_nodes() -> None:
    nodes = [node("robot", SEED="7", SPEED="3"), node("snn", NEST_SEED="8"), node("plot")]
    assert seeds(nodes) == {"robot": {"SEED": "7"}, "snn": {"NEST_SEED": "8"}}


def test_versions_name_what_is_installed(tmp_path: Path) -> None:
    versions = provenance(["launch.py", "tennis"], [], tmp_path)["versions"]
    assert versions["packages"]["pytest"] == pytest.__version__
    assert {"neuros", "python", "kernel"} < set(versions)


def test_versions_of_nodes_are_named_where_they_differ(tmp_path: Path) -> None:
    nodes = [node(name) for name in ("same", "other", "never", "torn")]
    for each in nodes:
        (tmp_path / each.name).mkdir()
    note_versions(tmp_path / "same")
    other = {"python": "3.13.1", "packages": {"numpy": "1.0"}}
    (tmp_path / "other/versions.json").write_text(json.dumps(other))
    (tmp_path / "torn/versions.json").write_text('{"python":')
    assert provenance([], nodes, tmp_path)["versions"]["nodes"] == {"other": other}


def test_the_first_of_two_versions_on_the_path_counts(tmp_path: Path) -> None:
    for folder, version in (("a", "1.0"), ("b", "2.0")):
        (tmp_path / folder / f"thing-{version}.dist-info").mkdir(parents=True)
    folders = [str(tmp_path / name) for name in ("a", "missing", "b")]
    assert installed_packages(folders) == {"thing": "1.0"}


def test_a_project_that_is_committed_is_clean(repository: Path) -> None:
    state = GitState(repository / "project").finish()
    assert state == {"commit": git(repository, "rev-parse", "HEAD"), "is_dirty": False}


@pytest.mark.parametrize("name", ["project/project.json", "project/new.py"])
def test_a_change_or_a_new_file_in_its_folder_makes_it_dirty(repository: Path, name: str) -> None:
    (repository / name).write_text("changed")
    assert GitState(repository / "project").finish()["is_dirty"] is True


def test_a_change_elsewhere_does_not(repository: Path) -> None:
    (repository / "elsewhere.txt").write_text("new")
    assert GitState(repository / "project").finish()["is_dirty"] is False


def test_a_folder_outside_of_any_repository_has_no_commit(tmp_path: Path) -> None:
    assert GitState(tmp_path).finish() is None


def test_a_machine_without_git_has_no_commit(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", os.devnull)
    assert GitState(repository).finish() is None


def test_while_the_run_goes_on_git_is_not_left_as_a_zombie(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = tmp_path / "bin/git"
    fake.parent.mkdir()
    fake.write_text(
        f"#!/bin/sh\necho $$ > {tmp_path}/pid.new\nmv {tmp_path}/pid.new {tmp_path}/pid\n"
    )
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{fake.parent}{os.pathsep}{os.environ['PATH']}")
    state = GitState(tmp_path)
    wait_until((tmp_path / "pid").exists, 10.0)
    pid = int((tmp_path / "pid").read_text())
    wait_until(lambda: not psutil.pid_exists(pid), 10.0)
    assert state.finish() is not None
