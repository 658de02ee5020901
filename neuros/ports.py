"""All seams of NeuROS on one page: adapters (layer 4) implement what nodes and supervisor use."""

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
    """The log of a node: rclpy's logger, or one with these methods."""

    def debug(self, message: str) -> object: ...
    def info(self, message: str) -> object: ...
    def warning(self, message: str) -> object: ...
    def error(self, message: str) -> object: ...


class Inbox(Protocol):
    """A node, as its transport calls it: in the node's own thread, between hooks."""

    def on_packet(self, connection: Connection, packet: Packet) -> None:
        """A packet has arrived on a connection to this node."""

    def on_external_packet(self, port: Port, packet: Packet) -> None:
        """A packet has arrived on the external topic of an input."""

    def on_acknowledgement(self, connection: Connection, position: int) -> None:
        """Every taker at the far end has started on the packets up to ``position`` (from 1)."""

    def on_registered(self, connection: Connection) -> None:
        """The far end of an output's connection is there: the first packet cannot vanish."""


class Transport(Protocol):
    """Carries the packets of one node to its neighbours and back."""

    def open(self, inbox: Inbox) -> None:
        """Create the endpoints and begin to announce this node to its neighbours."""

    def sender(self, connections: Sequence[Connection]) -> Callable[[Packet], bytes | None]:
        """The function that sends a packet on connections of one output; may return its bytes."""

    def send_external(self, port: Port, packet: Packet) -> None:
        """Publish on the external topic of an output."""

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        """The function that tells the sender up to which position every taker has started."""

    @property
    def digests(self) -> Mapping[Connection, array[int]]:
        """Digests of all packets sent or received on connections that keep them; read once."""

    @property
    def compressed(self) -> Mapping[str, tuple[int, int]]:
        """By connection on which this node compresses: bytes before and after."""

    def note_execution(self) -> None:
        """A hook has ended: what has reached the node meanwhile comes before the next one."""

    def give_way(self) -> None:
        """That hook took long: what waits for other nodes of this process comes first, too."""

    def has_taken_in(self) -> bool:
        """Whether that has been handled."""

    def waiting_for(self) -> Sequence[Connection]:
        """Connections whose other end has not been found yet."""

    def close(self) -> None:
        """Give up all endpoints; further calls have no effect."""


class Packets(Protocol):
    """Operations on packets, for each message class worked out once."""

    def message_class(self, type_name: str) -> type:
        """The class of a message type in ROS notation. Raises ``EnvironmentFault``."""

    def make(self, type_name: str) -> Packet:
        """A new message with default values, for a type in ROS notation."""

    def checker(self, kind: type, *, for_jpeg: bool = False) -> Callable[[Packet], Packet]:
        """A check for packets of a class before they are sent, also as JPEG.

        It returns the packet, with the values that its receivers see; raises ``WrongValue``.
        """

    def copier(self, type_name: str) -> Callable[[Packet], Packet]:
        """A function from a checked packet of a type to one that shares nothing with it."""

    def encode(self, packet: Packet) -> bytes:
        """A packet as ROS serialises it."""

    def decode(self, type_name: str, data: bytes) -> Packet:
        """The inverse of :meth:`encode`, for a type in ROS notation."""


class Way(str, Enum):
    """How a packet passes a node that keeps it for the recording."""

    SENT = "sent"  # by an output, to other nodes or on its external topic
    TO_ITSELF = "to itself"  # on a connection of the node to itself
    HEARD = "heard"  # on the external topic of an input
    RECEIVED = "received"  # on a connection whose sender is not part of this run


class PacketRecorder(Protocol):
    """Takes the packets of a node that are recorded."""

    def stream(self, way: Way, name: str) -> int | None:
        """The number for packets of a port (by ``way``: connection); ``None``: not recorded."""

    def keep(self, stream: int, data: bytes, sim_time_s: float | None) -> None:
        """Keep a serialised packet, with the simulated time of the node if it owns one.

        Raises ``OSError`` if it cannot be kept, and nothing after it either.
        """

    def close(self) -> None:
        """Keep nothing any more."""


