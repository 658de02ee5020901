"""What is found in plugins without running them: by ``validate``, and before anything starts."""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.errors import HookError, ProjectError
from neuros.project.load import LoadedProject, load_project
from neuros.project.plugin_files import read_plugin
from neuros.testing import PluginHarness

INT = "std_msgs/msg/Int32"
Check = Callable[..., LoadedProject]
FINE = "@neuros_function(inputs='imu', outputs='rate')\ndef step(node, imu): return imu\n"


@pytest.fixture
def check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Check:
    """Load a project whose node ``brain`` has a plugin of this text."""
    monkeypatch.chdir(tmp_path)

    def check(
        text: str, *, head: str = "from neuros.hooks import *", overrides: Sequence[str] = ()
    ) -> LoadedProject:
        (tmp_path / "brain.py").write_text(f"{head}\n{textwrap.dedent(text)}")
        (tmp_path / "robot.py").write_text(f"{head}\n@neuros_tick(1)\ndef tick(node): pass")
        project = {
            "nodes": [
                {
                    "name": "brain",
                    "container": "neuros_python",
                    "plugin": "brain.py",
                    "inputs": [{"name": name, "type": INT} for name in ("imu", "odom", "loose")],
                    "outputs": [{"name": name, "type": INT} for name in ("rate", "alarm")],
                    "environment": {"SEED": 1},
                },
                {
                    "name": "robot",
                    "container": "neuros_python",
                    "plugin": "robot.py",
                    "outputs": [{"name": "imu", "type": INT}],
                },
            ],
            "connections": [
                {
                    "source_node": "robot",
                    "source_output": "imu",
                    "destination_node": "brain",
                    "destination_input": name,
                }
                for name in ("imu", "odom")
            ],
        }
        (tmp_path / "project.json").write_text(json.dumps(project))
        return load_project(tmp_path, workspace=tmp_path, overrides=overrides, reads_plugins=True)

    return check


def problems(check: Check, text: str, **options: str) -> list[str]:
    with pytest.raises(ProjectError) as raised:
        check(text, **options)
    return str(raised.value).splitlines()


