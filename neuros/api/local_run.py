"""A run whose nodes live in the thread of the program that steps it."""

from __future__ import annotations

import _thread
import atexit
import contextlib
import ctypes
import logging
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar

from neuros.api.live import why_it_ended
from neuros.api.plan import Plan
from neuros.api.run import Run
from neuros.api.run_folder import make_run_folder, removed_folders, save_record, write_node_files
from neuros.api.run_record import EXIT_ENVIRONMENT, judge, run_record, run_table
from neuros.backends.console import format_record
from neuros.backends.portable import check_this_process
from neuros.control import AtRest, Message, NodeStatus, Ready, Shutdown
from neuros.errors import NeurosError, RunError, UsageError
from neuros.launcher.outcome import EXIT_CODES, Outcome
from neuros.launcher.quiescence import Declarations
from neuros.node.context import ContextSwitch
from neuros.node.failures import callback_error
from neuros.node.instruments import PacketHistory
from neuros.node.node import NodeRuntime
from neuros.node.reports import declared
from neuros.options import recorded_values
from neuros.ports import Changes
from neuros.project.loops import modules_beside
from neuros.project.model import Node, NodeFile, Port
from neuros.project.plugin_files import read_plugin
from neuros.recording.provenance import GitState, provenance
from neuros.runtime.local import LocalLoop, LocalMiddleware, Record, log_in_python
from neuros.runtime.virtual import VirtualLoop, VirtualMiddleware
from neuros.transport.digests import digest_of
from neuros.transport.messages import copier_of

NAME = "local"
"""Of this back end, in ``session(backend=...)`` and in ``run.json``."""

_DRAIN_S = 5.0
_REPORT_S = 1.0
_CELL_S = 0.02
_CHECKS = 100
_GRACE_S = 1.0
"""How much longer than its time-out a step may take until the hook that runs is interrupted."""


