"""`neuros.Node`, `neuros.Connection` and `neuros.Project` of objects, with functions as plugins."""

from __future__ import annotations

import contextlib
import inspect
import json
import json.decoder
import math
import pickle
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import std_msgs.msg
from hypothesis import given
from hypothesis import strategies as st
from launching import launch
from std_msgs.msg import Int32
from std_msgs.msg import Int32 as Number

import neuros
from containers import require_containers
from neuros.distribution import python_command
from neuros.errors import HookError, NeurosError, ProjectError, RunError, UsageError
from neuros.hooks import (
    Optional,
    neuros_finalise,
    neuros_function,
    neuros_initialise,
    neuros_tick,
)
from neuros.project.model import Node as NodeOfModel
from neuros.project.split import project_to_json
from neuros.testing import PluginHarness

ACCEPTANCE = pytest.mark.acceptance
RUNS = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]
LAST = 3
HEAR = "from neuros.hooks import *\n@neuros_finalise()\ndef end(node): ...\n"
TABLE = [1, 2]
COUNT = 0
WEIGHTS = np.zeros(2)
INT32 = "std_msgs/Int32"
HEARD: dict[str, Any] = {"inputs": {"heard": INT32}, "outputs": {"number": INT32}}


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


# ------------------------------------------------------------------ functions as plugins


class Scale:
    factor = 1

    def of(self, number: int) -> int:
        return number * self.factor


def is_last(number: int) -> bool:
    return Scale().of(number) == LAST


@neuros_initialise(outputs=Optional("number"))
def begin(node: neuros.NodeHandle) -> Number | None:
    return Int32() if node.name == "alice" else None


@neuros_function(inputs="heard", outputs=Optional("number"))
def add_one(node: neuros.NodeHandle, heard: Any) -> Int32 | None:
    node.set_result("heard", heard.data)
    if is_last(heard.data):
        node.shutdown("that is enough")
        return None
    return std_msgs.msg.Int32(data=heard.data + math.ceil(0.5))


@neuros_tick(seconds=0.1, outputs="number")
def count(node: neuros.NodeHandle) -> Int32:
    global COUNT
    COUNT += 1
    return Int32(data=COUNT)


@neuros_function(inputs="heard")
def look_up(node: neuros.NodeHandle, heard: Any) -> None:
    node.set_result("found", [TABLE[0], WEIGHTS[0], __file__, add_one, missing])  # type: ignore[name-defined]  # noqa: F821


def undecorated(node: neuros.NodeHandle) -> None:
    """It is no hook."""


def talk(*hooks: Callable[..., Any], **keys: Any) -> neuros.Project:
    """The example of the README."""
    alice, bob = (neuros.Node(n, hooks or [begin, add_one], **HEARD) for n in ("alice", "bob"))
    return neuros.Project(
        nodes=[alice, bob],
        connections=[
            neuros.Connection(alice["number"], bob["heard"], discard_limit=0),
            neuros.Connection(bob["number"], alice["heard"], discard_limit=0),
        ],
        **keys,
    )


@RUNS
@pytest.mark.parametrize(
    "back_end", ["in-process", "process", pytest.param("docker", marks=ACCEPTANCE)]
)
def test_functions_run_as_plugins(tmp_path: Path, back_end: str) -> None:
    if back_end == "docker":
        require_containers()
    run = talk().run(backend=back_end, output="out", check=True)
    assert run.reason == "alice ended the project: that is enough"
    assert run.node_results == {"alice": {"heard": 3}, "bob": {"heard": 2}}
    assert (tmp_path / "out/alice/plugin/alice_plugin.py").exists(), "the run keeps what has run"


@RUNS
def test_a_function_that_fails_is_named_with_its_line_in_the_plugin_of_the_run() -> None:
    @neuros_function(inputs="heard")
    def fail(node: neuros.NodeHandle, heard: Any) -> None:
        raise RuntimeError("of no use")

    run = talk(begin, fail).run(backend="in-process", output="out")
    assert run.exit_code == 1
    assert "hook 'fail': RuntimeError: of no use" in run.reason
    assert "bob_plugin.py:" in run.reason
    assert f"# {Path(__file__).name}:" in Path("out/bob/plugin/bob_plugin.py").read_text()


