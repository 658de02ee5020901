"""The connection of the control channel comes from a back end: a Unix socket is one way."""

from __future__ import annotations

import os
import resource
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from supervised import SHUTS_DOWN, WELL_BEHAVED, Run, supervised

from neuros.backends.control_sockets import UnixListener, connect, connect_by
from neuros.control import CONTROL_VARIABLE, TO_NODES, Hello, Stop
from neuros.control.link import ControlLink
from neuros.errors import EnvironmentFault
from neuros.launcher.channels import Channels


class TcpListener:
    """Listens on this machine over TCP, as a back end with nodes on other machines might."""

    files: tuple[Path, ...] = ()

    def __init__(self, _: Path) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._socket.setblocking(False)

    @property
    def address(self) -> str:
        return f"tcp:127.0.0.1:{self._socket.getsockname()[1]}"

    def open(self) -> None:
        self._socket.listen()

    def fileno(self) -> int:
        return self._socket.fileno()

    def accept(self) -> socket.socket | None:
        try:
            return self._socket.accept()[0]
        except BlockingIOError:
            return None

    def close(self) -> None:
        self._socket.close()


TCP = """
import socket

def connect(place):
    name, _, port = place.rpartition(":")
    return socket.create_connection((name, int(port)))
"""


def test_nobody_else_reaches_the_socket_whatever_the_umask(tmp_path: Path) -> None:
    listener = UnixListener(tmp_path)
    before = os.umask(0)
    try:
        listener.open()
    finally:
        os.umask(before)
    (socket_file,) = listener.files
    listener.close()
    assert socket_file.stat().st_mode & 0o777 == 0o600


@pytest.fixture
def tcp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A distribution that knows how to connect to ``tcp:`` is installed."""
    metadata = tmp_path / "far-1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Name: far\nVersion: 1\n")
    (metadata / "entry_points.txt").write_text("[neuros.control]\ntcp = far_control:connect\n")
    (tmp_path / "far_control.py").write_text(TCP)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    with supervised(tmp_path) as run:
        yield run


def test_a_supervisor_runs_nodes_that_connect_over_tcp(run: Run) -> None:
    run.listener = TcpListener
    outcome = run(a=SHUTS_DOWN, b=WELL_BEHAVED)
    assert (outcome.exit_code, outcome.reason) == (0, "a ended the project: enough")
    assert all(map(outcome.has_final_report, "ab"))
    assert not list(run.folder.glob("control*")), "there is no socket in the run folder"


def test_and_sees_those_that_crash(run: Run) -> None:
    run.listener = TcpListener
    outcome = run(a="host.up(); import os; os._exit(7)", b=WELL_BEHAVED)
    assert outcome.reason == "node 'a' ended unexpectedly: exit code 7"


@pytest.mark.usefixtures("tcp")
@pytest.mark.parametrize("kind", [UnixListener, TcpListener])
def test_messages_go_both_ways(kind: type[UnixListener | TcpListener], tmp_path: Path) -> None:
    listener = kind(tmp_path)
    channels = Channels(listener)
    link = ControlLink(connect_by({CONTROL_VARIABLE: listener.address}), TO_NODES, "the supervisor")
    link.send(Hello(("a",)))
    heard: list[object] = []
    while not heard:
        channels.wait(5.0)
        heard += [message for _, message in channels.receive()]
    assert heard == [Hello(("a",))]
    channels.send(Stop())
    assert link.receive() == [Stop()]
    channels.close()
    assert link.receive() is None
    link.close()


def test_a_back_end_that_is_not_installed_is_named() -> None:
    with pytest.raises(EnvironmentFault, match=r"no way to connect to 'far:' \(known are unix"):
        connect("far:away")


def test_a_node_that_is_started_by_hand_is_told_who_starts_it() -> None:
    with pytest.raises(EnvironmentFault, match="`neuros launch` starts it"):
        connect_by({})


def test_an_address_where_nobody_listens_is_an_error_of_the_system(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        connect(f"unix:{tmp_path}/control.sock")


def test_a_unix_socket_may_lie_deep(tmp_path: Path) -> None:
    folder = tmp_path / ("deep" * 20) / ("deeper" * 20)
    folder.mkdir(parents=True)
    listener = UnixListener(folder)
    assert listener.files == (folder / "control.sock",)
    listener.open()
    assert os.path.exists(listener.files[0])
    link = ControlLink(connect(listener.address), TO_NODES, "the supervisor")
    accepted = listener.accept()
    assert accepted is not None
    accepted.close()
    link.close()
    listener.close()


def test_a_launcher_without_free_file_descriptors_says_so(tmp_path: Path) -> None:
    listener = UnixListener(tmp_path)
    listener.open()
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with closing(listener), closing(connect(listener.address)):
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (0, limits[1]))
            with pytest.raises(EnvironmentFault, match=r"Too many open files.*ulimit -n"):
                listener.accept()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
