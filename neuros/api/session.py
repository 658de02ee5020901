"""A run that a Python program holds in its hand: it steps the run, reads outputs and feeds inputs.

The nodes live in the thread of the program (:mod:`neuros.api.local_run`), or in processes of their
own: then the session is an observer on the control channel of the run, which stands paused from its
start. Its inputs are external topics that are on no ROS graph. A packet that is sent before a step
is there when the step begins.
"""

from __future__ import annotations

import asyncio
import html
import math
import operator
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any

import numpy as np

from neuros.api.changes import changes_of
from neuros.api.live import PROGRAM_FAILED, why_it_ended
from neuros.api.loading import seed_variables, value_text, with_model_fields
from neuros.api.run import Run
from neuros.api.run_record import run_table
from neuros.api.session_link import (
    Held,
    LaunchedRun,
    connections_to,
    declared_at,
    port_of,
)
from neuros.control import AtRest, NodeStatus
from neuros.errors import NeurosError, RunError, UsageError
from neuros.node.instruments import room_for
from neuros.ports import Changes
from neuros.project.model import Node, Port, Project
from neuros.project.repeatable import why_not_repeatable
from neuros.project.suggest import did_you_mean, listed
from neuros.registry import BAG_FORMATS
from neuros.transport.messages import RosPackets, checked

_READ_S = 1.0
_LONGEST_S = 1e6  # operating systems wait for no more than some weeks
_MOST_ROUNDS_AT_REST = 1000
_FINE = 1e-9
_MOST_VARIATION = 2.0


@dataclass(frozen=True)
class Prepared:
    """A run that was checked.

    Attributes:
        project: as it is described, without the inputs of the session.
        start: starts it, with values to restore, and with what is recorded of a fork.
        is_stepped: whether all nodes are in the thread of the program.
    """

    project: Project
    start: Callable[[Mapping[str, Any], Mapping[str, Any]], Held]
    is_stepped: bool


Prepare = Callable[[int | None, Mapping[str, Any]], Prepared]
"""Checks a run with a seed and settings."""