@RUNS
def test_functions_run_in_the_background_and_in_sessions() -> None:
    with talk().start(backend="in-process", record=True) as live:
        run = live.wait()
    assert [packet.data for packet in run.bag["alice.number -> bob.heard"]] == [0, 2]
    with talk().session(backend="in-process") as s:
        for _ in range(2):
            s.step()
            assert s["alice.number"].packet == Int32(data=2)
            s.reset()


@RUNS
def test_a_session_in_this_thread_calls_the_functions_themselves() -> None:
    seen: list[int] = []

    @neuros_function(inputs="heard", outputs=Optional("number"))
    def add(node: neuros.NodeHandle, heard: Any) -> Int32:
        seen.append(heard.data)
        assert sys.modules[__name__].add_one is add_one, "modules are those of the program"
        return Int32(data=heard.data + 1)

    with talk(begin, add).session(backend="local") as s:
        s.step(2)
        assert seen == [0, 1, 2, 3]
        s.reset()
        s.step()
        assert seen == [0, 1, 2, 3, 0, 1]
        assert sys.modules[__name__].add_one is add_one


@RUNS
def test_an_error_of_a_function_in_this_thread_has_its_own_line() -> None:
    @neuros_function(inputs="heard")
    def fail(node: neuros.NodeHandle, heard: Any) -> None:
        raise RuntimeError("of no use")

    with (
        talk(begin, fail).session(backend="local") as s,
        pytest.raises(RunError, match=rf"{Path(__file__).name}:\d+: hook 'fail': RuntimeError"),
    ):
        s.step()


def test_files_and_installed_modules_are_plugins_as_in_json(tmp_path: Path) -> None:
    (tmp_path / "brain.py").write_text(HEAR)
    module = ModuleType("brain")
    module.__file__ = str(tmp_path / "brain.py")
    plugins = ["brain.py", Path("brain.py"), module]
    nodes = [neuros.Node(f"n{index}", plugin) for index, plugin in enumerate(plugins)]
    described = neuros.Project(nodes).described(is_held=True)
    assert [node.plugin for node in described.nodes] == [tmp_path / "brain.py"] * 3
    for plugin in ("json.decoder", json.decoder):
        with pytest.raises(ProjectError, match=r"json/decoder\.py:1:1: declares no hooks"):
            neuros.Project([neuros.Node("one", plugin)])


@RUNS
def test_a_setting_can_replace_functions_by_a_file(tmp_path: Path) -> None:
    (tmp_path / "other.py").write_text(
        "from neuros.hooks import neuros_function\n"
        "@neuros_function(inputs='heard')\ndef end(node, heard): node.shutdown('it was other')\n"
    )
    run = talk().run(backend="in-process", set={"nodes.bob.plugin": "other.py"})
    assert run.reason == "bob ended the project: it was other"


@RUNS
def test_settings_and_seeds_work_as_with_files() -> None:
    @neuros_initialise()
    def tell(node: neuros.NodeHandle) -> None:
        import os

        node.set_result("values", [os.environ["RATE"], os.environ["SEED"]])
        node.shutdown("told")

    node = neuros.Node("one", tell, environment={"RATE": 1, "SEED": 0})
    project = neuros.Project([node]).with_settings({"nodes.one.environment.RATE": 0.5})
    run = project.run(backend="in-process", seed=7)
    assert run.node_results == {"one": {"values": ["0.5", "7"]}}
    assert run.is_ok


# ------------------------------------------------------------------ the same checks as with files


def one(plugin: Any = count, **keys: Any) -> neuros.Node:
    return neuros.Node("one", plugin, **{"outputs": {"number": INT32}, **keys})


