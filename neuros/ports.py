"""All seams of NeuROS on one page: interfaces for nodes and supervisor, and data in their calls."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from neuros.distribution import python_command
from neuros.errors import EnvironmentFault, Problem
from neuros.options import Option
from neuros.project.model import Connection, Folders, Node, NodeFile, Port, Project
from neuros.stacks import ProcessThreads

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future
    from contextlib import AbstractContextManager

Packet: TypeAlias = Any  # one ROS message


class Logger(Protocol):
    """The log of a node, as rclpy's."""

    def debug(self, message: str) -> object: ...
    def info(self, message: str) -> object: ...
    def warning(self, message: str) -> object: ...
    def error(self, message: str) -> object: ...


class Inbox(Protocol):
    """A node, for its transport, which calls it in the node's thread, between hooks."""

    def on_packet(self, connection: Connection, packet: Packet) -> None:
        """A packet has arrived on a connection to this node."""

    def on_external_packet(self, port: Port, packet: Packet) -> None:
        """A packet has arrived on the external topic of an input."""

    def on_acknowledgement(
        self, connection: Connection, position: int, arrival_ns: int | None = None
    ) -> None:
        """All hooks at the far end have started on the packets up to ``position`` (from 1).

        ``arrival_ns``: when this has arrived, on the clock of the node; by default now.
        """

    def on_registered(self, connection: Connection) -> None:
        """The far end of an output's connection is there: it will get the first packet."""


class Transport(Protocol):
    """Exchanges packets between a node and its neighbours."""

    def open(self, inbox: Inbox) -> None:
        """Create the endpoints, and announce the node to its neighbours."""

    def sender(self, connections: Sequence[Connection]) -> Callable[[Packet], bytes | None]:
        """A function that sends a packet on connections of an output; may return its bytes."""

    def send_external(self, port: Port, packet: Packet) -> None:
        """Publish on the external topic of an output."""

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        """A function that acknowledges packets up to a position to the sender."""

    @property
    def digests(self) -> Mapping[Connection, array[int]]:
        """Digests of all packets of the connections that keep them; for one read."""

    @property
    def compressed(self) -> Mapping[str, tuple[int, int]]:
        """Bytes before and after compression, by connection."""

    def note_execution(self) -> None:
        """A hook has ended: handle the arrivals of its time before the next hook."""

    def give_way(self) -> None:
        """Handle the events of other nodes in this process, too: the hook ran long."""

    def has_taken_in(self) -> bool:
        """Whether all arrivals have been handled."""

    def waiting_for(self) -> Sequence[Connection]:
        """Connections whose other end has not been found."""

    def close(self) -> None:
        """Destroy all endpoints; further calls have no effect."""


class Packets(Protocol):
    """Operations on packets, compiled once per type.

    A type is that of a port: a message type in ROS notation, or that of arrays, ``float64[18]``.
    """

    def packet_class(self, type_name: str) -> type:
        """The message class of a type, or NumPy's array. Raises ``EnvironmentFault``."""

    def maker(self, type_name: str) -> Callable[[], Packet]:
        """A function that makes a new message with default values, or an array of zeros."""

    def checker(self, type_name: str, *, for_jpeg: bool = False) -> Callable[[Packet], Packet]:
        """A check of packets of a type, also for JPEG.

        The check returns the packet with the values that receivers see; raises ``WrongValue``.
        """

    def copier(self, type_name: str) -> Callable[[Packet], Packet]:
        """A function that copies a checked packet of a type; the copy shares nothing with it."""

    def encode(self, packet: Packet) -> bytes:
        """A packet in the serialisation of ROS."""

    def decode(self, type_name: str, data: bytes) -> Packet:
        """The inverse of :meth:`encode`; arrays are read-only."""


class Way(str, Enum):
    """The way by which a recorded packet passes a node."""

    SENT = "sent"  # by an output, to other nodes or on its external topic
    TO_ITSELF = "to itself"  # on a connection of the node to itself
    HEARD = "heard"  # on the external topic of an input
    RECEIVED = "received"  # on a connection whose sender is not part of this run