class Session:
    """A run that stands still, but for the steps of this program::

        with neuros.Project.from_file("project.json").session() as s:
            while s["robot.imu"].packet is None:
                s.step()
            s.send("robot.wheels", command)
            s.step(sim_s=0.02)

    A *round* lets each hook that drives the project start once, and lasts until nothing moves any
    more. Several threads may use it, one at a time. At the end of the block the run is ended,
    drained; where the block fails, it is ended at once.

    Attributes:
        folder: the run folder.
        runs: those that a reset has ended; each has a folder of its own.
    """

    def __init__(
        self,
        prepare: Prepare,
        seed: int | None,
        fork: Mapping[str, Any] | None = None,
        *,
        settings: Mapping[str, Any] | None = None,
        is_forkable: bool = False,
    ) -> None:
        self._prepare = prepare
        self._seed = seed
        self._is_forkable = is_forkable
        self._journal: list[tuple[str, tuple[Any, ...]]] = []  # what a fork does again
        self._unnoted = 0  # and then so many rounds
        self._why_no_fork = ""
        self._lock = threading.RLock()
        self._outputs: dict[str, _Received] = {}
        self.runs: list[Run] = []
        self._settings: Mapping[str, Any] = settings or {}  # with which the run began
        self._latest = self._settings  # of the last reset, whether it began a run or not
        self._checked: set[str] = set()  # paths of settings
        self._hold(prepare(seed, self._settings).start({}, fork or {}))
        self._usual = self._project if not settings else prepare(seed, {}).project

    def _hold(self, held: Held) -> None:
        """Take a run that has just been started."""
        self._held, self._project, self._inputs = held.run, held.project, held.inputs
        self._ports: dict[str, tuple[Node, Port]] = {}  # of inputs, by name
        self.folder = held.run.folder
        self._run: Run | None = None
        sys.path[:0] = [path for path in map(str, held.messages) if path not in sys.path]
        self._begin_anew()
        try:
            self._take(held.run.begin(self._known))
        except BaseException:
            held.run.interrupt("the session could not begin", PROGRAM_FAILED)
            raise

    def _begin_anew(self) -> None:
        """Forget packets and times."""
        for received in self._outputs.values():
            received.begin_anew()
        self._known = dict.fromkeys(self._outputs, 0)
        self._sim_times: Mapping[str, float] = {}
        self._journal, self._unnoted = [], 0
        self._why_no_fork = ""

    # ------------------------------------------------------------------ time

    @property
    def is_running(self) -> bool:
        """Whether the run has not ended."""
        return self._run is None

    @property
    def sim_time(self) -> float | None:
        """Simulated seconds, ``None`` where they are unknown."""
        return max(self._sim_times.values(), default=None)

    def step(
        self,
        rounds: int | None = None,
        *,
        sim_s: float | None = None,
        until: Callable[[Session], object] | None = None,
        timeout_s: float | None = None,
    ) -> bool:
        """Let the run go on by rounds, each until nothing moves any more.

        Args:
            rounds: so many; one if no length is given.
            sim_s: in their place, as many as it takes for so many simulated seconds.
            until: or as many as it takes until ``until(session)`` is true; it is asked before.
            timeout_s: the longest time to wait, in wall seconds; ``None``: for ever.

        Returns:
            Whether the run goes on; ``False`` once the project has ended itself.

        Raises:
            RunError: if it has failed, or had ended before.
            TimeoutError: if it takes longer; what goes on is waited for by the next step, but not
                by :meth:`send`, :meth:`state`, a :meth:`run` of wall time and :meth:`reset`. The
                first look at an output waits for a second, then raises this error, too. Where the
                nodes are in the thread of this program, a hook that does not return is interrupted
                a second later, which fails the run: the error says where it stood.
            UsageError: for more than one length, for ``sim_s`` where no node owns simulated time,
                and for a length that is no number, negative or not finite.
        """
        count = check_length(rounds, sim_s, until)
        end_s = None if timeout_s is None else _end_of(timeout_s)
        with self._lock:
            if self._run is not None:
                self._check_running()
            if until is not None and self._held.is_behind and not self._advance(0, end_s):
                return False
            is_counted = sim_s is None and until is None
            for _ in range(count) if is_counted else self._rounds(sim_s, until):
                self._unnoted += 1
                if not self._take(self._held.advance(1, self._known, end_s)):
                    return False
            return self._run is None  # `until` may have closed it

    async def astep(self, rounds: int | None = None, **options: Any) -> bool:
        """As :meth:`step`, for coroutines."""
        return await asyncio.to_thread(partial(self.step, rounds, **options))

    def run(self, *, duration_s: float | None = None, duration_sim_s: float | None = None) -> bool:
        """Let the run go freely for a time, as without a session, then hold it again.

        Args:
            duration_s: wall seconds; the run is held when they are over.
            duration_sim_s: simulated seconds. So many rounds are granted at once that it is not
                held in between, and ends with the round that reaches the time.

        Returns:
            As :meth:`step`, and raises what that raises.
        """
        if (duration_s is None) == (duration_sim_s is None):
            raise UsageError("run: give either duration_s or duration_sim_s")
        with self._lock:
            self._check_running()
            if duration_s is None:
                return self._run_sim(check_seconds(duration_sim_s=duration_sim_s))
            duration_s = check_seconds(duration_s=duration_s)
            if self._project.is_virtual:
                self._note("run", duration_s)
            else:
                self._why_no_fork = (
                    "it ran for a wall time (run(duration_s=...)): use duration_sim_s"
                )
            return self._take(self._held.run_for(duration_s, self._known))

    def reset(
        self,
        seed: int | None = None,
        *,
        set: Mapping[str, Any] | None = None,
        keep: bool | str | Sequence[str] = False,
    ) -> None:
        """Bring every node back to where it was when the session began, with a seed and settings.

        The same seed and settings give the same packets from then on. Where all nodes are in one
        process, and nothing is recorded, they are loaded anew in it, or their ``@neuros_reset``
        hooks run; else the run is ended, drained, and a new one takes its place (see :attr:`runs`).
        A run that has ended or failed can be reset, too.

        Args:
            seed: for every variable with SEED in its name in the environment of a node; ``None``:
                that of before.
            set: values that replace those of the project until the next reset, by path:
                ``nodes.robot.environment.RATE``, or any other path of ``--set``; and fields of a
                MuJoCo model: ``robot.model.geom_friction`` (of ``mujoco.MjModel``; a number for
                all its values, or all of them in its shape).
            keep: what survives of that which plugins keep (``node.keep``), as in
                ``"brain.weights"``, or several in a list; ``True``: all of it. Other values are
                those of the beginning, ``restore`` of the session included.

        Raises:
            UsageError: if there is a seed, and no node takes one; for a path that leads nowhere;
                for a name by which nothing is kept.
            ProjectError, EnvironmentFault, RunError: as for the start of a session.
        """
        with self._lock:
            seed = self._seed if seed is None else seed
            settings = with_model_fields(self._usual, set or {})
            kept = self._kept(keep)
            if not settings.keys() <= self._checked:
                self._prepare(seed, settings)  # says what is wrong with them
                self._checked |= settings.keys()
            if not self._reset_in_place(seed, settings, kept):
                start = self._prepare(seed, settings).start  # what is wrong ends no run
                run = self.close("the session was reset")
                self.runs.append(run)
                values = {f"{node}.{name}": run for node in kept for name in kept[node]}
                self._hold(start(values, {}))
                self._settings = settings
            self._seed, self._latest = seed, settings
            if kept:
                self._why_no_fork = "values were kept over its reset: reset it without keep"

    def fork(self, *, set: Mapping[str, Any] | None = None) -> Session:
        """A second session, which has come to where this one stands, and goes on by itself.

        It is a run of its own, executed again from the start of this one, or from its last reset:
        the same rounds, on the same packets. This session is not changed.

        Args:
            set: values that change there, by path: ``nodes.robot.environment.RATE``,
                ``nodes.robot.parameters.speed``, ``robot.model.geom_friction``. Hooks that read
                them from then on see them; a plugin that read them before can ask for a call
                (``node.on_change``).

        Raises:
            UsageError: if it cannot be repeated, with all reasons; for a path that a fork cannot
                change.
            ProjectError, EnvironmentFault: as for the start of a session.
            RunError: if it has ended, if it comes to another place, or if a node refuses a change.
        """
        with self._lock:
            self._check_running()
            prepared = self._prepare(self._seed, self._latest)
            why = why_not_repeatable(prepared.project, is_stepped=prepared.is_stepped)
            why += [self._why_no_fork] if self._why_no_fork else []
            if why:
                raise UsageError(
                    "\n".join(["the session cannot be forked:", *(f"  {each}" for each in why)])
                )
            changes = changes_of(
                prepared.project,
                set or {},
                lambda more: self._prepare(self._seed, {**self._latest, **more}).project,
            )
            counts = self.sent_counts()
            journal = [*self._journal, ("advance", (self._unnoted, None))]
            about = {
                "run": str(self.folder),
                "at_sim_s": self.sim_time,
                "set": {path: value_text(path, value) for path, value in (set or {}).items()},
            }
            other = Session(
                self._prepare,
                self._seed,
                about,
                settings=self._latest,
                is_forkable=self._is_forkable,
            )
        try:
            other.change(changes, only_checks=True)
            for what, arguments in journal:
                if what == "advance":
                    other._advance(arguments[0], None, arguments[1])
                elif what == "run":
                    other.run(duration_s=arguments[0])
                elif what == "send":
                    other._held.deliver(*arguments)
                    other._note(what, *arguments)
                else:
                    other.change(*arguments)
            if (found := other.sent_counts()) != counts:
                name = next(name for name in counts if counts[name] != found.get(name))
                raise RunError(
                    f"the fork has come to another place: {found.get(name)} packets on {name}, and"
                    f" {counts[name]} in this session: does a plugin use wall time, or random"
                    " numbers without a seed?",
                    1,
                )
            other.change(changes)
        except BaseException as error:
            other._held.interrupt(*why_it_ended(error))
            raise
        return other

    def change(self, changes: Changes, *, only_checks: bool = False) -> None:
        """Change environments and parameters of nodes, which go on from where they are.

        Args:
            only_checks: whether to check that this is possible, and to change nothing.

        Raises:
            RunError: if a node refuses that, which ends the run.
        """
        if changes and not self._take(self._held.change(changes, only_checks=only_checks)):
            self._check_running()
        if changes and not only_checks:
            self._note("change", changes)

    def sent_counts(self) -> dict[str, int]:
        """By connection, how many packets were sent. Raises ``RunError`` if the run has ended."""
        metrics = [status.counters.metrics for status in self.state().values() if status.counters]
        return {name: sent["sent"] for each in metrics for name, sent in each["outgoing"].items()}

    def finish(self) -> Run:
        """Let the run go freely to its own end, and return what it has left behind."""
        with self._lock:
            if self._run is None:
                assert isinstance(self._held, LaunchedRun)
                self._held.resume()
                self._end()
            assert self._run is not None
            return self._run

    def _note(self, name: str, *arguments: Any) -> None:
        """Remember what a fork has to do again."""
        if self._unnoted:
            self._journal.append(("advance", (self._unnoted, None)))
            self._unnoted = 0
        self._journal.append((name, arguments))

    def _kept(self, asked: bool | str | Sequence[str]) -> dict[str, list[str]]:
        """The names of the values that a reset keeps, by node."""
        if not asked:
            return {}
        if (statuses := self._held.look() if self._run is None else None) is not None:
            known = [f"{each.node}.{name}" for each in statuses for name in each.keeps]
        else:  # it has ended
            self._end()
            assert self._run is not None
            nodes = self._run.nodes.items()
            known = [
                f"{node}.{name}" for node, figures in nodes for name in figures.get("kept", ())
            ]
        wanted = [asked] if isinstance(asked, str) else known if asked is True else [*asked]
        found: dict[str, list[str]] = {}
        for value in wanted:
            node, _, name = value.partition(".")
            if value not in known:
                has = f"plugins keep {listed(known)}" if known else "no plugin has called node.keep"
                hint = did_you_mean(value, known) or has
                raise UsageError(f"keep: nothing in node '{node}' keeps '{name}' ({hint})")
            found.setdefault(node, []).append(name)
        return found

    def _reset_in_place(
        self, seed: int | None, settings: Mapping[str, Any], kept: Mapping[str, Sequence[str]]
    ) -> bool:
        """Whether the nodes could be reset in their process."""
        variables = {} if seed is None else seed_variables(self._project, seed)
        usual = {node.name: node.environment for node in self._usual.nodes}
        for path in (*self._settings, *settings):
            kind, _, rest = path.partition(".")
            node, _, rest = rest.partition(".")
            place, _, variable = rest.partition(".")
            is_variable = kind == "nodes" and node in usual and place == "environment"
            if not (is_variable and variable):
                return False
            value = settings[path] if path in settings else usual[node].get(variable)
            if value is None:
                return False
            variables.setdefault(node, {})[variable] = value_text(path, value)
        try:
            if self._run is not None or not self._held.reset(variables, kept):
                return False
        except RunError:
            return False
        except KeyboardInterrupt as error:  # some nodes are reset, and others are not
            self._held.interrupt(*why_it_ended(error))
            self._end()
            raise
        self._begin_anew()
        self._take(self._held.begin(self._known))
        return True

    # ------------------------------------------------------------------ packets

    def __getitem__(self, output: str) -> SessionOutput:
        """An output, ``robot.imu``. Raises ``UsageError`` if there is none of that name."""
        node, port = port_of(self._project, output, is_input=False)
        return SessionOutput(self, f"{node.name}.{port.name}", port)

    def probe(self, output: str, *, every: int = 1) -> PacketProbe:
        """Keep the packets of an output from now on, over resets, too.

        Args:
            every: each packet is kept that follows so many others: 1 keeps all, 10 each tenth one.
        """
        if every < 1:
            raise UsageError(f"every={every}: give 1 or more packets")
        found = self[output]
        with self._lock:
            probe = PacketProbe(found.name, found._port, every)
            self._received(found.name)._probes.append((probe, partial(self._copy, found._port)))
        return probe

    def send(self, input_name: str, message: Any) -> None:
        """Send a packet to an input that the project leaves free, or that was taken over.

        It waits in the queue of the input (of 10 packets, or ``depth`` of its ``qos``) for a hook
        that starts on it in the next round. The message is sent as it is now.

        Raises:
            UsageError: if the node has no such input, or a connection feeds it.
            TypeError, ValueError: if the message is of another type, or holds a value that no node
                may send.
            RunError: if the run has ended.
        """
        if input_name not in self._ports:
            self._ports[input_name] = self._input(input_name)
        node, port = self._ports[input_name]
        packet = checked(port, message)
        with self._lock:
            if self._run is not None:
                self._check_running()
            self._held.deliver(node.name, port, packet)
            if self._is_forkable:
                own = RosPackets().copier(port.type)(packet)
                self._note("send", node.name, port, own)
            elif not self._why_no_fork:
                self._why_no_fork = (
                    f"{input_name} was sent packets that are not kept: begin it with"
                    " session(forkable=True)"
                )

    def _input(self, input_name: str) -> tuple[Node, Port]:
        node, port = port_of(self._project, input_name, is_input=True)
        name = f"{node.name}.{port.name}"
        if name not in self._inputs:
            feeding = " and ".join(connections_to(self._project, name))
            raise UsageError(
                f"{name}: {feeding} feeds this input: take it over with"
                f' session(take_over="{name}"), or send to another;'
                f" {declared_at(node)}"
            )
        return node, port

    # ------------------------------------------------------------------ state

    def state(self) -> dict[str, NodeStatus]:
        """State and counters of each node, by name.

        ``state()["robot"].counters.metrics`` has ``state``, ``hooks``, ``incoming``, ``outgoing``.

        Raises:
            RunError: if the run has ended.
        """
        with self._lock:
            self._check_running()
            found = self._held.look()
            if found is None:
                self._end()
                self._check_running()
        return {status.node: status for status in found or ()}

    def close(self, reason: str = "the session was closed") -> Run:
        """End the run, drained, and return what it has left behind; a second time the same."""
        with self._lock:
            if self._run is None:
                self._held.stop(reason)
                self._end()
            assert self._run is not None
            return self._run

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None and self._run is None:
            self._held.interrupt(*why_it_ended(error))
            self._end()
        self.close()

    def __repr__(self) -> str:
        time_s = "" if self.sim_time is None else f", {self.sim_time:g} s simulated"
        state = f"held{time_s}" if self.is_running else "ended"
        return f"<Session of {self._project.name}: {state}; {self.folder}>"

    def _repr_html_(self) -> str:
        """For notebooks: the graph, if an extension draws it, and how often hooks have run."""
        if self._run is not None:
            return f"<pre>{html.escape(run_table(self._run.record))}</pre>"
        rows = "".join(
            f"<tr><td>{name}</td><td>{html.escape(hook)}</td><td>{figures['executions']}</td></tr>"
            for name, status in self.state().items()
            if status.counters is not None
            for hook, figures in status.counters.metrics["hooks"].items()
        )
        head = "<tr><th>node</th><th>hook</th><th>executions</th></tr>"
        caption = html.escape(repr(self))
        graph = BAG_FORMATS.load("svg")(self._project) if "svg" in BAG_FORMATS else ""
        return f"{graph}<p>{caption}</p><table>{head}{rows}</table>"

    # ------------------------------------------------------------------ inside

    def _rounds(
        self, sim_s: float | None, until: Callable[[Session], object] | None
    ) -> Iterator[None]:
        """As many turns as there are rounds to go."""
        if until is not None:
            while not until(self):
                yield
        if sim_s is not None:
            end_s = self._sim_now() + sim_s
            at_rest = 0
            while (now_s := self._sim_now()) < end_s - _FINE:
                yield
                at_rest = 0 if self._sim_now() > now_s else at_rest + 1
                self._check_progress(at_rest)

    def _run_sim(self, duration_s: float) -> bool:
        """Grant many rounds at once, but none that is to begin after the end.

        In one thread the nodes know the end, too. Elsewhere a round is taken to gain twice as much
        as the largest average so far, so a grant covers half of what is left, or less. Where rounds
        suddenly gain several times as much, some may begin after it.
        """
        end_s = self._sim_now() + duration_s
        count, at_rest, most_s = 1, 0, 0.0
        while (now_s := self._sim_now()) < end_s - _FINE:
            if not self._advance(count, end_sim_s=end_s - _FINE):
                return False
            gained_s = self._sim_now() - now_s
            at_rest = 0 if gained_s > 0 else at_rest + 1
            self._check_progress(at_rest)
            most_s = max(most_s, gained_s / count)
            if gained_s > 0:
                safe = int((end_s - self._sim_now()) / (_MOST_VARIATION * most_s))
                count = max(1, min(2 * count, safe))
        return True

    def _sim_now(self) -> float:
        if not any(node.owns_time for node in self._project.nodes):
            raise UsageError(
                f"no node of {self._project.name} owns simulated time: step by rounds, or give"
                " duration_s"
            )
        return self.sim_time or 0.0

    def _check_progress(self, at_rest: int) -> None:
        if at_rest >= _MOST_ROUNDS_AT_REST:
            raise TimeoutError(
                f"simulated time has stood still at {self._sim_now():g} s for {at_rest} rounds:"
                " does a hook wait for an input that the session has to send?"
            )

    def _advance(
        self, rounds: int, end_s: float | None = None, end_sim_s: float | None = None
    ) -> bool:
        """Go on by rounds, and wait until nothing moves; whether the run goes on."""
        if end_sim_s is None:
            self._unnoted += rounds
        else:
            self._note("advance", rounds, end_sim_s)
        return self._take(self._held.advance(rounds, self._known, end_s, end_sim_s))

    def _take(self, answer: AtRest | None) -> bool:
        """Keep times and packets; whether the run goes on."""
        if answer is None:
            self._end()
            self._check_well()
            return False
        self._sim_times = answer.sim_times
        for name, (count, contents) in answer.packets.items():
            self._outputs[name].add(count, contents, self._held.size_of)
            self._known[name] = count
        return True

    def _received(self, output: str, wait_s: float | None = _READ_S) -> _Received:
        """What has come from an output.

        Args:
            wait_s: for so long at most, if a round was given up: it may go on for ever.
        """
        with self._lock:
            received = self._outputs.get(output)
            if received is None:
                received = self._outputs[output] = _Received()
                self._known[output] = 0
                if self._run is not None:
                    self._take_last(output, received)
                end_s = _end_of(wait_s if self._held.is_behind else None)
                try:
                    if self._run is None:
                        self._advance(0, end_s)
                except BaseException:
                    del self._outputs[output], self._known[output]
                    raise
            return received

    def _copy(self, port: Port, content: Any) -> Any:
        return self._held.copy(port.type, content)

    def _end(self) -> None:
        self._run = self._held.wait()
        for name, received in self._outputs.items():
            self._take_last(name, received)

    def _take_last(self, name: str, received: _Received) -> None:
        """Keep the packets that came after the last answer."""
        count, contents = self._held.last_packets(name)
        if count > received.count:
            received.add(count, contents[received.count - count :], self._held.size_of)

    def _check_running(self) -> None:
        if self._run is not None:
            self._check_well()
            raise RunError(f"the run has ended: {self._run.reason}", self._run.exit_code)

    def _check_well(self) -> None:
        """Raise ``RunError`` if the run has failed; its cause is the error of the node."""
        assert self._run is not None
        try:
            self._run.check()
        except NeurosError as error:
            raise error from self._held.error