def two(*ends: str, **keys: Any) -> neuros.Project:
    """A node that counts, connected to one that looks at the number."""
    seer = neuros.Node("two", add_one, **HEARD)
    output, input_ = ends or ("number", "heard")
    wire = neuros.Connection(one()[output], seer[input_], **keys)
    return neuros.Project([one(), seer], [wire])


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "no type": (
        lambda: neuros.Project([one(outputs={"number": "std_msgs/Int23"})]),
        "neuros.Node('one'): /outputs/number/type: unknown message type 'std_msgs/msg/Int23'",
    ),
    "no text": (
        lambda: neuros.Project([one(outputs={"number": 3})]),
        "neuros.Node('one'): /outputs/number/type: must be a text, but is a whole number",
    ),
    "no key": (
        lambda: neuros.Project([one(enviroment={"A": 1})]),
        "neuros.Node('one'): /enviroment: unknown key 'enviroment' (did you mean 'environment'?)",
    ),
    "no number": (
        lambda: neuros.Project([one(environment={"A": math.nan})]),
        "neuros.Node('one'): /environment/A: NaN is not a JSON number",
    ),
    "no value of JSON": (
        lambda: one(environment={"A": {1, 2}}),
        "neuros.Node('one'): environment: {1, 2} is no value of JSON",
    ),
    "no mapping": (
        lambda: one(inputs=["number"]),
        "neuros.Node('one'): inputs: give the message type of each port by its name",
    ),
    "a name of its own": (
        lambda: one(inputs={"x": {"name": "y", "type": INT32}}),
        "neuros.Node('one'): inputs: leave out the key 'name' of port 'x'",
    ),
    "no file": (
        lambda: neuros.Project([one("brian.py")]),
        "neuros.Node('one'): /plugin: there is no file 'brian.py'",
    ),
    "no plugin": (
        lambda: neuros.Project([one(None)]),
        "neuros.Node('one'): needs exactly one of 'plugin', 'network' or 'policy'",
    ),
    "no hook": (
        lambda: one(undecorated),
        "plugin: the function 'undecorated' is no hook: put @neuros_function(...) or",
    ),
    "no function": (
        lambda: one([count, "count"]),
        "plugin: 'count' is neither a function, a path nor a module",
    ),
    "no functions": (lambda: one([]), "plugin=[] has no function"),
    "another port": (
        lambda: neuros.Project([one(outputs={"x": INT32})]),
        "hook 'count': node 'one' declares no output 'number' (it has x)",
    ),
    "no such output": (
        lambda: two("numbr", "heard"),
        "one['numbr'] >> two['heard']: /source_output: node 'one' has no output 'numbr' (did you",
    ),
    "no such limit": (
        lambda: two(discard_limit=-1),
        "one['number'] >> two['heard']: /discard_limit: must be at least 0, but is -1",
    ),
    "a node for a port": (
        lambda: one()["number"] >> one(),  # type: ignore[operator]
        "one['number'] >> neuros.Node('one'): 'one' is no port: name one, as in node[\"x\"]",
    ),
    "a node that is left out": (
        lambda: neuros.Project([one()], [one()["number"] >> neuros.Node("two")["heard"]]),
        "one['number'] >> two['heard']: /destination_node: there is no node 'two'",
    ),
    "one name twice": (
        lambda: neuros.Project([one(), one()]),
        "neuros.Project: /nodes/1: the node name 'one' occurs twice (see neuros.Project: /nodes/0)",
    ),
    "other types": (
        lambda: neuros.Project(
            [one(), neuros.Node("two", add_one, **{**HEARD, "inputs": {"heard": "std_msgs/Int8"}})],
            [one()["number"] >> neuros.Node("two")["heard"]],
        ),
        "one['number'] >> two['heard']: the output sends std_msgs/msg/Int32, the input takes"
        " std_msgs/msg/Int8 (see neuros.Node('one'): /outputs/number/type and neuros.Node('two'):"
        " /inputs/heard/type)",
    ),
    "no key of a project": (
        lambda: neuros.Project([one()], budget={}),
        "neuros.Project: /budget: unknown key 'budget' (did you mean 'budgets'?)",
    ),
    "a file for a node": (
        lambda: neuros.Project(["one.json"]),  # type: ignore[list-item]
        "nodes[0] is 'one.json': give neuros.Node(...); neuros.Project.from_file reads files",
    ),
    "no nodes": (lambda: neuros.Project([]), "neuros.Project: /nodes: must not be empty"),
    "no folder": (lambda: neuros.Project([one()], folder="nowhere"), "there is no such folder"),
    "no container": (
        lambda: neuros.Project([one(container="neuros_pyton")]).validate(),
        "neuros.Node('one'): /container: there is no container 'neuros_pyton'",
    ),
}