class PacketRecorder(Protocol):
    """Keeps the recorded packets of a node."""

    def stream(self, way: Way, name: str) -> int | None:
        """The number of a stream: a port, or a connection; ``None`` if it is not recorded."""

    def keep(
        self, stream: int, data: bytes, sim_time_s: float | None, virtual_ns: int | None
    ) -> None:
        """Keep a serialised packet, with the simulated time of a node that has one.

        Args:
            virtual_ns: when it was sent in virtual time; ``None``: the run is in real time.

        Raises ``OSError`` if neither this packet nor later ones can be kept.
        """

    def close(self) -> None:
        """End the recording."""


class NodeEvents(Protocol):
    """The events of a node, or of all nodes of a process.

    Attributes:
        clock: monotonic clock in nanoseconds.
        waits_for: what keeps an event that is next from being handled, as a sentence; mostly empty.
    """

    @property
    def waits_for(self) -> str: ...

    @property
    def clock(self) -> Callable[[], int]: ...

    def post(self, event: Callable[[], None]) -> None:
        """Handle ``event`` after all waiting events. Loop thread only."""

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """As :meth:`post`, also after all events that wait in ROS."""

    def post_from_thread(self, event: Callable[[], None]) -> None:
        """As :meth:`post`, from any thread; wakes the loop."""

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Callable[[], None]) -> None:
        """Call ``on_due`` whenever the clock reaches ``next_due_ns()``."""


class EventLoop(NodeEvents, Protocol):
    """The thread of all nodes of a process: one event at a time, oldest first."""

    @property
    def has_waiting_events(self) -> bool:
        """Whether events of engines wait."""

    @property
    def has_taken_in(self) -> bool:
        """Whether all arrivals have been handled; at a loop-back they have."""

    def note_execution(self) -> None:
        """A hook, or a callback of a plugin, has ended; packets may have arrived meanwhile."""

    def run(self) -> None:
        """Handle events until :meth:`stop`."""

    def stop(self) -> None:
        """End :meth:`run` after the current event. Any thread."""


class NodeLoop(NodeEvents, Protocol):
    """The clock and the events of one node in virtual time.

    Attributes:
        seed: from which durations, delays and losses are drawn.
        zero_ns: time 0 of the run.
        starts: how many hooks have started at this instant.
    """

    starts: int

    @property
    def seed(self) -> str: ...
    @property
    def zero_ns(self) -> int: ...

    def announce(self, duration_ns: int) -> None:
        """The hook that starts now takes at least so long."""

    def watch(self, awaited: Callable[[], Sequence[Connection]]) -> None:
        """``awaited``: connections whose acknowledgements could change which hooks start."""

    def ready(self) -> None:
        """The initialise hooks have run, but for those that wait for packets."""

    def at_zero(self, event: Callable[[], None], first_pass: Callable[[], None]) -> None:
        """Handle two events at time 0 of the run; the second after the first of all nodes."""

    def hold(self, duration_ns: int) -> None:
        """The hook that has just run takes so long."""

    def at(self, time_ns: int, event: Callable[[], None]) -> None:
        """Handle an event at a time, or now if that has passed."""

    def after(self, duration_ns: int, event: Callable[[], None]) -> None:
        """Handle an event so long from now, before everything else at that instant."""

    def lost(self, connection: Connection) -> int:
        """How many packets of the node are lost on a connection, or will be."""

    def begin(self) -> None:
        """Time 0 of the run has come."""

    def end(self, drain_s: float, tell: Callable[[], None]) -> None:
        """The node asks for the end: nothing happens after this instant until :meth:`drain`.

        ``tell`` is called if no node has asked before, or at this instant with an earlier name.
        """

    def drain(self, event: Callable[[], None], stop: Callable[[], None], *, is_asked: bool) -> None:
        """Handle ``event`` when the end reaches the node; ``stop`` it if it drains for too long.

        ``is_asked``: a node has asked for the end; else it is now.
        """


