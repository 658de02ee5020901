"""Containers whose software this environment has not, on the process back end, for real."""

from __future__ import annotations

import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from deadlines import wait_until
from launching import EXAMPLES, Finished, Running, launch, start
from packages import make_slow_package, make_wheel

from neuros.backends.pythons import HERE, find_python
from neuros.backends.run_processes import RUN_ID
from neuros.installation.machine import NEWEST, OLDEST, dotted

CONFLICT = EXAMPLES / "5_containers/conflict"
COUNT = 20
VERSIONS = [(3, minor) for minor in range(NEWEST[1], OLDEST[1] - 1, -1) if (3, minor) != HERE]
OTHER = next((version for version in VERSIONS if find_python(version, os.environ)), None)

PLUGIN = """
import neuros_colour
from neuros.hooks import neuros_initialise

@neuros_initialise()
def begin(node):
    node.get_logger().info(f"the colour is {neuros_colour.NAME}")
    if node.name == "last":
        node.shutdown("seen")
"""

BACKEND = """
import pathlib, zipfile

def build_editable(target, config_settings=None, metadata_directory=None):
    name, info = "neuros_colour-1.0-py3-none-any.whl", "neuros_colour-1.0.dist-info"
    files = {
        "neuros_colour.pth": str(pathlib.Path.cwd()),
        f"{info}/METADATA": "Metadata-Version: 2.1\\nName: neuros_colour\\nVersion: 1.0\\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n",
    }
    files[f"{info}/RECORD"] = "".join(f"{each},,\\n" for each in [*files, f"{info}/RECORD"])
    with zipfile.ZipFile(pathlib.Path(target, name), "w") as wheel:
        for each, text in files.items():
            wheel.writestr(each, text)
    return name

build_wheel = build_editable
"""


class Project:
    """A node in a container that needs a package of an index of its own; no network."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "project"
        self.index = folder / "index"
        self.cache = folder / "cache"
        self.environments = self.cache / "neuros" / "environments"
        self.index.mkdir()
        self._nodes: list[dict[str, str]] = []
        self.folder.mkdir()
        (self.folder / "plugin.py").write_text(PLUGIN)
        (self.folder / "hello.sh").write_text("echo hello")

    def node(self, name: str, container: str, requirements: str) -> None:
        folder = self.folder / "containers" / container
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "requirements.txt").write_text(requirements)
        node = {"name": name, "container": container, "plugin": "plugin.py", "script": "hello.sh"}
        self._nodes.append(node)
        (self.folder / "project.json").write_text(json.dumps({"nodes": self._nodes}))

    @property
    def environment(self) -> dict[str, str]:
        return {
            "NEUROS_BACKEND": "process",
            "PIP_NO_INDEX": "1",
            "PIP_FIND_LINKS": str(self.index),
            "UV_CACHE_DIR": str(self.cache.parent / "uv"),
            "PIP_CONFIG_FILE": os.devnull,
            "XDG_CACHE_HOME": str(self.cache),
        }

    def start(self, *arguments: str) -> Running:
        cwd = self.folder.parent
        return start(self.folder, *arguments, cwd=cwd, **self.environment)

    def launch(self, *arguments: str) -> Finished:
        with self.start(*arguments) as running:
            return running.finish(60.0)

    def left(self) -> list[str]:
        """What is in the cache, but logs."""
        if not self.environments.exists():
            return []
        return sorted(path.name for path in self.environments.iterdir() if path.suffix != ".log")

    def builds(self) -> int:
        file = self.index / "builds"
        return len(file.read_text().splitlines()) if file.exists() else 0


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return Project(tmp_path)


def processes_with(text: bytes) -> list[int]:
    """Those in whose environment it occurs."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                environment = (folder / "environ").read_bytes()
            except OSError:
                continue
            if text in environment and RUN_ID.encode() in environment:
                found.append(int(folder.name))
    return found


def run_conflict(example: Path, cwd: Path, **environment: str) -> Finished:
    command = f"nodes.planner.environment.COMMANDS={COUNT}"
    cache = str(cwd / "cache")
    return launch(
        example,
        *("--backend", "process", "--set", command),
        cwd=cwd,
        timeout_s=240.0,
        XDG_CACHE_HOME=cache,
        **environment,
    )


def assert_both_run(run: Finished, planner_python: str, gripper_python: str) -> None:
    """What each says of itself is what the other has received; nothing was lost."""
    assert run.exit_code == 0, run.output
    planner = f"python-statemachine 2.5.0 on Python {planner_python}"
    gripper = f"python-statemachine 0.9.0 on Python {gripper_python}"
    assert run.said("planner") == [f"I run {planner}", f"the gripper runs {gripper}"]
    assert run.said("gripper") == [f"I run {gripper}", f"the planner runs {planner}"]
    for connection in ("planner.command -> gripper.command", "gripper.state -> planner.state"):
        counted = run.connection(connection)
        assert counted["sent"] == counted["consumed"] == COUNT


