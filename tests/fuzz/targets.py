"""What is fed with changed inputs: files, messages, requests, bytes from topics.

A target lets an ordinary input through, and answers any other with an error of ours. Commands run
as users run them, up to their exit code.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import os
import shutil
import socket
import struct
import tempfile
import warnings
from array import array
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any
from zlib import crc32

from neuros_analysis.charts import load_figure
from neuros_analysis.comparison import comparison_rows
from neuros_analysis.findings import findings_of
from neuros_analysis.graph_picture import graph_svg
from neuros_analysis.replay.recorded_node import RecordedNode, recorded_node, recorded_run
from neuros_analysis.replay.script import Script
from neuros_analysis.review import open_for_review
from neuros_analysis.run_pages import figures_of, panels_page, picture, report_page, world_pages
from neuros_dashboard.live_metrics import ObservedRun
from neuros_dashboard.pages import Pages
from neuros_dashboard.server import Dashboard

import neuros.bag
from neuros import control
from neuros.api.run_record import open_run
from neuros.api.verify import RecordedPackets, compare
from neuros.cli.main import main
from neuros.control.link import ControlLink, decode, decoder_of, to_bytes
from neuros.errors import ControlError, NeurosError, ProtocolError
from neuros.launcher.peers import RUNNING, PeerState, state_from
from neuros.project.graph import graph_mermaid, graph_text
from neuros.project.load import load_project
from neuros.project.model import Folders
from neuros.project.split import node_file_from_json, node_file_to_json, project_to_json, split
from neuros.recording.recorder import Recorder
from neuros.transport.codecs import WrongBytes, message_codec
from neuros.transport.large_packets import LargeInput, LargeOutput
from neuros.transport.message_buffers import message_buffers
from neuros.transport.ros import data_qos, position_of
from neuros.transport.ros_graph import qos_profile
from tests.support.message_packages import MANIFEST
from tests.support.message_values import message_classes
from tests.support.recordings import NUMBER, number, plan, spool
from tests.support.run_folders import accounting, run_folder

from .mutation import Mutate, change_bytes, change_json, change_text, change_xml, mixed

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Target:
    """One way in.

    Attributes:
        feed: lets one input in, in an empty folder; raises for what must not happen.
        seeds: ordinary inputs.
        factor: the most memory that an input may take, as a multiple of it.
        is_json: whether ordinary inputs are JSON.
    """

    feed: Callable[[bytes, Path], object]
    seeds: Callable[[], Sequence[bytes]]
    mutate: Mutate
    factor: int = 10
    is_json: bool = False


TARGETS: dict[str, Target] = {}


def target(
    seeds: Callable[[], Sequence[bytes]], *ways: Mutate, factor: int = 10
) -> Callable[[Callable[[bytes, Path], object]], Callable[[bytes, Path], object]]:
    """Register a function under its name."""

    def register(feed: Callable[[bytes, Path], object]) -> Callable[[bytes, Path], object]:
        is_json = change_json in ways
        TARGETS[feed.__name__] = Target(feed, seeds, mixed(*ways), factor, is_json)
        return feed

    return register


def command(*arguments: str, codes: Sequence[int]) -> int:
    """Run a command of neuros; its exit code must be one of these."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main(arguments)
    assert code in codes, f"neuros {' '.join(arguments)}: exit code {code}: {said.getvalue()}"
    assert code == 0 or said.getvalue(), "nothing was said"
    return code


# ---------------------------------------------------------------------- projects

