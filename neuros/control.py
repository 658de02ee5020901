"""The control channel of a run: typed messages between supervisor, node processes and observers.

It is no part of the data path: nodes report once per second, on a change of state and at the end;
the supervisor answers rarely. Observers (the dashboard) get no more than they ask for. Every
message is a dataclass of this module; :data:`FROM_NODES`, :data:`TO_NODES`, :data:`FROM_OBSERVERS`
and :data:`TO_OBSERVERS` say who sends which.

A message is one line: a JSON object with its fields and ``kind``, the name of its class in
snake_case. The bytes go through any :class:`neuros.ports.ControlStream`; the back end supplies it.
"""

from __future__ import annotations

import functools
import json
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from enum import Enum
from typing import Any, TypedDict, Union, get_args, get_origin, get_type_hints, is_typeddict

from neuros.errors import ControlError
from neuros.hooks import HookKind, InputSpec
from neuros.ports import ControlStream
from neuros.stacks import Stack

CONTROL_VARIABLE = "NEUROS_CONTROL"
"""The environment variable with the address at which the supervisor of a run listens."""

ELSEWHERE_VARIABLE = "NEUROS_ELSEWHERE"
"""The environment variable with the nodes that other launchers start, separated by commas."""


# ---------------------------------------------------------------------- what messages are made of


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


@dataclass(frozen=True)
class LiveCounters:
    """Counters and latest times of a node, short enough to be sent often.

    Attributes:
        now_s: time of the reading, on the monotonic clock.
        metrics: of hooks only ``executions`` and ``busy_s``.
        sent_ns: by connection, the position of the last packet sent, and when the last few were.
        taken_ns: by connection, the position of the packet on which a hook has started last, and
            when that was.
    """

    now_s: float
    metrics: Metrics
    sent_ns: Mapping[str, tuple[int, tuple[int, ...]]]
    taken_ns: Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class HookDeclaration:
    """A hook, as its plugin declares it."""

    kind: HookKind
    inputs: tuple[InputSpec, ...] = ()
    outputs: tuple[str, ...] = ()


class Message:
    """Base of all messages."""


# ---------------------------------------------------------------------- from nodes


@dataclass(frozen=True)
class Hello(Message):
    """A node process is up."""

    nodes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Report(Message):
    """State and counters of a node: once per second, on a change of state, at the end.

    Attributes:
        waiting_for: connections whose other end has not been found yet.
        sim_time: simulated seconds, ``None`` where the node owns no time.
        expected_end_s: simulated time at which the plugin expects to end the project.
        timeline: further points of simulated and wall time, in seconds.
        running_since_s: since when the node has been initialised, on the monotonic clock.
        metrics: ``None`` before the plugin is loaded.
        stack: where the plugin stands, if its hook runs for long.
        fault: what cannot be recorded.
        is_driving: whether some hook starts with no packet for it.
        is_final: whether this is the last report.
    """

    node: str
    waiting_for: tuple[str, ...] = ()
    sim_time: float | None = None
    expected_end_s: float | None = None
    timeline: tuple[tuple[float, float], ...] = ()
    running_since_s: float | None = None
    metrics: Metrics | None = None
    stack: Stack | None = None
    fault: str | None = None
    is_driving: bool = False
    is_final: bool = False


@dataclass(frozen=True, kw_only=True)
class Probed(Report):
    """Report of a node between two events, in answer to ``probe``.

    Attributes:
        number: that of the probe.
        is_startable: whether a hook could start on a packet that has arrived.
        is_wakeable: whether a timer, a thread or an external input may wake the node.
        is_running: whether the node has been initialised and may start hooks.
        is_idle: whether no event waits.
    """

    metrics: Metrics = field()  # without the default of a report
    number: int
    is_startable: bool
    is_wakeable: bool
    is_running: bool
    is_idle: bool


@dataclass(frozen=True)
class Hooks(Message):
    """The hooks that a plugin declares, once it is loaded; finalise hooks by name."""

    node: str
    hooks: tuple[HookDeclaration, ...]
    finalise: tuple[str, ...]


@dataclass(frozen=True)
class FirstHook(Message):
    """A node starts its first hook."""

    node: str


@dataclass(frozen=True)
class Finalising(Message):
    """A node starts a finalise hook; ``""``: it closes what it holds; ``None``: it has."""

    node: str
    hook: str | None


@dataclass(frozen=True)
class Shutdown(Message):
    """A plugin has called ``node.shutdown``."""

    node: str
    reason: str
    drain_s: float


@dataclass(frozen=True)
class Failed(Message):
    """A node has failed."""

    node: str
    text: str


@dataclass(frozen=True)
class Explanation(Message):
    """Why a node does not move, in answer to ``explain``."""

    node: str
    lines: tuple[str, ...]


@dataclass(frozen=True)
class Heard(Message):
    """State that another launcher publishes by its node; ``None``: that node is gone."""

    node: str
    text: str | None