def test_two_nodes_with_versions_of_a_library_that_exclude_each_other(tmp_path: Path) -> None:
    nowhere = {"PATH": "", "PYENV_ROOT": "/nowhere", "XDG_DATA_HOME": "/nowhere"}
    here = platform.python_version()
    assert_both_run(run_conflict(CONFLICT, tmp_path, **nowhere), here, here)
    again = run_conflict(CONFLICT, tmp_path, **nowhere)
    assert_both_run(again, here, here)
    assert "making the environment" not in again.output


@pytest.mark.acceptance
@pytest.mark.skipif(OTHER is None, reason="there is only one Python on this machine")
def test_the_same_in_two_versions_of_python(tmp_path: Path) -> None:
    assert OTHER is not None
    example = tmp_path / "conflict"
    shutil.copytree(CONFLICT, example)
    for container, version in (("statemachine_2", OTHER), ("statemachine_0", HERE)):
        (example / "containers" / container / ".python-version").write_text(dotted(version))
    program = "import platform; print(platform.python_version())"
    python = str(find_python(OTHER, os.environ))
    other = subprocess.check_output([python, "-I", "-c", program], text=True).strip()
    assert_both_run(run_conflict(example, tmp_path), other, platform.python_version())


def test_a_script_runs_in_front_of_a_node_with_an_environment_of_its_own(project: Project) -> None:
    make_wheel(project.index, "neuros_colour", "1.0", "NAME = 'red'")
    make_wheel(project.index, "neuros_colour", "2.0", "NAME = 'blue'")
    project.node("last", "old", "neuros_colour<2")
    run = project.launch()
    assert run.exit_code == 0, run.output
    assert "[last] hello" in run.output
    assert run.said("last") == ["the colour is red"]
    (environment,) = (path for path in project.environments.iterdir() if path.is_dir())
    found = environment.glob("lib/*/site-packages/*.dist-info")
    installed = [path.name for path in found if not path.is_symlink()]  # links: extensions
    assert installed == ["neuros_colour-1.0.dist-info"], "all else is that of the launcher"


def test_a_package_with_another_hash_than_the_container_names_is_refused(project: Project) -> None:
    make_wheel(project.index, "neuros_colour", "1.0", "NAME = 'red'")
    project.node("last", "exact", f"neuros_colour==1.0 --hash=sha256:{'0' * 64}")
    run = project.launch()
    assert run.exit_code == 4
    assert "Hash mismatch for `neuros-colour==1.0`" in run.output
    assert project.left() == []


def test_an_editable_package_is_run_where_it_lies(project: Project) -> None:
    folder = project.folder / "colour"
    folder.mkdir()
    (folder / "neuros_colour.py").write_text("NAME = 'red'")
    (folder / "backend.py").write_text(BACKEND)
    (folder / "pyproject.toml").write_text(
        '[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n'
        '[project]\nname = "neuros_colour"\nversion = "1.0"\n'
    )
    project.node("last", "editable", f"-e {folder}")
    assert project.launch().said("last") == ["the colour is red"]
    (folder / "neuros_colour.py").write_text("NAME = 'blue'")
    assert project.launch().said("last") == ["the colour is blue"]


def test_two_launches_at_once_make_one_environment(project: Project) -> None:
    make_slow_package(project.index, "neuros_colour", "1.0", "NAME = 'red'")
    project.node("last", "slow", "neuros_colour")
    with project.start() as first:
        wait_until(lambda: project.builds() == 1)
        with project.start() as second:
            second.wait_for("waiting for another launch that makes the environment")
            (project.index / "go").touch()
            runs = [running.finish(60.0) for running in (first, second)]
    for run in runs:
        assert run.exit_code == 0, run.output
        assert run.said("last") == ["the colour is red"]
    assert project.builds() == 1
    assert len(project.left()) == 1


def test_what_cannot_be_satisfied_is_said_at_once_and_leaves_nothing(project: Project) -> None:
    make_wheel(project.index, "neuros_colour", "1.0")
    project.node("a", "missing", "neuros_colour==7")
    project.node("last", "torn", "neuros_colour<1\nneuros_colour>1")
    project.node("b", "own", "jsonschema<4")
    run = project.launch()
    assert run.exit_code == 4
    sentences = [row for row in run.output.splitlines() if "container '" in row and "log:" in row]
    sentences = [row for row in sentences if not row.startswith("[")]
    assert len(sentences) == 3, run.output
    assert "there is no version of neuros-colour==7 and you require" in sentences[0]
    assert "(for Python {}.{}) (log: ".format(*HERE) in sentences[0]
    assert "containers/torn/requirements.txt" in sentences[1]
    assert "jsonschema" in sentences[2]
    assert "Traceback" not in run.output
    assert project.left() == []
    assert run.run_folder is None


