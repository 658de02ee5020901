"""Connections that compress: over real topics, between machines, and as JPEG on every back end."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import test_transports
from launching import Finished, launch
from machines import require_machines
from transport_checks import SERIES, TransportBench

from neuros.project.model import Connection, NodeFile
from neuros.testing.harness import wire
from neuros.transport.large_packets import LargeCodecs
from neuros.transport.messages import make_packet

STREAM = Path(__file__).parent / "network" / "stream"
NEUROS = Path(sys.executable).with_name("neuros")
CONNECTION = "source.image -> sink.image"
COUNT, SIZE = 40, 300_000
ENDED_S = 120.0


def network(files: Sequence[NodeFile]) -> test_transports.RosNetwork:
    """Nodes with a context each, as in processes of their own."""
    return test_transports.RosNetwork([[file] for file in files])


def compressed(*arguments: Any, **options: Any) -> Connection:
    """As ``wire``."""
    return replace(wire(*arguments, **options), compression="zstd")


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every receiver tells its senders that it is on another machine."""
    monkeypatch.setattr(LargeCodecs, "note", lambda *_: "another machine")


@pytest.mark.usefixtures("elsewhere")
class TestCompressedRosTransport(test_transports.TestRosTransport):
    """The whole suite, with compression on every connection."""

    @pytest.fixture(autouse=True)
    def compression(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("transport_checks.wire", compressed)


@pytest.fixture
def bench(elsewhere: None) -> Iterator[TransportBench]:
    with TransportBench(network, compressed("a.series -> b.series", 0)) as made:
        made.meet()
        yield made


def series(value: float) -> Any:
    packet = make_packet(SERIES)
    packet.data.extend([value] * 50_000)
    return packet


def test_a_large_packet_arrives_as_it_was_and_both_ends_digest_the_same(
    bench: TransportBench,
) -> None:
    (connection,) = bench.connections
    a, b = (bench.network.transport(name) for name in "ab")
    for value in (1.0, 2.0):
        a.sender([connection])(series(value))
        bench.wait(lambda v=value: len(bench.inboxes["b"].packets.get(connection, ())) == int(v))
    assert bench.inboxes["b"].packets[connection] == [series(1.0), series(2.0)]
    assert a.digests[connection] == b.digests[connection]
    assert len(a.digests[connection]) == 2
    before, after = a.compressed[str(connection)]
    assert before > 2 * 400_000
    assert after < before / 20


def test_ros_tools_that_read_the_topic_get_whole_messages(bench: TransportBench) -> None:
    (connection,) = bench.connections
    heard = bench.network.listen(f"{connection.topic}/data", SERIES)
    a: Any = bench.network.transport("a")
    count_readers = a._sending[connection].count_readers
    bench.wait(lambda: count_readers() == 2)
    a.sender([connection])(series(1.0))
    bench.wait(lambda: bool(heard))
    assert heard == [series(1.0)]
    before, after = a.compressed[str(connection)]
    assert before == after


# ------------------------------------------------------------------------ launched


def run(folder: Path, *, compression: str | None, is_elsewhere: bool) -> Finished:
    """The stream of images, with its sink on this machine or on one with memory of its own."""
    folder.mkdir()
    project = Path(shutil.copytree(STREAM, folder / "stream")) / "project.json"
    content = json.loads(project.read_text())
    content["nodes"][0]["environment"] |= {"COUNT": str(COUNT), "SIZE": str(SIZE)}
    if compression:
        content["connections"][0]["transport"] = {"compression": compression}
    project.write_text(json.dumps(content))
    arguments = ["--record", "--backend", "process"]
    if is_elsewhere:
        apart = 'mount -t tmpfs tmpfs /dev/shm && XDG_CACHE_HOME="$0" exec "$@"'
        through = ["unshare", "--mount", "sh", "-c", apart, str(folder / "cache")]
        host = {"through": through, "neuros": str(NEUROS), "address": "127.0.0.1"}
        file = folder / "deployment.json"
        hosts = {"hosts": {"other": host}, "nodes": {"sink": "other"}, "timeout_s": 60}
        file.write_text(json.dumps(hosts))
        arguments = ["--record", "--deployment", str(file)]
    finished = launch(project.parent, *arguments, cwd=folder, timeout_s=ENDED_S)
    assert finished.exit_code == 0, finished.output
    assert finished.connection(CONNECTION)["received"] == COUNT
    return finished


def test_between_machines_packets_are_compressed_and_the_same(tmp_path: Path) -> None:
    require_machines()
    plain = run(tmp_path / "plain", compression=None, is_elsewhere=True)
    squeezed = run(tmp_path / "squeezed", compression="zstd", is_elsewhere=True)
    assert "compressed_bytes" not in plain.connection(CONNECTION)
    books = squeezed.connection(CONNECTION)
    assert books["bytes"] > COUNT * SIZE
    assert books["compressed_bytes"] < books["bytes"] / 100
    assert "source.image -> sink.image: 12 MB compressed to " in squeezed.output


def test_within_a_machine_nothing_is_compressed(tmp_path: Path) -> None:
    finished = run(tmp_path / "here", compression="zstd", is_elsewhere=False)
    assert "compressed_bytes" not in finished.connection(CONNECTION)


# ---------------------------------------------------------------------------- JPEG

CAMERA = """
from array import array
from neuros.hooks import neuros_tick

number = 0

@neuros_tick(seconds=0.01, outputs="image")
def send(node):
    global number
    number += 1
    if number == 5:
        node.shutdown("all sent")
    image = node.make_packet("image")
    image.width, image.height, image.encoding, image.step = 64, 48, "ENCODING", 192
    image.data = array("B", bytes((x * y + number) % 251 for y in range(48) for x in range(192)))
    return image
"""
VIEWER = """
from zlib import crc32
from neuros.hooks import neuros_finalise, neuros_function

seen = {}

@neuros_function(inputs="image", outputs="sum")
def take(node, image):
    assert (image.width, image.height, image.encoding, image.step) == (64, 48, "rgb8", 192)
    seen.setdefault("image", []).append(crc32(image.data))
    made = node.make_packet("sum")
    made.data = seen["image"][-1]
    return made

@neuros_function(inputs="whole")
def take_whole(node, image):
    seen.setdefault("whole", []).append(crc32(image.data))

@neuros_finalise()
def tell(node):
    node.set_result("seen", seen)
"""
LISTENER = """
from neuros.hooks import neuros_function

@neuros_function(inputs="sum")
def take(node, sum): pass
"""


def camera(folder: Path, encoding: str = "rgb8") -> Path:
    """A camera that sends its images to an input as they are, and to another one as JPEG."""
    folder.mkdir()
    image = {"type": "sensor_msgs/msg/Image"}
    total = {"name": "sum", "type": "std_msgs/msg/UInt32"}
    ports: dict[str, Any] = {
        "eye": {"outputs": [{"name": "image", **image}]},
        "viewer": {
            "inputs": [{"name": "image", **image}, {"name": "whole", **image}],
            "outputs": [total],
        },
        "listener": {"inputs": [total]},
    }
    lines = {
        "eye.image -> viewer.whole": {},
        "eye.image -> viewer.image": {"transport": {"compression": "jpeg", "quality": 80}},
        "viewer.sum -> listener.sum": {},
    }
    project = {
        "nodes": [
            {"name": name, "container": "neuros_python", "plugin": f"{name}.py", **own}
            for name, own in ports.items()
        ],
        "connections": [{**wire(line, 0).keys, **more} for line, more in lines.items()],
    }
    (folder / "project.json").write_text(json.dumps(project))
    (folder / "eye.py").write_text(CAMERA.replace("ENCODING", encoding))
    (folder / "viewer.py").write_text(VIEWER)
    (folder / "listener.py").write_text(LISTENER)
    return folder


def test_images_as_jpeg_are_the_same_on_every_back_end_and_in_a_replay(tmp_path: Path) -> None:
    project = camera(tmp_path / "camera")
    seen, digests = [], []
    for backend in ("in-process", "process"):
        finished = launch(
            project, "--backend", backend, "--record", "--digests", cwd=tmp_path, timeout_s=ENDED_S
        )
        assert finished.exit_code == 0, finished.output
        assert [each["lost"] for each in finished.record["connections"]] == [0, 0, 0]
        seen.append(finished.record["nodes"]["viewer"]["results"]["seen"])
        digests.append([each["digests"] for each in finished.record["connections"]])
        replayed = subprocess.run(
            [NEUROS, "replay", str(finished.run_folder), "--node", "viewer"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert replayed.returncode == 0, replayed.stdout + replayed.stderr
        assert "identical: 5 packets" in replayed.stdout, replayed.stdout
    assert "eye.image -> viewer.image: 0.0461 MB compressed to " in finished.output
    assert seen[0] == seen[1]
    assert digests[0] == digests[1]
    assert len(seen[0]["image"]) == 5
    assert seen[0]["image"] != seen[0]["whole"]


def test_an_image_that_jpeg_cannot_hold_ends_the_run_with_hook_and_field(tmp_path: Path) -> None:
    project = camera(tmp_path / "camera", "16UC3")
    finished = launch(project, "--backend", "in-process", cwd=tmp_path, timeout_s=ENDED_S)
    assert finished.exit_code == 1
    assert "Traceback" not in finished.output
    assert "field 'encoding' must be one of rgb8, bgr8, mono8" in finished.output
    assert "eye.py" in finished.output