class VirtualRun(EventLoop, Protocol):
    """The loop of a process in virtual time."""

    def plan(
        self,
        duration_s: float | None,
        on_end: Callable[[], None],
        real_time_factor: float | None,
    ) -> None:
        """Call ``on_end`` at the end of a duration from time 0; go no faster than the factor."""

    def call_at(self, time_s: float, event: Callable[[], None]) -> None:
        """Call ``event`` so long after time 0, before anything else happens at that time."""

    def rest(self, time_ns: int) -> None:
        """Nothing moves in the run any more: it is this time in all nodes."""

    def go_on(self, *, is_stepped: bool) -> None:
        """A pause ends, now in all nodes of the run; ``is_stepped``: until nothing moves."""


class StatePublisher(Protocol):
    """Publishes the state of a launcher to its peers."""

    def publish(self, text: str) -> None:
        """Publish the state, also for later subscribers. Any thread."""

    def close(self) -> None:
        """Let the last state arrive, then end."""


class Middleware(Protocol):
    """Connects the nodes of a process to each other and to the rest of the world."""

    @property
    def loop(self) -> EventLoop: ...

    @property
    def packets(self) -> Packets: ...

    def loop_of(self, file: NodeFile) -> NodeEvents:
        """The clock and the events of one node."""

    def begin_anew(
        self, files: Sequence[NodeFile], variables: Mapping[str, Mapping[str, str]]
    ) -> None:
        """All nodes are about to be reset, with these variables in their environments."""

    def transport(self, file: NodeFile) -> Transport:
        """The transport of one node; creates its ROS node."""

    def ros_node(self, file: NodeFile) -> Any:
        """The real ``rclpy.node.Node`` of a node that has a transport."""

    def mark_own_entities(
        self, file: NodeFile, enter: Callable[[], None], fail: Callable[[Any, BaseException], None]
    ) -> None:
        """Tell NeuROS's entities of a ROS node from those that its plugin creates later.

        ``enter`` is called before each callback of the plugin's subscriptions, timers, services,
        clients and actions, ``fail`` with a callback and its exception.
        """

    def has_foreign_entities(self, file: NodeFile) -> bool:
        """Whether a plugin has created entities on its ROS node."""

    def join_peers(
        self,
        names: Sequence[str],
        elsewhere: Sequence[str],
        heard: Callable[[str, str | None], None],
    ) -> StatePublisher:
        """Publish the state of the nodes ``names``, and subscribe to that of nodes elsewhere.

        ``heard`` is called from any thread with a node and its state; ``None``: the node has ended.
        """

    def take_in(self) -> None:
        """Count what had arrived when the loop was stopped; no hook runs."""

    def flush(self) -> None:
        """End sending and receiving; packets sent before still leave."""

    def close(self) -> None:
        """Destroy all entities, after :meth:`flush`."""


class TransportKind(ABC):
    """A way to carry packets: an entry point ``name`` of the group ``neuros.transports``."""

    name: str

    @abstractmethod
    def middleware(
        self,
        files: Sequence[NodeFile],
        on_failure: Callable[[BaseException], None],
        *,
        digests: bool,
        record: bool,
        debug: bool,
    ) -> Middleware:
        """The middleware of a process with these nodes.

        Args:
            on_failure: is called with errors outside of hooks.
            digests: whether to keep a digest of every packet.
            record: whether packets are recorded.
            debug: whether to log DEBUG records.
        """


WorldLook: TypeAlias = "Callable[[Mapping[str, Any], int], Mapping[str, Any]]"
"""A view of a simulated world, for JSON, by the observer's request and number. Any thread."""


Changes: TypeAlias = "Mapping[str, tuple[Mapping[str, str], Mapping[str, Any]]]"
"""By node, the variables of its environment and the parameters of its ROS node that change."""


class VirtualClock(Protocol):
    """The clock of a run in virtual time, for a simulator that steps itself."""

    def clock_s(self) -> float:
        """Seconds since time 0 of the run."""

    def when_active(self, event: Callable[[], None]) -> None:
        """Call ``event`` at time 0 of the run, or now if that has passed."""

    def call_at(self, time_s: float, event: Callable[[], None]) -> None:
        """Call ``event`` so many seconds after time 0, or now if that has passed."""

    def send(self, packets: Mapping[str, Packet], sent: Callable[[], None]) -> None:
        """Send packets, by output, as soon as a hook could; then call ``sent``."""

    def will_step_to(self, sim_time_s: float) -> None:
        """The hook that runs steps the simulator so far, which will be the end of the hook."""


