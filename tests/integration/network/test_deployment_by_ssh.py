"""A project on two machines by one command, over ``ssh``; and every fault that can come between.

The machine on the right has its own network, host name, shared memory, cache and monotonic clock, and
multicast does not pass. All but the first test are long runs.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from launching import Finished, Running, start
from machines import APART_S, Machine, require_machines
from ssh_server import SshServer, ssh_server
from two_machines import ADDRESSES, TwoMachines

from neuros.backends.run_processes import RunProcesses
from neuros.backends.sessions import Session, sessions

HERE = Path(__file__).parent
STREAM = HERE / "stream"
NEUROS = Path(sys.executable).with_name("neuros")
CONNECTION = "source.image -> sink.image"
ENDLESS = ("--set", "nodes.source.environment.COUNT=0")
UP_S = 60.0  # on a machine that does many other things
TIMEOUT_S = 5.0
GONE_S = 6.0
"""What docs/deployment.md promises, beside the time-out."""


@pytest.fixture(scope="module")
def right() -> Iterator[Machine]:
    require_machines("ip", "iptables")
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

    def launch(*arguments: str) -> Running:
        options = ("--deployment", str(file), *arguments)
        return machines.start("left", project, *options, cwd=tmp_path)

    machines.stop_multicast()
    yield launch
    machines.repair()


def left_there(server: SshServer) -> list[str]:
    """What runs have left in the cache there."""
    return [path.name for path in (server.cache / "neuros/machines").glob("r*-*")]


def test_one_command_runs_a_project_on_two_machines(
    deployed: Deployed, server: SshServer
) -> None:
    with deployed("--record") as running:
        finished = running.finish(UP_S)
    assert finished.exit_code == 0, finished.output
    books = finished.connection(CONNECTION)
    assert (books["sent"], books["received"], books["lost"]) == (100, 100, 0)
    assert finished.run_folder is not None
    received = json.loads((finished.run_folder / "sink/received.json").read_text())
    assert received["numbers"] == list(range(1, 101))
    assert f"recorded 100 packets on 1 topic: {finished.run_folder}/bag" in finished.output
    # Its clock is a day ahead; what it reports is on the clock of this machine nevertheless.
    assert min(received["ages_s"]) > APART_S / 2
    assert 0 < books["latency_ms"]["p50"] <= books["latency_ms"]["max"] < 1e3 * UP_S
    assert finished.record["running_s"] < UP_S
    assert left_there(server) == []
