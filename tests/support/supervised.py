"""Stand-ins under a supervisor: real processes that keep to the control channel, without ROS."""

from __future__ import annotations

import contextlib
import secrets
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neuros.backends.control_sockets import SOCKET_NAME, UnixListener
from neuros.backends.guardian import Guardian
from neuros.backends.process_launchers import InProcessLauncher, ProcessLauncher, RunningProcess
from neuros.launcher.outcome import Outcome
from neuros.launcher.peers import Peers
from neuros.launcher.supervisor import Supervisor
from neuros.ports import ControlListener, NodeProgram
from neuros.project.model import Connection, Folders, Node, NodeFile

HOST = [sys.executable, "-S", str(Path(__file__).parents[1] / "launcher" / "stand_in_host.py")]
WELL_BEHAVED = "host.up(); host.serve()"
SHUTS_DOWN = "host.up(); host.tell('shutdown', reason='enough', drain_s=5); host.serve()"
DEAF = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)"

Act = Callable[[], object]


@dataclass
class Output:
    """Notes what the supervisor says, and lets a test act when it says something."""

    said: list[str] = field(default_factory=list)
    when: dict[str, Act] = field(default_factory=dict)
    polls: list[Act] = field(default_factory=list)

    def log(self, severity: str, text: str) -> None:
        self.said.append(text)
        for beginning, act in tuple(self.when.items()):
            if text.startswith(beginning):
                del self.when[beginning]
                act()

    def poll(self) -> object:
        for act in self.polls:
            act()
        return None


class Run:
    """Runs stand-ins under a supervisor."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.output = Output()
        self.signals: list[int] = []
        self.hosts: list[RunningProcess] = []
        self.lasted_s = 0.0
        self.listener: Callable[[Path], ControlListener] = UnixListener

    def file(self, name: str, act: str, connections: tuple[Connection, ...]) -> NodeFile:
        node = Node(name, "", Path("/plugin.py"), environment={"ACT": f"{act}\n"})
        mine = tuple(c for c in connections if name in (c.source_node, c.destination_node))
        return NodeFile(node, mine, Folders(self.folder, self.folder, self.folder))

    def __call__(
        self,
        *,
        connections: tuple[Connection, ...] = (),
        in_process: bool = False,
        duration_s: float | None = None,
        finalise_s: float | None = None,
        elsewhere: tuple[str, ...] = (),
        on_stop: Act = lambda: None,
        **acts: str,
    ) -> Outcome:
        """Run nodes that do as the text under their names says, to the end."""
        files = [self.file(name, act, connections) for name, act in acts.items()]
        kind = InProcessLauncher if in_process else ProcessLauncher
        with contextlib.ExitStack() as stack:
            guardian = Guardian.start(secrets.token_hex(8))
            stack.callback(guardian.finish)
            supervisor = Supervisor(
                files,
                _Noting(kind(NodeProgram(program=HOST, guardian=guardian)), self.hosts),
                {"ALL": " ".join(acts)} | ({"ACT": acts["all"]} if in_process else {}),
                self.folder,
                self.output,
                self.signals,
                listener=self.listener(self.folder),
                duration_s=duration_s,
                finalise_s=finalise_s,
                peers=Peers("this run", elsewhere, files),
                on_stop=on_stop,
            )
            start_s = time.monotonic()
            outcome = supervisor.run()
            self.lasted_s = time.monotonic() - start_s
            for host in self.hosts:
                assert host.wait(5.0) is not None, "nobody is left"
        return outcome

    def clear(self) -> None:
        """Make the folder new."""
        self.hosts.clear()
        (self.folder / SOCKET_NAME).unlink()

    def after(self, beginning: str, act: Act) -> None:
        """Do something when the supervisor says something that begins like this."""
        self.output.when[beginning] = act

    def when_file_exists(self, name: str, act: Act) -> None:
        """Do something once a stand-in has made a file in the run folder.

        What it said before is heard by then: between two looks the supervisor listens.
        """
        was_there = False

        def look() -> None:
            nonlocal was_there
            if look in self.output.polls and (self.folder / name).exists():
                if was_there:
                    self.output.polls.remove(look)
                    act()
                was_there = True

        self.output.polls.append(look)

    def press_ctrl_c(self) -> None:
        self.signals.append(signal.SIGINT)


@dataclass
class _Noting:
    """A launcher whose hosts the test can look after."""

    launcher: Any
    hosts: list[RunningProcess]

    def start(self, *arguments: Any) -> Any:
        self.hosts += self.launcher.start(*arguments)
        return list(self.hosts)

    def describe(self, *arguments: Any) -> Any:
        return self.launcher.describe(*arguments)


@contextlib.contextmanager
def supervised(folder: Path) -> Iterator[Run]:
    """Runs in a folder, whose processes are gone in the end."""
    run = Run(folder)
    try:
        yield run
    finally:
        for host in run.hosts:
            host.kill()
            host.wait(10)


def wire(text: str, index: int = 0) -> Connection:
    source, destination = text.split(" -> ")
    return Connection(*source.split("."), *destination.split("."), 0, index=index)