Advance: TypeAlias = "Callable[[], Mapping[str, Packet]]"
"""Steps a world that runs by itself, to packets that are due or less far; returns them."""


class NodeContext(Protocol):
    """The node handle of hooks, as far as simulators need it."""

    @property
    def virtual_time(self) -> VirtualClock | None:
        """The clock of a run in virtual time; ``None`` in real time."""

    @property
    def name(self) -> str:
        """Its name in the project."""

    @property
    def run_dir(self) -> Path:
        """The node's writable folder in the run folder."""

    @property
    def description(self) -> Node:
        """The declaration of the node: ports, ``mujoco`` keys, environment."""

    @property
    def copies(self) -> int:
        """The number of worlds that each hook serves at once."""

    @property
    def seeds(self) -> list[int]:
        """A seed for each copy. Raises ``NodeError`` if the node has no variable for a seed."""

    def make_packet(self, output: str) -> Packet:
        """A new message of the type of an output."""

    def get_logger(self) -> Logger:
        """The log of the node."""

    def resolve_path(self, path: str) -> Path:
        """An existing file, found like paths in node files. Raises ``ModelError``."""

    def own_simulated_time(self, read_s: Callable[[], float]) -> None:
        """Report simulated time, in seconds, by calling ``read_s`` (cheap, from any thread)."""

    def note_simulated_time(self) -> bool:
        """Report progress of simulated time; returns whether to go on. Any thread."""

    def wait_until_active(self, cancelled: Callable[[], bool]) -> bool:
        """Wait for time 0 of the run; False if ``cancelled()`` or the node ends. Other threads."""

    @property
    def is_ending(self) -> bool:
        """Whether no further hook starts. Any thread."""

    def reading(self, value: int) -> int:
        """A reading of what goes on by itself: that of the run in a replay, else the value."""

    def drive(self, advance: Advance) -> bool:
        """Whether the node advances a world that runs by itself, so that no thread has to."""

    def show_world(self, look: WorldLook) -> None:
        """Show a simulated world to observers; see :mod:`neuros.simulators.mujoco.scene`."""

    def submit(self, packets: Mapping[str, Packet], cancelled: Callable[[], bool]) -> bool:
        """Send packets, by output, from another thread; waits while an output is blocked.

        Returns ``False`` if ``cancelled()`` or the end of the node came first.
        """

    def on_close(self, callback: Callable[[], None]) -> None:
        """Call ``callback`` once when the node ends, after its finalise hooks."""

    def on_change(
        self,
        callback: Callable[[], object],
        check: Callable[[Mapping[str, str]], object] = lambda _: None,
    ) -> None:
        """Call ``callback`` when a fork has changed the environment, and ``check`` before."""

    def fail(self, error: BaseException) -> None:
        """End the node with an error from outside of hooks. Any thread."""


class Simulator(Protocol):
    """A simulated world."""

    @property
    def sim_time(self) -> float:
        """Simulated seconds since the start."""

    @property
    def timestep(self) -> float:
        """Simulated seconds per step."""

    def step_synchronous(self, count: int = 1) -> None:
        """Advance ``count`` timesteps, without sending. Raises ``ModelError``."""

    def step_to_next(self) -> None:
        """Advance to the next firing of any sensor."""

    def read(self, output: str) -> Packet | None:
        """The packet of a sensor that came due since the last read, if any."""

    def run_asynchronous(self, real_time_factor: float | None = 1.0) -> None:
        """Step in a thread, at this many simulated seconds per wall second (``None``: freely)."""

    def pause(self) -> None:
        """Begin no further step."""

    def resume(self) -> None:
        """Go on after :meth:`pause`, at the time of the pause."""

    def reset(self) -> None:
        """Return to time zero and the initial state; drop unread packets."""


class ControlStream(Protocol):
    """A byte stream to another process, as a connected ``socket.socket``."""

    def fileno(self) -> int:
        """For selectors; readable when :meth:`recv` does not wait."""

    def setblocking(self, flag: bool, /) -> None:
        """Let calls wait, or raise ``BlockingIOError``."""

    def recv(self, size: int, /) -> bytes:
        """Arrived bytes; empty once the other end is gone. Raises ``OSError``."""

    def send(self, data: bytes | bytearray, /) -> int:
        """Send a part; returns the number of bytes. Raises ``OSError``."""

    def sendall(self, data: bytes, /) -> None:
        """Send all. Raises ``OSError``."""

    def close(self) -> None:
        """Close the stream."""


