"""The program of every process and container: one or more nodes in one event loop."""

from __future__ import annotations

import gc
import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.control import Lines, connect
from neuros.engine.engine import Engine
from neuros.engine.event_log import LoggedEngine
from neuros.errors import NeurosError
from neuros.hooks import HookKind, HookSpec
from neuros.node.context import ContextSwitch
from neuros.node.control_thread import ControlThread, signals_as_socket
from neuros.node.failures import as_node_error, callback_error
from neuros.node.node import NodeRuntime
from neuros.node.peer_link import ELSEWHERE_VARIABLE, PeerLink
from neuros.ports import Middleware, PacketRecorder
from neuros.project.model import NodeFile
from neuros.stacks import StackFile

MiddlewareFactory = Callable[[Sequence[NodeFile], Callable[[BaseException], None]], Middleware]
Event = Callable[[], None]


class NodeProcess:
    """Runs nodes until the supervisor, a signal or a failure ends it.

    Args:
        files: the nodes that live here.
        make_middleware: joins them to the world; it may take its time to import ROS.
        open_recorder: where a node puts what is recorded; ``None``: nothing is.
        duration_sim_s: simulated time after which the node that owns it ends the project.
        own_logs: whether each node writes to a log file of its own (several nodes share the
            process), rather than to the output that the process was started with.
    """

    def __init__(
        self,
        files: Sequence[NodeFile],
        make_middleware: MiddlewareFactory,
        *,
        open_recorder: Callable[[NodeFile], PacketRecorder] | None = None,
        duration_sim_s: float | None = None,
        own_logs: bool = False,
    ) -> None:
        self._files = files
        self._make_middleware = make_middleware
        self._open_recorder = open_recorder
        self._duration_sim_s = duration_sim_s
        self._own_logs = own_logs
        self._contexts = ContextSwitch()
        self._nodes: list[NodeRuntime] = []
        self._middleware: Middleware | None = None
        self._early_events: list[Event] = []
        self._early_lock = threading.Lock()
        self._has_failed = False
        self._stop_asked = threading.Event()
        self._tell_lock = threading.Lock()
        self._lines: Lines | None = None
        self._stack_file: StackFile | None = None
        self._peers = PeerLink(
            [file.node.name for file in files], os.environ.get(ELSEWHERE_VARIABLE, ""), self._tell
        )

    def run(self) -> int:
        """Run to the end; returns 0 if it was asked to end, 1 if a node failed."""
        run_folder = self._files[0].folders.run
        os.chdir(run_folder)
        self._lines = connect(run_folder)
        own_folder = run_folder / self._files[0].node.name
        plugins = {file.node.name: file.node.plugin for file in self._files}
        self._stack_file = StackFile(own_folder, plugins)
        self._tell("hello", nodes=[file.node.name for file in self._files], pid=os.getpid())
        with signals_as_socket() as signalled:
            thread = ControlThread(self._lines, signalled, self)
            thread.start()
            self._guard(self._live)
            for node in self._nodes:
                self._guard(node.finalise)
            self._guard(lambda: self.report(is_final=True))
            self._guard(self._peers.close)
            if self._middleware is not None:
                self._guard(self._middleware.close)
            thread.end()
        return 1 if self._has_failed else 0

    # ------------------------------------------------------------------ called by the supervisor

    def ask_to_stop(self) -> None:
        """Start no further hook, then finalise and end. Any thread."""
        self._stop_asked.set()
        for node in tuple(self._nodes):
            node.stop()
        if self._middleware is not None:
            self._middleware.loop.stop()

    def post(self, event: Event) -> None:
        """Have an event handled by the loop, as soon as there is one. Any thread."""
        with self._early_lock:
            if self._middleware is None:
                self._early_events.append(event)
                return
        self._middleware.loop.post_from_thread(event)

    def drain(self, last_round: Mapping[str, Sequence[int]]) -> None:
        """Stop the hooks that send unasked; ``last_round``, by node, start at most once more.

        Loop thread only.
        """
        for node in self._nodes:
            node.drain(last_round.get(node.name, ()))

    def pause(self) -> None:
        """Start no further hook until :meth:`resume`. Loop thread only."""
        for node in self._nodes:
            node.pause()

    def resume(self) -> None:
        """Go on after a pause. Loop thread only."""
        for node in self._nodes:
            node.resume()

    def step(self, count: int, *, is_driven: bool) -> None:
        """While paused, go on by so many steps. Loop thread only."""
        for node in self._nodes:
            node.step(count, is_driven=is_driven)

    def look(self, wanted: Mapping[str, Any], asker: int) -> None:
        """Show an observer what all nodes do; ``wanted`` is what to sample, by node. Any thread."""
        for node in tuple(self._nodes):
            self._tell("node_status", **node.reports.look(wanted.get(node.name, {}), asker))

    def probe(self, number: int) -> None:
        """Report the state of all nodes at one moment. Loop thread only."""
        assert self._middleware is not None
        is_idle = not self._middleware.loop.has_waiting_events
        has_free_threads = self._has_free_threads()
        for node in self._nodes:
            fields = node.reports.probe()
            # A thread of a plugin may submit packets, or end the project, at any time.
            fields["is_wakeable"] = fields["is_wakeable"] or has_free_threads
            self._tell("report", **fields, probe=number, is_idle=is_idle)

    def report(self, *, is_final: bool = False) -> None:
        """Report state and counters of all nodes. Any thread."""
        if self._stack_file is not None:
            self._stack_file.renew()
        for node in tuple(self._nodes):
            node.reports.write_packet_log()
            self._tell("report", **node.reports.state(), is_final=is_final)

    def explain(self) -> None:
        """Report why nothing moves, but for nodes whose hook runs. Any thread."""
        for node in tuple(self._nodes):
            if node.engine is None or node.engine.executing is None:
                self._tell("explanation", node=node.name, lines=node.reports.explain())

    def say(self, text: str) -> None:
        """Pass on to nodes elsewhere what the launcher says. Any thread."""
        self._peers.say(text)

    def leave(self) -> None:
        """Nothing more will be said to nodes elsewhere. Any thread."""
        self._peers.leave()

    # ------------------------------------------------------------------ inside

    def _live(self) -> None:
        self._open_middleware()
        assert self._middleware is not None
        self._peers.open(self._middleware)
        for file in self._files:
            self._add(file)
        for node in self._nodes:
            if self._is_ending:
                return
            try:
                node.load()
                self._tell("hooks", node=node.name, **declared(node.specs))
            except NeurosError as error:
                self._fail(node.name, error)
        if self._is_ending:
            return
        self.report()
        for node in self._nodes:
            self._middleware.loop.post(node.start)
        gc.freeze()
        self._middleware.loop.run()
        self._middleware.take_in()

    def _open_middleware(self) -> None:
        middleware = self._make_middleware(self._files, self._fail_outside_hooks)
        with self._early_lock:
            self._middleware = middleware
            for event in self._early_events:
                middleware.loop.post_from_thread(event)

    @property
    def _is_ending(self) -> bool:
        return self._stop_asked.is_set() or self._has_failed

    def _guard(self, action: Event) -> None:
        """A failure anywhere must not keep the others from finalising."""
        try:
            action()
        except BaseException as error:
            self._fail_outside_hooks(error)

    def _add(self, file: NodeFile) -> None:
        assert self._middleware is not None
        self._nodes.append(
            NodeRuntime(
                file,
                self._middleware,
                self._contexts,
                tell=self._tell,
                fail=self._fail,
                recorder=None if self._open_recorder is None else self._open_recorder(file),
                make_engine=Engine if self._open_recorder is None else LoggedEngine,
                log_file=_log_file(file) if self._own_logs else None,
                duration_sim_s=self._duration_sim_s,
                on_initialised=_keep_for_good,
            )
        )

    def _has_free_threads(self) -> bool:
        """Whether there is a thread, besides NeuROS's own, that does not wait for a connection."""
        bound = {threading.main_thread(), threading.current_thread()}
        bound.update(*(node.waiting_threads for node in self._nodes))
        return any(
            thread not in bound and not isinstance(thread, ControlThread)
            for thread in threading.enumerate()
        )

    def _tell(self, kind: str, **fields: Any) -> None:
        assert self._lines is not None
        with self._tell_lock:
            self._lines.send(kind, **fields)

    def _fail(self, name: str, error: NeurosError) -> None:
        self._has_failed = True
        node = next((node for node in self._nodes if node.name == name), None)
        if node is not None:
            node.failures.log(error)
        else:  # there is no logger yet
            traceback.print_exception(error, file=sys.stderr)
        self._tell(
            "failed",
            node=name,
            text=str(error),
            hook=getattr(error, "hook", ""),
            where=getattr(error, "where", ""),
        )
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


def declared(specs: Sequence[HookSpec]) -> dict[str, Any]:
    """The hooks of a node, as the supervisor needs them."""
    return {
        "hooks": [
            {
                "kind": spec.kind.value,
                "inputs": [[port.name, port.is_all, port.is_optional] for port in spec.inputs],
                "outputs": [port.name for port in spec.outputs],
            }
            for spec in specs
            if spec.kind is not HookKind.FINALISE
        ],
        "finalise": [spec.name for spec in specs if spec.kind is HookKind.FINALISE],
    }


def _keep_for_good() -> None:
    """Leave what exists after initialisation to itself: modules, networks, figures.

    It stays to the end, and each full round of the garbage collector would go through all of it,
    for 40 ms in the midst of a run.
    """
    gc.collect()
    gc.freeze()


def _filenames(error: BaseException) -> Iterator[str]:
    trace = error.__traceback__
    while trace is not None:
        yield trace.tb_frame.f_code.co_filename
        trace = trace.tb_next


def _log_file(file: NodeFile) -> Path:
    return file.folders.run / file.node.name / "node.log"