@dataclass(frozen=True)
class NodeStatus(Message):
    """State and samples of a node, for the observer with this number; in answer to ``look``."""

    node: str
    asker: int
    sim_time: float | None = None
    counters: LiveCounters | None = None
    samples: Mapping[str, dict[str, Any]] = field(default_factory=dict)


# ---------------------------------------------------------------------- to nodes


@dataclass(frozen=True)
class Probe(Message):
    """Report between two events."""

    number: int


@dataclass(frozen=True)
class Explain(Message):
    """Say why nothing moves."""


@dataclass(frozen=True)
class Drain(Message):
    """Stop the hooks that send unasked; some, by node and place, may start once more."""

    last_round: Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class Stop(Message):
    """Start no further hook, finalise and end."""


@dataclass(frozen=True)
class Say(Message):
    """Publish the state of this launcher to its peers."""

    text: str


@dataclass(frozen=True)
class Leave(Message):
    """Peers have heard and said all: a node at its end may go."""


@dataclass(frozen=True)
class Pause(Message):
    """Start no further hook."""


@dataclass(frozen=True)
class Resume(Message):
    """Go on after a pause."""


@dataclass(frozen=True)
class Step(Message):
    """While paused, go on by so many steps; ``is_driven``: some hooks start with no packet."""

    count: int
    is_driven: bool


@dataclass(frozen=True)
class Look(Message):
    """Show an observer what the node does; ``wanted``: what to sample, by node and port."""

    wanted: Mapping[str, Mapping[str, Any]]
    asker: int


# ---------------------------------------------------------------------- from observers


@dataclass(frozen=True)
class Watch(Message):
    """An observer is there."""


@dataclass(frozen=True)
class LookAll(Message):
    """Have every node show its status once; ``wanted``: what to sample, by node and port."""

    wanted: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class StepAll(Message):
    """While the run is paused, let it go on by so many steps."""

    count: int


@dataclass(frozen=True)
class End(Message):
    """End the run, drained, with exit code 0."""

    reason: str


@dataclass(frozen=True)
class Interrupt(Message):
    """Do what Ctrl+C does (``neuros stop``)."""


# ---------------------------------------------------------------------- to observers


@dataclass(frozen=True)
class PhaseChanged(Message):
    """Phase of the run, whenever it changes."""

    phase: str
    is_paused: bool


@dataclass(frozen=True)
class LogRecord(Message):
    """Message of the launcher to the user."""

    severity: str
    text: str


@dataclass(frozen=True)
class Ended(Message):
    """All nodes have ended; ``reports``: the last one of each; ``running_s``: how long all ran."""

    exit_code: int
    reason: str
    reports: Mapping[str, Report]
    running_s: float | None


FROM_NODES: Sequence[type[Message]] = (
    *(Hello, Report, Probed, Hooks, FirstHook, Finalising, Shutdown, Failed, Explanation, Heard),
    NodeStatus,
)
TO_NODES: Sequence[type[Message]] = (
    *(Probe, Explain, Drain, Stop, Say, Leave, Pause, Resume, Step, Look),
)
FROM_OBSERVERS: Sequence[type[Message]] = (Watch, LookAll, Pause, Resume, StepAll, End, Interrupt)
TO_OBSERVERS: Sequence[type[Message]] = (NodeStatus, PhaseChanged, LogRecord, Ended)


# ---------------------------------------------------------------------- links


class ControlLink:
    """One end of a control channel.

    Args:
        stream: what carries it.
        accepted: the messages that may come from the other end.
        peer: the other end, for error messages: "the supervisor", "node 'a'".
    """

    def __init__(self, stream: ControlStream, accepted: Sequence[type[Message]], peer: str) -> None:
        self.stream = stream
        self.peer = peer
        self._accepted = {kind_of(each): each for each in accepted}
        self._rest = b""

    def fileno(self) -> int:
        """For selectors."""
        return self.stream.fileno()

    def send(self, message: Message) -> bool:
        """Send one message; returns False if the other end is gone."""
        try:
            self.stream.sendall(encode(message))
        except OSError:
            return False
        return True

    def receive(self) -> list[Message] | None:
        """The messages that have arrived, after one read; ``None`` once the other end is gone.

        Raises:
            ControlError: if one cannot be understood.
        """
        try:
            lines = self.read_lines()
        except BlockingIOError:
            return []
        return None if lines is None else [self.decode(line) for line in lines]

    def read_lines(self) -> list[bytes] | None:
        """The whole lines that have arrived, after one read; ``None`` once the other end is gone.

        Raises:
            BlockingIOError: if the stream does not block, and there is nothing to read.
        """
        try:
            data = self.stream.recv(1 << 16)
        except BlockingIOError:
            raise
        except OSError:
            return None
        if not data:
            return None
        *lines, self._rest = (self._rest + data).split(b"\n")
        return lines

    def decode(self, line: bytes) -> Message:
        """The message of a line. Raises ``ControlError``."""
        return decode(line, self._accepted, self.peer)

    def close(self) -> None:
        """Hang up."""
        self.stream.close()


# ---------------------------------------------------------------------- lines