class ControlListener(Protocol):
    """The listening end of the control channel, from a back end."""

    @property
    def address(self) -> str:
        """The address for processes on this machine: ``unix:/runs/1/control.sock``."""

    @property
    def files(self) -> Sequence[Path]:
        """Files that a killed launcher leaves behind."""

    def open(self) -> None:
        """Listen. Raises ``EnvironmentFault``."""

    def fileno(self) -> int:
        """For selectors; readable when a connection waits."""

    def accept(self) -> ControlStream | None:
        """The next connection; ``None`` if none waits."""

    def close(self) -> None:
        """Stop listening."""


class RunningNode(Protocol):
    """A started process or container, with its nodes."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def poll(self) -> str | None:
        """``None`` while running, then the end: "exit code 0", "killed by SIGKILL"."""

    @property
    def is_abandoned(self) -> bool:
        """Whether the container engine is gone, so that the node is not to blame."""

    def kill(self) -> None: ...

    def threads(self) -> ProcessThreads:
        """The Python stacks of its threads; empty if they cannot be read."""


class Launcher(Protocol):
    """Starts nodes."""

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningNode]:
        """Start all nodes or none; adds ``environment``. Raises ``EnvironmentFault``."""

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line for each process or container that :meth:`start` would start."""


class ChildProcess(Protocol):
    """A child process that leads its own session and process group."""

    pid: int

    def poll(self) -> int | None:
        """``None`` while running, then the exit code, negative for a signal."""

    def wait(self, timeout_s: float) -> None:
        """Wait for the end, for ``timeout_s`` seconds at most."""

    def send_signal(self, number: int, *, is_for_group: bool = False) -> None:
        """Signal the process, or its process group; does nothing after the end."""


class Guardian(Protocol):
    """Cleans up a run after the end of its launcher, even by SIGKILL."""

    def spawn(
        self,
        command: Sequence[str],
        log: Path,
        folder: Path,
        environment: Mapping[str, str],
        cores: Sequence[int] = (),
    ) -> ChildProcess:
        """Start a process in its own session, without input; its output goes to the log.

        Its descendants end with the run. Raises ``OSError``.
        """

    def watch(self, pid: int) -> None:
        """Register another process, which does not have the run's id in its environment."""

    def remove_later(self, path: Path) -> None:
        """Remove a file, socket or folder once all processes of the run are gone."""

    def clean_with(self, module: str, argument: str) -> None:
        """Register a module that cleans up containers or jobs, with the standard library only.

        Its ``resume(argument, run_id)`` resumes paused nodes, for their end. Its
        ``remove(argument, run_id, settle_s=..., give_up_s=...)`` removes containers or jobs until
        none was left for ``settle_s`` (more may appear), for ``give_up_s`` at most.
        """


@dataclass(frozen=True)
class NodeProgram:
    """The program that runs nodes.

    Attributes:
        options: of the program, as ``--debug``.
        cores: by node, the cores that it may use; other nodes may use any.
        pythons: by node, the Python that it needs in place of this one.
        guardian: of the run; ``None`` if it starts nothing.
        environ: the environment of the launcher.
        is_isolated: whether the nodes have a network of their own.
        program: the command without options and paths of ``node.json`` files.
    """

    options: Sequence[str] = ()
    cores: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    pythons: Mapping[str, Path] = field(default_factory=dict)
    guardian: Guardian | None = None
    environ: Mapping[str, str] = field(default_factory=dict)
    is_isolated: bool = False
    program: Sequence[str] = field(default_factory=lambda: python_command("neuros.cli", "node"))

    def command(self, python: Sequence[str] = ()) -> tuple[str, ...]:
        """The command with this Python, or with the command ``python``."""
        return (*(python or self.program[:1]), *self.program[1:], *self.options)


Notice: TypeAlias = tuple[str, str]  # a line for the user: severity (INFO, WARN) and text


