"""The recipes of CONTRIBUTING.md, followed in a copy: so many files change, and it works."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from distributions import path_with

ROOT = Path(__file__).resolve().parents[1]


PLUGIN = "from neuros.hooks import *\n@neuros_initialise()\ndef begin(node): pass\n"
_PORT = {"name": "x", "type": "std_msgs/msg/Float64"}
_NODE = {"container": "neuros_python", "plugin": "plugin.py"}
TWO_NODES = ({**_NODE, "name": "a", "outputs": [_PORT]}, {**_NODE, "name": "b", "inputs": [_PORT]})
ENDS = {
    "source_node": "a",
    "source_output": "x",
    "destination_node": "b",
    "destination_input": "x",
}


class Checkout:
    """A copy of what NeuROS is made of, in which files are changed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.changed: set[str] = set()
        skipped = shutil.ignore_patterns("__pycache__", "static")
        shutil.copytree(ROOT / "neuros", folder / "neuros", ignore=skipped, symlinks=True)
        for name in ("schema", "containers"):
            shutil.copytree(ROOT / name, folder / name)

    def insert(self, file: str, before: str, text: str) -> None:
        """Put text into a file, before another one that is there once."""
        path = self.folder / file
        source = path.read_text("utf-8")
        assert source.count(before) == 1, f"{file} has {source.count(before)} times: {before}"
        path.write_text(source.replace(before, text + before), "utf-8")
        self.changed.add(file)

    def run(self, *arguments: str) -> str:
        """What Python prints in the copy."""
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(self.folder), "COLUMNS": "200"},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def write_project(
        self, nodes: Sequence[Mapping[str, Any]] = TWO_NODES, **keys_of_connection: Any
    ) -> None:
        """A project with these nodes; of two, the first sends to the second."""
        (self.folder / "plugin.py").write_text(PLUGIN)
        connections = [{**ENDS, **keys_of_connection}] if len(nodes) > 1 else []
        project = {"nodes": nodes, "connections": connections}
        (self.folder / "project.json").write_text(json.dumps(project))


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_a_launch_flag_touches_two_files(checkout: Checkout) -> None:
    checkout.insert(
        "neuros/api/request.py",
        "    verbose: bool = option(",
        '    quiet: bool = option("-q", "--quiet", default=False,'
        ' help="print nothing of the plan")\n',
    )
    checkout.insert(
        "neuros/cli/launch.py",
        "    messages = plan.messages.describe()",
        "    if plan.request.quiet:\n        return 0\n",
    )
    assert len(checkout.changed) == 2

    checkout.write_project()
    neuros = ("-m", "neuros.cli", "launch")
    assert "-q, --quiet           print nothing of the plan" in checkout.run(*neuros, "--help")
    assert "process a" in checkout.run(*neuros, ".", "--dry-run", "--backend", "process")
    assert "process a" not in checkout.run(*neuros, ".", "--dry-run", "--backend", "process", "-q")
    program = (
        "import inspect, sys, neuros\n"
        "from neuros.api.request import Request\n"
        "from neuros.options import recorded_values\n"
        "argument = inspect.signature(neuros.Project.run).parameters['quiet']\n"
        "assert (argument.annotation, argument.default) == ('bool', False)\n"
        "assert 'quiet: ``--quiet``: print nothing of the plan.' in neuros.Project.run.__doc__\n"
        "assert recorded_values(Request(quiet=True))['quiet'] is True\n"
        f"sys.path.append({str(ROOT / 'docs')!r})\n"
        "from site_parts.command_line import add_option_tables\n"
        "page = ['<!-- options of LaunchOptions -->']\n"
        "add_option_tables(None, 'docs/command_line', page)\n"
        "assert '`-q`, `--quiet` | `quiet` | print nothing of the plan |' in page[0], page[0]\n"
    )
    checkout.run("-c", program)


