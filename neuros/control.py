"""The control channel between the supervisor and the processes that hold the nodes.

A Unix socket in the run folder carries one JSON object per line. It is no part of the data path:
nodes report once per second, on a change of state and at the end; the supervisor answers rarely.

=========== ========================================================= =====================
kind        sent by a process of nodes                                fields
=========== ========================================================= =====================
hello       when it is there                                          nodes, pid
report      once per second, on demand, at the end                    node, ... (see runtime)
hooks       what a node's plugin declares, once it is loaded           node, hooks, finalise
first_hook  when a node has started its first hook                    node
finalising  when a node starts a finalise hook; "": it closes what it  node, hook
            holds; null: it has
shutdown    when a plugin calls ``node.shutdown``                     node, reason, drain_s
failed      when a node fails                                         node, text, hook, where
explanation in answer to ``explain``                                  node, lines
heard       from a node of another launcher; null: it is gone         node, text
node_status in answer to ``look``                                     node, asker, ...
=========== ========================================================= =====================

======= ================================================ =================
kind    sent by the supervisor                           fields
======= ================================================ =================
probe   report between two events, all at one moment     number
explain say why nothing moves
drain   stop the hooks that send unasked; some start     last_round
        once more (their places, by node)
stop    start no further hook, finalise and end
say     let nodes elsewhere hear this (see launch.peers) text
leave   all is said and heard: a node at its end may go
pause   start no further hook
resume  go on
step    while paused, go on by so many steps             count, is_driven
look    show what you do; what to sample, by node        wanted, asker
======= ================================================ =================

Observers (the dashboard) are on the same channel, and get no more than they ask for:

======= ================================================ =================
kind    sent by an observer                              fields
======= ================================================ =================
watch   it is there
look    all nodes are to show it what they do, once      wanted
pause   the run stands still
resume  the run goes on
step    while it stands still, let it do so many steps   count
end     end the run, drained, with exit code 0           reason
signal  do what Ctrl+C does (``neuros stop``)
======= ================================================ =================

=========== ================================================ =================
kind        sent to observers                                fields
=========== ================================================ =================
node_status state and counters of a node, for the one asking node, ...
phase       phase of the run                                 phase, is_paused
log         messages of the launcher to the user             severity, text
ended       all nodes have ended; their last reports         exit_code, reason, ...
=========== ================================================ =================
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

SOCKET_NAME = "control.sock"
_NO_CHARACTER = re.compile("[\ud800-\udfff]")


class Lines:
    """A connected socket as a sequence of JSON objects, one per line."""

    def __init__(self, connected: socket.socket) -> None:
        self.socket = connected
        self._rest = b""

    def fileno(self) -> int:
        """For selectors."""
        return self.socket.fileno()

    def send(self, kind: str, **fields: Any) -> bool:
        """Send one object; returns False if the other end is gone."""
        try:
            self.socket.sendall(encode_line(kind, fields))
        except OSError:
            return False
        return True

    def receive(self) -> list[Mapping[str, Any]] | None:
        """What has arrived, after one read; ``None`` once the other end is gone."""
        try:
            return self.receive_now()
        except BlockingIOError:
            return []

    def receive_now(self) -> list[Mapping[str, Any]] | None:
        """As :meth:`receive`; a socket that does not block raises ``BlockingIOError`` at its end.

        ``ValueError`` means that the other end does not keep to the format.
        """
        try:
            data = self.socket.recv(1 << 16)
        except BlockingIOError:
            raise
        except OSError:
            return None
        if not data:
            return None
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        """Hang up."""
        self.socket.close()


def encode_line(kind: str, fields: Mapping[str, Any]) -> bytes:
    """One object as it goes through the socket."""
    text = json.dumps({"kind": kind, **fields}, ensure_ascii=False)
    # What is no character cannot be written anywhere: both ends see its escape in its place.
    return _NO_CHARACTER.sub(lambda match: f"\\\\u{ord(match[0]):04x}", text).encode() + b"\n"


@contextlib.contextmanager
def _short_path(path: Path) -> Iterator[str]:
    """A name for ``path`` that fits into the 107 bytes which Unix sockets allow."""
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def listen(run_folder: Path) -> socket.socket:
    """The supervisor's end: a listening socket in the run folder."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _short_path(run_folder / SOCKET_NAME) as name:
            listening.bind(name)
    except OSError:
        listening.close()
        raise
    listening.listen(256)
    return listening


def connect(run_folder: Path) -> Lines:
    """A node's end; raises ``OSError`` where no supervisor listens."""
    connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _short_path(run_folder / SOCKET_NAME) as name:
            connected.connect(name)
    except OSError:
        connected.close()
        raise
    return Lines(connected)