class Deployment(ABC):
    """A back end ready for some nodes; the defaults are for nodes with this machine's paths.

    Attributes:
        transport: the name of the transport of the nodes, if not that of the back end.
    """

    transport = ""
    notices: Sequence[Notice] = ()
    places: Mapping[str, str] = {}
    """The machine of each node that runs on another one."""

    def connect(self, log: Callable[[str, str], None]) -> Sequence[str]:
        """Connect to the other machines and prepare them; returns their addresses.

        Args:
            log: receives ``(severity, text)`` for the user, in any thread.

        Raises:
            EnvironmentFault: with all faults; every machine is released then.
        """
        return ()

    @abstractmethod
    def launcher(self, program: NodeProgram) -> Launcher:
        """The launcher of the nodes."""

    def as_seen(self, file: NodeFile) -> NodeFile:
        """A node with its paths in the place where it runs."""
        return file

    def as_here(self, text: str, folders: Folders) -> str:
        """The output of a node, with its paths translated to this machine."""
        return text

    def control_listener(self, run_folder: Path) -> ControlListener | None:
        """The listener of the control channel; ``None``: a socket in the run folder."""
        return None

    def logs(self, run_folder: Path) -> Mapping[str, Path]:
        """Logs besides those of nodes, by their displayed origin."""
        return {}

    def finish(self, is_enough: Callable[[], bool]) -> Sequence[str]:
        """Fetch files of nodes on other machines, until ``is_enough()``; returns faults."""
        return ()

    def record(self) -> Mapping[str, Any]:
        """Facts about the deployment for ``run.json``, at the end of the run."""
        return {}


class FindingState(Enum):
    """The state of a finding."""

    GOOD = "ok"
    ABSENT = "-"  # projects run without it
    BAD = "PROBLEM"  # projects do not run, or not well


@dataclass(frozen=True)
class Finding:
    """A line of ``neuros doctor``."""

    state: FindingState
    subject: str
    text: str
    remedy: str = ""

    @classmethod
    def good(cls, subject: str, text: str) -> Finding:
        return cls(FindingState.GOOD, subject, text)

    @classmethod
    def absent(cls, subject: str, text: str, remedy: str = "") -> Finding:
        return cls(FindingState.ABSENT, subject, text, remedy)

    @classmethod
    def bad(cls, subject: str, text: str, remedy: str = "") -> Finding:
        return cls(FindingState.BAD, subject, text, remedy)

    def __str__(self) -> str:
        remedy = f": {self.remedy}" if self.remedy else ""
        return f"{self.state.value:<8} {self.subject:<12} {self.text}{remedy}"


class MachineCheck(ABC):
    """Checks this machine for ``neuros doctor``. An entry point of the group ``neuros.checks``."""

    @abstractmethod
    def checks(self, environ: Mapping[str, str]) -> Iterable[Finding]:
        """What ``neuros doctor`` finds."""


@dataclass(frozen=True)
class Subcommand:
    """A command of ``neuros``. Registered as an entry point of the group ``neuros.commands``.

    Attributes:
        module: is imported when the command is used. Its ``add_<command>(parser)`` adds arguments
            and sets the default ``command``, a function of the parsed arguments that returns the
            exit code. Its optional ``prepare_<command>(parser, arguments)`` adds options that
            depend on other arguments.
        help: the line in ``neuros --help``; empty for a command that only NeuROS uses.
    """

    module: str
    help: str = ""


@dataclass(frozen=True)
class Shown:
    """A run, for its views.

    Attributes:
        environment: variables of the nodes that the launcher does not have.
        logs: by node.
        names: the nodes of this run; other nodes of the project run elsewhere.
    """

    run_id: str
    folder: Path
    environment: Mapping[str, str]
    logs: Mapping[str, Path]
    project: Project
    names: Sequence[str]
    is_one_process: bool


class View(Protocol):
    """A view of a running run."""

    def start(self, run: Shown, guardian: Guardian, log: Callable[[str, str], None]) -> None:
        """Open the view, once there is a control socket; ``log`` takes ``(severity, text)``.

        Raises ``EnvironmentFault``.
        """

    def finish(self) -> None:
        """Close the view at the end of the run, even if it was not started."""