class LocalRun:
    """Holds a run for a session, in the thread that calls (:class:`HeldRun`).

    Nodes have the environment, the import path, the modules and the current folder that they have
    in a process of their own, while their code runs. A hook that crashes the process, or that never
    returns, is the program's.

    Args:
        plan: the project with the inputs of the session, and how to run it.
        messages: folders of its message packages, for ``sys.path``.
        exposes: whether ROS tools see its topics.

    Raises:
        UsageError: if the run folder cannot be made, or this Python was started without the
            variables of a portable run.
    """

    _nest_user: ClassVar[LocalRun | None] = None

    def __init__(self, plan: Plan, messages: Sequence[Path], *, exposes: bool) -> None:
        request, project = plan.request, plan.project
        if project.is_portable:
            check_this_process(plan.nodes)
        sys.path[:0] = [path for path in map(str, messages) if path not in sys.path]
        self._plan = plan
        self._started = time.time()
        self._started_s = time.monotonic()
        self._run_id = os.urandom(8).hex()
        self._git = GitState(project.folder)
        with _Thread.turn:  # else the current folder and the environment may be those of nodes
            self.folder = make_run_folder(request.output, project.name)
            self._contexts = ContextSwitch()
        _, self._files = write_node_files(plan, self.folder, keeps_functions=True)
        self._outcome = Outcome()
        self._declarations = Declarations(self._files)
        self._ready: set[str] = set()
        self.error: NeurosError | None = None
        self._end: tuple[str, float, str] | None = None  # reason, seconds to drain, node
        self._run: Run | None = None
        self._has_begun = self._is_active = False
        self._next_report_s = self._started_s + _REPORT_S
        self._is_behind = False
        self._sent: list[tuple[NodeRuntime, Port, Any]] = []
        self._is_shown = bool(getattr(request, "show", False))
        arguments = (self._write, self._fail_in_callback)
        keywords: dict[str, Any] = {
            "exposes": exposes,
            "digest": digest_of if request.digests else None,
            "level": logging.INFO,
        }
        self._loop = LocalLoop()
        self._middleware = LocalMiddleware(self._loop, *arguments, **keywords)
        if project.is_virtual:
            loop = self._loop = VirtualLoop(self._files[0].seed)
            self._middleware = VirtualMiddleware(loop, *arguments, **keywords)
        self._contexts.hide_from_nodes(project.folder)
        self._nodes: dict[str, NodeRuntime] = {}
        self._histories: dict[str, PacketHistory] = {}  # of outputs that a session has read
        self._thread = _Thread(
            self.folder,
            self._loop,
            self._contexts.leave,
            self._describe_hang,
            self._fail_after_hang,
        )
        atexit.register(self._end_with_program)
        try:
            with self._thread:
                self._load()
                self._loop.run_until_idle()
        except BaseException as error:
            self.interrupt(*why_it_ended(error))
            raise
        if self._end is not None or self._outcome.failures:
            self._finish()

    # ------------------------------------------------------------------ steps

    @property
    def is_behind(self) -> bool:
        """Whether a step was given up, and nothing has come to rest since."""
        return self._is_behind

    def begin(self, known: Mapping[str, int]) -> AtRest | None:
        return self._rest(known)

    def advance(
        self,
        rounds: int,
        known: Mapping[str, int],
        end_s: float | None = None,
        end_sim_s: float | None = None,
    ) -> AtRest | None:
        if self._run is not None:
            return None
        nodes = self._nodes.values()
        with self._thread if end_s is None else self._thread.until(end_s):
            if self._sent:
                self._deliver_sent()
            if self._is_behind or not rounds:
                self._come_to_rest()
            for _ in range(rounds):
                if (
                    end_sim_s is not None
                    and max(self._sim_times().values(), default=0.0) >= end_sim_s
                ):
                    break
                self._is_behind = True
                is_driven = False
                for node in nodes:
                    is_driven = is_driven or node.loaded.is_driving
                for node in nodes:
                    node.step(1, is_driven=is_driven)
                self._come_to_rest()
                if self._end is not None or self._outcome.failures:
                    break
        return self._rest(known)

    def run_for(self, duration_s: float, known: Mapping[str, int]) -> AtRest | None:
        if self._run is not None:
            return None
        began_s = time.monotonic()
        with self._thread:
            self._deliver_sent()
            self._is_behind = True
            nodes = self._nodes.values()
            try:
                if self._plan.project.is_virtual:
                    for node in nodes:
                        node.run_for(round(duration_s * 1e9))
                    self._loop.run_until_idle()
                else:
                    for node in nodes:
                        node.resume()
                    try:
                        self._loop.run_for(duration_s)
                    finally:
                        for node in nodes:
                            node.pause()
            finally:
                self._outcome.paused_s -= time.monotonic() - began_s
            self._come_to_rest()
        return self._rest(known)

    def deliver(self, node: str, port: Port, packet: Any) -> None:
        """Put a packet into the queue of an input, where the next round finds it."""
        self._sent.append((self._nodes[node], port, copier_of(port.type)(packet)))

    def copy(self, type_name: str, content: Any) -> Any:
        return copier_of(type_name)(content)

    def view(self, type_name: str, content: Any) -> Any:
        return content

    def size_of(self, content: Any) -> int:
        return len(self._middleware.packets.encode(content))

    def change(self, changes: Changes, *, only_checks: bool = False) -> AtRest | None:
        if self._run is not None:
            return None
        with self._thread:
            for name, (variables, parameters) in changes.items():
                self._nodes[name].change(variables, parameters, only_checks=only_checks)
        return self._rest({})

    def look(self) -> Sequence[NodeStatus] | None:
        if self._run is not None or (not self._is_behind and self.advance(0, {}) is None):
            return None
        return [node.reports.status({}, 0) for node in self._nodes.values()]

    def reset(
        self, variables: Mapping[str, Mapping[str, str]], keep: Mapping[str, Sequence[str]]
    ) -> bool:
        nodes = self._nodes.values()
        is_fixed = self._thread.has_threads or any(node.why_not_reset for node in nodes)
        if self._run is not None or is_fixed:
            return False
        with self._thread:
            self._sent.clear()
            self._histories.clear()
            for node in nodes:
                node.pause()  # takes back what is left of steps, which might go on for ever
            self._loop.run_until_idle()
            self._middleware.begin_anew(self._files, variables)
            for node in nodes:
                try:
                    node.reset(variables.get(node.name, {}), keep.get(node.name, ()))
                except NeurosError as error:
                    self._fail(node.name, error)
                    break
                self._declarations.add(declared(node.name, node.specs))
                self._loop.post(partial(node.start, awaits_others=not self._is_active))
            self._come_to_rest()
        return True

    # ------------------------------------------------------------------ ends

    def stop(self, reason: str) -> None:
        self._thread.check_outside()
        self._end = self._end or (reason, _DRAIN_S, "")
        self._finish()

    def interrupt(self, reason: str, exit_code: int) -> None:
        if not _Thread.turn.acquire(blocking=False):
            # A step that goes on in another thread ends before its next event.
            self._loop.interrupt(RunError(f"the run has ended: {reason}", exit_code))
            _Thread.turn.acquire()
        try:
            if self._run is None:
                self._outcome.fail(reason, exit_code)
                self._finish()
        finally:
            _Thread.turn.release()

    def wait(self) -> Run:
        assert self._run is not None
        return self._run

    def last_packets(self, output: str) -> tuple[int, Sequence[Any]]:
        node, _, port = output.partition(".")
        history = self._nodes[node].histories.by_output.get(port) if node in self._nodes else None
        return (history.count, [*history.packets]) if history is not None else (0, ())

    # ------------------------------------------------------------------ inside

    def _load(self) -> None:
        self._claim_nest()
        for file in self._files:
            try:
                self._add(file)
            except NeurosError as error:
                self._fail(file.node.name, error)
                return
        self._has_begun = True
        for node in self._nodes.values():
            node.reports.begin()
        for node in self._nodes.values():
            node.start(awaits_others=True)

    def _claim_nest(self) -> None:
        """Have NEST begin anew, if nodes of this run use it: its kernel is that of the process.

        Raises:
            UsageError: if another session of the program uses it now.
        """
        if not any(_uses_nest(file.node) for file in self._files):
            return
        user = LocalRun._nest_user
        if user is not None:
            raise UsageError(
                f"NEST has one kernel per process, and the session in {user.folder} uses it: close"
                ' that, or use session(backend="process")'
            )
        LocalRun._nest_user = self
        if "nest" in sys.modules:
            sys.modules["nest"].ResetKernel()

    def _add(self, file: NodeFile) -> None:
        node = self._nodes[file.node.name] = NodeRuntime(
            file,
            self._middleware,
            self._contexts,
            tell=self._receive,
            fail=self._fail,
            log_file=None,
            duration_sim_s=self._plan.request.end.sim_s,
            is_held=True,
            is_local=True,
        )
        node.load()
        self._declarations.add(declared(node.name, node.specs))

    def _activate(self) -> None:
        """Every node is ready: this is time 0 of the run."""
        self._is_active = True
        self._outcome.started_s = time.monotonic()
        for node in self._nodes.values():
            node.activate()
        for node in self._nodes.values():
            node.on_timer()

    def _come_to_rest(self) -> None:
        """Handle events until none waits, then take back what hooks could not use of a round."""
        self._loop.run_until_idle()
        self._is_behind = False
        for node in self._nodes.values() if self._end is None else ():  # else the run drains
            node.loaded.pause()

    def _deliver_sent(self) -> None:
        """Put what the program has sent into the queues, before a round begins."""
        sent, self._sent = self._sent, []
        for node, port, packet in sent:
            node.on_external_packet(port, packet)

    def _sim_times(self) -> dict[str, float]:
        times = {}
        for name, node in self._nodes.items():
            if node.time.read_s is not None:
                times[name] = node.time.read_s()
        return times

    def _rest(self, known: Mapping[str, int]) -> AtRest | None:
        if self._end is not None or self._outcome.failures:
            self._finish()
            return None
        if (now_s := time.monotonic()) >= self._next_report_s:
            self._next_report_s = now_s + _REPORT_S
            for node in self._nodes.values():
                node.reports.write_logs()
                self._outcome.add(node.reports.report(), now_s)
        packets = {}
        for name, number in known.items():
            history = self._histories.get(name)
            if history is None:
                owner, _, output = name.partition(".")
                history = self._nodes[owner].histories.by_output.get(output)
                if history is None:
                    continue
                self._histories[name] = history
            if history.count > number:
                packets[name] = history.count, history.since(number)
        return AtRest(0, self._sim_times(), packets)

    def _describe_hang(self, thread: int) -> str:
        """Where a hook stands that does not return."""
        frame = sys._current_frames().get(thread)
        for node in self._nodes.values():
            hook = node.engine.executing if node.engine is not None else None
            if hook is not None and frame is not None:
                stack = traceback.extract_stack(frame)
                files = [each.filename for each in stack]
                plugin = str(node.file.node.plugin)
                own = stack[files.index(plugin) :] if plugin in files else stack
                lines = "".join(traceback.format_list(own))
                text = f"hook '{hook.name}' did not return in time; it stood here:\n{lines}"
                self._write(node.name, Record("ERROR", text))
                return f"node '{node.name}': {text}"
        return "the step did not end in time"

    def _fail_after_hang(self) -> None:
        """A hook was interrupted, or the engine, whose state is unknown then."""
        if not self._outcome.failures:
            self._outcome.fail("a step that took too long was interrupted")
        self._finish()

    # ------------------------------------------------------------------ what nodes say

    def _receive(self, message: Message) -> None:
        if isinstance(message, Ready):
            self._ready.add(message.node)
            if not self._is_active and len(self._ready) == len(self._files):
                self._loop.post(self._activate)
        elif isinstance(message, Shutdown) and self._end is None:
            because = f": {message.reason}" if message.reason else ""
            reason = f"{message.node} ended the project{because}"
            self._end = reason, message.drain_s, message.node
            self._loop.end_run()

    def _fail(self, name: str, error: NeurosError) -> None:
        if name in self._nodes:
            self._nodes[name].failures.log(error)
        else:
            self._write(name, Record("ERROR", str(error)))
        self.error = self.error or error
        first_line = (str(error).strip() or "no reason was given").splitlines()[0]
        self._outcome.fail(f"node '{name}' failed: {first_line}")
        self._loop.end_run()
        for node in self._nodes.values():
            node.stop()

    def _fail_in_callback(self, error: BaseException) -> None:
        name = self._files[0].node.name
        self._fail(name, error if isinstance(error, NeurosError) else callback_error(error))

    def _write(self, name: str, record: Record) -> None:
        """Write a record into the log of its node, and pass it on to Python's ``logging``."""
        node = name.partition(".")[0]
        line = format_record(record.severity, name, record.text) + "\n"
        data = line.encode("utf-8", "backslashreplace")
        with contextlib.suppress(OSError), open(self.folder / node / "node.log", "ab") as log:
            log.write(data)
        if self._is_shown:
            sys.stdout.write(data.decode())
        log_in_python(name, record)

    # ------------------------------------------------------------------ the end

    def _finish(self) -> None:
        """Drain, if the run ends well; finalise all nodes; write ``run.json``."""
        if self._run is not None:
            return
        outcome = self._outcome
        outcome.begin_to_end(time.monotonic())
        interruption: KeyboardInterrupt | None = None
        try:
            if self._end is not None and not outcome.failures and self._is_active:
                outcome.reason, drain_s, stopped = self._end
                try:
                    self._drain(drain_s, stopped)
                except KeyboardInterrupt as error:
                    interruption = error
                    outcome.fail("ended by Ctrl+C", EXIT_CODES[signal.SIGINT])
            with self._thread:
                for node in self._nodes.values():
                    node.finalise(runs_hooks=self._has_begun)
                    node.reports.write_logs()
                    outcome.add(node.reports.report(is_final=True), time.monotonic())
        finally:
            self._middleware.close()
            self._contexts.close()
            self._thread.close()
            atexit.unregister(self._end_with_program)
            if LocalRun._nest_user is self:
                LocalRun._nest_user = None
            self._run = self._record()
        if interruption is not None:
            raise interruption

    def _drain(self, drain_s: float, stopped: str) -> None:
        last_round = self._declarations.last_round(stopped)
        try:
            is_virtual = self._plan.project.is_virtual
            with self._thread if is_virtual else self._thread.until(time.monotonic() + drain_s):
                for node in self._nodes.values():
                    node.drain(last_round.get(node.name, ()))
                self._loop.run_until_idle()
        except TimeoutError as error:
            self._outcome.late_drain = str(error)
        self._outcome.has_drained = True

    def _record(self) -> Run:
        plan, outcome = self._plan, self._outcome
        outcome.ended_s = time.monotonic()
        for fault in (*removed_folders(self._files, self.folder), *outcome.faults):
            outcome.fail(fault, EXIT_ENVIRONMENT)
        if outcome.started_s is not None:
            outcome.paused_s += outcome.ended_s - outcome.started_s
        wall_s = outcome.ended_s - (outcome.started_s or self._started_s)
        record = run_record(plan.project, self._files, outcome, wall_s, self.folder)
        record |= {
            "backend": NAME,
            "is_one_process": True,
            "is_portable": plan.project.is_portable,
            "domain_id": None,
            "namespace": plan.project.names.namespace,
            "started": self._started,
            "options": recorded_values(plan.request),
            **plan.provenance,
            "run_id": self._run_id,
            **provenance(sys.argv, plan.project.nodes, self.folder),
            "git": self._git.finish(),
        }
        judge(record, outcome, plan.project.budgets)
        save_record(record, outcome, self.folder, self._run_id)
        if self._is_shown:
            sys.stdout.write(f"\n{run_table(record)}\n\n{outcome.reason}\n")
        try:
            return Run(self.folder)
        except NeurosError:  # the disk is full, and the reason of the end says so
            return Run.unwritten(self.folder, record)

    def _end_with_program(self) -> None:
        if _Thread.turn.acquire(timeout=_GRACE_S):  # else a hook runs for ever in another thread
            self.interrupt(
                "the program ended before it closed the session", EXIT_CODES[signal.SIGINT]
            )