def test_an_index_that_cannot_be_reached_is_no_fault_of_the_package(project: Project) -> None:
    project.node("last", "remote", "neuros_colour")
    online = {"PIP_NO_INDEX": "0", "PIP_RETRIES": "1", "PIP_INDEX_URL": "http://127.0.0.1:9/"}
    cwd, environment = project.folder.parent, project.environment | online
    run = launch(project.folder, cwd=cwd, timeout_s=60.0, **environment)
    assert run.exit_code == 4
    assert "cannot be reached: check the network" in run.output
    assert project.left() == []


NO_FILE_SYSTEM = subprocess.call(["unshare", "--user", "--map-root-user", "--mount", "true"]) != 0


@pytest.mark.skipif(NO_FILE_SYSTEM, reason="the kernel lets nobody mount a file system here")
def test_a_full_disk_leaves_nothing(project: Project) -> None:
    make_wheel(project.index, "neuros_colour", "1.0", f"NAME = 'red'  # {'x' * 10**6}")
    project.node("last", "large", "neuros_colour")
    project.cache.mkdir()
    launcher = [sys.executable, "-m", "neuros.cli", "launch", str(project.folder)]
    small = f"mount -t tmpfs -o size=500k none {project.cache} && {shlex.join(launcher)}"
    look = f"echo left:; ls -R {project.environments} | grep -v '[.]log$'"
    # A file system of our own, that of this process only; no rights are needed for it.
    done = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", f"{small}; {look}"],
        cwd=project.folder.parent,
        env={**os.environ, **project.environment},
        capture_output=True,
        text=True,
        timeout=180.0,
        check=False,
    )
    assert "is full: make room (df -h)" in done.stderr, done.stdout + done.stderr
    assert done.stdout.partition("left:")[2].split() == [f"{project.environments}:"]


@pytest.mark.parametrize(
    ("number", "exit_code"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -signal.SIGKILL)],
)
def test_what_is_interrupted_never_looks_whole(
    project: Project, number: signal.Signals, exit_code: int
) -> None:
    make_slow_package(project.index, "neuros_colour", "1.0", "NAME = 'red'")
    project.node("last", "slow", "neuros_colour")
    with project.start() as running:
        wait_until(lambda: project.builds() == 1)
        running.signal(number)
        assert running.finish().exit_code == exit_code
    is_ours = str(project.index).encode()
    wait_until(lambda: not processes_with(is_ours))
    assert not [*project.environments.glob("*/neuros-whole")]
    if number != signal.SIGKILL:
        assert project.left() == []
        return

    (project.index / "go").touch()
    run = project.launch()
    assert run.exit_code == 0, run.output
    assert run.said("last") == ["the colour is red"]
    assert project.builds() == 2
    assert len(project.left()) == 1


def test_an_environment_is_made_whether_or_not_somebody_reads_about_it(project: Project) -> None:
    make_slow_package(project.index, "neuros_colour", "1.0", "NAME = 'red'")
    project.node("last", "slow", "neuros_colour")
    with project.start() as running:
        wait_until(lambda: project.builds() == 1)
        assert running.process.stdout is not None
        running.process.stdout.close()
        (project.index / "go").touch()
        running.process.wait(60.0)
    wait_until(lambda: bool([*project.environments.glob("*/neuros-whole")]))


def test_in_one_process_the_node_is_named_whose_software_is_not_here(project: Project) -> None:
    project.node("last", "other", "neuros_colour<2")
    run = project.launch("--backend", "in-process")
    assert run.exit_code == 4
    assert (
        "container 'other' (node last) needs neuros_colour<2 (not installed): in one" in run.output
    )
    assert project.left() == []


def test_a_dry_run_shows_the_python_of_each_node_and_makes_nothing(project: Project) -> None:
    project.node("last", "other", "neuros_colour<2")
    project.node("first", "same", "jsonschema")
    run = project.launch("--dry-run")
    assert run.exit_code == 0
    container, last, first = run.output.splitlines()[-3:]
    assert container.startswith("container other: Python {}.{}, an envi".format(*HERE))
    folder = container.rpartition(" ")[2]
    assert last.startswith("process last")
    assert f": {folder}/bin/python -c " in last
    assert f": {sys.executable} -c " in first
    assert all(" neuros.cli node " in each for each in (last, first))
    assert not project.cache.exists()
