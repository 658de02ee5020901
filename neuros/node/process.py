"""The program of every process and container: one or more nodes in one event loop."""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import selectors
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum
from pathlib import Path
from typing import cast

import neuros.control as control
from neuros.control import ELSEWHERE_VARIABLE, TO_NODES, Message
from neuros.control.link import ControlLink
from neuros.engine.engine import Engine
from neuros.errors import ControlError, NeurosError
from neuros.node.context import ContextSwitch
from neuros.node.failures import as_node_error, callback_error
from neuros.node.node import NodeRuntime
from neuros.node.peer_link import PeerLink
from neuros.node.reports import declared
from neuros.ports import Changes, ControlStream, Middleware, PacketRecorder, VirtualRun
from neuros.project.model import NodeFile
from neuros.project.timing import VIRTUAL
from neuros.stacks import allow_reading

_LONGEST_S = 60.0
"""A file that stays open for longer, and does not grow, is no progress."""


class Saving:
    """The files that a node has opened for writing, in its folder, since it began to finalise.

    A file may grow late: Python writes it in pieces of 8 KiB, some libraries only when they close
    it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._since_s = time.monotonic()
        self._before = {*self._open_files()}

    @property
    def is_writing(self) -> bool:
        """Whether one of them is open. Any thread."""
        if time.monotonic() - self._since_s > _LONGEST_S:
            return False
        return any(each not in self._before for each in self._open_files())

    def _open_files(self) -> Iterator[Path]:
        for number in os.listdir("/proc/self/fd"):
            try:
                path = Path(os.readlink(f"/proc/self/fd/{number}"))
                info = Path(f"/proc/self/fdinfo/{number}").read_text("ascii")
            except OSError:  # closed meanwhile, this listing itself among them
                continue
            flags = int(info.split("flags:", 1)[1].split(None, 1)[0], 8)
            if flags & os.O_ACCMODE != os.O_RDONLY and path.is_relative_to(self._folder):
                yield path


MiddlewareFactory = Callable[[Sequence[NodeFile], Callable[[BaseException], None]], Middleware]
Event = Callable[[], None]

_REPORT_S = 1.0
_DRAIN_S = 5.0


class ProcessStage(IntEnum):
    """How far a node process has come; it never goes back."""

    LOADING = 0
    INITIALISING = 1
    ACTIVE = 2
    ENDING = 3


class NodeProcess:
    """Runs nodes until the supervisor, a signal or a failure ends it.

    Args:
        files: the nodes that live here.
        make_middleware: joins them to the world; it may take its time to import ROS.
        connect: connects to the supervisor; the current folder is the run folder by then.
        open_recorder: where a node puts what is recorded; ``None``: nothing is.
        duration_sim_s: simulated time after which the node that owns it ends the project.
        duration_s: virtual time after which the project ends.
        real_time_factor: seconds of virtual time per second of the machine, at most.
        fork: seconds of virtual time, and what changes there: by node, variables of its
            environment and parameters.
        is_held: whether nodes stand still from the start, for a session.
        own_logs: whether each node writes to a log file of its own (several nodes share the
            process), rather than to the output that the process was started with.
    """

    def __init__(
        self,
        files: Sequence[NodeFile],
        make_middleware: MiddlewareFactory,
        connect: Callable[[], ControlStream],
        *,
        open_recorder: Callable[[NodeFile], PacketRecorder] | None = None,
        duration_sim_s: float | None = None,
        duration_s: float | None = None,
        real_time_factor: float | None = None,
        fork: tuple[float, Changes] | None = None,
        is_held: bool = False,
        own_logs: bool = False,
    ) -> None:
        self._files = files
        self._duration_s = duration_s
        self._real_time_factor = real_time_factor
        self._fork = fork
        self._make_middleware = make_middleware
        self._connect = connect
        self._open_recorder = open_recorder
        self._duration_sim_s = duration_sim_s
        self._is_held = is_held
        self._own_logs = own_logs
        self._contexts = ContextSwitch()
        self._nodes: dict[str, NodeRuntime] = {}
        self._middleware: Middleware | None = None
        self._virtual: VirtualRun | None = None
        self._early_events: list[Event] = []
        self._early_lock = threading.Lock()
        self._stage, self._stage_lock = ProcessStage.LOADING, threading.Lock()
        self._has_begun = False  # whether hooks may have run; it stays while the process ends
        self._has_failed = False
        self._goes_on = threading.Event()  # begins or ends
        self._asked: control.Probe | None = None
        self._once_idle: list[Event] = []
        self._saving: tuple[str, Saving] | None = None  # of the node that finalises
        self._has_been_reset = False
        self._tell_lock = threading.Lock()
        self._link: ControlLink | None = None
        self._peers = PeerLink(
            [file.node.name for file in files], os.environ.get(ELSEWHERE_VARIABLE, ""), self._tell
        )

    def run(self) -> int:
        """Run to the end; returns 0 if it was asked to end, 1 if a node failed.

        Whoever has made the middleware closes it, as the last act of the process.
        """
        run_folder = self._files[0].folders.run
        os.chdir(run_folder)
        self._link = ControlLink(self._connect(), TO_NODES, "the supervisor")
        allow_reading()
        plugins = {file.node.name: str(file.node.plugin) for file in self._files}
        self._tell(control.Hello(tuple(plugins), plugins))
        with signals_as_socket() as (signalled, waker):
            thread = ControlThread(self._link, signalled, self)
            thread.start()
            self._guard(self._live)
            self.report()  # hooks are over: what peers want to know is known before a long end
            for node in self._nodes.values():
                self._saving = node.name, Saving(node.run_dir)
                self._guard(functools.partial(node.finalise, runs_hooks=self._has_begun))
                self._guard(functools.partial(self._report_last, node))
            self._guard(self._peers.close)
            if self._middleware is not None:
                self._guard(self._middleware.flush)
            thread.end(waker)
        return 1 if self._has_failed else 0

    # ------------------------------------------------------------------ called by the supervisor

    def handle(self, message: Message) -> None:
        """Do what the supervisor asks for, between two events where hooks are concerned."""
        match message:
            case control.Begin():
                self.post(self._begin)
                self._goes_on.set()
            case control.Stop():
                self.ask_to_stop()
            case control.StopHooks():
                for node in tuple(self._nodes.values()):
                    node.stop()
            case control.Leave():
                self._peers.leave()
            case control.PublishState(text):
                self._peers.publish(text)
            case control.GetStatus(wanted, asker):
                for node in tuple(self._nodes.values()):
                    self._tell(node.reports.status(wanted.get(node.name, {}), asker))
            case _:
                self.post(lambda: self._handle_in_loop(message))

    def _handle_in_loop(self, message: Message) -> None:
        if self.is_ending:
            return
        nodes = self._nodes.values()
        match message:
            case control.Activate():
                self._reach(ProcessStage.ACTIVE)
                self._change(only_checks=True)
                for node in nodes:
                    node.activate()
                for node in nodes:
                    node.on_timer()
            case control.Probe(once_idle=False):
                self._answer(message)
            case control.Probe():
                self._asked = message
                self._when_idle(self._answer_asked)
            case control.Reset():
                if why_not := self._why_not_reset():
                    self._tell(control.WasReset(why_not))
                    return
                for node in nodes:
                    node.pause()  # takes back what is left of steps, which might go on for ever
                self._when_idle(lambda: self._reset(message))
            case control.Drain(last_round, is_asked):
                if any(node.is_paused for node in nodes):
                    self._go_on(is_stepped=False)
                for node in nodes:
                    node.drain(last_round.get(node.name, ()), is_asked=is_asked)
            case control.Pause(at_ns):
                if at_ns is not None and self._virtual is not None:
                    self._virtual.rest(at_ns)
                for node in nodes:
                    node.pause()
            case control.Resume():
                self._asked = None  # where the run goes freely, an answer would hold it again
                self._go_on(is_stepped=False)
                for node in nodes:
                    node.resume()
            case control.Step(count, is_driven, virtual_ns):
                self._go_on(is_stepped=True)
                for node in nodes:
                    if virtual_ns:
                        node.run_for(virtual_ns)
                    else:
                        node.step(count, is_driven=is_driven)
            case control.Deliver(name, input_name, data) if name in self._nodes:
                self._nodes[name].deliver(input_name, data)
            case control.Change(name) if name in self._nodes:
                self._nodes[name].change(
                    message.variables, message.parameters, only_checks=message.only_checks
                )

    def ask_to_stop(self) -> None:
        """Start no further hook, then finalise and end. Any thread."""
        self._reach(ProcessStage.ENDING)
        self._goes_on.set()
        for node in tuple(self._nodes.values()):
            node.stop()
        if self._middleware is not None:
            self._middleware.loop.stop()

    def on_supervisor_gone(self) -> None:
        """End, and wait for no peer. Any thread."""
        self.ask_to_stop()
        self._peers.leave()

    def post(self, event: Event) -> None:
        """Have an event handled by the loop, as soon as there is one. Any thread."""
        with self._early_lock:
            if self._middleware is None:
                self._early_events.append(event)
                return
        self._middleware.loop.post_from_thread(event)

    def report(self) -> None:
        """Report state and counters of all nodes. Any thread."""
        for node in tuple(self._nodes.values()):
            if not self.is_ending:  # else a log that grows would pass for progress of the plugin
                node.reports.write_logs()
            self._tell(node.reports.report())
        if self._saving is not None:
            name, saving = self._saving
            if saving.is_writing:
                self._tell(control.Progress(name))

    def _report_last(self, node: NodeRuntime) -> None:
        node.reports.write_logs()
        self._tell(node.reports.report(is_final=True))

    def _answer(self, asked: control.Probe) -> None:
        """Tell where all nodes stand at one moment."""
        assert self._middleware is not None
        is_idle = not self._middleware.loop.has_waiting_events
        # A thread besides those of NeuROS that does not wait for a connection may wake a node.
        bound = {threading.main_thread(), threading.current_thread()}
        bound.update(*(node.waiting_threads for node in self._nodes.values()))
        has_free_threads = any(
            thread not in bound and not isinstance(thread, ControlThread)
            for thread in threading.enumerate()
        )
        probes = {
            name: node.reports.probe(is_idle=is_idle, has_free_threads=has_free_threads)
            for name, node in self._nodes.items()
        }
        self._tell(control.Probed(asked.number, probes))

    def _when_idle(self, action: Event) -> None:
        """Do something once no event waits: a hook that may start has a loop-back waiting."""
        self._once_idle.append(action)
        if len(self._once_idle) == 1:
            self._wait_until_idle()

    def _wait_until_idle(self) -> None:
        assert self._middleware is not None
        loop = self._middleware.loop
        if loop.has_waiting_events or not loop.has_taken_in:
            loop.post_loop_back(self._wait_until_idle)
            return
        actions, self._once_idle = self._once_idle, []
        for action in actions:
            action()

    def _answer_asked(self) -> None:
        """Answer the last probe of a step, unless the run was resumed meanwhile."""
        asked, self._asked = self._asked, None
        if asked is None or self.is_ending:
            return
        packets = {
            name: (history.count, history.since(asked.known[name]))
            for node in self._nodes.values()
            for output, history in node.histories.by_output.items()
            if (name := f"{node.name}.{output}") in asked.known
            and history.count > asked.known[name]
        }
        probes = {n: node.reports.probe_at_rest(self._nodes) for n, node in self._nodes.items()}
        self._tell(control.Probed(asked.number, probes, packets))

    def _reset(self, asked: control.Reset) -> None:
        """Bring all nodes back to their start, if they can still be."""
        assert self._middleware is not None
        if not (why_not := self._why_not_reset()):
            self._has_been_reset = True
            self._middleware.begin_anew(self._files, asked.variables)
            for node in self._nodes.values():
                try:
                    node.reset(asked.variables.get(node.name, {}), asked.keep.get(node.name, ()))
                except NeurosError as error:
                    self._fail(node.name, error)
                    return
                self._tell(declared(node.name, node.specs))
                start = functools.partial(
                    node.start, awaits_others=self._stage < ProcessStage.ACTIVE
                )
                self._middleware.loop.post(start)
        self._tell(control.WasReset(why_not))

    def _why_not_reset(self) -> str:
        """Why the nodes cannot be reset where they are; empty if they can."""
        nodes = self._nodes.values()
        if not all(node.is_paused for node in nodes):
            return "the run is not paused: pause it first"
        connections = (c for file in self._files for c in file.connections)
        if any({c.source_node, c.destination_node} - {*self._nodes} for c in connections):
            return "its nodes are in several processes"
        threads = {t for t in threading.enumerate() if not isinstance(t, ControlThread)}
        others = (f"a plugin has a thread ({t.name})" for t in threads - {threading.main_thread()})
        return next(filter(None, (*(node.why_not_reset for node in nodes), *others)), "")

    # ------------------------------------------------------------------ inside

    def _live(self) -> None:
        # Modules of ROS stay: rounds of the garbage collector would go through them for nothing.
        gc.disable()
        try:
            middleware = self._make_middleware(self._files, self._fail_outside_hooks)
            if self._files[0].time == VIRTUAL:
                loop = self._virtual = cast(VirtualRun, middleware.loop)
                loop.plan(self._duration_s, self._end_by_duration, self._real_time_factor)
                if self._fork is not None:
                    loop.call_at(self._fork[0], functools.partial(self._change, only_checks=False))
            with self._early_lock:
                self._middleware = middleware
                for event in self._early_events:
                    middleware.loop.post_from_thread(event)
            self._peers.open(middleware)
            for file in self._files:
                self._add(file)
        finally:
            gc.freeze()
            gc.enable()
        for node in self._nodes.values():
            if self.is_ending:
                return
            try:
                node.load()
                self._tell(declared(node.name, node.specs))
            except NeurosError as error:
                self._fail(node.name, error)
        gc.freeze()
        self._goes_on.wait()  # meanwhile nothing of ROS is handled: nobody can send here
        if not self.is_ending:
            self._guard(middleware.loop.run)
            middleware.take_in()

    def _go_on(self, *, is_stepped: bool) -> None:
        if self._virtual is not None:
            self._virtual.go_on(is_stepped=is_stepped)

    def _begin(self) -> None:
        self._has_begun = True
        self._reach(ProcessStage.INITIALISING)
        for node in self._nodes.values():
            node.reports.begin()
        self.report()
        for node in self._nodes.values():
            node.start(awaits_others=True)

    def _change(self, *, only_checks: bool) -> None:
        """Make the changes of a fork, or check them."""
        for name, (variables, parameters) in (self._fork or (0.0, {}))[1].items():
            if name in self._nodes:
                self._nodes[name].change(variables, parameters, only_checks=only_checks)

    def _end_by_duration(self) -> None:
        reason = f"{self._duration_s:g} s of virtual time have passed"
        self._tell(control.Shutdown("", reason, _DRAIN_S))

    @property
    def is_ending(self) -> bool:
        """Whether no further hook starts."""
        return self._stage is ProcessStage.ENDING

    def _reach(self, stage: ProcessStage) -> None:
        with self._stage_lock:  # the control thread may end what the loop begins
            self._stage = max(self._stage, stage)

    def _guard(self, action: Event) -> None:
        """A failure anywhere must not keep the others from finalising."""
        try:
            action()
        except BaseException as error:
            self._fail_outside_hooks(error)

    def _add(self, file: NodeFile) -> None:
        assert self._middleware is not None
        make_engine: type[Engine] = Engine
        if self._open_recorder is not None:
            from neuros.engine.event_log import LoggedEngine

            make_engine = LoggedEngine
        node = NodeRuntime(
            file,
            self._middleware,
            self._contexts,
            tell=self._tell,
            fail=self._fail,
            recorder=None if self._open_recorder is None else self._open_recorder(file),
            make_engine=make_engine,
            log_file=file.folders.run / file.node.name / "node.log" if self._own_logs else None,
            duration_sim_s=self._duration_sim_s,
            is_held=self._is_held,
            on_initialised=self._keep_for_good,
        )
        self._nodes[node.name] = node

    def _keep_for_good(self) -> None:
        """Leave what exists after initialisation to itself: modules, networks, figures.

        It stays to the end, and each full round of the garbage collector would go through all of
        it, for 40 ms in the midst of a run. What comes after a reset goes with the next one.
        """
        if not self._has_been_reset:
            gc.collect()
            gc.freeze()

    def _tell(self, message: Message) -> None:
        assert self._link is not None
        with self._tell_lock:
            self._link.send(message)

    def _fail(self, name: str, error: NeurosError) -> None:
        self._has_failed = True
        self._reach(ProcessStage.ENDING)
        if name in self._nodes:
            self._nodes[name].failures.log(error)
        else:  # there is no logger yet
            traceback.print_exception(error, file=sys.stderr)
        self._tell(control.Failed(name, str(error)))
        self.ask_to_stop()

    def _fail_outside_hooks(self, error: BaseException) -> None:
        """A task of ROS that a plugin has started has failed, or NeuROS itself."""
        if not self._nodes:
            known = error if isinstance(error, NeurosError) else as_node_error(error)
            self._fail(self._files[0].node.name, known)
            return
        nodes = [*self._nodes.values()]
        names = {frame.f_code.co_filename for frame, _ in traceback.walk_tb(error.__traceback__)}
        suspects = [node for node in nodes if str(node.file.node.plugin) in names]
        node = next((node for node in suspects if node.has_context), (suspects or nodes)[0])
        if not isinstance(error, NeurosError):
            error = callback_error(error)
        self._fail(node.name, error)


class ControlThread(threading.Thread):
    """Reports once per second and passes on what the supervisor asks for, also while hooks run.

    A supervisor that has gone, and a signal, both mean: stop. What fails here (a simulator whose
    time cannot be read, say) fails again in the loop, which knows what to do about it.
    """

    def __init__(
        self,
        link: ControlLink,
        signalled: socket.socket,
        process: NodeProcess,
    ) -> None:
        super().__init__(name="neuros-control", daemon=True)
        self._link = link
        self._signalled = signalled
        self._process = process
        self._ended = threading.Event()
        # Here: once the thread comes to it, a node that fails at once may have closed them.
        self._selector = selectors.DefaultSelector()
        self._selector.register(link, selectors.EVENT_READ)
        self._selector.register(signalled, selectors.EVENT_READ)

    def run(self) -> None:
        """Until the supervisor hangs up or :meth:`end`."""
        next_report_s = time.monotonic() + _REPORT_S
        with self._selector as selector:
            while not self._ended.is_set():
                ready = selector.select(max(0.0, next_report_s - time.monotonic()))
                for key, _ in ready:
                    if key.fileobj is self._signalled:
                        with contextlib.suppress(OSError):
                            self._signalled.recv(64)
                            if not self._ended.is_set():
                                self._process.ask_to_stop()
                    elif not self._handle_messages():
                        return
                if time.monotonic() >= next_report_s and not self._ended.is_set():
                    next_report_s = time.monotonic() + _REPORT_S
                    self._try(self._process.report)

    def end(self, waker: socket.socket) -> None:
        """End the thread: while it lives, Python does not close what plugins have left open."""
        self._ended.set()
        waker.send(b"\0")
        self.join(_REPORT_S)

    def _handle_messages(self) -> bool:
        """Returns False once the supervisor is gone."""
        try:
            messages = self._link.receive()
        except ControlError as error:
            self._raise_in_loop(error)
            return True
        if messages is None:
            self._process.on_supervisor_gone()
            return False
        for message in messages:
            self._try(functools.partial(self._process.handle, message))
        return True

    def _try(self, action: Event) -> None:
        try:
            action()
        except Exception as error:
            self._raise_in_loop(error)

    def _raise_in_loop(self, error: Exception) -> None:
        def fail() -> None:
            raise error

        self._process.post(fail)


@contextlib.contextmanager
def signals_as_socket() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A socket that becomes readable on SIGTERM or SIGINT, also during a wait in C++; its peer."""
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    reader.setblocking(False)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    previous = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    try:
        yield reader, writer
    finally:
        signal.set_wakeup_fd(previous)
        reader.close()
        writer.close()