class LaunchExtension(ABC):
    """Further options of ``neuros launch``: each flag is an entry point of ``neuros.launch``."""

    options: Sequence[Option] = ()

    @abstractmethod
    def prepare(
        self, options: Mapping[str, Any], back_end: BackEnd, *, is_isolated: bool
    ) -> View | None:
        """The view that the options request; ``None`` if they request none.

        Args:
            options: the value of each of :attr:`options`, by name.
            back_end: of the run.
            is_isolated: whether the run has a network of its own.

        Raises:
            UsageError: for options that contradict each other.
            EnvironmentFault: if something is missing on this machine.
        """


@dataclass(frozen=True)
class RobotChoices:
    """What the file of a robot does not say.

    Attributes:
        base: ``free`` or ``fixed``; ``None``: the file says it, or the user is asked.
        drive: ``position``, ``velocity``, ``motor`` or ``none`` for every joint; ``None``: position
            for joints with limits, velocity for others.
    """

    base: str | None = None
    drive: str | None = None


class ModelFormat(ABC):
    """A format of models besides MuJoCo's own, an entry point of the group ``neuros.models``.

    Attributes:
        name: the suffix of its files, without the dot.
    """

    name: str

    @abstractmethod
    def find(self, name: str, folder: Path, environ: Mapping[str, str]) -> Path | None:
        """The file of a model that is not in the project.

        Args:
            name: a path, or a URI.
            folder: of the plugin.
        """

    @abstractmethod
    def read(self, file: Path, environ: Mapping[str, str]) -> tuple[Any, Sequence[str]]:
        """An ``MjSpec``, and a line for each part of the file that it lacks or changes.

        Raises:
            DescriptionError: with all problems of the file.
        """

    @abstractmethod
    def make_project(
        self, file: Path, folder: Path, environ: Mapping[str, str], choices: RobotChoices
    ) -> Sequence[str]:
        """Write a project around the robot of a file into a folder; what is in it, in lines.

        Raises:
            DescriptionError: with all problems of the file.
            UsageError: something is neither in the file nor chosen.
            OSError: the folder cannot be written.
        """


Job: TypeAlias = "Callable[[], Any]"
"""One run: a picklable callable, the result of which is picklable, too."""


@dataclass(frozen=True)
class JobResources:
    """Resources of a job on a cluster; ``None`` and 0: the cluster's default."""

    cpus: int | None = None
    mem_bytes: int | None = None
    gpus: int = 0

    @classmethod
    def of(cls, project: Project) -> JobResources:
        """The sum of the declared ``resources`` of all nodes.

        A GPU that several nodes name counts once; ``all`` counts as one GPU.
        """
        cpus = [node.resources.cpus for node in project.nodes if node.resources.cpus]
        memory = [node.resources.mem_bytes for node in project.nodes if node.resources.mem_bytes]
        gpus = {gpu for node in project.nodes for gpu in node.access.gpus}
        return cls(
            math.ceil(sum(cpus)) if cpus else None,
            sum(memory) if memory else None,
            max(len(gpus - {"all"}), int("all" in gpus)),
        )

    @classmethod
    def most(cls, needs: Iterable[JobResources]) -> JobResources:
        """The least resources that are enough for each of several jobs."""
        listed = list(needs)
        return cls(
            max((each.cpus for each in listed if each.cpus), default=None),
            max((each.mem_bytes for each in listed if each.mem_bytes), default=None),
            max((each.gpus for each in listed), default=0),
        )


@dataclass(frozen=True)
class SweepPlan:
    """A sweep, for its executor.

    Attributes:
        name: of the project.
        folder: of the sweep; the same path on every machine that executes runs.
        count: of runs at a time, ``None``: as many as there is room for.
        resources: of each run.
        distribution: with the code of the jobs, installed on every machine.
    """

    name: str
    folder: Path
    count: int | None
    resources: JobResources
    distribution: str


class Jobs(Protocol):
    """The jobs of a sweep."""

    def submit(self, jobs: Sequence[Job]) -> Sequence[Future[Any]]:
        """Submit jobs, in this order; the futures hold their results.

        Raises ``EnvironmentFault``.
        """

    def cancel(self) -> None:
        """End the running jobs; jobs that begin later return at once."""


