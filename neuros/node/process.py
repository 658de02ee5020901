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
from typing import cast

import neuros.control as control
from neuros.control import ELSEWHERE_VARIABLE, TO_NODES, Advance, Message
from neuros.control.link import ControlLink
from neuros.engine.engine import Engine
from neuros.engine.event_log import LoggedEngine
from neuros.errors import ControlError, NeurosError
from neuros.node.context import ContextSwitch
from neuros.node.failures import as_node_error, callback_error
from neuros.node.node import NodeRuntime
from neuros.node.peer_link import PeerLink
from neuros.node.reports import declared
from neuros.node.saving import Saving
from neuros.ports import Changes, ControlStream, Middleware, PacketRecorder, VirtualRun
from neuros.project.model import Connection, NodeFile
from neuros.project.timing import VIRTUAL
from neuros.stacks import allow_reading

MiddlewareFactory = Callable[[Sequence[NodeFile], Callable[[BaseException], None]], Middleware]
Event = Callable[[], None]

_REPORT_S = 1.0
_DRAIN_S = 5.0


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
        self._nodes: list[NodeRuntime] = []
        self._by_name: dict[str, NodeRuntime] = {}
        self._middleware: Middleware | None = None
        self._early_events: list[Event] = []
        self._early_lock = threading.Lock()
        self._has_failed = False
        self._asked: Advance | None = None
        self._is_settling = False
        self._has_begun = self._is_active = False
        self._saving: tuple[str, Saving] | None = None  # of the node that finalises
        self._has_been_reset = False
        self._stop_asked, self._may_begin = threading.Event(), threading.Event()
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
            for node in self._nodes:
                self._saving = node.name, Saving(node.run_dir)
                self._guard(functools.partial(node.finalise, runs_hooks=self._has_begun))
                self._guard(functools.partial(self._report_last, node))
            self._guard(self._peers.close)
            if self._middleware is not None:
                self._guard(self._middleware.flush)
            thread.end(waker)
        return 1 if self._has_failed else 0

    # ------------------------------------------------------------------ called by the supervisor

    def obey(self, message: Message) -> None:
        """Do what the supervisor asks for, between two events where hooks are concerned."""
        match message:
            case control.Begin():
                self.post(self._begin)
                self._may_begin.set()
            case control.Activate():
                self.post(self._activate)
            case control.Stop():
                self.ask_to_stop()
            case control.StopHooks():
                for node in tuple(self._nodes):
                    node.stop()
            case control.Leave():
                self._peers.leave()
            case control.Say(text):
                self._peers.say(text)
            case control.Look(wanted, asker):
                for node in tuple(self._nodes):
                    self._tell(node.reports.look(wanted.get(node.name, {}), asker))
            case control.Explain():
                self._explain()
            case _:
                self.post(lambda: self._obey_in_loop(message))

    def _obey_in_loop(self, message: Message) -> None:
        if self.is_ending:
            return
        if isinstance(message, control.Probe):
            self._probe(message.number)
            return
        if isinstance(message, Advance):
            self._asked = message
            self._begin_settling()
            return
        if isinstance(message, control.Reset):
            self._reset(message)
            return
        if isinstance(message, control.Resume):
            self._asked = None  # where the run goes freely, an answer would hold it again
        for node in self._nodes:
            match message:
                case control.Drain(last_round):
                    node.drain(last_round.get(node.name, ()))
                case control.Pause():
                    node.pause()
                case control.Resume():
                    node.resume()
                case control.Step(count, is_driven):
                    node.step(count, is_driven=is_driven)
                case control.Deliver(name, input_name, data) if name == node.name:
                    node.deliver(input_name, data)
                case control.Change(name) if name == node.name:
                    node.change(
                        message.variables, message.parameters, only_checks=message.only_checks
                    )

    def ask_to_stop(self) -> None:
        """Start no further hook, then finalise and end. Any thread."""
        self._stop_asked.set()
        self._may_begin.set()
        for node in tuple(self._nodes):
            node.stop()
        if self._middleware is not None:
            self._middleware.loop.stop()

    def let_go(self) -> None:
        """The supervisor is gone: end, and wait for no peer. Any thread."""
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
        for node in tuple(self._nodes):
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

    def _probe(self, number: int) -> None:
        """Report the state of all nodes at one moment."""
        assert self._middleware is not None
        is_idle = not self._middleware.loop.has_waiting_events
        has_free_threads = self._has_free_threads()
        for node in self._nodes:
            self._tell(
                node.reports.probe(number, is_idle=is_idle, has_free_threads=has_free_threads)
            )

    def _begin_settling(self) -> None:
        if not self._is_settling:
            self._is_settling = True
            self._settle()

    def _settle(self) -> None:
        """Answer once no event waits: a hook that may start has a loop-back waiting.

        Of several questions the last one counts. Where the run is let go on, none is answered.
        """
        assert self._middleware is not None
        loop = self._middleware.loop
        asked = self._asked
        self._is_settling = asked is not None
        if asked is None or self.is_ending:
            return
        if loop.has_waiting_events or not loop.has_taken_in:
            loop.post_loop_back(self._settle)
            return
        self._asked, self._is_settling = None, False
        self._tell(_with_counters(_at_rest(self._nodes, asked), self._nodes))

    def _reset(self, asked: control.Reset) -> None:
        """Bring all nodes back to their start, once no event waits, if they can be."""
        assert self._middleware is not None
        loop = self._middleware.loop
        if not (why_not := self._why_not_reset()):
            for node in self._nodes:
                node.pause()  # takes back what is left of steps, which might go on for ever
            if loop.has_waiting_events or not loop.has_taken_in:
                loop.post_loop_back(lambda: self._reset(asked))
                return
            self._has_been_reset = True
            self._middleware.begin_anew(self._files, asked.variables)
            for node in self._nodes:
                try:
                    node.reset(asked.variables.get(node.name, {}), asked.keep.get(node.name, ()))
                except NeurosError as error:
                    self._fail(node.name, error)
                    return
                self._tell(declared(node.name, node.specs))
                loop.post(functools.partial(node.start, awaits_others=not self._is_active))
        self._tell(control.WasReset(why_not))

    def _why_not_reset(self) -> str:
        """Why the nodes cannot be reset where they are; empty if they can."""
        if not all(node.is_paused for node in self._nodes):
            return "the run is not paused: pause it first"
        connections = (c for file in self._files for c in file.connections)
        if any({c.source_node, c.destination_node} - {*self._by_name} for c in connections):
            return "its nodes are in several processes"
        threads = {t for t in threading.enumerate() if not isinstance(t, ControlThread)}
        others = (f"a plugin has a thread ({t.name})" for t in threads - {threading.main_thread()})
        return next(filter(None, (*(node.why_not_reset for node in self._nodes), *others)), "")

    def _explain(self) -> None:
        """Report why nothing moves; while a hook runs, that is what all nodes here wait for."""
        nodes = tuple(self._nodes)
        if not any(node.engine is not None and node.engine.executing for node in nodes):
            for node in nodes:
                self._tell(control.Explanation(node.name, tuple(node.reports.explain())))

    # ------------------------------------------------------------------ inside

    def _live(self) -> None:
        # Modules of ROS stay: rounds of the garbage collector would go through them for nothing.
        gc.disable()
        try:
            middleware = self._open_middleware()
            self._peers.open(middleware)
            for file in self._files:
                self._add(file)
        finally:
            gc.freeze()
            gc.enable()
        for node in self._nodes:
            if self.is_ending:
                return
            try:
                node.load()
                self._tell(declared(node.name, node.specs))
            except NeurosError as error:
                self._fail(node.name, error)
        gc.freeze()
        self._tell(control.Loaded())
        self._may_begin.wait()  # meanwhile nothing of ROS is handled: nobody can send here
        if not self.is_ending:
            self._guard(middleware.loop.run)
            middleware.take_in()

    def _begin(self) -> None:
        self._has_begun = True
        for node in self._nodes:
            node.reports.begin()
        self.report()
        for node in self._nodes:
            node.start(awaits_others=True)

    def _change(self, *, only_checks: bool) -> None:
        """Make the changes of a fork, or check them."""
        assert self._fork is not None
        for name, (variables, parameters) in self._fork[1].items():
            self._by_name[name].change(variables, parameters, only_checks=only_checks)

    def _activate(self) -> None:
        self._is_active = True
        if self._fork is not None:
            self._change(only_checks=True)
        for node in self._nodes:
            node.activate()
        for node in self._nodes:
            node.on_timer()

    def _open_middleware(self) -> Middleware:
        middleware = self._make_middleware(self._files, self._fail_outside_hooks)
        if self._files[0].time == VIRTUAL:
            loop = cast(VirtualRun, middleware.loop)
            loop.plan(self._duration_s, self._end_by_duration, self._real_time_factor)
            if self._fork is not None:
                loop.call_at(self._fork[0], functools.partial(self._change, only_checks=False))
        with self._early_lock:
            self._middleware = middleware
            for event in self._early_events:
                middleware.loop.post_from_thread(event)
        return middleware

    def _end_by_duration(self) -> None:
        reason = f"{self._duration_s:g} s of virtual time have passed"
        self._tell(control.Shutdown("", reason, _DRAIN_S))

    @property
    def is_ending(self) -> bool:
        """Whether no further hook starts."""
        return self._stop_asked.is_set() or self._has_failed

    def _guard(self, action: Event) -> None:
        """A failure anywhere must not keep the others from finalising."""
        try:
            action()
        except BaseException as error:
            self._fail_outside_hooks(error)

    def _add(self, file: NodeFile) -> None:
        assert self._middleware is not None
        node = NodeRuntime(
            file,
            self._middleware,
            self._contexts,
            tell=self._tell,
            fail=self._fail,
            recorder=None if self._open_recorder is None else self._open_recorder(file),
            make_engine=Engine if self._open_recorder is None else LoggedEngine,
            log_file=file.folders.run / file.node.name / "node.log" if self._own_logs else None,
            duration_sim_s=self._duration_sim_s,
            is_held=self._is_held,
            on_initialised=self._keep_for_good,
        )
        self._nodes.append(node)
        self._by_name[node.name] = node

    def _keep_for_good(self) -> None:
        """Leave what exists after initialisation to itself: modules, networks, figures.

        It stays to the end, and each full round of the garbage collector would go through all of
        it, for 40 ms in the midst of a run. What comes after a reset goes with the next one.
        """
        if not self._has_been_reset:
            gc.collect()
            gc.freeze()

    def _has_free_threads(self) -> bool:
        """Whether there is a thread, besides NeuROS's own, that does not wait for a connection."""
        bound = {threading.main_thread(), threading.current_thread()}
        bound.update(*(node.waiting_threads for node in self._nodes))
        return any(
            thread not in bound and not isinstance(thread, ControlThread)
            for thread in threading.enumerate()
        )

    def _tell(self, message: Message) -> None:
        assert self._link is not None
        with self._tell_lock:
            self._link.send(message)

    def _fail(self, name: str, error: NeurosError) -> None:
        self._has_failed = True
        node = next((node for node in self._nodes if node.name == name), None)
        if node is not None:
            node.failures.log(error)
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
        names = set(_filenames(error))
        suspects = [node for node in self._nodes if str(node.file.node.plugin) in names]
        node = next((node for node in suspects if node.has_context), (suspects or self._nodes)[0])
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
        self._selector.register(link, selectors.EVENT_READ, self._on_messages)
        self._selector.register(signalled, selectors.EVENT_READ, self._on_signal)

    def run(self) -> None:
        """Until the supervisor hangs up or :meth:`end`."""
        next_report_s = time.monotonic() + _REPORT_S
        with self._selector as selector:
            while not self._ended.is_set():
                ready = selector.select(max(0.0, next_report_s - time.monotonic()))
                for key, _ in ready:
                    if not key.data():
                        return
                if time.monotonic() >= next_report_s and not self._ended.is_set():
                    next_report_s = time.monotonic() + _REPORT_S
                    self._try(self._process.report)

    def end(self, waker: socket.socket) -> None:
        """End the thread: while it lives, Python does not close what plugins have left open."""
        self._ended.set()
        waker.send(b"\0")
        self.join(_REPORT_S)

    def _on_signal(self) -> bool:
        with contextlib.suppress(OSError):
            self._signalled.recv(64)
            if not self._ended.is_set():
                self._process.ask_to_stop()
        return True

    def _on_messages(self) -> bool:
        """Returns False once the supervisor is gone."""
        messages = self._received(self._link)
        if messages is None:
            self._process.let_go()
            return False
        for message in messages:
            self._try(functools.partial(self._process.obey, message))
        return True

    def _received(self, link: ControlLink) -> list[Message] | None:
        try:
            return link.receive()
        except ControlError as error:
            self._raise_in_loop(error)
            return []

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


