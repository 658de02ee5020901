"""One ``node.json`` per node, and back: nothing is lost, nothing is added."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from neuros.project.load import load_project
from neuros.project.model import Access, Connection, Folders, Node, Port, Project, Resources
from neuros.project.names import Names
from neuros.project.qos import Qos
from neuros.project.split import (
    node_file_from_json,
    node_file_to_json,
    node_files_from_json,
    project_to_json,
    split,
    translated,
)
from neuros.project.validate import schema

ROOT = Path("/home/user/demo")
NAMES = st.from_regex(r"[a-z][a-z0-9_]{0,5}", fullmatch=True)
TYPES = st.sampled_from(["std_msgs/msg/String", "sensor_msgs/msg/Imu"])
TEXTS = st.text(st.characters(blacklist_characters="\0", blacklist_categories=["Cs"]), max_size=6)
RESOURCES = st.builds(
    Resources,
    mem_bytes=st.none() | st.integers(1, 1 << 20).map(lambda kib: kib << 10),
    cpus=st.none() | st.floats(0.01, 64),
    pids=st.none() | st.integers(1, 4096),
)
ACCESSES = st.builds(
    Access,
    devices=st.sampled_from([(), ("/dev/ttyUSB0", "/dev/video0")]),
    gpus=st.sampled_from([(), ("all",), ("0", "1")]),
    display=st.booleans(),
)
QOS = st.none() | st.builds(
    Qos,
    reliability=st.sampled_from(["reliable", "best_effort"]),
    durability=st.sampled_from(["volatile", "transient_local"]),
    depth=st.integers(1, 1000),
)
PROJECT_NAMES = st.builds(
    Names,
    namespace=st.sampled_from(["", "/left", "/lab/left"]),
    remap=st.lists(st.tuples(NAMES, NAMES), max_size=3, unique_by=lambda rule: rule[0]).map(tuple),
)
PARAMETERS = st.dictionaries(
    NAMES, st.booleans() | st.integers(-9, 9) | TEXTS | st.just((1.0, 2.5)), max_size=2
)
SENSOR = {"sensor": "imu", "element": "imu", "rate": 50}


def folders_for(node: Node) -> Folders:
    return Folders(ROOT, Path("/workspace"), Path("/run") / node.name)


@st.composite
def ports(draw: st.DrawFn, side: str) -> tuple[Port, ...]:
    names = draw(st.lists(NAMES, max_size=3, unique=True))
    return tuple(
        Port(
            name,
            draw(TYPES),
            external_topic=(topic := draw(st.sampled_from([None, None, "/topic", "~/topic"]))),
            qos=draw(QOS) if topic else None,
            mujoco=draw(st.sampled_from([{}, SENSOR])) if side == "outputs" else {},
            gazebo_type=draw(st.sampled_from([None, "ignition.msgs.IMU"])),
        )
        for name in names
    )


@st.composite
def projects(draw: st.DrawFn, root: Path = ROOT) -> Project:
    names = draw(st.lists(NAMES, min_size=1, max_size=4, unique=True))
    nodes = []
    for index, name in enumerate(names):
        environment = draw(st.dictionaries(NAMES, TEXTS, max_size=3))
        paths = tuple(key for key in sorted(environment) if draw(st.booleans()))
        environment.update({key: str(root / "p.py") for key in paths})
        node = Node(
            name=name,
            container=draw(st.sampled_from(["neuros_python", "own"])),
            plugin=root / "p.py",
            script=draw(st.sampled_from([None, root / "s.sh"])),
            inputs=draw(ports("inputs")),
            outputs=draw(ports("outputs")),
            environment=environment,
            file=root / "project.json",
            pointer=f"/nodes/{index}",
            environment_paths=paths,
            affinity=tuple(draw(st.lists(st.integers(0, 9), max_size=2, unique=True))),
            resources=draw(RESOURCES),
            access=draw(ACCESSES),
            parameters=draw(PARAMETERS),
        )
        nodes.append(node)
    pairs = [
        (a.name, o.name, b.name, i.name)
        for a in nodes for o in a.outputs for b in nodes for i in b.inputs
        if o.type == i.type and o.external_topic is None and i.external_topic is None
    ]  # fmt: skip
    project_names = draw(PROJECT_NAMES)
    chosen = draw(st.lists(st.sampled_from(pairs), unique=True, max_size=5)) if pairs else []
    connections = tuple(
        Connection(
            *ends,
            discard_limit=draw(st.none() | st.integers(0, 3)),
            queue_size=draw(st.integers(1, 3)),
            index=index,
            namespace=project_names.namespace,
            compression=draw(st.sampled_from([None, "zstd"])),
        )
        for index, ends in enumerate(chosen)
    )
    description = draw(TEXTS)
    return Project(
        root.name,
        tuple(nodes),
        connections,
        root / "project.json",
        description,
        names=project_names,
    )


@settings(max_examples=100)
@given(projects(), st.randoms())
def test_the_parts_make_up_the_project(project: Project, random: Any) -> None:
    parts = list(split(project, folders_for))
    random.shuffle(parts)
    parts.sort(key=lambda part: part.index)
    connections = {c.index: c for part in parts for c in part.connections}
    merged = replace(
        project,
        nodes=tuple(part.node for part in parts),
        connections=tuple(connections[index] for index in sorted(connections)),
        names=parts[0].names if parts else Names(),
    )
    assert merged == project


@settings(max_examples=100)
@given(projects())
def test_a_node_file_survives_json_and_has_the_documented_form(project: Project) -> None:
    form = {**schema("node"), "$ref": "#/$defs/node_file"}
    for key in ("required", "oneOf", "additionalProperties", "properties"):
        form.pop(key)
    form["$defs"]["node_file"]["properties"]["node"] = {"type": "object"}
    for part in split(project, folders_for):
        content = json.loads(json.dumps(node_file_to_json(part)))
        Draft202012Validator(form).validate(content)
        Draft202012Validator(schema("node")).validate(content["node"])
        assert node_file_from_json(content) == part


@settings(max_examples=100)
@given(projects())
def test_nodes_that_share_a_process_share_their_connections(project: Project) -> None:
    parts = split(project, folders_for)
    files = node_files_from_json(map(node_file_to_json, parts))
    assert files == list(parts)
    ends = [connection for file in files for connection in file.connections]
    assert len({id(connection) for connection in ends}) == len(project.connections)


@settings(max_examples=100)
@given(projects())
def test_a_node_gets_its_own_connections_only(project: Project) -> None:
    for part in split(project, folders_for):
        assert part.folders.run == Path("/run") / part.node.name
        assert part.connections == tuple(
            c for c in project.connections
            if part.node.name in (c.source_node, c.destination_node)
        )  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_the_expanded_project_loads_again(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as name:
        root = Path(name).resolve() / "demo"
        run = Path(name).resolve() / "run"
        root.mkdir()
        run.mkdir()
        (root / "p.py").touch()
        (root / "s.sh").touch()
        project = data.draw(projects(root=root))
        file = run / "project.json"
        file.write_text(json.dumps(project_to_json(project)))
        again = load_project(file, workspace=run, folder=root).project
    assert project_to_json(again) == project_to_json(project)
    assert (again.name, again.connections) == (project.name, project.connections)
    assert [n.environment for n in again.nodes] == [n.environment for n in project.nodes]


def test_paths_are_translated_to_what_the_node_sees() -> None:
    def translate(path: Path) -> Path:
        return Path("/project") / path.relative_to(ROOT)

    node = Node(
        name="n", container="c", plugin=ROOT / "p.py", script=ROOT / "s.sh",
        environment={"MODEL": str(ROOT / "m.xml"), "TEXT": str(ROOT)},
        environment_paths=("MODEL",), file=ROOT / "project.json",
    )  # fmt: skip
    seen = translated(node, translate)
    assert seen.plugin == Path("/project/p.py")
    assert seen.script == Path("/project/s.sh")
    assert seen.environment == {"MODEL": "/project/m.xml", "TEXT": str(ROOT)}
    assert seen.file == ROOT / "project.json"


def test_a_connection_from_a_node_to_itself_is_there_once() -> None:
    port = (Port("x", "std_msgs/msg/String"),)
    node = Node("n", "c", Path("p.py"), inputs=port, outputs=port)
    project = Project("p", (node,), (Connection("n", "x", "n", "x"),), Path("project.json"))
    (part,) = split(project, folders_for)
    assert part.connections == project.connections


def test_anything_else_is_no_node_file() -> None:
    with pytest.raises(KeyError):
        node_file_from_json({"nodes": []})


def test_the_transport_of_a_connection_is_one_key() -> None:
    ends = Connection("eye", "image", "brain", "image").keys
    keys = {**ends, "transport": {"compression": "jpeg", "quality": 80.0}}
    connection = Connection.of(keys, index=2)
    assert (connection.compression, connection.quality, connection.index) == ("jpeg", 80, 2)
    assert connection.keys == keys
    assert list(connection.keys["transport"]) == ["compression", "quality"]
    assert Connection.of(ends).keys == ends
