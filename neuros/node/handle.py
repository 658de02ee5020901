"""The ``node`` that every hook receives, the services behind it, and its results file."""

from __future__ import annotations

import json
import math
import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from neuros.engine.engine import Engine
from neuros.errors import ModelError, NodeError
from neuros.node.failures import Failures, as_node_error
from neuros.node.keeping import Keeping
from neuros.node.simulated_time import SimulatedTime
from neuros.node.virtual import VirtualTime, refuse_thread
from neuros.ordinary_files import write_whole
from neuros.ports import Advance, Logger, NodeEvents, Packets, WorldLook
from neuros.project.model import SEEDS, Node, NodeFile
from neuros.project.suggest import did_you_mean

_POLL_S = 0.05
Check: TypeAlias = "Callable[[Mapping[str, str]], object]"
_EMPTY = "std_msgs/msg/Empty"


class PluginServices:
    """Requests of a plugin, from its hooks and from its own threads, made through ``node``.

    Args:
        ask_for_end: called with ``reason`` and ``drain_s``, the seconds for draining.
        tell_progress: called with what a plugin says of its progress.
        show_world: called with what shows the simulated world of the node.
        drive: called with what advances a world that runs by itself; returns whether the node does
            that, so that no thread has to.

    Attributes:
        closers: called once when the node ends, last added first.
        changes: called when environment or parameters have changed, and before, as a check.
        engine: the node's, ``None`` until its plugin is loaded.
        is_active: set at time 0 of the run, when every node of the project is ready.
        is_ending: whether no further hook starts.
        results: what the plugin has noted.
            keeping: what it keeps.
        maker_of: the function that makes packets of the type of a port.
            time: that of the node, if it has one.
        virtual_time: that of the run; ``None``: the run is in real time.
        waiting_threads: those that wait until packets that they have offered are sent.
    """

    def __init__(
        self,
        packets: Packets,
        loop: NodeEvents,
        time: SimulatedTime,
        failures: Failures,
        ask_for_end: Callable[..., object],
        tell_progress: Callable[[str], object],
        show_world: Callable[[WorldLook], None],
        drive: Callable[[Advance], bool],
        results: Results,
        keeping: Keeping,
    ) -> None:
        self.engine: Engine | None = None
        self._thread_id = threading.get_ident()
        self.is_ending = False
        self.is_active = threading.Event()
        self.virtual_time: VirtualTime | None = None
        self.waiting_threads: set[threading.Thread] = set()
        self.maker_of = packets.maker
        self._loop = loop
        self.time = time
        self._failures = failures
        self._ask_for_end = ask_for_end
        self.tell_progress = tell_progress
        self.show_world = show_world
        self.drive = drive
        self.results = results
        self.keeping = keeping
        self.closers: list[Callable[[], None]] = []
        self.changes: list[tuple[Callable[[], object], Check]] = []

    def stop(self) -> None:
        """Start no further hook. Any thread."""
        self.is_ending = True
        if self.engine is not None:
            self.engine.stop_hooks()

    def shutdown(self, reason: str, drain_s: float) -> None:
        """Ask the supervisor for a drained end; this node starts no further hook."""
        if self.engine is not None:
            self.engine.stop_hooks()
        self._ask_for_end(reason=reason, drain_s=drain_s)

    def close(self) -> None:
        """Give up what the plugin holds, last opened first."""
        while self.closers:
            try:
                self.closers.pop()()
            except BaseException as error:  # the others must still be closed
                self._failures.report(as_node_error(error, "failed while it was closed: "))

    def reading(self, value: int) -> int:
        """What a hook reads of something that goes on by itself; any other thread just reads it."""
        engine = self.engine
        is_hook = engine is not None and engine.executing is not None
        if not is_hook or threading.get_ident() != self._thread_id:
            return value
        assert engine is not None
        return engine.reading(value)

    def note_time(self) -> bool:
        """Simulated time has gone on in another thread; returns whether it is not over."""
        is_over = self.time.is_over
        if is_over:
            self._loop.post_from_thread(lambda: self._failures.guard(self.time.update))
        return not is_over

    def fail_from_thread(self, error: BaseException) -> None:
        """End the project with an error that happened outside the hooks."""
        self._loop.post_from_thread(lambda: self._failures.report(error))

    def offer_from_thread(
        self, packets: Mapping[str, Any], accepted: Callable[[], None]
    ) -> Callable[[Callable[[], None]], None]:
        """Offer packets from another thread; returns a function that withdraws them."""
        withdrawals: list[Callable[[], None]] = []
        thread = threading.current_thread()

        def accept() -> None:
            self.waiting_threads.discard(thread)
            accepted()

        def offer() -> None:
            assert self.engine is not None
            self.waiting_threads.add(thread)
            withdrawals.append(self.engine.offer(packets, accept))
            if self.time.is_watched:
                self.time.update()

        def withdraw(done: Callable[[], None]) -> None:
            def event() -> None:
                self.waiting_threads.discard(thread)
                for each in withdrawals:
                    each()
                done()

            self._loop.post_from_thread(event)

        self._loop.post_from_thread(lambda: self._failures.guard(offer))
        return withdraw


