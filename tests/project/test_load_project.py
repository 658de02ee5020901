"""Loading valid projects: what the files may look like, and what becomes of it."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from neuros.errors import ProjectError
from neuros.project.load import LoadedProject, load_project
from neuros.project.model import Connection
from neuros.project.validate import nest_conflicts

STRING = "std_msgs/msg/String"


class Folder:
    """A project folder that tests write into."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.workspace = path.parent / "workspace"
        self.workspace.mkdir(parents=True)
        path.mkdir()
        self.file("p.py", "")

    def file(self, name: str, content: Any) -> Path:
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    def load(self, name: str = "project.json", *overrides: str) -> LoadedProject:
        return load_project(self.path / name, workspace=self.workspace, overrides=overrides)


@dataclass(frozen=True)
class ArmPackage:
    """A workspace with the package ``arm_msgs``, and where that is built."""

    folder: Path

    def messages(self, package: str) -> Collection[str] | None:
        return {"Joints"} if package == "arm_msgs" else None

    def installed(self, package: str) -> Path | None:
        return self.folder if package == "arm_msgs" else None

    def fields(self, package: str, name: str) -> None:
        return None


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "demo")


def node(name: str = "n", **more: Any) -> dict[str, Any]:
    return {"name": name, "container": "neuros_python", "plugin": "p.py", **more}


def link(source: str, destination: str, **more: Any) -> dict[str, Any]:
    (a, b), (c, d) = source.split("."), destination.split(".")
    keys = {"source_node": a, "source_output": b, "destination_node": c, "destination_input": d}
    return {**keys, **more}


def test_a_project_in_the_published_style_loads_as_it_is(folder: Folder) -> None:
    folder.file(
        "project.json",
        {
            "nodes": [
                node("a", outputs=[{"name": "ball", "type": "std_msgs.msg.String"}],
                     environment={"SEED": 1, "RATE": 1.50, "ON": True}),
                node("b", inputs=[{"name": "ball", "type": STRING}]),
            ],
            "connections": [link("a.ball", "b.ball", discard_limit=0), ],
        },
    )  # fmt: skip
    loaded = folder.load()
    assert loaded.warnings == ()
    project = loaded.project
    assert (project.name, project.file) == ("demo", folder.path / "project.json")
    assert project.node("a").output("ball").type == STRING
    assert project.node("a").environment == {"SEED": "1", "RATE": "1.5", "ON": "true"}
    assert project.connections == (Connection("a", "ball", "b", "ball", discard_limit=0),)


def test_connections_may_be_left_out_and_the_folder_is_enough(folder: Folder) -> None:
    folder.file("project.json", {"nodes": [node()]})
    loaded = load_project(folder.path, workspace=folder.workspace)
    assert [n.name for n in loaded.project.nodes] == ["n"]


def test_a_variant_has_a_name_of_its_own(folder: Folder) -> None:
    folder.file("strict.json", {"nodes": [node()]})
    assert folder.load("strict.json").project.name == "demo-strict"


def test_numbers_in_the_environment_are_taken_as_they_are_written(folder: Folder) -> None:
    text = '"environment": {"A": 1.0, "B": 1e3, "C": false, "D": "##f80", "E": "@@home", "F": ""}'
    folder.file("project.json", json.dumps({"nodes": [node()]}).replace("}]", f", {text}}}]"))
    environment = folder.load().project.node("n").environment
    assert environment == {
        "A": "1.0", "B": "1e3", "C": "false", "D": "#f80", "E": "@home", "F": "",
    }  # fmt: skip


def test_what_only_gazebo_understands_is_named_once_in_every_node(folder: Folder) -> None:
    port = {"type": STRING, "external_topic": "/x", "gazebo_type": "ignition.msgs.IMU"}
    ports = [{"name": name, **port} for name in "abc"]
    folder.file("project.json", {"nodes": [node(inputs=ports), node("m", outputs=ports)]})
    loaded = folder.load()
    assert [str(warning).partition(": ")[2] for warning in loaded.warnings] == [
        f"/nodes/{index}/{side}/0/gazebo_type: Gazebo itself is not supported: 3 ports have a "
        "'gazebo_type', which has no effect: 'a', 'b', 'c'; their external topics are plain ROS "
        "topics, without a bridge (MuJoCo stands in for it, see the key 'mujoco')"
        for index, side in ((0, "inputs"), (1, "outputs"))
    ]
    assert loaded.project.node("n").input("a").gazebo_type == "ignition.msgs.IMU"