@pytest.mark.filterwarnings("ignore:.*there is no container")
@pytest.mark.parametrize("what", WRONG)
def test_a_mistake_names_the_object(what: str) -> None:
    make, text = WRONG[what]
    with pytest.raises((ProjectError, UsageError)) as caught:
        make()
    assert text in str(caught.value)


def test_all_mistakes_are_told_at_once() -> None:
    with pytest.raises(ProjectError) as caught:
        two("numbr", "herd", queue_size=0)
    assert len(caught.value.problems) == 3


def test_the_loop_of_functions_is_known_and_one_that_nobody_starts_is_found() -> None:
    nobody = "nobody starts the loop of alice, bob"
    with pytest.warns(UserWarning, match=nobody), pytest.raises(ProjectError, match=nobody):
        talk(add_one).validate()
    assert talk().validate() == ()


def test_what_a_function_takes_is_checked_as_in_a_file() -> None:
    @neuros_function(inputs="heard")
    async def wait(node: neuros.NodeHandle) -> None: ...

    with pytest.raises(ProjectError) as caught:
        talk(begin, wait)
    text = str(caught.value)
    assert "hook 'wait' gets (node, heard), but takes (node)" in text
    assert "hook 'wait' is a coroutine, and would never run" in text


NAMES = st.from_regex(r"\A[A-Za-z][A-Za-z0-9_]{0,8}\Z")
TEXTS = st.text("ab #@.", max_size=3).filter(lambda text: text[:1] not in ("#", "@"))
NUMBERS = st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.booleans()
NODES = st.fixed_dictionaries(
    {},
    optional={
        "environment": st.dictionaries(NAMES, TEXTS | NUMBERS, max_size=3),
        "affinity": st.lists(st.integers(0, 99), unique=True, min_size=1, max_size=2),
        "parameters": st.dictionaries(NAMES, st.integers(-9, 9) | TEXTS, max_size=2),
        "finalise_s": st.floats(0.1, 99),
        "description": TEXTS,
    },
)
WIRES = st.fixed_dictionaries(
    {},
    optional={
        "discard_limit": st.integers(0, 9),
        "queue_size": st.integers(1, 9),
        "transport": st.just({"compression": "zstd"}),
    },
)


@given(node=NODES, wire=WIRES)
def test_a_project_in_python_is_that_of_the_same_json(
    tmp_path_factory: pytest.TempPathFactory, node: dict[str, Any], wire: dict[str, Any]
) -> None:
    folder = tmp_path_factory.mktemp("same")
    (folder / "hear.py").write_text(
        "from neuros.hooks import *\n@neuros_finalise()\ndef f(node): 1"
    )
    ports = [{"name": "x", "type": "std_msgs/msg/Int32"}]
    in_json = {"name": "one", "container": "neuros_python", "plugin": "hear.py", **node}
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    content = {
        "nodes": [{**in_json, "inputs": ports, "outputs": ports}],
        "connections": [{**dict(zip(keys, ("one", "x", "one", "x"), strict=True)), **wire}],
    }
    (folder / "project.json").write_text(json.dumps(content))
    one = neuros.Node("one", "hear.py", inputs={"x": INT32}, outputs={"x": INT32}, **node)
    connection = neuros.Connection(one["x"], one["x"], **wire)
    project = neuros.Project([one], [connection], folder=folder)
    expected = neuros.Project.from_file(folder).text()
    assert project.text() == expected
    project.to_json(overwrite=True)
    assert neuros.Project.from_file(folder).text() == expected


# ------------------------------------------------------------------ as files


def test_the_files_of_a_project_in_python_launch_as_they_are(tmp_path: Path) -> None:
    file = talk(folder=tmp_path).to_json("made/here")
    assert file == tmp_path / "made/here/project.json"
    assert sorted(path.name for path in file.parent.iterdir()) == [
        *("alice.json", "alice_plugin.py", "bob.json", "project.json")
    ]
    done = launch(file, "--backend", "in-process", cwd=tmp_path)
    assert done.exit_code == 0, done.output
    assert "alice ended the project: that is enough" in done.output
    again = neuros.Project.from_file(file)
    assert (again.nodes, again.connections) == (talk().nodes, talk().connections)


