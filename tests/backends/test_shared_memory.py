"""What killed nodes leave in shared memory goes, and what lives is never touched."""

from __future__ import annotations

import fcntl
import mmap
import os
import queue
import secrets
import signal
import subprocess
import sys
import threading
import time
from array import array
from collections.abc import Iterator
from pathlib import Path

import pytest

from neuros.backends.domain import DomainLock, choose_domain
from neuros.backends.guardian import Guardian
from neuros.backends.run_processes import RUN_ID
from neuros.backends.shared_memory import hold, remove_dead_runs, sweep
from neuros.transport.dds_profile import PROFILES_VARIABLE, RANGE_VARIABLE
from neuros.transport.large_packets import SegmentWriter

SHM = Path("/dev/shm")
PORT = ("fastrtps_port7411", "fastrtps_port7411_el", "sem.fastrtps_port7411_mutex")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in PORT:
        (tmp_path / name).write_bytes(b"x" * 64)
    return tmp_path


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _sweep(folder: Path, started_s: float = 0.0) -> tuple[str, ...]:
    return sweep(started_s, folder=folder, look_again_s=0.0)


def test_a_group_with_a_free_lock_is_removed_as_a_whole(folder: Path) -> None:
    assert sorted(_sweep(folder)) == sorted(PORT)
    assert not _names(folder)


def test_a_group_whose_owner_holds_the_lock_stays(folder: Path) -> None:
    with open(folder / PORT[1]) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert _sweep(folder) == ()
    assert _names(folder) == set(PORT)


def test_so_does_one_whose_readers_share_a_lock(folder: Path) -> None:
    (folder / PORT[1]).rename(folder / "fastrtps_port7411_sl")
    with open(folder / "fastrtps_port7411_sl") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        assert _sweep(folder) == ()


def test_who_has_only_opened_the_lock_file_does_not_keep_it(folder: Path) -> None:
    with open(folder / PORT[1]):
        assert sorted(_sweep(folder)) == sorted(PORT)


def test_who_locks_only_to_look_does_not_keep_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Another sweep does so, and Fast DDS in a neighbour, to see whether it is locked.
    with open(folder / PORT[1]) as looking:
        fcntl.flock(looking, fcntl.LOCK_EX)
        monkeypatch.setattr("time.sleep", lambda _: looking.close())
        assert sorted(_sweep(folder)) == sorted(PORT)


def test_an_owner_that_locks_between_two_looks_is_not_disturbed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open(folder / PORT[1]) as lock:
        monkeypatch.setattr("time.sleep", lambda _: fcntl.flock(lock, fcntl.LOCK_EX))
        assert _sweep(folder) == ()
    assert _names(folder) == set(PORT)


def test_without_a_lock_file_it_counts_whether_somebody_maps_the_memory(folder: Path) -> None:
    (folder / PORT[1]).unlink()
    with open(folder / PORT[0], "r+b") as file:
        memory = mmap.mmap(file.fileno(), 0)
    assert _sweep(folder) == ()
    memory.close()
    assert set(_sweep(folder)) == {PORT[0], PORT[2]}


def test_what_was_there_before_the_run_stays(folder: Path) -> None:
    long_ago = time.time() - 3600
    for path in folder.iterdir():
        os.utime(path, (long_ago, long_ago))
    assert _sweep(folder, time.time()) == ()


def test_what_came_right_after_the_start_counts_as_of_the_run(tmp_path: Path) -> None:
    started = time.time()
    (tmp_path / PORT[0]).touch()
    assert _sweep(tmp_path, started) == (PORT[0],)


def test_tracing_files_go_when_nobody_maps_them_however_old(tmp_path: Path) -> None:
    waits = tmp_path / "lttng-ust-wait-8-0"
    waits.write_bytes(b"x" * 64)
    os.utime(waits, (0, 0))
    with open(waits, "r+b") as file:
        memory = mmap.mmap(file.fileno(), 0)
    assert _sweep(tmp_path, time.time()) == ()
    memory.close()
    assert _sweep(tmp_path, time.time()) == (waits.name,)