def _at_rest(nodes: Sequence[NodeRuntime], asked: Advance) -> control.AtRest:
    """Times and new packets of all nodes of a process at one moment."""
    packets = {
        name: (history.count, history.since(asked.known[name]))
        for node in nodes
        for output, history in node.histories.by_output.items()
        if (name := f"{node.name}.{output}") in asked.known and history.count > asked.known[name]
    }
    times = {node.name: time_s for node in nodes if (time_s := node.sim_time) is not None}
    return control.AtRest(asked.number, times, packets)


def _with_counters(answer: control.AtRest, nodes: Sequence[NodeRuntime]) -> control.AtRest:
    """The answer with what the supervisor compares with those of other processes."""
    answer.nodes = names = tuple(node.name for node in nodes)
    engines = [node.engine for node in nodes if node.engine is not None]
    answer.is_active = len(engines) == len(nodes) and all(e.is_active for e in engines)
    answer.sent = {
        str(w.connection): (w.sent, w.acknowledged if w.is_reliable else -1)
        for engine in engines
        for w in engine.send_windows.values()
        if w.connection.destination_node not in names
    }
    answer.received = {
        s.name: (s.received, s.acknowledged if s.is_acknowledged else -1)
        for engine in engines
        for s in engine.subscriptions.values()
        if isinstance(s.key, Connection) and s.key.source_node not in names
    }
    return answer


def _filenames(error: BaseException) -> Iterator[str]:
    trace = error.__traceback__
    while trace is not None:
        yield trace.tb_frame.f_code.co_filename
        trace = trace.tb_next