def test_plugins_that_are_files_keep_their_paths(tmp_path: Path) -> None:
    for name in ("brain.py", "eye.py"):
        (tmp_path / name).write_text(HEAR)
    module = ModuleType("eye")
    module.__file__ = str(tmp_path / "eye.py")
    plugins = {"brain": "brain.py", "eye": module, "third": "@third.py"}
    (tmp_path / "workspace").mkdir()
    (tmp_path / "workspace/third.py").write_text(HEAR)
    project = neuros.Project([neuros.Node(name, plugin) for name, plugin in plugins.items()])
    file = project.to_json()
    written = [json.loads(Path(f"{name}.json").read_text())["plugin"] for name in plugins]
    assert written == ["brain.py", "eye.py", "@third.py"]
    assert neuros.Project.from_file(file).text() == project.text()


def test_settings_are_in_the_files(tmp_path: Path) -> None:
    node = one(environment={"RATE": 1})
    project = neuros.Project([node]).with_settings({"nodes.one.environment.RATE": 2})
    with pytest.raises(UsageError, match="it sets the global 'COUNT'"):
        project.to_json("out")
    assert not Path("out").exists(), "nothing is written unless all can be"
    silent = neuros.Project([neuros.Node("one", begin, outputs=HEARD["outputs"], affinity=[0])])
    file = silent.with_settings({"nodes.one.affinity": [1]}).to_json()
    assert json.loads(Path("one.json").read_text())["affinity"] == [1]
    with pytest.raises(UsageError, match=r"has project.json, one.json, one_plugin.py already"):
        silent.to_json()
    assert silent.to_json(overwrite=True) == file
    with pytest.raises(UsageError, match="has its files already"):
        neuros.Project.from_file(file).to_json()


def test_files_that_another_folder_would_lack_are_named(tmp_path: Path) -> None:
    (tmp_path / "world.xml").write_text("<mujoco/>")
    node = neuros.Node("one", begin, outputs=HEARD["outputs"], environment={"MODEL": "#world.xml"})
    project = neuros.Project([node])
    with pytest.raises(UsageError, match=r"out lacks files that the project names: world.xml"):
        project.to_json("out")
    Path("out").mkdir()
    (tmp_path / "out/world.xml").write_text("<mujoco/>")
    made = neuros.Project.from_file(project.to_json("out")).described(is_held=True)
    assert made.node("one").environment["MODEL"] == str(tmp_path / "out/world.xml")


def test_a_plugin_file_has_what_its_functions_name() -> None:
    talk().to_json("out")
    text = Path("out/alice_plugin.py").read_text()
    assert text.startswith('"""Plugin that NeuROS has written')
    for line in (
        "from __future__ import annotations",
        "import math",
        "import std_msgs.msg",
        "from neuros.hooks import Optional, neuros_function, neuros_initialise",
        "LAST = 3",
        "class Scale:",
        "def is_last(number: int) -> bool:",
    ):
        assert f"\n{line}\n" in text, line
    assert "undecorated" not in text