class SweepExecutor(ABC):
    """Executes runs of sweeps. An entry point of the group ``neuros.executors``.

    Attributes:
        name: of the entry point, for ``--executor``.
        place: the word for the value of ``--executor NAME=...``, as ``ADDRESS``; empty: no value.
    """

    name: str
    place: str = ""

    @abstractmethod
    def open(self, place: str | None, plan: SweepPlan) -> AbstractContextManager[Jobs | Executor]:
        """Connect to the executor; the end of the context waits for running jobs.

        The context may be a pool of :mod:`concurrent.futures`.

        Raises:
            UsageError: for a wrong place or count.
            EnvironmentFault: if something is missing, or does not answer.
        """


class PluginCheck(ABC):
    """Checks the nodes of a plugin before a run. An entry point of ``neuros.plugin_checks``.

    The name of the entry point is that of the plugin's module.
    """

    @abstractmethod
    def problems(self, node: Node) -> Iterable[Problem]:
        """The mistakes that keep the node from running."""

    @abstractmethod
    def doubts(self, node: Node) -> Iterable[Problem]:
        """Possible mistakes, and parts that cannot be checked on this machine."""


class BackEnd(ABC):
    """Where nodes run. Registered as an entry point of the group ``neuros.backends``.

    Attributes:
        name: of the entry point, for ``--backend``.
        place: of a node, as in "each node in *a container*".
        rank: ``--backend auto`` chooses the usable back end of highest rank; ``None``: never.
        options: of ``neuros launch`` with this back end.
        transport: the name of the transport of its nodes.
        is_one_process: whether all nodes share a process. They run in turns then, and exchange
            packets in memory, invisible for ROS tools and other launchers.
        has_own_pythons: whether nodes run on Pythons of the back end (those of images).
        has_own_network: whether the back end makes the network of an isolated run, in place of the
            launcher.
        is_forked: whether the guardian starts its node processes, so that it may fork them.
    """

    name: str
    place: str
    rank: int | None = None
    options: Sequence[Option] = ()
    transport = "ros"
    is_one_process = False
    has_own_pythons = has_own_network = is_forked = False

    @abstractmethod
    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        """Prepare a run of the nodes.

        Args:
            options: the value of each of :attr:`options`, by name.

        Raises:
            EnvironmentFault: with everything that is missing, and remedies.
        """

    def why_not(self, fault: EnvironmentFault) -> str:
        """The reason why ``auto`` skips the back end, in one line; ``fault`` of :meth:`prepare`."""
        reason, *others = str(fault).splitlines()
        return f"{reason} (and {len(others)} more)" if others else reason

    def checks(self, environ: Mapping[str, str]) -> Iterable[Finding]:
        """Findings of ``neuros doctor`` about the needs of the back end."""
        return ()

    def on_this_machine(self, file: NodeFile, folders: Folders, messages: Path) -> NodeFile:
        """The inverse of :meth:`Deployment.as_seen`, after a run.

        ``messages``: the folder of built message packages on this machine.
        """
        return file

    def place_in(self, record: Mapping[str, Any], node: str) -> str:
        """The :attr:`place` of a node of a past run, by its ``run.json``."""
        return self.place

    def provenance(self, record: Mapping[str, Any]) -> Mapping[str, str]:
        """Facts of :meth:`Deployment.record` for reports, by heading."""
        return {}


class DeploymentKind(ABC):
    """Runs nodes by a deployment file, an entry point of ``neuros.deployments``."""

    name: str

    @abstractmethod
    def prepare(
        self,
        file: Path,
        project: Project,
        here: Callable[[Sequence[Node]], Deployment],
        *,
        monitors_load: bool,
    ) -> Deployment:
        """A deployment of all nodes.

        Args:
            here: prepares the nodes of this machine.
            monitors_load: whether the other machines record their load.

        Raises:
            ProjectError: with all problems of the file.
        """

    @abstractmethod
    def checks(self, file: Path, *, proves: bool) -> Iterable[Finding]:
        """Findings of ``neuros doctor`` about the machines of a file.

        ``proves``: start nodes there. Raises ``ProjectError``.
        """
