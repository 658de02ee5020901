"""Which Python a container gets, decided from the files in its folder."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from neuros.backends.containers import ContainerFolder, find_container
from neuros.backends.pythons import (
    HERE,
    Choice,
    Pythons,
    choose,
    find_python,
    require_one_python,
    wanted_version,
    why_no_files,
    why_uv_failed,
)
from neuros.errors import EnvironmentFault
from neuros.project.model import Node

OTHER = (3, 10) if HERE != (3, 10) else (3, 12)
NO_PYTHONS = {"PATH": "", "PYENV_ROOT": "/nowhere", "XDG_DATA_HOME": "/nowhere"}


class Project:
    """A project folder with containers; its cache is beside them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environ = {**NO_PYTHONS, "XDG_CACHE_HOME": str(folder / "cache")}

    def container(self, name: str, requirements: str, python: str | None = None) -> None:
        folder = self.folder / "containers" / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "requirements.txt").write_text(requirements)
        if python is not None:
            (folder / ".python-version").write_text(python)

    def choice(self, name: str, **environ: str) -> Choice:
        container = find_container(name, self.folder)
        assert container is not None
        return choose(container, self.folder / "cache", {**self.environ, **environ})

    def pythons(self, **containers: str) -> Pythons:
        return Pythons.choose(nodes(containers), self.folder, self.environ)


def nodes(containers: Mapping[str, str]) -> list[Node]:
    """Nodes by name, with their containers."""
    return [Node(name, container, Path("plugin.py")) for name, container in containers.items()]


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return Project(tmp_path)