def test_a_node_of_gazebos_container_runs_in_that_of_mujoco(folder: Folder) -> None:
    folder.file("project.json", {"nodes": [node(container="neuros_gazebo")]})
    loaded = folder.load()
    assert loaded.project.node("n").container == "neuros_mujoco"
    (warning,) = loaded.warnings
    assert warning.pointer == "/nodes/0/container"
    assert "runs in 'neuros_mujoco' instead of 'neuros_gazebo'" in warning.text


def test_folders_that_only_gazebo_needs_may_be_missing(folder: Folder) -> None:
    (folder.path / "models").mkdir()
    environment = {
        "GZ_SIM_RESOURCE_PATH": "#models",
        "GAZEBO_MODEL_PATH": "#nowhere",
        "GZ_SIM_SYSTEM_PLUGIN_PATH": "@install/plugin/lib",
        "GZ_VERBOSE": 1,
    }
    folder.file("project.json", {"nodes": [node(environment=environment)]})
    loaded = folder.load()
    assert loaded.project.node("n").environment == {
        "GZ_SIM_RESOURCE_PATH": str(folder.path / "models"),
        "GZ_VERBOSE": "1",
    }
    assert sorted(warning.pointer.rpartition("/")[2] for warning in loaded.warnings) == [
        "GAZEBO_MODEL_PATH",
        "GZ_SIM_SYSTEM_PLUGIN_PATH",
        "GZ_VERBOSE",
    ]


def test_unconnected_ports_are_warnings(folder: Folder) -> None:
    port = [{"name": "x", "type": STRING}]
    folder.file("project.json", {"nodes": [node(inputs=port, outputs=port)]})
    assert [warning.text for warning in folder.load().warnings] == [
        "input 'x' of node 'n' is not connected",
        "output 'x' of node 'n' is not connected",
    ]


def test_messages_of_a_users_own_container_need_not_be_here(folder: Folder) -> None:
    port = {"name": "x", "type": "my_msgs/msg/Thing"}
    folder.file("project.json", {"nodes": [node(container="mine", outputs=[port])]})
    assert folder.load().project.node("n").output("x").type == "my_msgs/msg/Thing"


def test_mujoco_keys_reach_the_model(folder: Folder) -> None:
    mujoco = {"sensor": "imu", "element": "imu", "rate": 50}
    port = {"name": "x", "type": "sensor_msgs/msg/Imu", "mujoco": mujoco}
    folder.file("project.json", {"nodes": [node(outputs=[port])]})
    loaded = folder.load().project.node("n")
    assert loaded.output("x").mujoco == mujoco
    assert loaded.owns_time


class TestNodeFiles:
    def test_paths_start_at_the_file_that_names_them(self, folder: Folder) -> None:
        folder.file("parts/own.py", "")
        folder.file("parts/n.json", node(plugin="own.py", environment={"MODEL": "#own.py"}))
        folder.file("project.json", {"nodes": ["parts/n.json"]})
        loaded = folder.load().project.node("n")
        assert loaded.plugin == folder.path / "parts/own.py"
        assert loaded.environment == {"MODEL": str(folder.path / "parts/own.py")}
        assert loaded.environment_paths == ("MODEL",)
        assert (loaded.file, loaded.pointer) == (folder.path / "parts/n.json", "")

    def test_then_at_the_project(self, folder: Folder) -> None:
        folder.file("parts/n.json", node(plugin="p.py", environment={"MODEL": "#/p.py"}))
        folder.file("project.json", {"nodes": ["parts/n.json"]})
        loaded = folder.load().project.node("n")
        assert loaded.plugin == folder.path / "p.py"
        assert loaded.environment["MODEL"] == str(folder.path / "p.py")

    def test_a_list_of_nodes_and_a_path_to_a_path(self, folder: Folder) -> None:
        folder.file("all.json", [node("a"), "b.json"])
        folder.file("b.json", '"parts/b.json"')
        folder.file("parts/b.json", node("b"))
        folder.file("project.json", {"nodes": ["all.json", node("c")]})
        loaded = folder.load().project
        assert [n.name for n in loaded.nodes] == ["a", "b", "c"]
        assert loaded.node("a").pointer == "/0"