class EventLoop(Protocol):
    """The one thread in which all nodes of a process run: one event at a time, oldest first."""

    @property
    def has_waiting_events(self) -> bool:
        """Whether events of engines wait."""

    @property
    def has_taken_in(self) -> bool:
        """Whether all that had come from outside has been handled; at a loop-back it has."""

    def note_execution(self) -> None:
        """A hook, or a callback of a plugin, has ended: something may have arrived meanwhile."""

    def post(self, event: Callable[[], None]) -> None:
        """Handle ``event`` after everything that already waits. Loop thread only."""

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """The same, and after everything that waits outside (in ROS), too."""

    def post_from_thread(self, event: Callable[[], None]) -> None:
        """Like :meth:`post`, from any thread; wakes the loop."""

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Callable[[], None]) -> None:
        """Call ``on_due`` whenever the monotonic clock reaches ``next_due_ns()``."""

    def run(self) -> None:
        """Handle events until :meth:`stop`."""

    def stop(self) -> None:
        """End :meth:`run` after the current event. Any thread."""


class Voice(Protocol):
    """Publishes the state of a launcher to its peers."""

    def say(self, text: str) -> None:
        """Let it be heard elsewhere, also by who comes later. Any thread."""

    def close(self) -> None:
        """Let the last state arrive, then be silent."""


class Middleware(Protocol):
    """Joins the nodes of this process to each other and to the rest of the world."""

    @property
    def loop(self) -> EventLoop: ...

    @property
    def packets(self) -> Packets: ...

    def transport(self, file: NodeFile) -> Transport:
        """The transport of one node; creates its ROS node."""

    def ros_node(self, file: NodeFile) -> Any:
        """The real ``rclpy.node.Node`` of a node that has a transport."""

    def mark_own_entities(
        self, file: NodeFile, enter: Callable[[], None], fail: Callable[[Any, BaseException], None]
    ) -> None:
        """Remember what exists on a ROS node before its plugin gets hold of it.

        ``enter`` is called before each callback of subscriptions, timers, services, clients and
        actions that the plugin creates there, ``fail`` with the callback and what it has raised.
        """

    def has_foreign_entities(self, file: NodeFile) -> bool:
        """Whether a plugin has subscriptions, timers, services or clients on its ROS node."""

    def join_peers(
        self,
        names: Sequence[str],
        elsewhere: Sequence[str],
        heard: Callable[[str, str | None], None],
    ) -> Voice:
        """Speak for the nodes ``names`` of this process, and listen to nodes elsewhere.

        ``heard`` is called from any thread, with a node and its state, or ``None`` when it is gone.
        """

    def take_in(self) -> None:
        """Handle what had arrived when the loop was stopped, so that it counts; call no plugin."""

    def flush(self) -> None:
        """Send and receive nothing any more, and let what was sent last leave."""

    def close(self) -> None:
        """Give up everything, once flushed."""


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

        ``on_failure`` takes what fails outside of hooks; ``digests``: keep one of every packet,
        whatever that costs; ``record``: packets are recorded; ``debug``: log DEBUG records.
        """


WorldLook: TypeAlias = "Callable[[Mapping[str, Any], int], Mapping[str, Any]]"
"""Shows a simulated world to an observer, for JSON, from any thread: what it wants, its number."""


class NodeContext(Protocol):
    """The ``node`` that hooks receive, as far as simulators need it."""

    @property
    def name(self) -> str:
        """Its name in the project."""

    @property
    def run_dir(self) -> Path:
        """Its own writable folder in the run folder."""

    @property
    def description(self) -> Node:
        """The node as its file declares it (ports, ``mujoco`` keys, environment)."""

    def make_packet(self, output: str) -> Packet:
        """A new message of the type of an output."""

    def get_logger(self) -> Logger:
        """A logger that writes to the node's log."""

    def resolve_path(self, path: str) -> Path:
        """An existing file, looked up as paths in node files are. Raises ``ModelError``."""

    def own_simulated_time(self, read_s: Callable[[], float]) -> None:
        """Report simulated time, in seconds, by calling ``read_s`` (cheap, from any thread)."""

    def note_simulated_time(self) -> bool:
        """Tell, from any thread, that it has gone on; returns whether it is to go on further."""

    def wait_until_active(self, cancelled: Callable[[], bool]) -> bool:
        """Wait, in a thread, for time 0 of the run; False if ``cancelled()`` or the node ends."""

    def show_world(self, look: WorldLook) -> None:
        """Let observers look at a simulated world; see :mod:`neuros.simulators.mujoco.scene`."""

    def submit(self, packets: Mapping[str, Packet], cancelled: Callable[[], bool]) -> bool:
        """Send from another thread, as if a hook had returned them; wait while one is blocked.

        Returns ``False``, without having sent, once ``cancelled()`` is true or the node ends.
        """

    def on_close(self, callback: Callable[[], None]) -> None:
        """Call ``callback`` once when the node ends, after its finalise hooks."""

    def fail(self, error: BaseException) -> None:
        """End the node as failed by ``error``, which no hook raised. Any thread."""