def doubts(check: Check, text: str, overrides: Sequence[str] = ()) -> list[str]:
    """What is said of a project that is valid, but for what is not connected."""
    loaded = check(text, overrides=overrides)
    return [str(each) for each in loaded.warnings if "is not connected" not in each.text]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("def f(node:\n  pass", "brain.py:2:6: syntax error: '(' was never closed"),
        ("def f(node):\nreturn", "brain.py:3:1: syntax error: expected an indented block after"),
        ("return 1", "brain.py:2:1: syntax error: 'return' outside function"),
        ("x = 1", "brain.py:1:1: declares no hooks (mark functions with @neuros_function or"),
        ("@neuros_finalise\ndef f(node): pass", "brain.py:2:2: hook 'f': @neuros_finalise needs p"),
        (
            "@neuros_function(input='imu')\ndef f(node): pass",
            "brain.py:2:24: hook 'f': @neuros_function has no argument 'input' (did you mean 'inp",
        ),
        (
            "@neuros_finalise('imu')\ndef f(node): pass",
            "brain.py:2:2: hook 'f': @neuros_finalise takes no arguments, but is given 1",
        ),
        ("@neuros_tick()\ndef f(node): pass", "brain.py:2:2: hook 'f': @neuros_tick needs seconds"),
        (
            "@neuros_tick(0.1, sim_seconds=0.1)\ndef f(node): pass",
            "brain.py:2:2: hook 'f': @neuros_tick needs seconds or sim_seconds, and not both",
        ),
        (
            "@neuros_tick(sim_seconds=0)\ndef f(node): pass",
            "brain.py:2:26: hook 'f': sim_seconds=0 is not a positive time",
        ),
        (
            "@neuros_tick(sim_seconds=0.1)\ndef f(node): pass",
            "brain.py:2:26: hook 'f': ticks by simulated time, but node 'brain' has no input of ty",
        ),
        (
            "@neuros_tick(seconds=-0.1)\ndef f(node): pass",
            "brain.py:2:22: hook 'f': seconds=-0.1 is not a positive time",
        ),
        (
            "@neuros_tick('0.1')\ndef f(node): pass",
            "brain.py:2:14: hook 'f': seconds='0.1' is not a number",
        ),
        (
            "@neuros_function(outputs=All('rate'))\ndef f(node): pass",
            "brain.py:2:26: hook 'f': output 'rate' is wrapped in All, which is for inputs only",
        ),
        (
            "@neuros_function(inputs=All(Optional('imu')))\ndef f(node, x): pass",
            "brain.py:2:25: hook 'f': All(Optional('imu')) is not an input: give a name, Opt",
        ),
        (
            "@neuros_function(outputs=[3])\ndef f(node): pass",
            "brain.py:2:27: hook 'f': 3 is not an output: give a name or Optional(name)",
        ),
        (
            "@neuros_function(outputs=['rate', Optional('rate')])\ndef f(node): pass",
            "brain.py:2:35: hook 'f': output 'rate' is named twice",
        ),
        (
            "@neuros_function('imu')\ndef f(node): pass",
            "brain.py:3:1: hook 'f' gets (node, imu), but takes (node)",
        ),
        (
            "@neuros_function(['imu', All('odom')])\ndef f(node, imu): pass",
            "brain.py:3:1: hook 'f' gets (node, imu, odom), but takes (node, imu)",
        ),
        ("@neuros_tick(1)\ndef f(): pass", "brain.py:3:1: hook 'f' gets (node), but takes ()"),
        (
            "@neuros_tick(1)\ndef f(node, *, speed): pass",
            "brain.py:3:1: hook 'f' gets (node), but takes (node, speed)",
        ),
        (
            "@neuros_tick(1)\nasync def f(node): pass",
            "brain.py:3:1: hook 'f' is a coroutine, and would never run (only callbacks of ROS may",
        ),
        (
            "@neuros_tick(1, outputs='rate')\ndef f(node): yield node.make_packet('rate')",
            "brain.py:3:1: hook 'f' has 'yield', and would never run (a hook returns its packets)",
        ),
        (
            "@neuros_function('imuu')\ndef f(node, x): pass",
            "brain.py:2:18: hook 'f': node 'brain' declares no input 'imuu' (did you mean 'imu'?)",
        ),
        (
            "@neuros_tick(1, outputs=['rate', 'imu'])\ndef f(node): pass",
            "brain.py:2:34: hook 'f': node 'brain' declares no output 'imu' (it has an input of th",
        ),
        (
            "@neuros_tick(1, outputs='wheels')\ndef f(node): pass",
            "brain.py:2:25: hook 'f': node 'brain' declares no output 'wheels' (it has alarm, rate",
        ),
        (
            "@neuros_function('loose')\ndef f(node, x): pass",
            "brain.py:2:18: hook 'f': needs input 'loose', but nothing is connected to brain.loose",
        ),
    ],
)
def test_a_mistake_is_said_with_its_line(check: Check, text: str, expected: str) -> None:
    (found,) = problems(check, text)
    assert found.startswith(expected)


@pytest.mark.parametrize(
    ("head", "text", "expected"),
    [
        (
            "from neuros.hooks import neuros_funktion",
            "@neuros_funktion()\ndef f(node): pass",
            "brain.py:1:1: neuros.hooks has no 'neuros_funktion' (did you mean 'neuros_function'?)",
        ),
        (
            "from neuros.hooks import neuros_function",
            "@neuros_function(Optional('imu'))\ndef f(node, imu): pass",
            "brain.py:2:18: 'Optional' is not imported (from neuros.hooks import Optional)",
        ),
        (
            "import neuros.hooks as hooks",
            "@hooks.neuros_function('imuu')\ndef f(node, x): pass",
            "brain.py:2:24: hook 'f': node 'brain' declares no input 'imuu' (did you mean 'imu'?)",
        ),
    ],
)
def test_hooks_are_known_by_what_was_imported(
    check: Check, head: str, text: str, expected: str
) -> None:
    with pytest.raises(ProjectError) as raised:
        check(text, head=head)
    said = str(raised.value).splitlines()
    assert [line for line in said if line.startswith("brain.py")] == [expected]