def test_files_of_other_programs_are_left_alone(tmp_path: Path) -> None:
    for name in ("sem.mine", "fastrtps", "my_fastrtps_1", "lttng", "psm_1234"):
        (tmp_path / name).touch()
    assert _sweep(tmp_path) == ()


def test_a_folder_that_does_not_exist_is_clean(tmp_path: Path) -> None:
    assert _sweep(tmp_path / "nowhere") == ()
    assert remove(tmp_path / "nowhere") == ()


def test_the_guardian_removes_the_segments_of_its_run() -> None:
    run_id = secrets.token_hex(8)
    guardian = Guardian.start(run_id)
    guardian.await_ready()
    segment = SHM / f"neuros_{run_id}_camera_image_1"
    try:
        segment.write_bytes(b"x" * 64)
    finally:
        guardian.finish()
    assert not segment.exists()


# ------------------------------------------------------------------------- real ROS nodes

NODE = """
import sys, rclpy
from std_msgs.msg import String
rclpy.init(domain_id=int(sys.argv[2]))
node = rclpy.create_node(sys.argv[1])
if sys.argv[1].startswith("talker"):
    publisher = node.create_publisher(String, "talk", 10)
    node.create_timer(0.05, lambda: publisher.publish(String(data=sys.argv[1])))
    print("ready", flush=True)
else:
    node.create_subscription(String, "talk", lambda packet: print(packet.data, flush=True), 10)
while True:
    rclpy.spin_once(node, timeout_sec=0.1)
"""


class RosNode:
    """A process with a real ROS node: a talker, or a listener that prints what it hears."""

    def __init__(self, name: str, domain: int, run_id: str = "") -> None:
        # NeuROS's own settings, where a test before this has taken them on, do without this memory.
        unwanted = (PROFILES_VARIABLE, RANGE_VARIABLE)
        environment = {key: value for key, value in os.environ.items() if key not in unwanted}
        environment |= {RUN_ID: run_id} if run_id else {}
        self.process = subprocess.Popen(
            [sys.executable, "-c", NODE, name, str(domain)],
            stdout=subprocess.PIPE,
            env=environment,
            text=True,
        )
        self._heard: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as output:
            for line in output:
                self._heard.put(line.strip())

    def hears(self, name: str, times: int = 5, deadline_s: float = 20.0) -> None:
        """Wait until it has heard ``name`` so many times from now on."""
        while not self._heard.empty():
            self._heard.get()
        end = time.monotonic() + deadline_s
        while times:
            times -= self._heard.get(timeout=end - time.monotonic()) == name

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(10)
        self._reader.join(10)


def _in_use(pid: int) -> set[str]:
    """Names in ``/dev/shm`` that a process maps or has open."""
    names = set()
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        if f"{SHM}/" in line:
            names.add(line.rpartition("/")[2])
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        target = os.readlink(descriptor)
        if target.startswith(f"{SHM}/"):
            names.add(target.rpartition("/")[2])
    return names


@pytest.fixture
def domain() -> Iterator[DomainLock]:
    with choose_domain(None, {}, False) as lock:
        yield lock


@pytest.fixture
def nodes() -> Iterator[list[RosNode]]:
    nodes: list[RosNode] = []
    yield nodes
    for node in nodes:
        node.kill()
    sweep(_STARTED_S)


_STARTED_S = time.time()


def test_a_killed_run_leaves_nothing_and_its_neighbours_go_on(
    domain: DomainLock, nodes: list[RosNode]
) -> None:
    run_id = secrets.token_hex(8)
    guardian = Guardian.start(run_id)
    guardian.await_ready()
    try:
        # The run is there first, so that its neighbours know, and map, its memory.
        nodes.append(RosNode("talker_of_the_run", domain.id, run_id))
        listener = RosNode("listener", domain.id)
        nodes.append(listener)
        listener.hears("talker_of_the_run")
        nodes.append(RosNode("talker", domain.id))
        listener.hears("talker")
        run, *others = [node.process.pid for node in nodes]
        of_the_run = {name for name in _in_use(run) if (SHM / f"{name}_el").exists()}
        alive = set().union(*(_in_use(pid) for pid in others))
        owned = {name for pid in others for name in _in_use(pid) if name.endswith("_el")}
        os.kill(run, signal.SIGKILL)
    finally:
        guardian.finish()
    left = _names(SHM)
    dead = {name for name in of_the_run if f"{name}_el" not in owned}
    assert dead
    assert dead.isdisjoint(left)
    assert {f"{name}_el" for name in dead}.isdisjoint(left)
    assert alive - dead <= left
    listener.hears("talker")

    # A new node takes the number, and so the port, of the killed one.
    nodes.append(RosNode("talker_again", domain.id))
    listener.hears("talker_again")