class Simulator(Protocol):
    """A world with a time of its own."""

    @property
    def sim_time(self) -> float:
        """Simulated seconds since the start."""

    @property
    def timestep(self) -> float:
        """Simulated seconds per step."""

    def step_synchronous(self, count: int = 1) -> None:
        """Advance ``count`` timesteps; nothing is sent. Raises ``ModelError``."""

    def step_to_next(self) -> None:
        """Advance to the next firing of any sensor."""

    def read(self, output: str) -> Packet | None:
        """The packet of a sensor that has come due since the last read, if there is one."""

    def run_asynchronous(self, real_time_factor: float | None = 1.0) -> None:
        """Step in a thread of its own, so many simulated seconds per wall second (None: freely)."""

    def pause(self) -> None:
        """Let no further step begin."""

    def resume(self) -> None:
        """Go on after :meth:`pause`; the time between is not caught up."""

    def reset(self) -> None:
        """Back to time zero and the initial state; unread packets are dropped."""


class ControlStream(Protocol):
    """Bytes to and from another process, in order: a connected ``socket.socket`` is one."""

    def fileno(self) -> int:
        """For selectors: readable when :meth:`recv` does not wait."""

    def setblocking(self, flag: bool, /) -> None:
        """Whether calls wait; else they raise ``BlockingIOError``."""

    def recv(self, size: int, /) -> bytes:
        """What has arrived; empty once the other end is gone. Raises ``OSError``."""

    def send(self, data: bytes | bytearray, /) -> int:
        """Send as much as can be; returns the number of bytes. Raises ``OSError``."""

    def sendall(self, data: bytes, /) -> None:
        """Send all. Raises ``OSError``."""

    def close(self) -> None:
        """Hang up."""


class ControlListener(Protocol):
    """The supervisor's end of the control channel, before others connect; from a back end."""

    @property
    def address(self) -> str:
        """By which processes on this machine connect: ``unix:/runs/1/control.sock``."""

    @property
    def files(self) -> Sequence[Path]:
        """What remains where the launcher is killed."""

    def open(self) -> None:
        """Listen. Raises ``EnvironmentFault``."""

    def fileno(self) -> int:
        """For selectors: readable when somebody connects."""

    def accept(self) -> ControlStream | None:
        """The next connection; ``None`` if nobody waits."""

    def close(self) -> None:
        """Listen no more."""


class RunningNode(Protocol):
    """A started process or container, and the nodes that live in it."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def poll(self) -> str | None:
        """``None`` while it runs, then how it ended: "exit code 0", "killed by SIGKILL"."""

    @property
    def is_abandoned(self) -> bool:
        """Whether what it ran in has gone (its engine), so that its node is not to blame."""

    def kill(self) -> None: ...

    def threads(self) -> ProcessThreads:
        """Where its threads stand in Python; empty if that cannot be read."""


class Launcher(Protocol):
    """Starts nodes, and knows nothing of what they do."""

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningNode]:
        """Start all or none, with this added to their environment. Raises ``EnvironmentFault``."""

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line per thing that :meth:`start` would start."""


class ChildProcess(Protocol):
    """A process that leads a session and a process group of its own."""

    pid: int

    def poll(self) -> int | None:
        """``None`` while it runs, then its exit code, negative for a signal."""

    def wait(self, timeout_s: float) -> None:
        """Until it has ended, or ``timeout_s`` seconds have passed."""

    def send_signal(self, number: int, *, is_for_group: bool = False) -> None:
        """Send a signal to it, or to its process group; does nothing where it has ended."""