def test_all_mistakes_of_a_project_are_said_at_once(check: Check, tmp_path: Path) -> None:
    text = FINE + "@neuros_tick(0, outputs='rte')\ndef f(node, x): pass"
    found = problems(check, text)
    assert [line.partition(": ")[0] for line in found] == [
        "brain.py:4:14",
        "brain.py:4:25",
        "brain.py:5:1",
    ]
    file = tmp_path / "project.json"
    file.write_text(file.read_text().replace(INT, "std_msgs/msg/Int23", 1))
    with pytest.raises(ProjectError) as raised:
        load_project(tmp_path, workspace=tmp_path, reads_plugins=True)
    assert [*found, "project.json"] == [
        *(line for line in str(raised.value).splitlines() if line.startswith("brain")),
        raised.value.problems[-1].file,
    ]


@pytest.mark.parametrize(
    "text",
    [
        FINE,
        "NAME = 'x' * 3\n@neuros_function(NAME, outputs=[NAME, *NAME])\ndef f(node): pass",
        "@neuros_function(inputs=[f'imu{1}', Optional(str())])\ndef f(node, a, b): pass",
        "if 0:\n  @neuros_function('no')\n  def f(node): pass",
        "try: pass\nfinally:\n  @neuros_tick(1, outputs='no')\n  def f(node): pass",
        "@print\n@neuros_function('imu')\ndef f(node): pass",
        "def f(node): pass\nneuros_tick(1)(f)",
        "def make(x):\n  @neuros_function(x)\n  def f(node, x): pass\n  return f\ng = make('imu')",
        "class A:\n  @neuros_tick(1)\n  def f(node): pass\nf = A.f",
        "from common import step",
        "from common import *",
        "globals()['f'] = 1",
        "try:\n  from neuros.hooks import neuros_new\nexcept ImportError: pass\n" + FINE,
        "@neuros_function(*['imu'])\ndef f(node): pass",
        "@neuros_function(**{'inputs': 'imu'})\ndef f(node): pass",
        "@neuros_function('imu')\ndef f(*packets): pass",
        "@neuros_function('imu')\ndef f(node, imu, factor=2.0, **more): pass",
        "@neuros_tick(1)\ndef f(node):\n  def values(): yield 1\n  return None",
        "@neuros_tick(1e-3 * 20)\ndef f(node): pass",
        "@neuros_tick({(): 1}[()])\ndef f(node): pass",
        "@neuros_function(inputs={'imu': 1})\ndef f(node, imu): pass",
        "@neuros_tick(1)\n@neuros_function('imu')\ndef f(node, imu=None): pass",
        "Optional = print\n@neuros_function(Optional(3))\ndef f(node, x): pass",
        "@neuros_function(inputs=Optional(All('loose')))\ndef f(node, x): pass",
        "@neuros_function(inputs=All(name='imu'), outputs=None)\ndef f(node, x): pass",
    ],
)
def test_what_is_right_or_not_to_be_known_is_no_problem(check: Check, text: str) -> None:
    assert doubts(check, text) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "@neuros_tick(1)\ndef f(node): pass\n@neuros_tick(2)\ndef f(node): pass",
            "brain.py:3:1: hook 'f' never runs: line 5 defines another 'f'",
        ),
        (
            "@neuros_function(['imu', 'odom'])\ndef f(node, odom, imu): pass",
            "brain.py:3:1: hook 'f' gets (node, imu, odom), and takes (node, odom, imu) (packets",
        ),
    ],
)
def test_what_may_be_a_mistake_is_a_warning(check: Check, text: str, expected: str) -> None:
    (found,) = doubts(check, text)
    assert found.startswith(expected)


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="this Python knows these forms")
@pytest.mark.parametrize("text", ["type A = int\n", 'x = f"{"a"}"\n', "def g[T](x: T): pass\n"])
def test_what_a_newer_python_may_understand_is_a_warning(check: Check, text: str) -> None:
    (found,) = doubts(check, text + FINE)
    assert "syntax error: " in found