def test_a_run_that_is_alone_leaves_shared_memory_as_it_was(
    domain: DomainLock, nodes: list[RosNode]
) -> None:
    run_id = secrets.token_hex(8)
    guardian = Guardian.start(run_id)
    guardian.await_ready()
    try:
        nodes.append(RosNode("listener", domain.id, run_id))
        nodes.append(RosNode("talker", domain.id, run_id))
        nodes[0].hears("talker")
        used = set().union(*(_in_use(node.process.pid) for node in nodes))
        assert any(name.startswith("fastrtps_port") for name in used)
    finally:
        guardian.finish()
    stays = {name for name in used if name.startswith("lttng")}  # others may be using these
    bases = {name.removesuffix("_el") for name in used - stays}
    assert not {name for name in _names(SHM) for base in bases if base in name}


# ------------------------------------------------------------------ dead runs


@pytest.fixture
def run() -> str:
    """The id of a run that does not exist."""
    return secrets.token_hex(8)


def remove(folder: Path) -> tuple[str, ...]:
    return remove_dead_runs(folder, look_again_s=0.0)


def test_the_folder_of_containers_goes_with_what_is_in_it(tmp_path: Path, run: str) -> None:
    (tmp_path / f"neuros_{run}").mkdir()
    (tmp_path / f"neuros_{run}" / "fastrtps_1").touch()
    assert remove(tmp_path) == (f"neuros_{run}",)
    assert list(tmp_path.iterdir()) == []


def test_it_stays_while_its_launcher_holds_it(tmp_path: Path, run: str) -> None:
    folder = tmp_path / f"neuros_{run}"
    folder.mkdir()
    descriptor = hold(folder)
    assert remove(tmp_path) == ()
    os.close(descriptor)
    assert remove(tmp_path) == (folder.name,)


def test_large_packets_stay_while_their_sender_has_mapped_them(tmp_path: Path, run: str) -> None:
    writer = SegmentWriter(f"{run}_camera", slots=2, folder=tmp_path)
    writer.write([array("B", bytes(100))])
    (segment,) = tmp_path.iterdir()
    assert remove(tmp_path) == ()
    copy = tmp_path / f"neuros_{run}_of_one_that_was_killed"
    copy.write_bytes(segment.read_bytes())
    assert remove(tmp_path) == (copy.name,)
    assert list(tmp_path.iterdir()) == [segment]
    writer.close()


def test_nothing_goes_while_the_mark_of_the_run_is_locked(tmp_path: Path, run: str) -> None:
    """A sender that has ended holds nothing any more; receivers may still need its packets."""
    packets, mark = tmp_path / f"neuros_{run}_camera_image_1", tmp_path / f"neuros_{run}_mark"
    packets.touch()
    with open(mark, "w") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        assert remove(tmp_path) == ()
    assert remove(tmp_path) == (packets.name, mark.name)


def test_what_is_called_differently_is_left_alone(tmp_path: Path, run: str) -> None:
    for name in (f"my_neuros_{run}", f"neuros_{run[:8]}", f"neuros_{run}s", "neuros_lock"):
        (tmp_path / name).touch()
    assert remove(tmp_path) == ()


def test_what_was_made_anew_between_two_looks_stays(
    tmp_path: Path, run: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / f"neuros_{run}"
    folder.mkdir()

    def make_anew(_: float) -> None:
        folder.rename(tmp_path / "aside")
        folder.mkdir()

    monkeypatch.setattr("time.sleep", make_anew)
    assert remove(tmp_path) == ()