class NodeHandle:
    """A node as its plugin sees it."""

    def __init__(self, file: NodeFile, ros_node: Any, services: PluginServices) -> None:
        self._file = file
        self._ros_node = ros_node
        self._services = services
        self._types = {port.name: port.type for port in file.node.outputs}
        self._makers: dict[str, Callable[[], Any]] = {}
        self._user_data: Any = None

    @property
    def name(self) -> str:
        """The node's name in the project."""
        return self._file.node.name

    @property
    def run_dir(self) -> Path:
        """This node's own writable folder in the run folder."""
        return self._file.folders.run / self.name

    @property
    def description(self) -> Node:
        """The node as its file declares it."""
        return self._file.node

    @property
    def copies(self) -> int:
        """The number of worlds that each hook serves at once, ``"copies"`` of the node; else 1."""
        return self._file.node.copies or 1

    @property
    def seeds(self) -> list[int]:
        """A seed of 64 bits for each copy, for example for ``numpy.random.default_rng``.

        They follow from the variable with SEED in its name in the environment of the node, by
        ``numpy.random.SeedSequence``; that of a copy does not depend on how many there are. After
        a reset with another seed they are other ones.

        Raises:
            NodeError: if the node has no such variable, several, or one that is no whole number.
        """
        if given := os.environ.get(SEEDS):
            found: list[int] = json.loads(given)
            return found
        names = [name for name in self._file.node.environment if "SEED" in name.upper()]
        if len(names) != 1:
            has = f"several: {', '.join(names)}" if names else "none"
            raise NodeError(
                f"seeds: node '{self.name}' needs one variable with SEED in its name in its"
                f" environment, and has {has}"
            )
        text = os.environ.get(names[0], "")
        if not (text.isascii() and text.isdigit()):
            raise NodeError(f"seeds: {names[0]}={text!r} is no whole number from 0 on")
        from numpy.random import SeedSequence

        sequences = (SeedSequence(int(text), spawn_key=(index,)) for index in range(self.copies))
        return [int(each.generate_state(1, "uint64")[0]) for each in sequences]

    @property
    def sim_time(self) -> float | None:
        """Simulated seconds as far as this node knows: of its simulator, or else of its clock.

        The clock is the input of type ``rosgraph_msgs/msg/Clock``; its time is that of the packet
        which a hook of the node started on last. ``None`` before the first one, and without it.
        """
        return self._services.time.known_s

    def now(self) -> Any:
        """A stamp, ``builtin_interfaces/msg/Time``: simulated time, or else wall time.

        It is simulated where the node has a simulator or a clock, and 0 before that is known.
        """
        return self._services.time.stamp(self.reading)

    def make_packet(self, output: str | None = None) -> Any:
        """A new message for an output, with default values, or an array of zeros.

        Args:
            output: its name; ``None`` where only one type can be meant: all outputs have it, or
                it is ``std_msgs/msg/Empty`` and one of them has that.

        Raises:
            NodeError: if the node has no such output, or several could be meant.
        """
        if output is None:
            return self._services.maker_of(self._only_type())()
        make = self._makers.get(output)
        if make is None:
            if output not in self._types:
                known = ", ".join(self._types) or "none"
                raise NodeError(
                    f"make_packet: node '{self.name}' has no output '{output}' (it has {known})"
                )
            make = self._makers[output] = self._services.maker_of(self._types[output])
        return make()

    def get_ros_node(self) -> Any:
        """The real ``rclpy.node.Node``; what is created on it is served between hooks."""
        return self._ros_node

    def get_topic_list(self) -> list[str]:
        """The names of all topics on the ROS graph; to look around, while a plugin is written."""
        return [name for name, _ in self._ros_node.get_topic_names_and_types()]

    def get_topic_info(self, topic: str) -> str:
        """Its type, and how many publish on it and listen to it, as ``ros2 topic info`` says it.

        Raises:
            NodeError: if there is no such topic on the ROS graph.
        """
        known = dict(self._ros_node.get_topic_names_and_types())
        name = self._file.names.full(topic, self.name)
        if name not in known:
            hint = did_you_mean(name, known)
            raise NodeError(
                f"get_topic_info: there is no topic '{name}' now{hint and f' ({hint})'}"
            )
        types = known[name]
        return (
            f"Type: {types[0] if len(types) == 1 else types}\n"
            f"Publisher count: {self._ros_node.count_publishers(name)}\n"
            f"Subscription count: {self._ros_node.count_subscribers(name)}"
        )

    def get_logger(self) -> Logger:
        """The logger of the ROS node."""
        logger: Logger = self._ros_node.get_logger()
        return logger

    def set_user_data(self, data: Any) -> None:
        """Keep something for the next hook."""
        self._user_data = data

    def get_user_data(self) -> Any:
        """The data of the last :meth:`set_user_data`, ``None`` before."""
        return self._user_data

    def set_result(self, name: str, value: Any) -> None:
        """Note a result of the run: it is in ``run.json``, and a column of a sweep's table.

        A later one of the same name takes its place. Each is written to ``results.json`` in
        :attr:`run_dir` at once: for figures at the end, or now and then, not for every packet.

        Args:
            value: what JSON knows, or NumPy's numbers and arrays. A float that is no finite number
                becomes ``None``.

        Raises:
            NodeError: for anything else.
        """
        try:
            self._services.results.set(name, value)
        except (TypeError, ValueError) as error:
            raise NodeError(f"set_result: '{name}' cannot be kept: {error}") from error

    def keep(self, name: str, get: Callable[[], Any], put: Callable[[Any], object]) -> None:
        """Keep a value, such as weights, beyond this run; call it in an initialise hook.

        After the finalise hooks, what ``get()`` returns is written to ``kept/<name>.npz`` in
        :attr:`run_dir`. Where a value of that name is restored (``--restore``, ``restore=`` of a
        run or session), or survives a reset of a session (``keep=``), ``put(value)`` is called
        before this returns. A plugin that stays loaded for a reset need not call it again:
        ``put(value)`` is called after its reset hooks then.

        Args:
            get: returns a NumPy array, ``bytes``, ``str``, ``int``, ``float``, ``bool`` or
                ``None``, or a ``list`` of these, or a ``dict`` of these with keys of type ``str``;
                lists and dicts may be nested.
            put: takes such a value, which is its own.

        Raises:
            NodeError: for a name that is none, or that is kept already; for what is no function.
        """
        self._services.keeping.register(name, get, put)

    def shutdown(self, reason: str = "", drain_s: float = 5.0) -> None:
        """End the project: drained within ``drain_s`` seconds, with exit code 0."""
        self._services.shutdown(str(reason), float(drain_s))

    def resolve_path(self, path: str) -> Path:
        """An existing file: absolute, or relative to plugin, node file or project folder.

        Raises:
            ModelError: if there is none, naming all places that were looked at, or if it lies
                outside of project, workspace and run folder.
        """
        node, folders = self._file.node, self._file.folders
        if path.startswith("@"):
            wanted = path[1:].lstrip("/")
            workspaces = (folders.project / "workspace", folders.workspace)
            places = [*(folder / wanted for folder in workspaces), *self._built(wanted)]
        else:
            wanted = path[1:].lstrip("/") if path.startswith("#") else path
            bases = dict.fromkeys((node.plugin.parent, node.file.parent, folders.project))
            places = [base / wanted for base in bases]
        for place in places:
            if place.exists():
                built = (python.parent for python in self._file.messages)
                roots = [folders.project, folders.workspace, folders.run, *built]
                if node.module:
                    roots.append(node.plugin.parent)  # a package brings its data along
                if not any(place.resolve().is_relative_to(root.resolve()) for root in roots):
                    raise ModelError(
                        f"'{path}' leaves the project's folder: files may be in the folder of the"
                        " project file, in the run folder, and with '@' in the workspace"
                    )
                return place
        raise ModelError(f"'{path}' does not exist: looked for {', '.join(map(str, places))}")

    def progress(self, text: str) -> None:
        """Tell the user how far a long hook has come; a finalise hook then has time again.

        A node that makes no progress for ``finalise_s`` seconds while it finalises is killed.
        """
        self._services.tell_progress(str(text))

    def expect_end(self, sim_s: float) -> None:
        """Tell after how many seconds of simulated time this plugin will end the project.

        It is for those who watch the run; the end itself is :meth:`shutdown`.
        """
        self._services.time.expected_end_s = float(sim_s)

    def _only_type(self) -> str:
        types = {*self._types.values()}
        if _EMPTY in types:
            return _EMPTY  # as the published NeuROS does
        if len(types) == 1:
            return types.pop()
        known = ", ".join(self._types) or "none"
        raise NodeError(f"make_packet: say for which output of node '{self.name}': {known}")

    def _built(self, wanted: str) -> list[Path]:
        """Where ``install/PACKAGE/path`` may be: in the folder of a built message package."""
        install, _, inner = wanted.partition("/")
        package, _, rest = inner.partition("/")
        folders = [python.parent for python in self._file.messages if install == "install"]
        return [f / rest for f in folders if f.name.rpartition("-")[0] == package]

    def own_simulated_time(self, read_s: Callable[[], float]) -> None:
        """Report simulated time, in seconds, by calling ``read_s`` (cheap, from any thread)."""
        self._services.time.own(read_s)

    def note_simulated_time(self) -> bool:
        """Tell, from any thread, that it has gone on; returns whether it is to go on further."""
        return self._services.note_time()

    def reading(self, value: int) -> int:
        """A reading, from 0, of something that goes on by itself, such as a clock of a device.

        A hook that computes with what this returns does the same in a replay: a recorded run keeps
        the value, and a replay returns that one. Elsewhere than in a hook, it is just the value.
        """
        return self._services.reading(value)

    def drive(self, advance: Advance) -> bool:
        """Have a world that runs by itself advanced without a thread of its own.

        Args:
            advance: goes on to the next packets that are due, and returns them by output.

        Returns:
            Whether the node does that, as in a replay; else the simulator needs its thread.
        """
        return self._services.drive(advance)

    def show_world(self, look: WorldLook) -> None:
        """Let observers look at a simulated world, as the dashboard does."""
        self._services.show_world(look)

    @property
    def virtual_time(self) -> VirtualTime | None:
        """The clock of a run in virtual time, for a simulator that steps itself."""
        return self._services.virtual_time

    def on_close(self, callback: Callable[[], None]) -> None:
        """Call ``callback`` once when the node ends, after its finalise hooks."""
        self._services.closers.append(callback)

    def on_change(self, callback: Callable[[], object], check: Check = lambda _: None) -> None:
        """Call ``callback`` when a fork of the run has changed environment or parameters.

        That is between two hooks; by then, ``os.environ`` and the parameters have the new values.

        Args:
            check: called with the variables that will change, long before; what it raises ends the
                fork.
        """
        self._services.changes.append((callback, check))

    def fail(self, error: BaseException) -> None:
        """End the node as failed, from any thread: for errors that no hook can raise."""
        self._services.fail_from_thread(error)

    @property
    def is_ending(self) -> bool:
        """Whether no further hook starts. Any thread."""
        return self._services.is_ending

    @property
    def is_paused(self) -> bool:
        """Whether the run is paused, as from the dashboard or by a session. Any thread."""
        engine = self._services.engine
        return engine is not None and engine.is_paused

    def wait_until_active(self, cancelled: Callable[[], bool]) -> bool:
        """Wait, in another thread, for time 0 of the run: every node of the project is ready.

        Returns False, before that, once ``cancelled()`` is true or the node ends.
        """
        while not self._services.is_active.wait(_POLL_S):
            if self._services.is_ending or cancelled():
                return False
        return True

    def submit(self, packets: Mapping[str, Any], cancelled: Callable[[], bool]) -> bool:
        """Send from another thread, as if a hook with those outputs had returned them.

        Waits while a reliable connection of one of the outputs is blocked; returns False, without
        having sent, once ``cancelled()`` is true or the node ends.

        Raises:
            NodeError: in virtual time.
        """
        if self.virtual_time is not None:
            raise refuse_thread(self.name, "submit")
        sent = threading.Event()
        withdraw = self._services.offer_from_thread(packets, sent.set)
        while not sent.wait(_POLL_S):
            if self._services.is_ending:
                return sent.is_set()
            if cancelled():
                withdrawn = threading.Event()
                withdraw(withdrawn.set)
                while not withdrawn.wait(_POLL_S) and not self._services.is_ending:
                    pass
                return sent.is_set()
        return True


class Results:
    """Results by name, on the disk as soon as they are known: a killed node keeps them."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "results.json"
        self._values: dict[str, Any] = {}

    def clear(self) -> None:
        self._values = {}
        self._file.unlink(missing_ok=True)

    def set(self, name: str, value: Any) -> None:
        """Keep a value. Raises ``TypeError`` or ``ValueError`` for what JSON does not know."""
        value = _plain(value) if hasattr(value, "tolist") else value
        is_finite = not isinstance(value, float) or math.isfinite(value)
        values = {**self._values, str(name): value if is_finite else None}
        text = json.dumps(values, indent=2, default=_plain, allow_nan=False)
        write_whole(self._file, f"{text}\n".encode())
        self._values = values


def _plain(value: Any) -> Any:
    """A number or an array of NumPy as Python's own."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"JSON cannot hold a {type(value).__name__}")