def test_modules_beside_a_program_are_copied(tmp_path: Path) -> None:
    (tmp_path / "parts.py").write_text("import more\ndef last(): return more.LAST\n")
    (tmp_path / "more.py").write_text("LAST = 7\n")
    (tmp_path / "program.py").write_text(
        "import neuros, parts\n"
        "from neuros.hooks import neuros_initialise\n"
        "@neuros_initialise()\n"
        "def begin(node):\n"
        "    node.set_result('last', parts.last())\n"
        "    node.shutdown('done')\n"
        "project = neuros.Project([neuros.Node('one', begin)])\n"
        "project.to_json('out')\n"
        "print(project.run(backend='process', check=True).node_results)\n"
    )
    done = subprocess.run(
        [sys.executable, "program.py"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout == "{'one': {'last': 7}}\n", done.stderr
    assert {"more.py", "parts.py"} <= {path.name for path in Path("out").iterdir()}


def test_what_cannot_stand_in_a_file_is_named() -> None:
    limit = 3

    @neuros_function(inputs="heard")
    def stop(node: neuros.NodeHandle, heard: Any) -> None:
        if heard.data == limit:
            node.shutdown()

    @neuros_function(inputs="heard")
    def twice(node: neuros.NodeHandle, heard: Any) -> None: ...

    first = twice

    @neuros_function(inputs="heard")
    def twice(node: neuros.NodeHandle, heard: Any) -> None: ...  # type: ignore[no-redef]

    @neuros_function(inputs="heard")
    def remember(node: neuros.NodeHandle, heard: Any) -> None: ...

    remember.last = 0  # type: ignore[attr-defined]
    unnamed = neuros_finalise()(lambda node: None)
    hooks = [stop, first, twice, remember, look_up, unnamed]
    project = talk(begin, *hooks)
    with pytest.raises(UsageError) as caught:
        project.run(backend="in-process", output="out")
    for text in (
        "stop: it uses 'limit' of the function around it",
        "twice: another 'twice' comes before it in the file",
        "remember: it has attributes, 'last': keep",
        "look_up: it uses 'TABLE' (list, which changes): make it in an initialise hook",
        "look_up: it uses 'WEIGHTS' (ndarray): make it in an initialise hook",
        "look_up: it uses '__file__', which is another one in a file",
        "look_up: it uses 'missing', which its module does not have",
        "look_up: it calls 'add_one', a hook that the node does not have",
        "<lambda>: Python has kept no source of it, as of a lambda",
    ):
        assert text in str(caught.value), text
    assert not Path("out").exists()


def test_a_function_of_a_shell_has_no_source() -> None:
    program = (
        "import neuros\n"
        "from neuros.hooks import neuros_finalise\n"
        "@neuros_finalise()\n"
        "def end(node): ...\n"
        "\n"
        "project = neuros.Project([neuros.Node('one', end)])\n"
        "try: project.run()\n"
        "except neuros.errors.UsageError as error: print(error)\n"
    )
    done = subprocess.run(
        python_command(code=f"exec({program!r})"), capture_output=True, text=True, check=False
    )
    assert "__main__.end: Python has kept no source of it" in done.stdout, done.stderr


@ACCEPTANCE
def test_a_notebook_runs_its_functions() -> None:
    import nbclient
    import nbformat

    cells = [
        "import neuros; from neuros.hooks import *\nTEXT = 'of a notebook'",
        "@neuros_initialise()\ndef begin(node):\n    node.shutdown(TEXT)",
        "neuros.Project([neuros.Node('one', begin)]).run(backend='process').reason",
    ]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    nbclient.NotebookClient(notebook, timeout=60).execute()
    (shown,) = (each["data"]["text/plain"] for each in notebook.cells[2].outputs)
    assert shown == "'one ended the project: of a notebook'"


def test_a_project_of_functions_can_be_pickled() -> None:
    assert pickle.loads(pickle.dumps(talk())).text() == talk().text()


# ------------------------------------------------------------------ the harness


def test_the_harness_takes_functions_as_they_are() -> None:
    seen: list[int] = []

    @neuros_function(inputs="heard")
    def note(node: neuros.NodeHandle, heard: Any) -> None:
        seen.append(heard.data)

    with PluginHarness([add_one, note], **HEARD) as harness:
        harness.send("heard", Int32(data=1))
        harness.run()
        assert harness.received("number") == [Int32(data=2)]
        assert seen == [1], "a list of the test itself"


def test_the_harness_refuses_what_is_no_hook() -> None:
    with pytest.raises(UsageError, match="the function 'undecorated' is no hook"):
        PluginHarness(undecorated)
    with pytest.raises(HookError, match="declares no input 'heard'"):
        PluginHarness(add_one)


@RUNS
def test_the_three_ways_of_the_page_are_the_project_of_the_readme(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NEUROS_BACKEND", "in-process")
    _, _, section = (ROOT / "docs/python.md").read_text("utf-8").partition("## Projects in Python")
    in_python, in_harness = _blocks(section.partition("\n## ")[0], "python")
    readme = (ROOT / "README.md").read_text("utf-8")
    (plugin, *_), (content, *_) = _blocks(readme, "python"), _blocks(readme, "json")
    (tmp_path / "count.py").write_text(plugin)
    (tmp_path / "project.json").write_text(content)
    # As a program would, the functions have their source from a file.
    (tmp_path / "program.py").write_text(in_python + in_harness)
    space = runpy.run_path("program.py")
    out = capsys.readouterr().out
    for printed in ("alice ended the project: that is enough", "[std_msgs.msg.Int32(data=1)]"):
        assert f"{printed}\n" in out
    from_json = neuros.Project.from_file(tmp_path)
    made, launched = space["project"], neuros.Project.from_file(tmp_path / "count")
    assert from_json.connections == made.connections == launched.connections
    described = [each.described(is_held=True) for each in (from_json, made, launched)]
    ports = [[(node.name, node.inputs, node.outputs) for node in each.nodes] for each in described]
    assert ports[0] == ports[1] == ports[2]
    assert plugin.partition("@")[2].strip() in in_python, "the functions are the same"
    assert launched.run(check=True).reason in out


RUNTIME = {"neuros.engine.engine", "neuros.node.node"}


@neuros_function(inputs="heard")
def called_by(node: neuros.NodeHandle, heard: Any) -> None:
    """Which modules have called this hook."""
    frame, modules = inspect.currentframe(), set()
    while frame is not None:
        modules.add(frame.f_globals["__name__"])
        frame = frame.f_back
    (node.run_dir / "called_by.json").write_text(json.dumps(sorted(modules)))
    node.shutdown("that is enough")


@RUNS
def test_launched_held_and_harnessed_hooks_are_called_by_the_same_runtime(tmp_path: Path) -> None:
    project = talk(begin, called_by)
    file = project.to_json("talk")
    launched = launch(file, "--backend", "in-process", cwd=tmp_path)
    assert launched.exit_code == 0
    with project.session(backend="local") as s:
        s.step()
    harness = PluginHarness(
        [called_by], name="bob", inputs=HEARD["inputs"], run_folder=tmp_path / "harness"
    )
    harness.send("heard", Int32(data=0))
    harness.run()
    for folder in (launched.run_folder / "bob", s.folder / "bob", tmp_path / "harness" / "bob"):
        called_by_modules = json.loads((folder / "called_by.json").read_text())
        assert set(called_by_modules) >= RUNTIME, called_by_modules


def _blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


# ------------------------------------------------------------------ ports without a connection


@pytest.fixture
def lonely(tmp_path: Path) -> Path:
    """A project file whose output nothing is connected to."""
    end = neuros.Node("one", begin, outputs=HEARD["outputs"])
    return neuros.Project([end]).to_json("lonely")


NOT_CONNECTED = "output 'number' of node 'one' is not connected"


@RUNS
def test_a_session_is_no_place_to_warn_of_outputs_that_nothing_is_connected_to(
    lonely: Path,
) -> None:
    neuros.Project.from_file(lonely).session(backend="in-process").close()
    (problem,) = neuros.Project.from_file(lonely).validate()
    assert problem.text == NOT_CONNECTED


@RUNS
def test_a_run_warns_of_it_once_and_where_the_program_calls(
    lonely: Path, neuros_session: Callable[..., Any]
) -> None:
    project = neuros.Project.from_file(lonely)
    with pytest.warns(UserWarning, match=NOT_CONNECTED) as caught:
        project.run(backend="in-process", duration="0.01")
    assert [each.filename for each in caught] == [__file__]
    project.run(backend="in-process", duration="0.01")
    in_another_process = pickle.loads(pickle.dumps(project))
    in_another_process.run(backend="in-process", duration="0.01")


@RUNS
def test_other_warnings_come_at_once_and_point_to_the_program(
    lonely: Path, neuros_session: Callable[..., Any]
) -> None:
    node = lonely.parent / "one.json"
    node.write_text(node.read_text().replace("neuros_python", "neuros_pyton"))
    for make in (neuros.Project.from_file, neuros_session):
        with (
            pytest.warns(UserWarning, match="no container") as caught,
            contextlib.suppress(NeurosError),
        ):
            make(lonely)
        assert {each.filename for each in caught} == {__file__}


def test_the_model_of_functions_is_not_in_json() -> None:
    node: NodeOfModel = talk().described(is_held=True).node("alice")
    assert node.hooks == (begin, add_one)
    assert node.plugin == Path(__file__)
    assert node.plugin_name == "begin, add_one"
    assert "hooks" not in project_to_json(talk().described(is_held=True))["nodes"][0]
