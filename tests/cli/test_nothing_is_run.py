"""``validate`` and ``graph`` read a stranger's project, and run nothing of it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from message_packages import write_package
from needs import COMPILER

NEUROS = Path(sys.executable).with_name("neuros")
STRING = "std_msgs/msg/String"
MODEL = '<mujoco><option timestep="0.01"/><worldbody/></mujoco>'


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project in which all that could be run leaves a file behind."""
    folder = tmp_path / "project"
    folder.mkdir()
    trap = f"open({str(tmp_path / 'was run')!r}, 'w').close()\n"
    shell_trap = f"#!/bin/sh\ntouch '{tmp_path}/was run'\n"
    plugin = trap + (
        "import helper, os\n"
        "from neuros.hooks import neuros_tick\n"
        "from neuros.simulators.mujoco import MuJoCo\n"
        "robot = MuJoCo(os.environ['MODEL'])\n"
        "@neuros_tick(seconds=0.1, outputs='x')\n"
        "def send(node):\n    return None\n"
    )
    files = {
        "plugin.py": plugin,
        "prepare.sh": shell_trap,
        "model.xml": MODEL,
        "containers/own/Dockerfile": "FROM neuros_python\nRUN touch /was_run\n",
        "containers/own/requirements.txt": "--index-url http://127.0.0.1:1/\nnothing\n",
        **dict.fromkeys(
            (
                *("helper.py", "sitecustomize.py", "usercustomize.py", "conftest.py", "setup.py"),
                *("json.py", "signal.py", "jsonschema.py", "mujoco.py", "plugin_msgs/__init__.py"),
                *("workspace/things/setup.py", "workspace/things/things/__init__.py"),
                "plugin_msgs/msg/__init__.py",
            ),
            trap,
        ),
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    write_package(folder / "workspace", "thing_msgs", {"msg/Thing.msg": "int32 x\n"})
    node: dict[str, Any] = {
        "name": "a", "container": "own", "plugin": "plugin.py", "script": "prepare.sh",
        "outputs": [
            {"name": "x", "type": STRING, "mujoco": {"sensor": "clock", "rate": 50}},
            {"name": "y", "type": "plugin_msgs/msg/Thing", "external_topic": "/y"},
            {"name": "z", "type": "thing_msgs/msg/Thing", "external_topic": "/z"},
        ],
        "environment": {"MODEL": "#model.xml"},
    }  # fmt: skip
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}))
    return folder


def neuros(project: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run([NEUROS], project, *arguments)


def run(
    program: list[str | Path], project: Path, *arguments: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*program, *arguments],
        cwd=project,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.parametrize("program", [[NEUROS], [sys.executable, "-m", "neuros.cli"]])
@pytest.mark.parametrize(
    "command",
    [
        ["validate"],
        ["validate", "--set", "nodes.a.environment.SEED=1"],
        ["graph"],
        ["graph", "--format", "svg"],
    ],
)
def test_nothing_of_a_project_is_run_to_look_at_it(
    project: Path, command: list[str], program: list[str | Path]
) -> None:
    finished = run(program, project, *command, ".")
    assert finished.returncode == 0, finished.stderr
    assert not (project.parent / "was run").exists()
    assert not [*project.rglob("__pycache__")]


@pytest.mark.needs(*COMPILER)
def test_only_import_runs_plugins(project: Path) -> None:
    node: dict[str, Any] = {"name": "a", "container": "neuros_python", "plugin": "plugin.py"}
    node["outputs"] = [{"name": "x", "type": STRING}]
    (project / "project.json").write_text(json.dumps({"nodes": [node]}))
    finished = neuros(project, "validate", "--import", ".")
    assert (project.parent / "was run").exists(), finished.stdout + finished.stderr


@pytest.mark.parametrize("kind", ["robot.urdf", "robot.sdf"])
def test_a_description_names_no_file_outside_but_what_it_needs(tmp_path: Path, kind: str) -> None:
    """Neither xacro nor XInclude is a program here; entities are refused."""
    (tmp_path / "secret").write_text("secret")
    root = "robot" if kind.endswith("urdf") else "sdf"
    inside = '<link name="a"/>' if root == "robot" else '<model name="m"><link name="a"/></model>'
    (tmp_path / kind).write_text(
        f'<{root} name="r" version="1.9" xmlns:xi="http://www.w3.org/2001/XInclude"'
        ' xmlns:xacro="http://ros.org/wiki/xacro">'
        f'<xi:include href="file://{tmp_path}/secret" parse="text"/>'
        f"<xacro:property name='x' value=\"${{open('{tmp_path}/was run', 'w')}}\"/>"
        f"{inside}</{root}>"
    )
    finished = neuros(tmp_path, "convert", kind)
    written = tmp_path / "robot.xml"
    text = finished.stdout + finished.stderr + (written.read_text() if written.exists() else "")
    assert finished.returncode in (0, 3), text
    assert "secret<" not in text
    assert "secret\n" not in text
    assert not (tmp_path / "was run").exists()