class TestPaths:
    def test_at_means_the_workspace(self, folder: Folder) -> None:
        (folder.workspace / "shared.py").touch()
        folder.file("project.json", {"nodes": [node(plugin="@shared.py")]})
        assert folder.load().project.node("n").plugin == folder.workspace / "shared.py"

    def test_the_project_s_own_workspace_comes_first(self, folder: Folder) -> None:
        (folder.workspace / "shared.py").touch()
        own = folder.file("workspace/shared.py", "")
        folder.file("project.json", {"nodes": [node(plugin="@shared.py")]})
        assert folder.load().project.node("n").plugin == own

    def test_at_install_means_what_is_built_of_a_package(self, folder: Folder) -> None:
        value = {"A": "@install/arm_msgs/share/Joints.json"}
        folder.file("project.json", {"nodes": [node(environment=value)]})
        built = folder.path.parent / "cache" / "arm_msgs-0123456789ab"

        def found() -> str:
            packages = ArmPackage(built)
            path = folder.path / "project.json"
            loaded = load_project(path, workspace=folder.workspace, packages=packages)
            return loaded.project.node("n").environment["A"]

        assert found() == str(built / "share/Joints.json"), "launching will build it"
        built.mkdir(parents=True)
        with pytest.raises(ProjectError, match=r"is not in what was built: there is no .*\.json"):
            found()

    def test_at_install_leads_nowhere_else(self, folder: Folder) -> None:
        value = {"A": "@install/arm_msgs/../../secret"}
        folder.file("project.json", {"nodes": [node(environment=value)]})
        with pytest.raises(ProjectError, match="there is no file"):
            load_project(
                folder.path / "project.json",
                workspace=folder.workspace,
                packages=ArmPackage(folder.path.parent / "cache" / "arm_msgs"),
            )

    def test_a_folder_may_be_a_value_but_no_plugin(self, folder: Folder) -> None:
        folder.file("data/x", "")
        folder.file("project.json", {"nodes": [node(environment={"DATA": "#data"})]})
        assert folder.load().project.node("n").environment["DATA"] == str(folder.path / "data")

    def test_links_may_not_lead_outside(self, folder: Folder, tmp_path: Path) -> None:
        (tmp_path / "secret").touch()
        (folder.path / "link").symlink_to(tmp_path / "secret")
        folder.file("project.json", {"nodes": [node(environment={"A": "#link"})]})
        with pytest.raises(ProjectError, match="'#link' leaves the project's folder"):
            folder.load()

    def test_links_may_lead_around_inside(self, folder: Folder) -> None:
        (folder.path / "link.py").symlink_to(folder.path / "p.py")
        folder.file("project.json", {"nodes": [node(plugin="link.py")]})
        assert folder.load().project.node("n").plugin == folder.path / "p.py"

    def test_a_link_that_points_to_itself_is_no_file(self, folder: Folder) -> None:
        (folder.path / "loop.py").symlink_to("loop.py")
        folder.file("project.json", {"nodes": [node(plugin="loop.py")]})
        with pytest.raises(ProjectError, match=r"there is no file 'loop\.py'"):
            folder.load()

    def test_a_missing_project_names_what_is_there(self, folder: Folder) -> None:
        folder.file("strict.json", {})
        with pytest.raises(ProjectError, match=r"no project\.json \(it has strict\.json\)"):
            load_project(folder.path, workspace=folder.workspace)
        with pytest.raises(ProjectError, match=r"no such file \(did you mean 'strict\.json'\?\)"):
            folder.load("strct.json")


def test_two_nest_nodes_do_not_fit_into_one_process(folder: Folder) -> None:
    nodes = [node("a", container="neuros_nest"), node("b"), node("c", container="neuros_nest:2")]
    file = folder.file("project.json", {"nodes": nodes})
    (problem,) = nest_conflicts(folder.load().project)
    column = file.read_text().index('"neuros_nest:2"') + 1
    assert (problem.line, problem.column, problem.pointer) == (1, column, "/nodes/2/container")
    assert "nodes 'a' and 'c' both use NEST" in problem.text
    assert not nest_conflicts(folder.load().project, ["a", "b"]), "c is not started"