class StepTimeout(BaseException):
    """Interrupts a hook that has run for longer than its step may take."""

    def __str__(self) -> str:
        return "it did not return within the time-out of the step"


class _Thread:
    """The thread of the program while nodes run in it.

    Folder, environment, modules and signals belong to the process, so nodes of one session have
    them at a time; those of a session in another thread wait. Their folder is the current one then.
    Ctrl+C waits for the hook that runs; a second one does not.

    Args:
        folder: the run folder.
        leave: gives the process its own environment and modules back.
        describe_hang: where the thread of this number stands.
        on_hang: called outside, after a hook that did not return has been interrupted.

    Attributes:
        turn: held by the thread in which nodes run.
    """

    turn = threading.RLock()
    _open = 0  # sessions
    # Loops whose nodes run in the main thread, outermost first. An attribute of the class that
    # changed with each step would have Python look up all its methods anew.
    _interruptible: ClassVar[list[LocalLoop]] = []

    def __init__(
        self,
        folder: Path,
        loop: LocalLoop,
        leave: Callable[[], None],
        describe_hang: Callable[[int], str],
        on_hang: Callable[[], None],
    ) -> None:
        self._folder = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        self._program_path, self._program_folder = "", -1
        self._loop = loop
        self._leave = leave
        self._describe_hang = describe_hang
        self._on_hang = on_hang
        self._watchdog: _Watchdog | None = None
        self._is_inside = self._is_interruptible = False
        self._left_s = -math.inf
        self._others: set[threading.Thread] = set()
        self._count = -1  # of threads, when the others were looked up
        self._begun: set[threading.Thread] = set()
        with self.turn:
            _Thread._open += 1

    @property
    def has_threads(self) -> bool:
        """Whether a thread goes on that nodes have begun."""
        return any(thread.is_alive() for thread in self._begun)

    def check_outside(self) -> None:
        """Raise ``UsageError`` in a hook: a hook cannot use the session that runs it."""
        if self._is_inside:
            raise UsageError(
                "a hook of this session runs: it cannot step, reset or close the session, or look"
                " at it"
            )

    def until(self, end_s: float) -> _Thread:
        """The thread for nodes; they are interrupted at a time (monotonic, seconds)."""
        if not self._is_inside:
            self._watchdog = _Watchdog(end_s, self._loop, self._describe_hang)
        return self

    def __enter__(self) -> None:
        if self._is_inside:
            self.check_outside()
        watchdog = self._watchdog
        if watchdog is None:
            self.turn.acquire()
        elif not self.turn.acquire(timeout=max(0.0, watchdog.end_s - time.monotonic())):
            self._watchdog = None
            raise TimeoutError("a hook of another session has not returned in time")
        try:
            try:
                path = os.getcwd()
            except FileNotFoundError:  # it has been removed
                path = ""
            if path != self._program_path or not path:
                if self._program_folder >= 0:
                    os.close(self._program_folder)
                self._program_folder = os.open(".", os.O_PATH | os.O_DIRECTORY)
                self._program_path = path
            # A notebook exchanges the handler with each cell, so it is looked at after a pause.
            is_later = time.monotonic() - self._left_s > _CELL_S
            if is_later and _is_main() and _handler() is signal.default_int_handler:
                signal.signal(signal.SIGINT, _Thread._on_interrupt)
            self._is_inside = True
            if threading.get_ident() == _MAIN:
                self._is_interruptible = True
                self._interruptible.append(self._loop)
            os.fchdir(self._folder)
        except BaseException:
            self._end_inside()
            raise
        # threading.active_count() takes thirty times as long.
        if (count := _thread._count()) != self._count:
            self._count, self._others = count, {*threading.enumerate()}
        if watchdog is not None:
            watchdog.begin()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> None:
        watchdog, self._watchdog = self._watchdog, None
        hang = ""
        try:
            if watchdog is not None:
                watchdog.end()
                hang = watchdog.hang
        except StepTimeout:
            hang = watchdog.hang if watchdog is not None else ""
        # While nodes are loaded, the thread that asks git may end.
        if _thread._count() > self._count or self._left_s < 0:
            begun = self._begun | ({*threading.enumerate()} - self._others)
            self._begun = {thread for thread in begun if thread.is_alive()}
        self._leave()
        os.fchdir(self._program_folder)
        self._end_inside()
        self._left_s = time.monotonic()
        interruption, self._loop.interruption = self._loop.interruption, None
        if hang:
            self._on_hang()
            raise TimeoutError(hang)
        if error is None and isinstance(interruption, KeyboardInterrupt):
            raise interruption

    def close(self) -> None:
        """Leave folders and signals as they were."""
        os.close(self._folder)
        if self._program_folder >= 0:
            os.close(self._program_folder)
        with self.turn:
            _Thread._open -= 1
            if not _Thread._open and _is_main() and _handler() is _Thread._on_interrupt:
                signal.signal(signal.SIGINT, signal.default_int_handler)

    def _end_inside(self) -> None:
        """From here on, Ctrl+C is the program's again."""
        if self._is_interruptible:
            self._is_interruptible = False
            self._interruptible.pop()
        self._is_inside = False
        self.turn.release()

    @staticmethod
    def _on_interrupt(number: int, frame: FrameType | None) -> None:
        loops = _Thread._interruptible
        if not loops or loops[0].interruption is not None:
            signal.default_int_handler(number, frame)
        else:
            loops[0].interrupt(KeyboardInterrupt())