class _Received:
    """What a session has received of an output.

    Attributes:
        count: how many packets the output has sent.
        newest: the content of the newest.
        unread: contents since the program looked at them last, as many as there is room for.
        dropped: how many packets the program could not read, because it looked too late.
    """

    def __init__(self) -> None:
        self._probes: list[tuple[PacketProbe, Callable[[Any], Any]]] = []
        self.begin_anew()

    def begin_anew(self) -> None:
        """The run is another one."""
        self.count, self.newest = 0, None
        self.unread: deque[Any] = deque()
        self.dropped = 0

    def add(self, count: int, contents: Sequence[Any], size_of: Callable[[Any], int]) -> None:
        """Packets have come; the last one is the newest of so many."""
        if self.unread.maxlen is None:
            self.unread = deque(maxlen=room_for(size_of(contents[0])))
        assert self.unread.maxlen is not None
        lost = count - self.count - len(contents)
        room = self.unread.maxlen - len(self.unread)
        self.dropped += lost + max(0, len(contents) - room)
        self.count, self.newest = count, contents[-1]
        self.unread.extend(contents)
        for probe, copy in self._probes:
            probe._add(contents, lost, copy)


class SessionOutput:
    """An output of a node, as a session sees it: ``session["robot.imu"]``.

    Attributes:
        name: of node and output.
    """

    def __init__(self, session: Session, name: str, port: Port) -> None:
        self._session = session
        self.name = name
        self._port = port

    @property
    def count(self) -> int:
        """How many packets it has sent."""
        return self._session._received(self.name).count

    @property
    def packet(self) -> Any:
        """The newest packet, a message of its type; ``None`` before the first.

        It is the program's own: each look gives another copy.
        """
        received = self._session._received(self.name)
        return self._session._copy(self._port, received.newest) if received.count else None

    @property
    def shared_packet(self) -> Any:
        """As :attr:`packet`, without a copy: nobody may change it."""
        received = self._session._received(self.name)
        if not received.count:
            return None
        return self._session._held.view(self._port.type, received.newest)

    @property
    def packets(self) -> list[Any]:
        """The packets since this was looked at last, oldest first.

        A session keeps the newest 1000 of an output, or 64 MB of them. What was dropped because it
        was looked at too late is a Python warning, and counted by :attr:`dropped`.
        """
        received = self._session._received(self.name)
        with self._session._lock:
            contents = [*received.unread]
            received.unread.clear()
            dropped, received.dropped = received.dropped, 0
        if dropped:
            warnings.warn(
                f"{self.name}: {dropped} packets were dropped: only the newest"
                f" {len(contents)} are kept; look at `packets` more often, or use a probe",
                stacklevel=2,
            )
        return [self._session._copy(self._port, content) for content in contents]

    @property
    def dropped(self) -> int:
        """How many packets the next look at :attr:`packets` will miss."""
        return self._session._received(self.name).dropped

    def wait(self, timeout_s: float | None = None) -> Any:
        """Step until it sends a further packet, and return that.

        Raises:
            TimeoutError: if none comes in so many wall seconds.
            RunError: if the run ends before.
        """
        session = self._session
        end_s = _end_of(timeout_s)
        before = session._received(self.name, timeout_s).count

        def is_there(_: Session) -> bool:
            if self.count == before and end_s is not None and time.monotonic() >= end_s:
                raise TimeoutError(f"{self.name} has sent nothing in {timeout_s:g} s")
            return self.count > before

        if not session.step(until=is_there, timeout_s=timeout_s):
            session._check_running()
        return self.packet

    def __repr__(self) -> str:
        try:
            count = str(self.count)
        except (TimeoutError, RunError):
            count = "an unknown number of"
        return f"<{self.name}: {count} packets of {self._port.type}>"


