"""A plugin may be a module of an installed package: ``"plugin": "mypackage.module"``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from neuros.api.loading import load_with_messages
from neuros.backends.docker.back_end import BACK_END as DOCKER
from neuros.errors import EnvironmentFault, PluginError, ProjectError
from neuros.node.plugin import load_plugin
from neuros.project.graph import graph_text
from neuros.project.load import load_project
from neuros.project.model import Folders, Node, Port, Project
from neuros.project.paths import find_module, is_module_name
from neuros.project.split import node_file_from_json, node_file_to_json, project_to_json, split
from neuros.testing import PluginHarness

INT = "std_msgs/msg/Int32"
DOUBLER = """
from std_msgs.msg import Int32
from neuros.hooks import neuros_function, neuros_initialise
from . import factors

@neuros_function(inputs="number", outputs="double")
def double(node, number):
    return Int32(data=number.data * factors.FACTOR)
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package with a plugin, and with code that fails where it is run."""
    folder = tmp_path / "installed" / "lab_brains"
    (folder / "inner").mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "doubler.py").write_text(DOUBLER)
    (folder / "factors.py").write_text("FACTOR = 2\n")
    (folder / "weights.csv").write_text("1\n")
    (folder / "inner" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    (folder / "inner" / "deep.py").write_text(DOUBLER.replace('inputs="number"', 'inputs="none"'))
    monkeypatch.syspath_prepend(folder.parent)
    return folder


def write(folder: Path, plugin: str, container: str = "neuros_python") -> Path:
    """A project with one node of a plugin, in a folder that has no Python file."""
    project = folder / "project"
    project.mkdir(exist_ok=True)
    node: dict[str, Any] = {
        "name": "brain",
        "container": container,
        "plugin": plugin,
        "inputs": [{"name": "number", "type": INT, "external_topic": "/number"}],
        "outputs": [{"name": "double", "type": INT}],
    }
    (project / "project.json").write_text(json.dumps({"nodes": [node]}))
    return project


def load(project: Path) -> Project:
    return load_project(project, workspace=project / "workspace", reads_plugins=True).project


@pytest.mark.parametrize(
    ("text", "is_module"),
    [
        ("brain", True),
        ("lab.brain_2", True),
        ("brain.py", False),
        ("brain.so", False),
        ("lab/brain", False),
        ("#brain", False),
        ("lab..brain", False),
        ("2lab.brain", False),
        ("lab-brain", False),
        ("", False),
    ],
)
def test_what_is_named_as_python_imports_it_is_a_module(text: str, is_module: bool) -> None:
    assert is_module_name(text) is is_module


@pytest.mark.usefixtures("package")
class TestLoading:
    def test_the_file_is_found_and_nothing_is_imported(self, package: Path) -> None:
        assert find_module("lab_brains.doubler") == package / "doubler.py"
        assert find_module("lab_brains") == package / "__init__.py"
        assert find_module("lab_brains.inner.deep") == package / "inner" / "deep.py"
        assert find_module("lab_brains.nothing") is None
        assert find_module("lab_brains.doubler.inner") is None
        assert find_module("sys") is None, "it has no file"

    def test_a_node_has_both_names(self, tmp_path: Path, package: Path) -> None:
        (node,) = load(write(tmp_path, "lab_brains.doubler")).nodes
        assert node.module == node.plugin_name == "lab_brains.doubler"
        assert node.plugin == package / "doubler.py"

    def test_a_file_of_the_project_comes_first(self, tmp_path: Path) -> None:
        project = write(tmp_path, "lab_brains")
        (project / "lab_brains").write_text("")
        (node,) = load_project(project, workspace=project).project.nodes
        assert (node.module, node.plugin) == ("", project / "lab_brains")

    def test_its_hooks_are_checked_with_their_places(self, tmp_path: Path, package: Path) -> None:
        with pytest.raises(ProjectError) as error:
            load(write(tmp_path, "lab_brains.inner.deep"))
        assert "deep.py:6:25" in str(error.value)

    def test_a_module_of_a_container_need_not_be_here(self, tmp_path: Path) -> None:
        (node,) = load(write(tmp_path, "elsewhere.brain", "of_my_own")).nodes
        assert (node.module, node.plugin) == ("elsewhere.brain", Path())

    def test_unless_nothing_in_the_folder_of_the_container_names_it(self, tmp_path: Path) -> None:
        project = write(tmp_path, "elsewhere.brain", "of_my_own")
        container = project / "containers" / "of_my_own"
        container.mkdir(parents=True)
        (container / "requirements.txt").write_text("somewhere\n")
        (warning,) = (w for w in load_with_messages(project)[0].warnings if "plugin" in w.pointer)
        assert "/nodes/0/plugin: there is neither a file 'elsewhere.brain' nor" in str(warning)
        assert "of_my_own names 'elsewhere')" in str(warning)
        (container / "requirements.txt").write_text("elsewhere>=2\n")
        warnings = load_with_messages(project)[0].warnings
        assert not [warning for warning in warnings if "plugin" in warning.pointer]

    def test_the_graph_shows_its_name(self, tmp_path: Path) -> None:
        assert "brain  (neuros_python, lab_brains.doubler)" in graph_text(
            load(write(tmp_path, "lab_brains.doubler"))
        )


@pytest.mark.usefixtures("package")
class TestSplitting:
    def test_each_python_finds_the_module_for_itself(self, tmp_path: Path, package: Path) -> None:
        project = load(write(tmp_path, "lab_brains.doubler"))
        (file,) = split(project, lambda _: Folders(tmp_path, tmp_path, tmp_path))
        written = node_file_to_json(file)
        assert written["node"]["plugin"] == "lab_brains.doubler"
        assert node_file_from_json(written) == file
        package.rename(package.with_name("gone"))
        assert node_file_from_json(written).node == replace(file.node, plugin=Path())

    def test_an_expanded_project_is_valid(self, tmp_path: Path) -> None:
        project = load(write(tmp_path, "lab_brains.doubler"))
        (tmp_path / "expanded.json").write_text(json.dumps(project_to_json(project)))
        again = load_project(tmp_path / "expanded.json", workspace=tmp_path).project
        assert again.nodes[0].module == "lab_brains.doubler"


@pytest.mark.usefixtures("package")
class TestRunning:
    def test_it_runs_in_its_package(self, package: Path) -> None:
        from std_msgs.msg import Int32

        with PluginHarness(
            "lab_brains.doubler", inputs={"number": INT}, outputs={"double": INT}
        ) as harness:
            harness.send("number", Int32(data=21))
            harness.run()
            assert harness.received("double") == [Int32(data=42)]
            assert harness.node.resolve_path("weights.csv") == package / "weights.csv"

    def test_a_package_may_be_a_plugin_itself(self, package: Path) -> None:
        (package / "__init__.py").write_text(DOUBLER)
        with PluginHarness("lab_brains", inputs={"number": INT}, outputs={"double": INT}) as made:
            assert made.executions == {"double": 0}

    def test_a_python_without_it_says_what_to_do(self) -> None:
        with pytest.raises(PluginError, match=r"no module no\.brain .* goes into the requirements"):
            PluginHarness("no.brain", inputs={"number": INT})

    def test_its_errors_have_its_line(self, package: Path) -> None:
        (package / "factors.py").write_text("import nothing_of_the_kind\n")
        with pytest.raises(PluginError) as error:
            PluginHarness("lab_brains.doubler", inputs={"number": INT}, outputs={"double": INT})
        assert f'{package / "doubler.py"}", line 4, in <module>' in str(error.value)


@pytest.mark.usefixtures("package")
def test_a_container_of_neuros_cannot_have_it(tmp_path: Path) -> None:
    project = load(write(tmp_path, "lab_brains.doubler"))
    with pytest.raises(EnvironmentFault) as fault:
        DOCKER.prepare(project, project.nodes, {})
    assert "the plugin of node 'brain' is lab_brains.doubler, and the container" in str(fault.value)
    assert "containers/lab_brains/requirements.txt beside the project file" in str(fault.value)


def test_a_module_can_make_its_hooks_from_the_description_of_the_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``neuros_hooks``: a plugin for any ports."""
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "__init__.py").write_text("")
    file = tmp_path / "lab" / "any_ports.py"
    file.write_text(
        "from neuros.hooks import neuros_function\n"
        "def neuros_hooks(node):\n"
        "    names = [port.name for port in node.inputs]\n"
        "    return [neuros_function(inputs=names)(lambda node, *packets: None)]\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    ports = tuple(Port(name, "std_msgs/msg/Empty") for name in ("left", "right"))
    node = Node("any", "neuros_python", file, inputs=ports, module="lab.any_ports")
    (spec,) = load_plugin(node)
    assert [port.name for port in spec.inputs] == ["left", "right"]