class Reaper(Protocol):
    """Ends what is left of a run when its launcher has ended, be it by SIGKILL."""

    def spawn(
        self,
        command: Sequence[str],
        log: Path,
        folder: Path,
        environment: Mapping[str, str],
        cores: Sequence[int] = (),
    ) -> ChildProcess:
        """Start a process in a session of its own, without input; its output goes to the log.

        All that descends from it ends with the run. Raises ``OSError``.
        """

    def watch(self, pid: int) -> None:
        """Announce another process, which leads a session of its own."""

    def remove_later(self, path: Path) -> None:
        """Have a file, socket or folder removed once all processes of the run are gone."""

    def clean_with(self, module: str, argument: str) -> None:
        """Have a module clean up what is no process of this machine: containers, jobs.

        It needs the standard library only. Its ``resume(argument, run_id)`` lets paused nodes go
        on, to end. Its ``remove(argument, run_id, settle_s=..., give_up_s=...)`` removes what is
        left, until nothing was for ``settle_s`` (more may be under way), or after ``give_up_s``.
        """


@dataclass(frozen=True)
class NodeProgram:
    """The program that runs nodes, and what a run gives it.

    Attributes:
        options: of the program, as ``--debug``.
        cores, pythons: by name, of nodes that ask for some, or do not run on this Python.
        reaper: starts processes, and is told of all else that is; ``None`` where nothing is.
        environ: the environment of the launcher.
        is_isolated: whether the nodes are to have a network of their own.
        program: the command without its options; paths of ``node.json`` files follow these.
    """

    options: Sequence[str] = ()
    cores: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    pythons: Mapping[str, Path] = field(default_factory=dict)
    reaper: Reaper | None = None
    environ: Mapping[str, str] = field(default_factory=dict)
    is_isolated: bool = False
    program: Sequence[str] = field(default_factory=lambda: python_command("neuros.cli", "node"))

    def command(self, python: Sequence[str] = ()) -> tuple[str, ...]:
        """The command on this Python, or on the one that ``python`` starts."""
        return (*(python or self.program[:1]), *self.program[1:], *self.options)


Notice: TypeAlias = tuple[str, str]  # a line for the user: severity (INFO, WARN) and text


class Deployment(ABC):
    """A back end made ready for some nodes; defaults are for nodes that see files as we do."""

    notices: Sequence[Notice] = ()
    places: Mapping[str, str] = {}
    """The machine of each node that is not on this one."""

    def connect(self, log: Callable[[str, str], None]) -> Sequence[str]:
        """Reach the other machines and get them ready; returns their addresses.

        Args:
            log: takes lines for the user, as ``(severity, text)``, in any thread.

        Raises:
            EnvironmentFault: with all that went wrong; none of them is held any more then.
        """
        return ()

    @abstractmethod
    def launcher(self, program: NodeProgram) -> Launcher:
        """What starts the nodes."""

    def as_seen(self, file: NodeFile) -> NodeFile:
        """A node with all paths as it sees them itself."""
        return file

    def as_here(self, text: str, folders: Folders) -> str:
        """What a node has said, with the names that its paths have on this machine."""
        return text

    def control_listener(self, run_folder: Path) -> ControlListener | None:
        """Where node processes connect to the supervisor; ``None``: a socket in the run folder."""
        return None

    def logs(self, run_folder: Path) -> Mapping[str, Path]:
        """Logs besides those of the nodes, by what is shown of their origin."""
        return {}

    def finish(self, is_enough: Callable[[], bool]) -> Sequence[str]:
        """Bring here what nodes have left elsewhere, until ``is_enough()``; returns faults."""
        return ()

    def record(self) -> Mapping[str, Any]:
        """What ``run.json`` is to have of it, ready for JSON; asked for when the run is over."""
        return {}


class State(Enum):
    """How good a finding is."""

    GOOD = "ok"
    ABSENT = "-"  # projects run without it
    BAD = "PROBLEM"  # projects do not run, or not well