def test_a_key_of_a_connection_touches_three_files(checkout: Checkout) -> None:
    schema = "schema/node.schema.json"
    checkout.insert(
        schema,
        '        "queue_size": {\n          "title"',
        '        "note": {"title": "Note", "description": "For people.", "type": "string",'
        ' "default": "", "examples": ["as measured"]},\n',
    )
    checkout.insert(schema, '              "queue_size": true', '              "note": true,\n')
    checkout.insert(
        "neuros/project/model.py", "    index: int = 0\n    namespace", '    note: str = ""\n'
    )
    checkout.insert(
        "neuros/project/graph.py",
        '    return words + (f", queue',
        "    words += f', {connection.note}' if connection.note else ''\n",
    )
    assert len(checkout.changed) == 3

    checkout.write_project(note="as measured")
    neuros = ("-m", "neuros.cli")
    assert "valid: 2 nodes" in checkout.run(*neuros, "validate", ".")
    assert "as measured" in checkout.run(*neuros, "graph", ".")
    settings = ("--set", "connections.a.x.b.x.note=as guessed")
    assert "as guessed" in checkout.run(*neuros, "graph", ".", *settings)
    program = (
        "from pathlib import Path\n"
        "from neuros.api.loading import load_with_messages\n"
        "from neuros.project.model import Folders\n"
        "from neuros.project.split import node_file_from_json, node_file_to_json, split\n"
        "project = load_with_messages(Path('.'))[0].project\n"
        "folders = Folders(*[Path.cwd()] * 3)\n"
        "for file in split(project, lambda _: folders):\n"
        "    assert file.connections[0].note == 'as measured'\n"
        "    assert node_file_from_json(node_file_to_json(file)).connections == file.connections\n"
    )
    checkout.run("-c", program)


def test_a_sensor_touches_one_file(checkout: Checkout) -> None:
    pytest.importorskip("mujoco")
    sensors = "neuros/simulators/mujoco/sensors.py"
    checkout.insert(
        sensors,
        "SENSORS: Mapping[str, type[Sensor]]",
        "class Energy(Sensor):\n"
        '    """Kinetic energy of the whole model, in joules."""\n\n'
        '    kind = "energy"\n'
        '    types = ("std_msgs/msg/Float64",)\n\n'
        "    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:\n"
        "        mujoco.mj_energyVel(self.model, data)\n"
        "        packet.data = float(data.energy[1])\n\n\n",
    )
    checkout.insert(sensors, "Camera, Clock)", "Energy, ")
    assert checkout.changed == {sensors}
    checkout.run("-c", "from neuros.simulators.mujoco.sensors import write_schema; write_schema()")

    sensor = {"sensor": "energy", "rate": 10}
    output = {"name": "energy", "type": "std_msgs/msg/Float64", "mujoco": sensor}
    node = {"name": "body", "container": "neuros_mujoco", "plugin": "plugin.py"}
    checkout.write_project(nodes=[{**node, "outputs": [output]}])
    assert "valid: 1 node" in checkout.run("-m", "neuros.cli", "validate", ".")
    model = (
        '<mujoco><option gravity="0 0 -10" timestep="0.01"/><worldbody><body>'
        '<freejoint/><geom size="0.1" mass="2"/></body></worldbody></mujoco>'
    )
    program = (
        f"import sys; sys.path.append({str(ROOT / 'tests/support')!r})\n"
        "from simulated_node import SimulatedNode\n"
        "from neuros.simulators.mujoco import MuJoCo\n"
        f"outputs = {{'energy': ('std_msgs/msg/Float64', {sensor})}}\n"
        f"simulator = MuJoCo(SimulatedNode(outputs), {model!r})\n"
        "simulator.step_to_next()\n"
        "energy = simulator.read('energy').data\n"
        "assert abs(energy - 0.5 * 2.0 * 1.0**2) < 1e-6, energy\n"  # 0.1 s at 10 m/s^2
    )
    checkout.run("-c", program)


def test_an_extension_adds_a_command_an_option_of_launch_and_a_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    diary = tmp_path / "diary.txt"
    monkeypatch.setenv("PYTHONPATH", path_with(tmp_path / "site", "neuros_diary"))
    monkeypatch.setenv("DIARY", str(diary))
    project = str(ROOT / "examples/1_tick/clock")
    launch = ("launch", project, "--backend", "in-process", "--duration", "0.1")
    neuros("doctor", "--no-delivery", prints=f"ok       diary        {diary}")
    neuros("--help", prints="print the diary of runs")
    neuros("launch", "--help", prints="--diary TEXT")
    neuros(*launch, "--diary", "it ticks", "-o", str(tmp_path / "run"), prints="0.1 s are over")
    neuros("diary", "ticks", prints=f"clock: it ticks ({tmp_path / 'run'})\n")

    monkeypatch.setenv("DIARY", "/nowhere/diary.txt")
    wrong = "/nowhere/diary.txt cannot be written: set DIARY to another file"
    neuros("doctor", "--no-delivery", prints=wrong, exit_code=4)
    neuros(*launch, "--diary", "no", prints=f"neuros: --diary: {wrong}", exit_code=4)


def neuros(*arguments: str, prints: str, exit_code: int = 0) -> None:
    """Call a command, which prints this among other lines."""
    command = [sys.executable, "-m", "neuros.cli", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == exit_code, done.stdout + done.stderr
    assert prints in done.stdout + done.stderr