STRING = "std_msgs/msg/String"
PLUGIN = b"""\
import os
from neuros.hooks import All, Optional, neuros_function, neuros_tick

@neuros_tick(seconds=0.1, outputs="x")
def send(node):
    return node.make_packet("x")

@neuros_function(inputs=[Optional("y"), All("x")], outputs=Optional("z"))
def take(node, y, x):
    return None
"""
NODE: dict[str, Any] = {
    "name": "b", "container": "neuros_python", "plugin": "p.py",
    "inputs": [{"name": "x", "type": STRING},
               {"name": "y", "type": STRING, "external_topic": "/y",
                "qos": {"reliability": "reliable", "durability": "volatile", "depth": 3}}],
    "outputs": [{"name": "z", "type": STRING, "external_topic": "z", "qos": "sensor_data"},
                {"name": "x", "type": STRING}],
    "environment": {"A": "1", "B": "#p.py", "C": 0.5}, "parameters": {"gain": {"p": [1.5, 2.0]}},
    "resources": {"memory": "2g", "cpus": 1.5, "pids": 200}, "affinity": [0, 1],
    "devices": ["/dev/null"], "gpus": [0], "display": True,
}  # fmt: skip
PROJECT: dict[str, Any] = {
    "description": "A project",
    "nodes": [NODE | {"name": "a"}, "node.json"],
    "connections": [
        {"source_node": "a", "source_output": "x", "destination_node": "b",
         "destination_input": "x", "discard_limit": 0, "queue_size": 2},
        {"source_node": "b", "source_output": "x", "destination_node": "a",
         "destination_input": "x"},
    ],
    "namespace": "/left", "remap": {"/y": "/other", "a:z": "/far"},
    "budgets": {"lost_packets": {"a.x -> b.x": 0}, "real_time_factor": 0.5, "tick_error_ms": 5},
}  # fmt: skip