@dataclass(frozen=True)
class Finding:
    """One line of ``neuros doctor``: what was looked at, what was found, what to do."""

    state: State
    subject: str
    text: str
    remedy: str = ""

    @classmethod
    def good(cls, subject: str, text: str) -> Finding:
        return cls(State.GOOD, subject, text)

    @classmethod
    def absent(cls, subject: str, text: str, remedy: str = "") -> Finding:
        return cls(State.ABSENT, subject, text, remedy)

    @classmethod
    def bad(cls, subject: str, text: str, remedy: str = "") -> Finding:
        return cls(State.BAD, subject, text, remedy)

    def __str__(self) -> str:
        remedy = f": {self.remedy}" if self.remedy else ""
        return f"{self.state.value:<8} {self.subject:<12} {self.text}{remedy}"


@dataclass(frozen=True)
class Subcommand:
    """A command of ``neuros``. Registered as an entry point of the group ``neuros.commands``.

    Attributes:
        module: is imported when the command is used. Its ``add_<command>(parser)`` adds the
            arguments and sets the default ``command``, which is called with the parsed arguments
            and returns the exit code. With ``prepare_<command>(parser, arguments)`` it adds options
            that depend on others.
        help: its line in ``neuros --help``; empty for a program that NeuROS starts itself.
        is_for_people: whether its output goes to a terminal, and not to a log or a program.
    """

    module: str
    help: str = ""
    is_for_people: bool = True


@dataclass(frozen=True)
class Shown:
    """The run that is shown.

    Attributes:
        environment: what the environment of its nodes has beside that of the launcher.
        logs: by node.
        names: the nodes of this run; the others of the project run elsewhere.
    """

    run_id: str
    folder: Path
    environment: Mapping[str, str]
    logs: Mapping[str, Path]
    project: Project
    names: Sequence[str]
    is_one_process: bool


class View(Protocol):
    """Shows one run while it goes on."""

    def start(self, run: Shown, reaper: Reaper, log: Callable[[str, str], None]) -> None:
        """Open it, once there is a control socket; ``log`` tells the user, with a severity.

        Raises ``EnvironmentFault``.
        """

    def finish(self) -> None:
        """Close it with the run, also where it was not started."""


