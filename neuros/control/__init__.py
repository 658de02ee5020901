"""The control channel of a run: typed messages between supervisor, node processes and observers.

It is not part of the data path: nodes report once per second, on a change of state and at the end;
the supervisor answers rarely. Observers (the dashboard) get no more than they ask for. Every
message is a class of this module; :data:`FROM_NODES`, :data:`TO_NODES`, :data:`FROM_OBSERVERS` and
:data:`TO_OBSERVERS` say who sends which.

A message travels as MessagePack, behind its length: a map with its fields and ``kind``, the name of
its class in snake_case. The bytes go through any :class:`neuros.ports.ControlStream`; the back end
supplies it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import msgspec

from neuros.hooks import HookKind, InputSpec
from neuros.stacks import Stack

CONTROL_VARIABLE = "NEUROS_CONTROL"
"""The environment variable with the address at which the supervisor of a run listens."""

ELSEWHERE_VARIABLE = "NEUROS_ELSEWHERE"
"""The environment variable with the nodes that other launchers start, separated by commas."""


# ---------------------------------------------------------------------- what messages are made of


WORLD = "#world"
"""Stands for a port where an observer asks for the simulated world of a node."""


class SentCounts(TypedDict):
    """Counters of an outgoing connection."""

    sent: int
    acknowledged: int
    outstanding: int
    window: int
    is_reliable: bool
    is_blocked: bool


class ReceivedCounts(TypedDict):
    """Counters of an incoming connection; ``taker``: the hook that could start on a packet now."""

    received: int
    consumed: int
    discarded: int
    longest_discard: int
    unread: int
    acknowledged: int
    taker: str | None


class NodeState(TypedDict):
    """State of a node (``waiting``, ``blocked``), and the port or connection that causes it."""

    state: str
    cause: str


class ExecutingHook(TypedDict):
    """The hook that runs, for how long, and how often it had run before."""

    name: str
    for_s: float
    executions: int


class Metrics(TypedDict):
    """Metrics of a node, as :func:`neuros.engine.snapshot.snapshot` makes them."""

    state: NodeState
    executing: ExecutingHook | None
    outgoing: Mapping[str, SentCounts]
    incoming: Mapping[str, ReceivedCounts]
    hooks: Mapping[str, Mapping[str, Any]]
    accounting: Mapping[str, Any]


class LiveCounters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Counters and latest times of a node, short enough to be sent often.

    Attributes:
        now_s: time of the reading, on the monotonic clock.
        metrics: of hooks only ``executions`` and ``busy_s``.
        sent_ns: by connection, the position of the last packet sent, and when the last few were.
        taken_ns: by connection, the position of the packet on which a hook has started last, and
            when that was.
        paused_ns: start and end of the last times in which it stood still, since it was paused.
    """

    now_s: float
    metrics: Metrics
    sent_ns: Mapping[str, tuple[int, tuple[int, ...]]]
    taken_ns: Mapping[str, tuple[int, int]]
    paused_ns: tuple[tuple[int, int], ...] = ()


class HookDeclaration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A hook, as its plugin declares it."""

    kind: HookKind
    inputs: tuple[InputSpec, ...] = ()
    outputs: tuple[str, ...] = ()


def _kind(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


class Message(msgspec.Struct, tag_field="kind", tag=_kind, forbid_unknown_fields=True):
    """Base of all messages."""


# ---------------------------------------------------------------------- from nodes


class Hello(Message):
    """A node process is up; ``plugins``: the file of each node's plugin, as it sees it."""

    nodes: tuple[str, ...]
    plugins: Mapping[str, str] = {}


class Report(Message, kw_only=True):
    """State and counters of a node: once per second, on a change of state, at the end.

    Attributes:
        waiting_for: connections whose other end has not been found yet.
        sim_time: simulated seconds, ``None`` where the node owns no time.
        expected_end_s: simulated time at which the plugin expects to end the project.
        timeline: further points of simulated and wall time, in seconds.
        running_since_s: since when the node has been initialised, on the clock of the run.
        metrics: ``None`` before the node has begun.
        reasons: why the node does not move, one sentence each; none while it executes a hook.
        stack: where the plugin stands, if its hook runs for long.
        fault: what cannot be recorded.
        compressed: by connection on which the node compresses, bytes before and after.
        is_driving: whether some hook starts with no packet for it.
        is_final: whether this is the last report.
        virtual_s: virtual time of the node, ``None`` in real time.
    """

    node: str
    waiting_for: tuple[str, ...] = ()
    sim_time: float | None = None
    expected_end_s: float | None = None
    timeline: tuple[tuple[float, float], ...] = ()
    running_since_s: float | None = None
    metrics: Metrics | None = None
    reasons: tuple[str, ...] = ()
    stack: Stack | None = None
    fault: str | None = None
    compressed: Mapping[str, tuple[int, int]] = {}
    is_driving: bool = False
    is_final: bool = False
    virtual_s: float | None = None


