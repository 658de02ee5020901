"""A host that holds no nodes but keeps to the control channel as its test says.

No more than it needs, so that it is there in a moment. The environment variable ``ACT`` holds what
it does, in Python, with the functions below; the folder is the run folder. Messages are those of
``neuros.control``, by kind, as they go through the channel.
"""

from __future__ import annotations

import os
import socket
import sys
import threading  # noqa: F401 - as in every node: it gives threads their names
import time  # noqa: F401 - for what it does
from pathlib import Path
from typing import Any

# Started with -S: the packages are there, and what a site does at the start is left out.
sys.path += map(str, Path(sys.executable).parents[1].glob("lib/python*/site-packages"))

import msgspec

NAMES = [Path(argument).parent.name for argument in sys.argv[1:]]
SENT = {"sent": 0, "acknowledged": 0, "outstanding": 0, "window": 1}
SENT |= {"is_reliable": True, "is_blocked": False}
RECEIVED = {"received": 0, "consumed": 0, "discarded": 0, "longest_discard": 0, "unread": 0}
RECEIVED |= {"acknowledged": 0, "taker": None}


def encoded(kind: str, **fields: Any) -> bytes:
    """A message as it goes through the channel."""
    data = msgspec.msgpack.encode({"kind": kind, **fields})
    return len(data).to_bytes(4, "little") + data


class Host:
    """The node's end of the control channel."""

    def __init__(self) -> None:
        self.scheme, _, self.place = os.environ["NEUROS_CONTROL"].partition(":")
        is_unix = self.scheme == "unix"
        self.family = socket.AF_UNIX if is_unix else socket.AF_INET
        self.socket = socket.socket(self.family)
        self.stream = self.socket.makefile("rb")
        self.observer: socket.socket | None = None
        self.is_idle = True
        self.connections: dict[str, dict[str, Any]] = {"outgoing": {}, "incoming": {}}

    def connect(self, end: socket.socket) -> None:
        if self.scheme == "unix":
            end.connect(os.path.basename(self.place))  # which may be too long as a whole
        else:
            name, _, port = self.place.partition(":")
            end.connect((name, int(port)))

    def hello(self, **fields: Any) -> None:
        self.connect(self.socket)
        self.send("hello", nodes=NAMES, **fields)

    def send(self, kind: str, **fields: Any) -> None:
        self.socket.sendall(encoded(kind, **fields))

    def ask(self, kind: str, **fields: Any) -> None:
        """Ask for something as an observer, over a connection of its own."""
        if self.observer is None:
            self.observer = socket.socket(self.family)
            self.connect(self.observer)
            self.observer.sendall(encoded("watch"))
        self.observer.sendall(encoded(kind, **fields))

    def tell(self, kind: str, **fields: Any) -> None:
        """Send a message about the (first) node."""
        self.send(kind, **{"node": NAMES[0], **fields})

    def loaded(self) -> None:
        """Its plugins are loaded; goes on when initialise hooks may start."""
        self.report()
        self.declare()
        self.wait_for("begin")

    def declare(self) -> None:
        """Its plugins are loaded."""
        for name in NAMES:
            self.send("hooks", node=name, hooks=[], finalise=[])

    def report(self, kind: str = "report", **fields: Any) -> None:
        """A report of a node that has been loaded."""
        for name in NAMES:
            metrics = {"hooks": {}, "executing": None, "state": {"state": "idle", "cause": ""}}
            metrics |= {"accounting": {}} | self.connections
            self.send(kind, **{"node": name, "metrics": metrics, **fields})

    def up(self, **fields: Any) -> None:
        """Hello, loaded, ready; goes on at time 0, when all others are up, too."""
        self.hello(**fields)
        self.loaded()
        self.ready()

    def ready(self) -> None:
        for name in NAMES:
            self.send("ready", node=name)
        self.wait_for("activate")
        for name in NAMES:
            Path(f"{name}.up").touch()

    def hear(self) -> dict[str, Any] | None:
        """The next that the supervisor says, ``None`` when it has hung up."""
        length = int.from_bytes(self.stream.read(4), "little")
        return msgspec.msgpack.decode(self.stream.read(length)) if length else None

    def wait_for(self, kind: str) -> None:
        while (message := self.hear()) and message["kind"] != kind:
            if message["kind"] == "stop":  # before what it waits for
                self.report(is_final=True)
                sys.exit()
            self.answer(message)

    def answer(self, message: dict[str, Any]) -> None:
        if message["kind"] == "probe":
            outgoing, incoming = self.connections["outgoing"], self.connections["incoming"]
            probe = {
                "sent": {k: (c["sent"], c["acknowledged"]) for k, c in outgoing.items()},
                "received": {k: (c["received"], c["acknowledged"]) for k, c in incoming.items()},
                "is_wakeable": not self.is_idle,
                "is_idle": self.is_idle,
            }
            self.send("probed", number=message["number"], nodes=dict.fromkeys(NAMES, probe))

    def serve(self) -> None:
        """Do as asked, to a proper end."""
        self.wait_for("stop")
        self.report(is_final=True)


if __name__ == "__main__":
    host = Host()
    exec(os.environ["ACT"])
