"""A project on two machines by one command, over ``ssh``; and every fault that can come between.

The machine on the right has its own network, host name, shared memory, cache and monotonic clock;
no multicast passes. All but the first test are long runs.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
from deadlines import wait_until
from engines import OwnEngine, own_engine, require_engines
from launching import EXAMPLES, Finished, Running
from machines import APART_S, Machine, require_machines
from ssh_server import SshServer, ssh_server
from two_machines import ADDRESSES, TwoMachines

from neuros.backends.control_sockets import connect
from neuros.backends.run_processes import RunProcesses
from neuros.backends.sessions import RunOnThisMachine, sessions
from neuros.control import TO_OBSERVERS, GetStatus, NodeStatus, Watch
from neuros.control.link import ControlLink

STREAM = Path(__file__).parents[3] / "tests/integration/network/stream"
WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
NEUROS = Path(sys.executable).with_name("neuros")
CONNECTION = "source.image -> sink.image"
ENDLESS = ("--set", "nodes.source.environment.COUNT=0")
UP_S = 60.0  # on a machine that does many other things
PATIENCE_S = 600.0
TIMEOUT_S = 5.0
GONE_S = 6.0
"""What the README promises, beside the time-out."""
SLACK_S = 20.0


@pytest.fixture(scope="module")
def right() -> Iterator[Machine]:
    require_machines("ip", "iptables", has_own_clock=True)
    with closing(Machine("right", is_apart=True, has_own_clock=True)) as machine:
        yield machine


@pytest.fixture(scope="module")
def machines(right: Machine) -> Iterator[TwoMachines]:
    with closing(Machine("left", is_apart=True)) as left:
        yield TwoMachines({"left": left, "right": right})


@pytest.fixture(scope="module")
def server(
    machines: TwoMachines, right: Machine, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[SshServer]:
    with ssh_server(right, ADDRESSES["right"], tmp_path_factory.mktemp("ssh")) as server:
        yield server


Deployed = Callable[..., Running]


@pytest.fixture
def deployed(machines: TwoMachines, server: SshServer, tmp_path: Path) -> Iterator[Deployed]:
    """``deployed(*ARGUMENTS)``: the stream, with the source on the left, the sink on the right."""
    project = shutil.copytree(STREAM, tmp_path / "stream")
    host = {
        "ssh": f"root@{ADDRESSES['right']}",
        "ssh_options": list(server.options),
        "neuros": str(NEUROS),
    }
    content = {"hosts": {"right": host}, "nodes": {"sink": "right"}, "timeout_s": TIMEOUT_S}
    file = tmp_path / "deployment.json"
    file.write_text(json.dumps(content))

    def launch(*arguments: str, **changes: float) -> Running:
        if changes:
            file.write_text(json.dumps({**content, **changes}))
        options = ("--deployment", str(file), *arguments)
        return machines.start("left", project, *options, cwd=tmp_path)

    machines.stop_multicast()
    yield launch
    machines.repair()


def left_there(server: SshServer) -> list[str]:
    """What runs have left in the cache there."""
    return [path.name for path in (server.cache / "neuros/machines").glob("r*-*")]


def test_one_command_runs_a_project_on_two_machines(deployed: Deployed, server: SshServer) -> None:
    with deployed("--record", timeout_s=2 * UP_S) as running:  # however busy this machine is
        finished = running.finish(2 * UP_S)
    assert finished.exit_code == 0, finished.output
    books = finished.connection(CONNECTION)
    assert (books["sent"], books["received"], books["lost"]) == (100, 100, 0)
    assert finished.run_folder is not None
    received = json.loads((finished.run_folder / "sink/received.json").read_text())
    assert received["numbers"] == list(range(1, 101))
    assert f"recorded 100 packets on 1 topic: {finished.run_folder}/bag" in finished.output
    # Its clock is a day ahead; what it reports is on the clock of this machine nevertheless.
    assert min(received["ages_s"]) > APART_S / 2
    latency = books["latency_ms"]  # as exact as the clock is known: to half a round trip
    (there,) = finished.record["machines"].values()
    assert -1e3 * there["round_trip_s"] < latency["p50"] <= latency["max"] < 2e3 * UP_S
    assert finished.record["running_s"] < 2 * UP_S
    assert left_there(server) == []


@pytest.fixture(scope="module")
def engine(right: Machine) -> Iterator[OwnEngine]:
    """The one of the machine on the right."""
    require_engines()
    with own_engine(right) as engine:
        yield engine


def in_containers(
    folder: Path, engine: OwnEngine, server: SshServer, machines: TwoMachines, *arguments: str
) -> Running:
    """The stream, its sink in a container on the right."""
    docker = engine.address.replace("unix://", f"ssh://root@{ADDRESSES['right']}")
    host = {"docker": docker, "ssh_options": list(server.options)}
    file = folder / "deployment.json"
    content = {"hosts": {"box": host}, "nodes": {"sink": "box"}, "timeout_s": TIMEOUT_S}
    file.write_text(json.dumps(content))
    return machines.start("left", STREAM, "--deployment", str(file), *arguments, cwd=folder)


def containers_there(engine: OwnEngine) -> list[str]:
    with closing(engine.connect()) as client:
        return [each.name for each in client.containers.list(all=True, ignore_removed=True)]


def test_nodes_run_in_containers_of_an_engine_behind_ssh(
    machines: TwoMachines, server: SshServer, engine: OwnEngine, tmp_path: Path
) -> None:
    with in_containers(tmp_path, engine, server, machines, "--record") as running:
        finished = running.finish(2 * UP_S)
    assert finished.exit_code == 0, finished.output
    books = finished.connection(CONNECTION)
    assert (books["sent"], books["received"], books["lost"]) == (100, 100, 0)
    there = finished.record["machines"]["box"]
    assert there["address"] == ADDRESSES["right"]
    assert there["container"]["image"].startswith("neuros_python:")
    wait_until(lambda: not containers_there(engine))


@pytest.mark.acceptance
@pytest.mark.parametrize("fault", ["cable", "ssh", "launcher"])
def test_no_container_stays_there_when_it_is_cut_off(
    machines: TwoMachines, server: SshServer, engine: OwnEngine, tmp_path: Path, fault: str
) -> None:
    try:
        with in_containers(tmp_path, engine, server, machines, *ENDLESS) as running:
            running.wait_for("the first image is here", UP_S)
            if fault == "cable":
                machines.unplug()
            elif fault == "ssh":
                children = psutil.Process(running.process.pid).children(recursive=True)
                (tunnel,) = (each for each in children if each.name() == "ssh")
                tunnel.kill()
            else:
                running.process.kill()
            within_s = GONE_S + (TIMEOUT_S if fault == "cable" else 0) + SLACK_S
            wait_until(lambda: not containers_there(engine), within_s)
            if fault != "launcher":
                finished = running.finish(within_s)
                assert finished.exit_code == 4, finished.output
                assert "box cannot be reached any more" in finished.output
    finally:
        machines.repair()


@pytest.mark.acceptance
def test_an_image_that_the_engine_lacks_is_sent_once(
    machines: TwoMachines, right: Machine, server: SshServer, tmp_path: Path
) -> None:
    require_engines()
    with own_engine(right, disk="4g", has_images=False) as engine:
        for is_first in (True, False):
            with in_containers(tmp_path, engine, server, machines) as running:
                finished = running.finish(PATIENCE_S)
            assert finished.exit_code == 0, finished.output
            assert ("box gets the image neuros_python" in finished.output) is is_first


# ------------------------------------------------------------------ faults


@pytest.fixture
def at_work(deployed: Deployed, server: SshServer) -> Iterator[AtWork]:
    """An endless stream, as far as both nodes are at work."""
    with deployed(*ENDLESS) as running:
        running.wait_for("the first image is here", UP_S)
        (there,) = (s for s in sessions() if s.folder.startswith(str(server.cache)))
        yield AtWork(running, there, server)


@dataclass(frozen=True)
class AtWork:
    """A run with an agent, whose session ``there`` is."""

    running: Running
    there: RunOnThisMachine
    server: SshServer

    @property
    def ssh(self) -> psutil.Process:
        """The client."""
        (found,) = self._processes(self.running.process.pid, "ssh")
        return found

    @property
    def server_of_it(self) -> psutil.Process:
        """The process of the server that serves this connection."""
        return self._processes(self.server.process.pid, "sshd")[0]

    def _processes(self, parent: int, name: str) -> list[psutil.Process]:
        children = psutil.Process(parent).children(recursive=True)
        return [child for child in children if child.name() == name]

    def assert_ends(self, exit_code: int, reason: str, within_s: float) -> Finished:
        """The launcher tells why, and nothing is left on either machine."""
        began_s = time.monotonic()
        finished = self.running.finish(within_s + SLACK_S)
        assert time.monotonic() - began_s < within_s
        assert finished.exit_code == exit_code, finished.output
        assert reason in finished.said("neuros")[-1], finished.output
        self.assert_gone(began_s + within_s)
        return finished

    def assert_gone(self, until_s: float) -> None:
        """No process of the run is left there, its guardian included."""
        while time.monotonic() < until_s + SLACK_S:
            alive = RunProcesses(self.there.run).alive()
            if not alive and self.there.run not in {each.run for each in sessions()}:
                break
            time.sleep(0.05)
        assert time.monotonic() < until_s, f"still there: {alive}"


def assert_kept_its_log(finished: Finished) -> None:
    """What had come before is in the run folder."""
    assert finished.run_folder is not None
    assert "the first image is here" in (finished.run_folder / "sink/node.log").read_text()


@pytest.mark.acceptance
def test_ctrl_c_ends_both_machines(at_work: AtWork) -> None:
    at_work.running.signal(signal.SIGINT)
    finished = at_work.assert_ends(130, "ended by Ctrl+C", GONE_S)
    assert finished.record["nodes"]["sink"]["report"] == "final"
    assert finished.run_folder is not None
    assert (finished.run_folder / "sink/received.json").exists()
    assert left_there(at_work.server) == []


@pytest.mark.acceptance
def test_a_node_that_fails_there_ends_both_machines(deployed: Deployed, server: SshServer) -> None:
    with deployed("--set", "nodes.sink.plugin=source.py") as running:
        finished = running.finish(UP_S)
    assert finished.exit_code in (1, 3)
    assert left_there(server) == []


@pytest.mark.acceptance
def test_a_node_that_is_killed_there_ends_both_machines(at_work: AtWork) -> None:
    (pid,) = RunProcesses(at_work.there.run).nodes()
    os.kill(pid, signal.SIGKILL)
    at_work.assert_ends(1, "node 'sink' ended unexpectedly", GONE_S)
    assert left_there(at_work.server) == []


@pytest.mark.acceptance
def test_an_agent_that_is_killed_ends_both_machines(at_work: AtWork) -> None:
    os.kill(at_work.there.launcher[0], signal.SIGKILL)
    finished = at_work.assert_ends(4, "right cannot be reached any more", GONE_S)
    assert_kept_its_log(finished)


@pytest.mark.acceptance
@pytest.mark.parametrize("which", ["ssh", "server_of_it"])
def test_a_connection_that_is_killed_ends_both_machines(which: str, at_work: AtWork) -> None:
    getattr(at_work, which).kill()
    finished = at_work.assert_ends(4, "right cannot be reached any more", GONE_S)
    assert_kept_its_log(finished)
    there = (
        f"files that were not copied are still in root@{ADDRESSES['right']}:{at_work.there.folder}"
    )
    assert there in finished.said("neuros")[-1]
    assert Path(at_work.there.folder, "sink/received.json").exists()
    shutil.rmtree(at_work.there.folder)


@pytest.mark.acceptance
def test_a_network_that_goes_ends_both_machines(at_work: AtWork, machines: TwoMachines) -> None:
    machines.unplug()
    reason = f"nothing was heard of right for {TIMEOUT_S:g} s"
    finished = at_work.assert_ends(4, reason, TIMEOUT_S + GONE_S)
    assert_kept_its_log(finished)
    shutil.rmtree(at_work.there.folder)


@pytest.mark.acceptance
def test_a_network_that_comes_back_in_time_ends_nothing(
    at_work: AtWork, machines: TwoMachines
) -> None:
    machines.unplug()
    back_s = time.monotonic() + TIMEOUT_S / 2
    while (left_s := back_s - time.monotonic()) > 0:
        at_work.running.read(left_s)
    machines.repair()
    machines.stop_multicast()
    again_s = time.monotonic() + 2 * TIMEOUT_S
    while (left_s := again_s - time.monotonic()) > 0:
        at_work.running.read(left_s)
    at_work.running.signal(signal.SIGTERM)
    finished = at_work.assert_ends(143, "ended by SIGTERM", GONE_S)
    assert finished.connection(CONNECTION)["lost"] == 0


@pytest.mark.acceptance
@pytest.mark.parametrize("has_network", [True, False])
def test_a_launcher_that_is_killed_leaves_nothing_on_either_machine(
    has_network: bool, at_work: AtWork, machines: TwoMachines
) -> None:
    run = next(s for s in sessions() if s.launcher[0] == at_work.running.process.pid).run
    if not has_network:
        machines.unplug()
    at_work.running.signal(signal.SIGKILL)
    until_s = time.monotonic() + GONE_S + (0.0 if has_network else TIMEOUT_S)
    at_work.assert_gone(until_s)
    while RunProcesses(run).alive() and time.monotonic() < until_s:
        time.sleep(0.05)
    assert not RunProcesses(run).alive()
    shutil.rmtree(at_work.there.folder)


@pytest.mark.acceptance
def test_both_machines_know_of_the_run_and_either_can_stop_it(at_work: AtWork) -> None:
    command = [str(NEUROS), "ps", "--format", "json", "--filter", f"run={at_work.there.run[:8]}"]
    rows = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    found = sorted((row["node"], row["backend"], row["state"]) for row in rows)
    here = [("sink", "process on right", "running"), ("source", "process", "running")]
    assert found == sorted([*here, ("sink", "process", "running")])
    at_work.there.interrupt()  # what `neuros stop` does on that machine
    at_work.assert_ends(130, "ended by Ctrl+C", GONE_S)


@pytest.mark.acceptance
def test_an_observer_sees_the_nodes_there_on_the_clock_of_this_machine(at_work: AtWork) -> None:
    (here,) = (s for s in sessions() if s.launcher[0] == at_work.running.process.pid)
    link = ControlLink(connect(here.control), TO_OBSERVERS, "the supervisor")
    link.send(Watch())
    link.send(GetStatus({"sink": {"image": {"fields": ["height"]}}}))
    deadline_s = time.monotonic() + UP_S
    status = None
    while status is None and time.monotonic() < deadline_s:
        found = [each for each in link.receive() or () if isinstance(each, NodeStatus)]
        status = next((each for each in found if each.node == "sink" and each.counters), None)
    link.close()
    assert status is not None
    assert status.counters is not None
    assert abs(status.counters.now_s - time.monotonic()) < UP_S
    at_work.running.signal(signal.SIGINT)
    at_work.assert_ends(130, "ended by Ctrl+C", GONE_S)


@pytest.mark.acceptance
def test_the_system_load_of_both_machines_is_written(deployed: Deployed) -> None:
    with deployed(*ENDLESS, "-m", "--duration", "3") as running:
        finished = running.finish(UP_S)
    assert finished.exit_code == 0, finished.output
    assert finished.run_folder is not None
    assert (finished.run_folder / "machines/right/system_load.csv").exists()
    loads = finished.record["system_load"]["processes"]
    assert all(loads[node]["memory_bytes_max"] > 0 for node in ("source", "sink"))


@pytest.mark.acceptance
def test_the_doctor_looks_at_both_machines(
    deployed: Deployed, machines: TwoMachines, tmp_path: Path
) -> None:
    command = ["doctor", "--deployment", str(tmp_path / "deployment.json"), "--format", "json"]
    inside = machines.inside("left", tmp_path)
    done = subprocess.run([*inside, str(NEUROS), *command], capture_output=True, check=False)
    found = {each["subject"]: each for each in json.loads(done.stdout)}
    assert found["right"]["state"] == "good"
    assert "at 192.0.2.2; round trip" in found["right"]["text"]
    assert found["right: ROS 2"]["state"] == "good"
    assert found["delivery"]["text"].startswith("right: packets arrived: 20 of 20")


@pytest.mark.acceptance
def test_what_keeps_ssh_out_is_told_before_anything_is_started(
    deployed: Deployed, tmp_path: Path
) -> None:
    file = tmp_path / "deployment.json"
    content = json.loads(file.read_text())
    for keys, said in (
        ({"ssh_options": ["-F", "none"]}, "Host key verification failed"),
        ({"neuros": "/nowhere/neuros"}, "name the command neuros there in /hosts/right/neuros"),
        ({"ssh": "root@192.0.2.77"}, "No route to host"),
    ):
        hosts = {"right": {**content["hosts"]["right"], **keys}}
        file.write_text(json.dumps({**content, "hosts": hosts}))
        with deployed() as running:
            finished = running.finish(UP_S)
        assert finished.exit_code == 4
        assert said in finished.output
        assert finished.run_folder is None


@pytest.mark.acceptance
def test_whiskeye_with_its_physics_on_the_other_machine(
    deployed: Deployed, machines: TwoMachines, tmp_path: Path
) -> None:
    file = tmp_path / "deployment.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "nodes": {"robot": "right"}}))
    options = ("--deployment", str(file), "--record")
    with machines.start("left", WHISKEYE, *options, cwd=tmp_path) as running:
        finished = running.finish(PATIENCE_S)
    assert finished.exit_code == 0, finished.output
    imu = finished.connection("robot.imu -> snn.imu")
    assert imu["sent"] == imu["consumed"] >= 990
    assert finished.record["real_time_factor"] > 0