class PacketProbe:
    """The packets of an output since :meth:`Session.probe`, oldest first.

    Attributes:
        name: of node and output.
        packets: its packets, messages of their type.
        dropped: how many came so fast, between two rounds, that they were not kept.
    """

    def __init__(self, name: str, port: Port, every: int) -> None:
        self.name = name
        self.packets: list[Any] = []
        self.dropped = 0
        self._type = port.type
        self._has_fields = port.array is None
        self._every = every
        self._count = 0

    def __len__(self) -> int:
        return len(self.packets)

    def array(self, field: str = "") -> np.ndarray[Any, np.dtype[Any]]:
        """One field of all packets, ``linear_acceleration.x``: an array, a row per packet.

        Without a field: all packets of a port of arrays.

        Raises:
            UsageError: if packets have no such field, or its lengths differ.
        """
        if not field and not self._has_fields:
            return np.array(self.packets)
        try:
            if not (field and self._has_fields):
                raise AttributeError
            rows = [np.asarray(operator.attrgetter(field)(packet)) for packet in self.packets]
        except AttributeError:
            raise UsageError(f"{self.name}: {self._type} has no field '{field}'") from None
        if len({row.shape for row in rows}) > 1:
            raise UsageError(f"{self.name}: the length of '{field}' differs from packet to packet")
        return np.array(rows)

    def _add(self, contents: Sequence[Any], lost: int, copy: Callable[[Any], Any]) -> None:
        self.dropped += lost
        for content in contents:
            if self._count % self._every == 0:
                self.packets.append(copy(content))
            self._count += 1

    def __repr__(self) -> str:
        return f"<PacketProbe of {self.name}: {len(self)} packets of {self._type}>"