def write_project(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of an ordinary project, but for these."""
    whole = {"p.py": PLUGIN, "node.json": as_bytes(NODE), "project.json": as_bytes(PROJECT)}
    for name, content in {**whole, **files}.items():
        (folder / name).write_bytes(content)


def as_bytes(value: Any) -> bytes:
    return json.dumps(value, indent=1).encode()


def check_project(folder: Path) -> None:
    """``validate``, and what ``graph`` draws; a valid project can be told to its nodes."""
    if command("validate", str(folder), codes=(0, 3)):
        return
    project = load_project(folder / "project.json", workspace=folder).project
    for draw in (graph_text, graph_mermaid, graph_svg):
        assert draw(project).encode()
    for file in split(project, lambda _: Folders(folder, folder, folder)):
        text = json.dumps(node_file_to_json(file), allow_nan=False)
        assert node_file_from_json(json.loads(text)) == replace(
            file, node=replace(file.node, file=file.node.file)
        )
        for connection in file.connections:
            data_qos(connection)
        for port in (*file.node.inputs, *file.node.outputs):
            if port.qos is not None:
                qos_profile(port.qos)
        for name, value in file.node.environment.items():
            os.fsencode(name), os.fsencode(value)
    json.dumps(project_to_json(project), allow_nan=False)


@target(lambda: [as_bytes(PROJECT)], change_json, change_bytes, change_text)
def project_file(data: bytes, folder: Path) -> None:
    write_project(folder, {"project.json": data})
    check_project(folder)


@target(lambda: [as_bytes(NODE), as_bytes([NODE, NODE])], change_json, change_bytes, change_text)
def node_file(data: bytes, folder: Path) -> None:
    write_project(folder, {"node.json": data})
    check_project(folder)


@target(lambda: [PLUGIN], change_text, change_bytes)
def plugin_file(data: bytes, folder: Path) -> None:
    write_project(folder, {"p.py": data})
    command("validate", str(folder), codes=(0, 3))


MESSAGE = b"""\
# A message
int32 FIRST=1
string NAME="a"
int32[] values
string<=8[<=4] names
float64[9] matrix
std_msgs/Header header
bool done true
"""


@target(lambda: [MESSAGE], change_text, change_bytes)
def message_file(data: bytes, folder: Path) -> None:
    write_package(folder, {"msg/Thing.msg": data})


MANIFEST_SEED = MANIFEST.format(name="things", depends="  <depend>std_msgs</depend>\n").encode()


@target(lambda: [MANIFEST_SEED], change_xml, change_bytes)
def package_manifest(data: bytes, folder: Path) -> None:
    write_package(folder, {"package.xml": data})


def write_package(folder: Path, files: Mapping[str, bytes]) -> None:
    package = folder / "workspace" / "things"
    (package / "msg").mkdir(parents=True)
    for name, content in {"package.xml": MANIFEST_SEED, "msg/Thing.msg": MESSAGE, **files}.items():
        (package / name).write_bytes(content)
    write_project(folder, {})
    command("validate", str(folder), codes=(0, 3))


# ---------------------------------------------------------------------- descriptions


@cache
def sdf_seeds() -> Sequence[bytes]:
    return [(HERE.parents[1] / "extensions/neuros-robots/tests/everything.sdf").read_bytes()]


@target(sdf_seeds, change_xml, change_bytes, change_text)
def sdf_file(data: bytes, folder: Path) -> None:
    (folder / "robot.sdf").write_bytes(data)
    command("convert", str(folder / "robot.sdf"), codes=(0, 3))


@target(
    lambda: [(HERE / "seeds" / "robot.urdf").read_bytes()], change_xml, change_bytes, change_text
)
def urdf_file(data: bytes, folder: Path) -> None:
    (folder / "robot.urdf").write_bytes(data)
    command("convert", str(folder / "robot.urdf"), codes=(0, 3))


# ---------------------------------------------------------------------- what a run has left behind

NODE_FILES = ("0.sent_ns", "0.digests", "0.taken", "0.taken_ns", "executions", "event_log")


@cache
def a_run() -> tuple[tempfile.TemporaryDirectory[str], Path]:
    """The folder of a recorded run of two nodes, and what removes it in the end."""
    owner = tempfile.TemporaryDirectory(prefix="neuros-fuzz-")
    run = Path(owner.name)
    write_project(run, {})
    project = load_project(run / "project.json", workspace=run).project
    run_folder(
        run,
        {"a.x -> b.x": 0, "b.x -> a.x": None},
        {name: accounting(executing={"take": 1.0}, blocked={"a.x -> b.x": 3.0}) for name in "ab"},
        timeline={"a": [[0.0, 0.0], [1.0, 1.5], [2.0, 3.0]]},
        system_load={"machine": None, "processes": {}, "samples": 0, "file": "system_load.csv"},
        recording={"topics": {NUMBER.name: {"recorded": 5}}},
        machine={"name": "vm", "cores": 2, "usable_cores": 2, "memory_bytes": 1 << 30},
        versions={"neuros": "2.0.0", "python": "3.11.7", "packages": {"numpy": "2.3.5"}},
        git={"commit": "0" * 40, "is_dirty": False},
        seeds={"a": {"SEED": "1"}},
        command=["neuros", "launch", "made"],
        options={"set": ["/nodes/0/name=a"], "record": True},
        broken_budgets=[],
    )
    plan().save(run)
    for name in ("a", "b"):
        (run / name / "packets").mkdir(parents=True, exist_ok=True)
        (run / name / "packets" / "event_log").write_bytes(
            array("q", [5, ~2, 7, ~3, 9, ~(4 | 1 << 8)]).tobytes()
        )
    for file in split(project, lambda _: Folders(run, run, run)):
        (run / file.node.name / "node.json").write_bytes(as_bytes(node_file_to_json(file)))
    spool(run, "a", [(value, None, number(value)) for value in range(1, 20)])
    neuros.bag.open(run).close()
    return owner, run


def seed_of(path: str) -> Callable[[], Sequence[bytes]]:
    return lambda: [(a_run()[1] / path).read_bytes()]


def run_with(path: str, data: bytes, folder: Path) -> Path:
    """A copy of the run with another content of one file."""
    run = folder / "run"
    shutil.copytree(a_run()[1], run)
    (run / path).write_bytes(data)
    return run


def review(run: Path, data: bytes) -> None:
    """Read a run as ``report``, ``compare`` and ``verify`` do."""
    with allowed(NeurosError):
        opened = open_for_review(run)
        report_page(opened, findings_of(opened), {})
        comparison_rows([opened])
        world_pages(opened)
        if crc32(data) % 32 == 0:  # they take seconds
            figures_of(opened)
    with allowed(NeurosError):
        panels_page(open_for_review(run))
    with allowed(NeurosError):
        compare(open_run(run), open_run(a_run()[1]), RecordedPackets())


def replay(run: Path) -> None:
    """Read the nodes of a run as ``replay`` does."""
    with allowed(NeurosError):
        recorded = recorded_run(run)
        for name in ("a", "b"):
            node = RecordedNode(recorded, recorded_node(recorded, name))
            node.check()
            Script(node.event_log)


@contextlib.contextmanager
def allowed(*errors: type[BaseException]) -> Any:
    """Errors that are answers; they have a text."""
    try:
        yield
    except errors as error:
        if not str(error):
            raise AssertionError("an error without a text") from error


@target(seed_of("run.json"), change_json, change_bytes)
def run_record(data: bytes, folder: Path) -> None:
    run = run_with("run.json", data, folder)
    review(run, data)
    command("compare", str(run), codes=(0, 2, 4))


@target(seed_of("recording.json"), change_json, change_bytes)
def recording_plan(data: bytes, folder: Path) -> None:
    run = run_with("recording.json", data, folder)
    replay(run)
    with allowed(NeurosError), neuros.bag.open(run) as bag:
        assert bag.duration_s >= 0
    command("bag", "repair", str(run), codes=(0, 2, 4))


@target(seed_of("a/node.json"), change_json, change_bytes)
def node_of_a_run(data: bytes, folder: Path) -> None:
    replay(run_with("a/node.json", data, folder))


@target(seed_of("a/packets/executions"), change_bytes)
def packet_lists(data: bytes, folder: Path) -> None:
    """The first byte chooses the list."""
    name = NODE_FILES[data[0] % len(NODE_FILES)] if data else NODE_FILES[0]
    node = "b" if data[1:2] > b"\x7f" or "taken" in name else "a"
    run = run_with(f"{node}/packets/{name}", data, folder)
    review(run, data)
    replay(run)


POSE = b64encode(bytes(28)).decode()
WORLD = {
    "version": "1",
    "frames": [[0.0, 0.0, POSE], [0.5, 1.0, POSE], [0.7, 1.5, POSE]],
    "geometry": '{"bodies": []}',
}


@target(lambda: [json.dumps(WORLD).encode()], change_json, change_bytes, change_text)
def world_log(data: bytes, folder: Path) -> None:
    run = run_with("a/world.jsonl", data, folder)
    for page in world_pages(open_for_review(run)).values():
        _, _, text = page.partition('id="scenes">')
        json.loads(text.partition("</script>")[0], parse_constant=lambda name: 1 / 0)


LOAD = b"""\
time_s,unix_time_s,core0_percent,memory_used_bytes,a.cpu_percent,a.memory_bytes,a.threads
1.0,1700000001,50.0,1000000,40.0,500000,3
2.0,1700000002,60.0,1000000,,,
"""


@target(lambda: [LOAD], change_text, change_bytes)
def system_load(data: bytes, folder: Path) -> None:
    run = run_with("system_load.csv", data, folder)
    figure = load_figure(open_for_review(run))
    if figure is not None and crc32(data) % 8 == 0:  # it takes half a second
        picture(figure)


@target(seed_of("bag/bag.mcap"), change_bytes)
def bag_file(data: bytes, folder: Path) -> None:
    check_bag("bag.mcap", data, folder)


@target(seed_of("bag/metadata.yaml"), change_text, change_bytes)
def bag_metadata(data: bytes, folder: Path) -> None:
    check_bag("metadata.yaml", data, folder)


def check_bag(name: str, data: bytes, folder: Path) -> None:
    run = run_with(f"bag/{name}", data, folder)
    command("bag", "info", str(run / "bag"), codes=(0, 4))
    with warnings.catch_warnings(), allowed(NeurosError):
        warnings.simplefilter("ignore", UserWarning)  # packets are missing
        with neuros.bag.open(run) as bag:
            for topic in bag.topics.values():
                topic.array()
    command("bag", "repair", str(run), codes=(0, 4))


def record_spools(run: Path) -> None:
    """Move what lies in the spools of a run into its bag, as its recorder does."""
    said: list[str] = []
    recorder = Recorder(plan(), run, said.append)
    try:
        with allowed(OSError):
            recorder.complete()
            recorder.clean_up()
    finally:
        recorder.abandon()
    assert all(said)
    with neuros.bag.open(run / "bag") as bag:
        assert bag.topics.keys() >= {topic.name for topic in plan().topics}


@cache
def spool_seed() -> bytes:
    with tempfile.TemporaryDirectory() as name:
        run = Path(name)
        spool(run, "a", [(value, value, number(value)) for value in range(1, 5)])
        return (run / "a/spool/00000000").read_bytes()


@target(lambda: [spool_seed()], change_bytes)
def spool_file(data: bytes, folder: Path) -> None:
    """What a node writes for the recorder."""
    (folder / "a/spool").mkdir(parents=True)
    (folder / "a/spool/00000000").write_bytes(data)
    record_spools(folder)


HEARD = [asdict(replace(NUMBER, name=f"/heard{place}")) for place in range(2)]


@target(lambda: [as_bytes(HEARD)], change_json, change_bytes)
def listened_topics(data: bytes, folder: Path) -> None:
    """The recorder's own list, where a node has changed it."""
    spool(folder, ".listener", [(1, None, number(1))])
    (folder / ".listener/topics.json").write_bytes(data)
    record_spools(folder)


# ---------------------------------------------------------------------- other programs

SENT: Sequence[control.Message] = (
    control.Hello(("a",), {"a": "/a.py"}),
    control.Report(node="a", waiting_for=("a.x -> b.x",), sim_time=1.0, timeline=((1.0, 2.0),)),
    control.Hooks("a", (), ("end",)),
    control.Shutdown("a", "done", 5.0),
    control.Failed("a", "why"),
    control.NodeStatus("a", 1, 2.0, None, {"x": {"y": 1}}),
    control.Probe(3),
    control.Drain({"a": (1, 2)}),
    control.Step(1, is_driven=True),
    control.GetStatus({"a": {"x": {}}}, 1),
    control.Step(3),
    control.End("done"),
    control.PhaseChanged("running", is_paused=False),
    control.Ended(0, "done", {}, 1.0, None),
    control.Advance(3, 1, {"a.x": 2}),
    control.AtRest(3, {"a": 0.5}, {"a.x": (3, [b"1234"]), "a.z": (1, [b""])}),
)


@target(lambda: [to_bytes(each) for each in SENT], change_bytes)
def control_message(data: bytes, _: Path) -> None:
    for group in (control.FROM_NODES, control.TO_NODES, control.FROM_OBSERVERS,
                  control.TO_OBSERVERS):  # fmt: skip
        decoder = decoder_of(tuple(group))
        with allowed(ControlError):
            message = to_bytes(decode(data, decoder, "a"))
            assert to_bytes(decode(message, decoder, "a")) == message


@target(
    lambda: [PeerState("r", "p", ("a",), RUNNING).to_text().encode()], change_json, change_bytes
)
def peer_state(data: bytes, _: Path) -> None:
    state = state_from(data.decode("utf-8", "replace"))
    if state is not None:
        assert state_from(state.to_text()) == state


TOKEN = "secret"


def request(method: str, path: str, query: str = "", body: bytes = b"", **headers: str) -> bytes:
    whole = {"host": "127.0.0.1:1", "cookie": f"neuros_01234567={TOKEN}", **headers}
    head = "".join(f"{key}: {value}\n" for key, value in whole.items())
    return f"{method} {path} {query}\n{head}\n".encode() + body


def requests() -> Sequence[bytes]:
    wanted = as_bytes({"page": "1", "wanted": {"a": {"x": {"fields": ["data"], "all": True}}}})
    return [
        request("GET", "/"),
        request("GET", "/", f"token={TOKEN}&a=b", cookie=""),
        request("GET", "/static/style.css", origin="http://127.0.0.1:1"),
        request("POST", "/want", body=wanted),
        request("POST", "/do/step", body=b'{"count": 3}'),
        request("POST", "/do/stop"),
    ]


def change_body(data: bytes, chance: Any) -> bytes:
    head, end, body = data.partition(b"\n\n")
    return head + end + change_json(body or b"{}", chance)


@target(requests, change_bytes, change_body, change_text)
def dashboard_request(data: bytes, _: Path) -> None:
    """Method, path and query, then headers by lines, an empty line, and the body."""
    head, _, body = data.partition(b"\n\n")
    first, *lines = head.split(b"\n")
    method, path, query = (*first.split(b" ", 2), b"", b"", b"")[:3]
    headers = [line.partition(b": ")[::2] for line in lines]
    status = asyncio.run(answer(method, path, query, headers, body))
    assert status is None or 200 <= status < 500, f"status {status}"


async def answer(
    method: bytes, path: bytes, query: bytes, headers: Sequence[Sequence[bytes]], body: bytes
) -> int | None:
    """The status of the answer of a dashboard; ``None`` where it goes on for ever."""
    here, there = socket.socketpair()
    pages, link = Pages(), ControlLink(here, control.TO_OBSERVERS, "the supervisor")
    dashboard = Dashboard({}, lambda: None, dict, pages, ObservedRun(pages, link, ("a",), 0.0))  # type: ignore[arg-type, return-value]
    app = dashboard.app(TOKEN, "0123456789abcdef")
    statuses: list[int] = []
    scope = {
        "type": "http",
        "http_version": "1.1",
        "scheme": "http",
        "server": ("127.0.0.1", 1),
        "method": method.decode("latin-1"),
        "path": path.decode("utf-8", "replace"),
        "raw_path": path,
        "query_string": query,
        "headers": [(bytes(key).lower(), bytes(value)) for key, value in headers],
    }
    parts = [{"type": "http.request", "body": body}]

    async def receive() -> dict[str, Any]:
        return parts.pop() if parts else {"type": "http.disconnect"}

    async def send(message: Mapping[str, Any]) -> None:
        if "status" in message:
            statuses.append(message["status"])

    try:
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(app(scope, receive, send), 5)
    finally:
        link.close()
        there.close()
    return statuses[0] if statuses else None


# ---------------------------------------------------------------------- bytes from topics

HEADERS = (b"\0\1\0\0", b"\0\0\0\0", b"\0\3\0\0", b"\0\7\0\0")


@cache
def classes() -> Sequence[Any]:
    return message_classes()


def samples() -> Sequence[bytes]:
    found = []
    for place, kind in enumerate(classes()):
        message = kind()
        for name, of in kind.get_fields_and_field_types().items():
            if of == "string":
                setattr(message, name, "text")
            elif of.startswith("sequence<uint8"):
                setattr(message, name, [1, 2, 3])
        found.append(struct.pack("<HB", place, 0) + message_codec(kind).encode(message)[4:])
    return found


@target(samples, change_bytes, factor=40)
def packet(data: bytes, _: Path) -> None:
    """Two bytes choose the class of the message, one the encoding; then come its bytes."""
    if len(data) < 3:
        return
    place, header = struct.unpack("<HB", data[:3])
    kind = classes()[place % len(classes())]
    codec = message_codec(kind)
    with allowed(WrongBytes):
        again = codec.encode(codec.decode(HEADERS[header % len(HEADERS)] + data[3:]))
        assert codec.encode(codec.decode(again)) == again


@cache
def an_output() -> tuple[Any, Any, Any]:
    """A class with buffers, a sender of its large packets, and the folder of its memory."""
    from sensor_msgs.msg import Image

    buffers, owner = message_buffers(Image), tempfile.TemporaryDirectory(prefix="neuros-fuzz-")
    output = LargeOutput(Image, buffers, owner="r", slots=2, warn=print, folder=Path(owner.name))
    output.add_receiver(lambda: 1)
    return Image, output, owner


def parcels() -> Sequence[bytes]:
    kind, output, _ = an_output()
    return [output.encode(kind(data=array("B", bytes(70_000))))]


@target(parcels, change_bytes)
def parcel(data: bytes, _: Path) -> None:
    kind, _, owner = an_output()
    for is_reliable in (True, False):
        reader = LargeInput(
            kind, message_buffers(kind), is_reliable=is_reliable, folder=Path(owner.name)
        )
        try:
            with allowed(ProtocolError):
                found = reader.decode(data)
                if found is not None:
                    len(found.data)
        finally:
            reader.close()


@target(lambda: [b"\0\1\0\0" + bytes(8)], change_bytes)
def acknowledgement(data: bytes, _: Path) -> None:
    with allowed(ProtocolError):
        assert position_of(data) >= 0