def _uses_nest(node: Node) -> bool:
    if node.container.partition(":")[0] == "neuros_nest":
        return True
    plugin = read_plugin(node.plugin)
    parts = [] if plugin is None else [plugin, *modules_beside(plugin)]
    return any(each.name.partition(".")[0] == "nest" for part in parts for each in part.needs)


def _handler() -> object:
    return signal.getsignal(signal.SIGINT)


_MAIN = threading.main_thread().ident


def _is_main() -> bool:
    return threading.get_ident() == _MAIN


class _Watchdog:
    """Ends a step at its time: between two events, or, a moment later, in the midst of a hook.

    Args:
        end_s: monotonic, seconds.
        describe: where the thread of this number stands.

    Attributes:
        end_s: that time.
        hang: where the hook stood that did not return; empty if there was none.
    """

    def __init__(self, end_s: float, loop: LocalLoop, describe: Callable[[int], str]) -> None:
        self.end_s = end_s
        self._loop = loop
        self._describe = describe
        self._thread_id = threading.get_ident()
        self._is_over = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._watch, name="neuros-watchdog", daemon=True)
        self.hang = ""

    def begin(self) -> None:
        self._thread.start()

    def end(self) -> None:
        """Watch no more. Raises what it has set for this thread and has not come yet."""
        with self._lock:
            self._is_over.set()
        self._thread.join()
        for _ in range(_CHECKS if self.hang else 0):
            """Python raises what another thread has set at the next turn of a loop."""

    def _watch(self) -> None:
        if self._is_over.wait(max(0.0, self.end_s - time.monotonic())):
            return
        self._loop.interrupt(TimeoutError("the run has not come to rest in time"))
        if self._is_over.wait(_GRACE_S):
            return
        with self._lock:
            if not self._is_over.is_set():
                self.hang = self._describe(self._thread_id)
                ctypes.pythonapi.PyThreadState_SetAsyncExc(
                    ctypes.c_ulong(self._thread_id), ctypes.py_object(StepTimeout)
                )