@pytest.mark.parametrize("content", [b"\0", b"\xff", b"# -*- coding: nonsense -*-\n", b"x" * 9])
def test_what_is_no_python_at_all_is_no_crash(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "p.py").write_bytes(content)
    plugin = read_plugin(tmp_path / "p.py")
    assert plugin is not None
    assert plugin.mistakes


@pytest.mark.parametrize("name", ["brain.cpython-311-x86_64-linux-gnu.so", "brain.pyc", "gone.py"])
def test_what_is_no_source_is_left_to_the_node(tmp_path: Path, name: str) -> None:
    if name != "gone.py":
        (tmp_path / name).write_bytes(b"\x7fELF")
    assert read_plugin(tmp_path / name) is None


# ------------------------------------------------------------------ as a node says it

_name = st.sampled_from(["imu", "odom", "rate", "no"])
_port = st.one_of(
    _name.map(repr),
    _name.map("Optional({!r})".format),
    _name.map("All({!r})".format),
    _name.map("Optional(All({!r}))".format),
    _name.map("All(Optional({!r}))".format),
    st.just("7"),
)
_ports = st.one_of(_port, st.lists(_port, max_size=2).map(lambda ports: f"[{', '.join(ports)}]"))


@settings(deadline=None, max_examples=50)  # the node is really loaded
@given(inputs=_ports, outputs=_ports)
def test_the_judgement_is_that_of_a_node_that_loads_the_plugin(
    tmp_path_factory: pytest.TempPathFactory, inputs: str, outputs: str
) -> None:
    folder = tmp_path_factory.mktemp("judged")
    (folder / "p.py").write_text(
        "from neuros.hooks import *\n"
        f"@neuros_initialise(inputs={inputs}, outputs={outputs})\n"
        "def f(node, *packets): pass\n"
    )
    node = {
        "name": "n",
        "container": "neuros_python",
        "plugin": "p.py",
        "inputs": [{"name": name, "type": INT, "external_topic": name} for name in ("imu", "odom")],
        "outputs": [{"name": "rate", "type": INT}],
    }
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}))
    try:
        load_project(folder, workspace=folder, reads_plugins=True)
        found = True
    except ProjectError:
        found = False
    try:
        PluginHarness.from_project(folder, "n")
        loads = True
    except HookError:
        loads = False
    assert found is loads


# ------------------------------------------------------------------ environment variables

READS = """
import os
STEP = os.environ["NEUROS_RANDOMISE_DIRECTION"], os.environ.get("SEED")
"""


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("NEUROS_RANDOMIZE", " (did you mean 'NEUROS_RANDOMISE_DIRECTION'?)"),
        ("SEDE", " (did you mean 'SEED'?)"),
        ("WEATHER", ""),
    ],
)
def test_a_variable_that_nothing_reads_is_a_warning(check: Check, name: str, hint: str) -> None:
    setting = f"nodes.brain.environment.{name}=1"
    assert doubts(check, READS + FINE, [setting]) == [
        f"--set {setting}: character 25: /nodes/0/environment: nothing in the plugin of node"
        f" 'brain' reads {name}{hint}"
    ]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("SEED", READS),
        ("NEUROS_RANDOMISE_DIRECTION", READS),
        ("OMP_NUM_THREADS", READS),
        ("NEUROS_GUI", READS),
        ("IN_HELPER", READS),
        ("LEFT_GAIN", "import os\nGAIN = os.environ[f'{os.getpid()}_GAIN']\n"),
        ("LEFT_GAIN", "import os\nALL = dict(os.environ)\n"),
        ("LEFT_GAIN", "from os import environ\nname = 'x'\nGAIN = environ.get(name)\n"),
    ],
)
def test_what_is_read_somewhere_or_computed_is_none(
    check: Check, tmp_path: Path, name: str, text: str
) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "helper.py").write_text("import os\nos.getenv('IN_HELPER')\n")
    assert doubts(check, text + FINE, [f"nodes.brain.environment.{name}=1"]) == []


def test_taking_a_variable_away_is_none(check: Check) -> None:
    assert doubts(check, FINE, ["nodes.brain.environment.SEED="]) == []