def stand_in(folder: Path, version: tuple[int, int], says: str | None = None) -> Path:
    """A program that answers as that Python would."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "python{}.{}".format(*version)
    path.write_text(f"#!/bin/sh\necho {says or 'cpython {} {}'.format(*version)}\n")
    path.chmod(0o755)
    return path


class TestFolders:
    def test_the_projects_container_goes_before_neuros_own(self, tmp_path: Path) -> None:
        own = tmp_path / "own"
        for folder in (own / "snn", own / "robot", tmp_path / "containers" / "snn"):
            folder.mkdir(parents=True)
        snn, robot = (find_container(name, tmp_path, own) for name in ("snn:latest", "robot"))
        assert snn is not None
        assert robot is not None
        assert (snn.folder, snn.is_own) == (tmp_path / "containers" / "snn", False)
        assert (robot.folder, robot.is_own) == (own / "robot", True)

    @pytest.mark.parametrize("name", ["absent", "..", "registry.org/snn", "", ".", "snn:2"])
    def test_other_names_are_images_from_elsewhere(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "containers" / "snn").mkdir(parents=True)
        assert find_container(name, tmp_path, tmp_path / "own") is None


class TestVersions:
    @pytest.mark.parametrize("text", ["3.12", "# ours\n\n3.12.4\n3.11", "cpython-3.12", "3.12\n"])
    def test_the_file_says_which_python(self, tmp_path: Path, text: str) -> None:
        (tmp_path / ".python-version").write_text(text)
        assert wanted_version(tmp_path) == (3, 12)

    @pytest.mark.parametrize("text", ["3.9", "pypy3.10", "system", "", "3.99"])
    def test_a_python_without_ros_is_refused(self, tmp_path: Path, text: str) -> None:
        (tmp_path / ".python-version").write_text(text)
        with pytest.raises(EnvironmentFault, match=r"python-version asks for Python .*3\.10 to"):
            wanted_version(tmp_path)

    def test_without_the_file_any_python_does(self, tmp_path: Path) -> None:
        assert wanted_version(tmp_path) is None

    @pytest.mark.parametrize(
        ("place", "variable", "value"),
        [
            ("bin", "PATH", "bin"),
            ("versions/3.10.1/bin", "PYENV_ROOT", ""),
            ("uv/python/cpython-3.10/bin", "XDG_DATA_HOME", ""),
        ],
    )
    def test_it_is_found_where_pythons_are(
        self, tmp_path: Path, place: str, variable: str, value: str
    ) -> None:
        python = stand_in(tmp_path / place, (3, 10))
        environ = {**NO_PYTHONS, variable: str(tmp_path / value)}
        assert find_python((3, 10), environ) == python
        assert find_python((3, 12), environ) is None

    def test_what_only_looks_like_it_is_passed_over(self, tmp_path: Path) -> None:
        stand_in(tmp_path / "shims", (3, 10), "pyenv: command not found >&2; exit 127")
        stand_in(tmp_path / "pypy", (3, 10), "pypy 3 10")
        real = stand_in(tmp_path / "real", (3, 10))
        path = os.pathsep.join(str(tmp_path / name) for name in ("shims", "pypy", "real"))
        assert find_python((3, 10), {**NO_PYTHONS, "PATH": path}) == real


class TestChoices:
    def test_what_this_environment_satisfies_runs_in_it(self, project: Project) -> None:
        project.container("snn", "jsonschema")
        choice = project.choice("snn")
        assert choice.path == Path(sys.executable)
        assert choice.base is None
        choice.record_use()
        assert project.choice("snn").path == Path(sys.executable)

    def test_half_an_environment_is_not_recorded_as_whole(self, project: Project) -> None:
        project.container("snn", "jsonschema")
        choice = project.choice("snn")
        choice.entry.future_python.parent.mkdir(parents=True)
        choice.entry.future_python.symlink_to(sys.executable)
        choice.record_use()
        assert choice.entry.python() is None

    def test_what_it_lacks_gets_an_environment_on_top_of_it(self, project: Project) -> None:
        project.container("snn", "jsonschema<4")
        choice = project.choice("snn")
        assert choice.base is not None
        assert choice.is_layered
        assert choice.path == choice.entry.folder / "bin/python"
        assert "jsonschema<4" in choice.lacks[0]

    def test_another_python_gets_a_whole_environment(self, project: Project) -> None:
        project.container("snn", "jsonschema", "{}.{}".format(*OTHER))
        python = stand_in(project.folder / "bin", OTHER)
        choice = project.choice("snn", PATH=str(python.parent))
        assert (choice.base, choice.version, choice.is_layered) == (python, OTHER, False)

    def test_without_that_python_this_one_does_and_says_so(self, project: Project) -> None:
        project.container("snn", "jsonschema", "{}.{}".format(*OTHER))
        choice = project.choice("snn")
        assert choice.path == Path(sys.executable)
        assert "prefers Python {}.{} (".format(*OTHER) in choice.notice
        assert choice.notice.endswith("it gets Python {}.{}".format(*HERE))

    def test_of_neuros_own_containers_any_version_here_does(self, project: Project) -> None:
        folder = project.folder / "neuros_snn"
        folder.mkdir()
        (folder / "requirements.txt").write_text("jsonschema==1.0")
        for is_own in (True, False):
            container = ContainerFolder("neuros_snn", folder, is_own)
            choice = choose(container, project.folder / "cache", project.environ)
            assert (choice.path == Path(sys.executable)) == is_own

    def test_another_content_is_another_environment(self, project: Project) -> None:
        keys = set()
        for text in ("jsonschema<4", "jsonschema<3", "jsonschema<4"):
            project.container("snn", text)
            keys.add(project.choice("snn").entry)
        project.container("snn", "jsonschema<4", "{}.{}".format(*OTHER))
        python = stand_in(project.folder / "bin", OTHER)
        keys.add(project.choice("snn", PATH=str(python.parent)).entry)
        assert len(keys) == 3

    def test_what_is_installed_here_later_is_another_environment(
        self, project: Project, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        project.container("snn", "jsonschema<4")
        before = project.choice("snn").entry
        packages = project.folder / "site-packages"
        (packages / "jsonschema-3.2.dist-info").mkdir(parents=True)
        monkeypatch.syspath_prepend(str(packages))
        assert project.choice("snn").entry != before


class TestRuns:
    def test_only_nodes_with_a_python_of_their_own_are_named(self, project: Project) -> None:
        project.container("snn", "jsonschema<4")
        project.container("robot", "jsonschema")
        pythons = project.pythons(a="snn", b="snn", c="robot", d="an_image")
        assert set(pythons.paths) == {"a", "b"}
        assert pythons.paths["a"] == pythons.paths["b"]
        assert not pythons.is_made
        (line,) = pythons.describe()
        assert line.startswith("container snn: Python {}.{}, an environment that".format(*HERE))

    def test_nothing_is_written_before_it_is_used(self, project: Project) -> None:
        project.container("robot", "jsonschema")
        pythons = project.pythons(c="robot")
        assert not (project.folder / "cache").exists()
        pythons.record_use()
        assert len(list((project.folder / "cache/neuros/environments").iterdir())) == 1

    def test_what_is_wrong_in_all_containers_is_said_at_once(self, project: Project) -> None:
        project.container("snn", "", "2.7")
        project.container("robot", "-r absent.txt")
        with pytest.raises(EnvironmentFault) as caught:
            project.pythons(a="snn", b="robot")
        assert len(str(caught.value).splitlines()) == 2

    def test_one_process_has_one_python(self, project: Project) -> None:
        project.container("snn", "jsonschema<4")
        project.container("robot", "no-such-package")
        project.container("good", "jsonschema", "{}.{}".format(*OTHER))
        containers = {"a": "snn", "b": "snn", "c": "robot", "d": "good"}
        with pytest.raises(EnvironmentFault) as caught:
            require_one_python(nodes(containers), project.folder, project.environ)
        text = str(caught.value)
        assert text.startswith("container 'snn' (nodes a, b) needs jsonschema<4 (")
        assert "; container 'robot' (node c) needs no-such-package (not installed): in one" in text
        assert "use --backend process" in text
        require_one_python(nodes({"d": "good"}), project.folder, project.environ)


# ------------------------------------------------------------------ failures

UNSATISFIABLE = """\
error: No solution found when resolving dependencies
  cause: Because {}, we can conclude that your requirements are unsatisfiable.
"""


@pytest.mark.parametrize(
    ("output", "sentence"),
    [
        (
            UNSATISFIABLE.format("there is no version of a==9 and you require a==9"),
            "there is no version of a==9 and you require a==9 (for Python 3.12)",
        ),
        (
            UNSATISFIABLE.format("you require jsonschema<4 and jsonschema>=4,<5"),
            "you require jsonschema<4 and jsonschema>=4,<5 (for Python 3.12);"
            " NeuROS needs jsonschema<5,>=4",
        ),
        ("error: Failed to parse: `a b`\n  cause: Expected", "Failed to parse: `a b`: Expected"),
        ("", "uv failed"),
    ],
)
def test_what_uv_says(output: str, sentence: str) -> None:
    assert why_uv_failed(output, "3.12", ["jsonschema<5,>=4", "tabulate"]) == sentence


def test_without_a_network_no_package_is_blamed() -> None:
    output = "Connection refused\n" + UNSATISFIABLE.format("a was not found")
    sentence = why_uv_failed(output, "3.12", [])
    assert "cannot be reached" in sentence
    assert sentence.endswith("then launch again")


def test_a_folder_that_cannot_be_written_is_named() -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/c/x")
    assert why_no_files(full, Path("/c")).startswith("the disk of /c is full: make room")
    refused = OSError(errno.EROFS, os.strerror(errno.EROFS), "/c/x")
    assert why_no_files(refused, Path("/c")).startswith("/c/x: Read-only file system: set XDG")
