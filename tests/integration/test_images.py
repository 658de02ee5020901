"""Large packets between processes: bit for bit whatever the discard limit, and nothing is left."""

from __future__ import annotations

import itertools
import os
import re
import signal
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from launching import Finished, launch, start
from test_transports import RosNetwork
from transport_checks import SERIES, TransportBench

from neuros.backends.domain import choose_domain
from neuros.project.model import NodeFile
from neuros.testing.harness import wire
from neuros.transport import large_packets
from neuros.transport.messages import make_packet

PROJECT = Path(__file__).parent / "large_packets"
SHARED_MEMORY = Path("/dev/shm")
COUNT = 60
STORES = r"process (\d+) stores in (neuros_\S+)"


# --------------------------------------------------------------------------------- whole projects


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = tmp_path_factory.mktemp("large_packets")
    finished = launch(PROJECT, "--backend", "process", cwd=folder, timeout_s=60.0)
    assert finished.exit_code == 0, finished.output
    return finished


def seen(finished: Finished, node: str) -> list[int]:
    """The images that a node has seen, all of them as they were sent."""
    assert finished.run_folder is not None
    lines = (finished.run_folder / node / "seen").read_text().split("\n")[:-1]
    assert [line for line in lines if not line.endswith(" True")] == []
    return [int(line.split()[0]) for line in lines]


def test_images_pass_through_shared_memory_of_which_nothing_is_left(finished: Finished) -> None:
    found = re.search(STORES, finished.output)
    assert found is not None
    assert not (SHARED_MEMORY / found[2]).exists()


def test_without_loss_every_image_arrives(finished: Finished) -> None:
    assert seen(finished, "lossless") == list(range(1, COUNT + 1))
    counts = finished.connection("camera.image -> lossless.image")
    assert counts["sent"] == counts["received"] == counts["consumed"] == COUNT


def test_with_a_discard_limit_no_more_in_a_row_are_missing(finished: Finished) -> None:
    numbers = [0, *seen(finished, "limited")]
    assert all(0 < b - a <= 5 for a, b in itertools.pairwise(numbers))
    counts = finished.connection("camera.image -> limited.image")
    assert counts["sent"] == counts["received"] == COUNT
    assert counts["consumed"] == len(numbers) - 1


def test_with_best_effort_what_arrives_is_right_and_counted(finished: Finished) -> None:
    numbers = seen(finished, "best_effort")
    assert numbers
    assert numbers == sorted(set(numbers))
    counts = finished.connection("camera.image -> best_effort.image")
    assert counts["sent"] == COUNT
    assert counts["consumed"] == len(numbers) <= counts["received"] <= COUNT


def test_a_sender_that_is_killed_leaves_no_shared_memory(tmp_path: Path) -> None:
    arguments = ("--backend", "process", "--set", "nodes.camera.environment.COUNT=1000000")
    with start(PROJECT, *arguments, cwd=tmp_path) as running:
        running.wait_for("stores in neuros_")
        found = re.search(STORES, running.output)
        assert found is not None
        assert (SHARED_MEMORY / found[2]).exists()
        os.kill(int(found[1]), signal.SIGKILL)
        assert running.finish().exit_code != 0
    assert not (SHARED_MEMORY / found[2]).exists()


# ----------------------------------------------------------------------------------- on the topic


@pytest.fixture
def domain() -> Iterator[None]:
    with choose_domain(None, {}, False) as lock, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(lock.id))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


def network(files: Sequence[NodeFile]) -> RosNetwork:
    return RosNetwork([[file] for file in files])


def segments() -> list[Path]:
    return list(SHARED_MEMORY.glob(f"neuros_pid{os.getpid()}_*"))


def exchange(bench: TransportBench, first: int, count: int) -> None:
    """Send large packets from a to b, one after another, and see them arrive."""
    (connection,) = bench.connections
    transport, inbox = bench.network.transport("a"), bench.inboxes["b"]
    for number in range(first, first + count):
        packet = make_packet(SERIES)
        packet.data = array("d", [float(number)] * (1 << 15))
        before = len(inbox.packets.get(connection, ()))
        transport.sender([connection])(packet)
        bench.wait(lambda before=before: len(inbox.packets.get(connection, ())) > before)  # type: ignore[misc]
        bench.acknowledge(connection, before + 1)
        assert inbox.packets[connection][-1] == packet


@pytest.mark.usefixtures("domain")
def test_ordinary_ros_tools_see_whole_packets() -> None:
    with TransportBench(network, wire("a.series -> b.series", 0)) as bench:
        bench.meet()
        exchange(bench, 0, 2)
        assert segments()
        heard = bench.network.listen(f"{bench.connections[0].topic}/data", SERIES)
        assert heard is not None
        number = 2
        while not heard and number < 1000:
            exchange(bench, number, 1)
            number += 1
        exchange(bench, number, 3)
        bench.wait(lambda: bool(heard) and heard[-1].data[0] == number + 2)
        assert {len(packet.data) for packet in heard} == {1 << 15}
    assert not segments()


@pytest.mark.usefixtures("domain")
def test_who_does_not_see_the_same_shared_memory_gets_whole_packets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tokens = iter(["somewhere else", *["here"] * 100])
    monkeypatch.setattr(large_packets, "machine_token", lambda: next(tokens))
    with TransportBench(network, wire("a.series -> b.series", 0)) as bench:
        bench.meet()
        exchange(bench, 0, 3)
        assert not segments()


def test_a_large_packet_in_one_process_needs_no_segment(tmp_path: Path) -> None:
    finished = launch(PROJECT, "--backend", "in-process", cwd=tmp_path, timeout_s=60.0)
    assert finished.exit_code == 0, finished.output
    assert seen(finished, "lossless") == list(range(1, COUNT + 1))
    assert re.search(STORES, finished.output) is None