class NodeProbe(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True
):
    """Where a node stands between two events.

    At the end of a step it tells no more than counters of connections to other processes, its
    simulated time and whether it is active.

    Attributes:
        sent: by connection, packets sent and acknowledged.
        received: by connection, likewise.
        unread: the connections with packets that no hook has started on.
        executions: of all hooks.
        lacks: the input that it waits for, empty if there is none.
        sim_time: simulated seconds, ``None`` where the node owns no time.
        is_active: whether it has found its receivers, and may start all its hooks.
        is_startable: whether a hook could start on a packet that has arrived.
        is_wakeable: whether a timer, a thread or an external input may wake the node.
        is_idle: whether no event waits in its process.
        virtual_ns: the time of the node, ``None`` in real time.
    """

    sent: Mapping[str, tuple[int, int]] = {}
    received: Mapping[str, tuple[int, int]] = {}
    unread: frozenset[str] = frozenset()
    executions: int = 0
    lacks: str = ""
    sim_time: float | None = None
    is_active: bool = True
    is_startable: bool = False
    is_wakeable: bool = False
    is_idle: bool = True
    virtual_ns: int | None = None


class Probed(Message):
    """Where the nodes of a process stand between two events, in answer to ``probe``.

    ``packets``: as in ``at_rest``, of the outputs whose packets are asked for.
    """

    number: int
    nodes: Mapping[str, NodeProbe]
    packets: Mapping[str, tuple[int, list[bytes]]] = {}


class Ready(Message):
    """A node has initialised as far as it can alone; its other hooks wait for ``activate``."""

    node: str


class Hooks(Message):
    """A plugin is loaded: the hooks that it declares, of finalise hooks the names.

    No hook starts before ``begin``.
    """

    node: str
    hooks: tuple[HookDeclaration, ...]
    finalise: tuple[str, ...]


class Finalising(Message):
    """A node starts a finalise hook; ``""``: it closes its resources; ``None``: they are closed."""

    node: str
    hook: str | None


class Progress(Message):
    """A node is getting on, so it has time again while it finalises; ``text`` of its plugin."""

    node: str
    text: str = ""


class Shutdown(Message):
    """A plugin has called ``node.shutdown``."""

    node: str
    reason: str
    drain_s: float


class Failed(Message):
    """A node has failed."""

    node: str
    text: str


class StateOfPeer(Message):
    """State of another launcher, received from its node; ``None``: that node is gone."""

    node: str
    text: str | None


class NodeStatus(Message):
    """State and samples of a node, for the observer with this number; in answer to ``get_status``.

    ``keeps``: names of the values that its plugin keeps (``node.keep``).
    """

    node: str
    asker: int
    sim_time: float | None = None
    counters: LiveCounters | None = None
    samples: Mapping[str, dict[str, Any]] = {}
    keeps: tuple[str, ...] = ()


class AtRest(Message):
    """Nothing moves in the run, and no hook may start: answer to `advance`.

    Attributes:
        sim_times: of nodes that own simulated time, in seconds.
        packets: by output (``robot.imu``), the number of its newest packet, from 1, and in their
            ROS serialisation, the packets after the known number, as far as they are kept.
    """

    number: int
    sim_times: Mapping[str, float]
    packets: Mapping[str, tuple[int, list[bytes]]]


class WasReset(Message):
    """Answer to ``reset``; ``why_not``: why it was refused, empty if it was not."""

    why_not: str


# ---------------------------------------------------------------------- to nodes


class Probe(Message):
    """Tell between two events where the nodes stand.

    Attributes:
        once_idle: answer when no event waits in the process any more, unless it is resumed before.
        known: outputs whose packets are asked for, and the number of the newest known packet.
    """

    number: int
    once_idle: bool = False
    known: Mapping[str, int] = {}