def check_length(
    rounds: int | None, sim_s: float | None, until: Callable[[Session], object] | None = None
) -> int:
    """Refuse a length of a step that is no length; returns the number of rounds.

    Raises:
        UsageError: for it, and for more than one.
    """
    if rounds is None and sim_s is None and until is None:
        return 1
    given = {"rounds": rounds, "sim_s": sim_s, "until": until}
    names = [name for name, value in given.items() if value is not None]
    if len(names) > 1:
        raise UsageError(f"step: {' and '.join(names)} are lengths of one step: give one of them")
    if until is not None and not callable(until):
        raise UsageError(f"until={until!r}: give a function that takes the session")
    if sim_s is not None:
        check_seconds(sim_s=sim_s)
    if rounds is None:
        return 1
    try:
        count = operator.index(rounds)
    except TypeError:
        raise UsageError(f"rounds={rounds!r}: give a whole number") from None
    if count < 0 or isinstance(rounds, bool):
        raise UsageError(f"rounds={rounds!r}: give 0 or more")
    return count


def _end_of(timeout_s: float | None) -> float | None:
    """When a time-out is over (monotonic, seconds)."""
    if timeout_s is None:
        return None
    return time.monotonic() + min(check_seconds(timeout_s=timeout_s), _LONGEST_S)


def check_seconds(**named: Any) -> float:
    """The value of the one argument, in seconds. Raises ``UsageError`` if it is no such number."""
    ((name, seconds),) = named.items()
    try:
        if 0 <= float(seconds) < math.inf and not isinstance(seconds, bool | str):
            return float(seconds)
    except (TypeError, ValueError):
        pass
    raise UsageError(f"{name}={seconds!r}: give 0 or more seconds")