class LaunchExtension(ABC):
    """Further options of ``neuros launch``: each flag is an entry point of ``neuros.launch``."""

    options: Sequence[Option] = ()

    @abstractmethod
    def prepare(
        self, options: Mapping[str, Any], back_end: BackEnd, *, is_isolated: bool
    ) -> View | None:
        """Find what is needed to show the run as the options want it; ``None``: they want nothing.

        Args:
            options: the value of each of :attr:`options`, by name.
            back_end: of the run.
            is_isolated: whether the run has a network of its own.

        Raises:
            UsageError: for values that make no sense.
            EnvironmentFault: if something is missing here.
        """


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
            name: as the user gave it; may be relative, or a URI.
            folder: of the plugin.
        """

    @abstractmethod
    def read(self, file: Path, environ: Mapping[str, str]) -> tuple[Any, Sequence[str]]:
        """An ``MjSpec``, and a line for each part of the file that it lacks, or has otherwise.

        Raises:
            DescriptionError: with all problems of the file.
        """


Job: TypeAlias = "Callable[[], Any]"
"""One run: a picklable callable, the result of which is picklable, too."""


@dataclass(frozen=True)
class JobResources:
    """What a job asks a cluster for; ``None`` and 0: nothing, so the cluster's default holds."""

    cpus: int | None = None
    mem_bytes: int | None = None
    gpus: int = 0

    @classmethod
    def of(cls, project: Project) -> JobResources:
        """The ``resources`` of all nodes summed.

        What a node does not declare counts nothing. A GPU that several nodes name counts once;
        ``all`` stands for those that the job gets, and asks for one.
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
        """What is enough for each of several jobs."""
        listed = list(needs)
        return cls(
            max((each.cpus for each in listed if each.cpus), default=None),
            max((each.mem_bytes for each in listed if each.mem_bytes), default=None),
            max((each.gpus for each in listed), default=0),
        )


@dataclass(frozen=True)
class SweepPlan:
    """A sweep whose runs are to be executed.

    Attributes:
        name: of the project.
        folder: of the sweep, which every machine that executes runs sees under this path.
        count: how many runs at once, ``None``: as many as there is room for.
        resources: of each run.
        distribution: has the code of the jobs; machines that execute them have it, too.
    """

    name: str
    folder: Path
    count: int | None
    resources: JobResources
    distribution: str


class Jobs(Protocol):
    """The jobs of one sweep."""

    def submit(self, jobs: Sequence[Job]) -> Sequence[Future[Any]]:
        """Hand over jobs, in this order; the futures have what they return.

        Raises ``EnvironmentFault``.
        """

    def cancel(self) -> None:
        """End the jobs. Those that begin later return at once by themselves."""


class SweepExecutor(ABC):
    """What executes runs of sweeps. An entry point of the group ``neuros.executors``.

    Attributes:
        name: in ``--executor``; that of the entry point.
        place: what ``--executor NAME=...`` names, as ``ADDRESS``; empty: nothing.
    """

    name: str
    place: str = ""

    @abstractmethod
    def open(self, place: str | None, plan: SweepPlan) -> AbstractContextManager[Jobs | Executor]:
        """Connect to what executes; the end of the context waits for the jobs that go on.

        A pool of :mod:`concurrent.futures` will do.

        Raises:
            UsageError: for a place or a count that makes no sense.
            EnvironmentFault: if something is missing, or does not answer.
        """


class PluginCheck(ABC):
    """Checks nodes before a run. An entry point of the group ``neuros.plugin_checks``.

    Its name is that of a module, the plugin of these nodes.
    """

    @abstractmethod
    def problems(self, node: Node) -> Iterable[Problem]:
        """What keeps the node from running."""

    @abstractmethod
    def doubts(self, node: Node) -> Iterable[Problem]:
        """What may not be meant so, or cannot be checked here."""


class BackEnd(ABC):
    """Where nodes run. Registered as an entry point of the group ``neuros.backends``.

    Attributes:
        name: in ``--backend``; that of the entry point.
        place: where it runs a node, as in "each node in *a container*".
        rank: ``--backend auto`` takes the usable one with the highest; ``None``: never this one.
        options: of ``neuros launch`` with this back end.
        transport: the name of the transport that its nodes use.
        is_one_process: whether all nodes share a process. They take turns then, and hand packets
            over in memory, where ROS tools and other launchers do not see them.
        has_own_pythons: whether nodes run on Pythons that it brings (those of images).
        has_own_network: whether it gives an isolated run its network; else the launcher enters one.
    """

    name: str
    place: str
    rank: int | None = None
    options: Sequence[Option] = ()
    transport = "ros"
    is_one_process = False
    has_own_pythons = has_own_network = False

    @abstractmethod
    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        """Find what the nodes need to run here.

        Args:
            options: the value of each of :attr:`options`, by name.

        Raises:
            EnvironmentFault: with all that is missing, and what to do.
        """

    def why_not(self, fault: EnvironmentFault) -> str:
        """Why ``auto`` does not take it, in one line, for what :meth:`prepare` has raised."""
        reason, *others = str(fault).splitlines()
        return f"{reason} (and {len(others)} more)" if others else reason

    def checks(self, environ: Mapping[str, str]) -> Iterable[Finding]:
        """What ``neuros doctor`` finds of what it needs."""
        return ()

    def on_this_machine(self, file: NodeFile, folders: Folders, messages: Path) -> NodeFile:
        """The inverse of :meth:`Deployment.as_seen`, for a run that is over.

        ``messages`` is the folder with built message packages of this machine.
        """
        return file

    def place_in(self, record: Mapping[str, Any], node: str) -> str:
        """Where a node of a run that is over has run, as :attr:`place`, by its ``run.json``."""
        return self.place

    def provenance(self, record: Mapping[str, Any]) -> Mapping[str, str]:
        """What reports show of :meth:`Deployment.record`, by heading."""
        return {}


class DeploymentKind(ABC):
    """How nodes run where a deployment file says, an entry point of ``neuros.deployments``."""

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
        """A deployment of all nodes; raises ``ProjectError`` with all problems of the file.

        ``here`` makes nodes ready that run on this machine; ``monitors_load``: whether the others
        are to write their system load.
        """

    @abstractmethod
    def checks(self, file: Path, *, proves: bool) -> Iterable[Finding]:
        """What ``neuros doctor`` finds of the machines of a file; ``proves``: with nodes there.

        Raises ``ProjectError``, too.
        """