class Drain(Message):
    """Stop the hooks that send unasked.

    Attributes:
        last_round: indices of hooks that start once more.
        is_asked: whether a node has asked for the end, at a time of the run's clock.
    """

    last_round: Mapping[str, tuple[int, ...]]
    is_asked: bool = False


class Begin(Message):
    """Initialise: every node of the project is loaded; not sent once the run is stopping."""


class Activate(Message):
    """Start tick and function hooks: every node of the project is ready."""


class StopHooks(Message):
    """Start no further hook, and go on to receive."""


class Stop(Message):
    """Start no further hook, finalise and end."""


class PublishState(Message):
    """Publish the state of this launcher to its peers."""

    text: str


class Leave(Message):
    """Peers have exchanged all their states: a node that has ended may leave."""


class Pause(Message):
    """Start no further hook.

    ``at_ns``: in virtual time, once nothing moves: the latest time of a node, which all have then.
    """

    at_ns: int | None = None


class Resume(Message):
    """Go on after a pause."""


class Step(Message):
    """While paused, run ``count`` steps; ``is_driven``, to nodes: some hook starts unasked.

    ``virtual_ns``: or let the run go for so long, in virtual time.
    """

    count: int
    is_driven: bool = False
    virtual_ns: int = 0


class GetStatus(Message):
    """Ask every node for its status once.

    Attributes:
        wanted: what to sample, by node and port.
        asker: to nodes, the number of the observer.
    """

    wanted: Mapping[str, Mapping[str, Any]]
    asker: int = 0


class Advance(Message):
    """While paused, run steps; answer `at_rest` once nothing moves, and pause.

    Attributes:
        rounds: so many steps.
        known: outputs whose packets are asked for, and the number of the newest known packet.
        virtual_ns: or let the run go for so long, in virtual time.
    """

    number: int
    rounds: int
    known: Mapping[str, int]
    virtual_ns: int = 0


class Reset(Message):
    """While paused, return to the start and stay paused.

    Attributes:
        variables: environments, by node.
        keep: names of the values of its plugin that survive, by node.
    """

    variables: Mapping[str, Mapping[str, str]]
    keep: Mapping[str, tuple[str, ...]] = {}


class Change(Message):
    """While paused, change what a node was given, and go on from there.

    Attributes:
        variables: of its environment.
        parameters: of its ROS node.
        only_checks: whether to check that this is possible, and to change nothing.
    """

    node: str
    variables: Mapping[str, str]
    parameters: Mapping[str, Any]
    only_checks: bool = False


class Deliver(Message):
    """A packet of a session for one of its inputs."""

    node: str
    input: str
    data: bytes


# ---------------------------------------------------------------------- from observers


class Watch(Message):
    """An observer is there."""


class End(Message):
    """End the run, drained, with exit code 0."""

    reason: str


class Interrupt(Message):
    """Do what Ctrl+C does (``neuros stop``)."""


# ---------------------------------------------------------------------- to observers


class PhaseChanged(Message):
    """Phase of the run, whenever it changes."""

    phase: str
    is_paused: bool


class LogRecord(Message):
    """Message of the launcher to the user."""

    severity: str
    text: str


class Ended(Message):
    """All nodes have ended.

    Attributes:
        reports: the last one of each node.
        running_s: how long all nodes ran.
        real_time_factor: simulated seconds per second of that.
        has_drained: whether packets in flight were waited for.
    """

    exit_code: int
    reason: str
    reports: Mapping[str, Report]
    running_s: float | None
    real_time_factor: float | None
    has_drained: bool = False


FROM_NODES: Sequence[type[Message]] = (
    *(Hello, Ready, Report, Probed, Hooks, Finalising, Progress, Shutdown, Failed),
    *(StateOfPeer, NodeStatus, WasReset),
)
TO_NODES: Sequence[type[Message]] = (
    *(
        Begin,
        Activate,
        Probe,
        Drain,
        StopHooks,
        Stop,
        PublishState,
        Leave,
        Pause,
        Resume,
        Step,
        GetStatus,
    ),
    *(Deliver, Reset, Change),
)
FROM_OBSERVERS: Sequence[type[Message]] = (
    *(Watch, GetStatus, Pause, Resume, Step, End, Interrupt, Advance, Deliver, Reset),
    Change,
)
TO_OBSERVERS: Sequence[type[Message]] = (
    *(NodeStatus, PhaseChanged, LogRecord, Ended, AtRest, WasReset),
)
