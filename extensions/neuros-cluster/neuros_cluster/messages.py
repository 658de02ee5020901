"""Messages between a launcher and its agents: the programs that run its nodes on other machines.

Messages have the form of the control channel's, and travel over the standard input and output of
the program that reaches the machine (``ssh``). They also carry the control connections of the nodes
there: each has a number, and each of its messages is the data of a :class:`Said`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from neuros.control import Message
from neuros.stacks import ProcessThreads

# ---------------------------------------------------------------------- both ways


class Ping(Message):
    """A sign of life, answered at once; ``sent_s`` is on the sender's monotonic clock."""

    sent_s: float


class Pong(Message):
    """The answer, with the answering side's monotonic and Unix time, in seconds."""

    sent_s: float
    monotonic_s: float
    unix_s: float


class Opened(Message):
    """A control connection has been made to the agent."""

    link: int


class Said(Message):
    """A message on a control connection, without its length."""

    link: int
    data: bytes


class Closed(Message):
    """A control connection has ended."""

    link: int


class Chunk(Message):
    """Bytes of a file of a tree or of the run folder, which is cut off at ``offset`` before."""

    path: str
    offset: int
    data: bytes


# ---------------------------------------------------------------------- from the launcher


class Tree(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A folder, known by its content: the SHA-256 of each file, with ``+x`` for executables."""

    name: str
    files: Mapping[str, str]


class Place(Message):
    """Make these trees; a launcher that is silent for ``timeout_s`` seconds is gone."""

    trees: tuple[Tree, ...]
    timeout_s: float


class Sent(Message):
    """All lacking files have been sent, as :class:`Chunk`."""


class Prepare(Message):
    """Prepare nodes, given their ``node.json`` with the paths of the agent's machine."""

    nodes: tuple[Mapping[str, Any], ...]


class Start(Message):
    """Start the nodes that were prepared.

    Attributes:
        run: its id; ``project``: its name.
        machine: the name of the agent's machine.
        nodes: their ``node.json``.
        files: texts for the run folder, by name.
        environment: of each node.
        options: of the node program.
        cores: by node.
        monitors_load: whether to record the system load.
        restored: contents of files of kept values for the folders of nodes, by name.
    """

    run: str
    project: str
    machine: str
    nodes: tuple[Mapping[str, Any], ...]
    files: Mapping[str, str]
    environment: Mapping[str, str]
    options: tuple[str, ...]
    cores: Mapping[str, tuple[int, ...]]
    monitors_load: bool = False
    restored: Mapping[str, bytes] = {}


class KillNode(Message):
    """Kill the process of a node."""

    node: str


class ReadThreads(Message):
    """Read where the threads of a node's process stand."""

    node: str


class Took(Message):
    """This number of bytes of :class:`Chunk` has been written."""

    size: int


class Examine(Message):
    """Examine the machine, as ``neuros doctor`` does."""


class Finish(Message):
    """All nodes have ended: send their files, remove them, and end."""


# ---------------------------------------------------------------------- from the agent


class Ready(Message):
    """The agent is up.

    Attributes:
        version: of NeuROS there; ``python``: of Python.
        machine: its architecture; ``name``: its host name.
        reached_at: the address at which ``ssh`` has reached it, empty if not known.
    """

    version: str
    python: str
    machine: str
    name: str
    reached_at: str = ""


class Lacking(Message):
    """The files to send, for each tree; may be empty."""

    paths: tuple[tuple[str, ...], ...]


class Placed(Message):
    """The folders are there."""

    project: str
    workspace: str
    run: str


class Remark(Message):
    """A line for the user."""

    severity: str
    text: str


class Prepared(Message):
    """Nodes can be started; ``messages`` are the folders of built message packages."""

    messages: tuple[str, ...]


class Started(Message):
    """The processes of all nodes have been started."""


class Refused(Message):
    """The last request cannot be fulfilled; the reason, for the user."""

    text: str


class NodeEnded(Message):
    """The process of a node has ended, in words; its log has been sent."""

    node: str
    how: str


class ThreadsRead(Message):
    """Where the threads of a node's process stand."""

    node: str
    read: ProcessThreads


class Examined(Message):
    """State, subject, text and remedy of each finding."""

    findings: tuple[tuple[str, str, str, str], ...]


class Finished(Message):
    """All files have been sent; ``load``: the summary of the system load, ``None`` without one."""

    load: Mapping[str, Any] | None = None
    problems: tuple[str, ...] = ()


BOTH_WAYS: Sequence[type[Message]] = (Ping, Pong, Opened, Said, Closed, Chunk)
TO_AGENT: Sequence[type[Message]] = (
    *BOTH_WAYS,
    *(Place, Sent, Prepare, Start, KillNode, ReadThreads, Took, Examine, Finish),
)
FROM_AGENT: Sequence[type[Message]] = (
    *BOTH_WAYS,
    *(Ready, Lacking, Placed, Remark, Prepared, Started, Refused, NodeEnded, Examined),
    *(ThreadsRead, Finished),
)