_NO_CHARACTER = re.compile("[\ud800-\udfff]")
_LONGEST_SHOWN = 60


def kind_of(message: type[Message]) -> str:
    """The name of a class of messages in the channel: ``first_hook`` of :class:`FirstHook`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", message.__name__).lower()


def encode(message: Message) -> bytes:
    """A message as one line."""
    content = {"kind": kind_of(type(message)), **vars(message)}
    text = json.dumps(content, ensure_ascii=False, default=_plain)
    # What is no character cannot be written anywhere: both ends see its escape in its place.
    return _NO_CHARACTER.sub(lambda match: f"\\\\u{ord(match[0]):04x}", text).encode() + b"\n"


def decode(line: bytes, accepted: Mapping[str, type[Message]], peer: str) -> Message:
    """The message of a line.

    Args:
        accepted: the messages that may come, by kind.
        peer: who has sent it.

    Raises:
        ControlError: if it is none of them, or a field is missing, unknown or of a wrong type.
    """
    try:
        content = json.loads(line)
        kind = content.pop("kind")
    except (ValueError, AttributeError, TypeError, KeyError):
        raise ControlError(f"{peer} sent what is no control message: {_shown(line)}") from None
    message = accepted.get(kind) if isinstance(kind, str) else None
    if message is None:
        raise ControlError(f"{peer} sent a control message of the unknown kind {_shown(kind)}")
    read: _Reader = _reader(message)  # type: ignore[arg-type]
    try:
        found: Message = read(content, "")
    except _WrongField as error:
        raise ControlError(f"{peer} sent a wrong control message '{kind}': {error}") from None
    return found


class _WrongField(Exception):
    """A field that does not fit its class; its text says which."""


def _plain(value: Any) -> Any:
    return value.value if isinstance(value, Enum) else vars(value)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


_Reader = Callable[[Any, str], Any]
"""Makes a value of its declared type from JSON; gets the path of the field, too."""


@functools.cache
def _reader(declared: Any) -> _Reader:
    """The reader of a declared type."""
    origin, arguments = get_origin(declared), get_args(declared)
    if declared is Any:
        return lambda value, _: value
    if origin in (Union, types.UnionType):
        (some,) = (each for each in arguments if each is not types.NoneType)
        read_some = _reader(some)
        return lambda value, path: None if value is None else read_some(value, path)
    if origin is tuple and arguments[-1] is Ellipsis:
        read = _reader(arguments[0])
        return lambda value, path: tuple(
            read(each, f"{path}[{place}]")
            for place, each in enumerate(_checked(value, (list,), path, "a list"))
        )
    if origin is tuple:
        return functools.partial(_read_tuple, tuple(map(_reader, arguments)))
    if is_typeddict(declared):
        return lambda value, path: _checked(value, (dict,), path, "an object")
    if origin in (dict, Mapping):
        read_value = _reader(arguments[1])
        return lambda value, path: {
            key: read_value(each, f"{path}[{key!r}]")
            for key, each in _checked(value, (dict,), path, "an object").items()
        }
    if is_dataclass(declared):
        return _object_reader(declared)
    if issubclass(declared, Enum):
        return functools.partial(_read_enum, declared)
    kinds = (int, float) if declared is float else (declared,)
    return lambda value, path: _checked(value, kinds, path, declared.__name__)


def _checked(value: Any, kinds: tuple[type, ...], path: str, expected: str) -> Any:
    """A value of one of these types; ``bool`` is no number."""
    if type(value) not in kinds:
        raise _WrongField(f"{path} is {_shown(value)}, and must be {expected}")
    return value


def _read_tuple(readers: Sequence[_Reader], value: Any, path: str) -> tuple[Any, ...]:
    if type(value) is not list or len(value) != len(readers):
        raise _WrongField(f"{path} is {_shown(value)}, and must be a list of {len(readers)}")
    return tuple(
        read(each, f"{path}[{place}]")
        for place, (read, each) in enumerate(zip(readers, value, strict=True))
    )


def _read_enum(kind: type[Enum], value: Any, path: str) -> Enum:
    try:
        return kind(value)
    except ValueError:
        known = ", ".join(str(each.value) for each in kind)
        raise _WrongField(f"{path} is {_shown(value)}, and must be one of {known}") from None


def _object_reader(declared: Any) -> _Reader:
    """Reads a dataclass; fields with a default may be missing."""
    hints = get_type_hints(declared)
    readers = {each.name: _reader(hints[each.name]) for each in fields(declared)}
    required = {
        each.name
        for each in fields(declared)
        if each.default is MISSING and each.default_factory is MISSING
    }

    def read(value: Any, path: str) -> Any:
        given = _checked(value, (dict,), path, "an object")
        before = f"{path}." if path else ""
        if missing := required - given.keys():
            raise _WrongField(f"its field {before}{min(missing)} is missing")
        if unknown := given.keys() - readers.keys():
            raise _WrongField(f"it has no field {before}{min(unknown)}")
        return declared(**{k: readers[k](each, f"{before}{k}") for k, each in given.items()})

    return read
