"""A run that a Python program holds in its hand: it steps the run, reads outputs and feeds inputs.

The session is an observer on the control channel of the run, which stands paused from its start.
Its inputs are external topics that are on no ROS graph: packets for them, like steps, go over the
control channel, so a packet that is sent before a step is there when the step begins.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any

from neuros.api.loading import seed_variables
from neuros.api.run import Run
from neuros.api.run_record import run_table
from neuros.api.session_link import Held, SessionLink, connections_to, declared_at, port_of
from neuros.backends.control_sockets import connect
from neuros.control import (
    TO_OBSERVERS,
    AtRest,
    LookAll,
    Message,
    NodeStatus,
    Pause,
    Reset,
    Resume,
    WasReset,
    Watch,
)
from neuros.control.link import ControlLink
from neuros.errors import RunError, UsageError
from neuros.project.graph import graph_svg
from neuros.project.model import Node, Port
from neuros.transport.messages import RosPackets, checked

_CONNECT_S = 0.01
_READ_S = 1.0
_MOST_ROUNDS_AT_REST = 1000
_FINE = 1e-9
_MOST_VARIATION = 2.0


class Session:
    """A run that stands still, but for the steps of this program::

        with neuros.Project.from_file("project.json").session(backend="in-process") as s:
            while s["robot.imu"].packet is None:
                s.step()
            s.send("robot.wheels", command)
            s.step(sim_s=0.02)

    A *round* lets each hook that drives the project start once, and lasts until nothing moves any
    more. Several threads may use it, one at a time. At the end of the block the run is ended,
    drained; where the block fails, interrupted.

    Attributes:
        folder: the run folder.
        runs: those that a reset has ended; each has a folder of its own.
    """

    def __init__(self, start: Callable[[int | None], Held], seed: int | None) -> None:
        self._start = start
        self._seed = seed
        self._packets = RosPackets()
        self._lock = threading.RLock()
        self._newest: dict[str, tuple[int, bytes]] = {}
        self.runs: list[Run] = []
        self._hold(start(seed))

    def _hold(self, held: Held) -> None:
        """Take a run that has just been started."""
        self._live, self._project, self._inputs = held.live, held.project, held.inputs
        self._ports: dict[str, tuple[Node, Port]] = {}  # of inputs, by name
        self.folder = held.live.folder
        self._run: Run | None = None
        sys.path[:0] = [path for path in map(str, held.messages) if path not in sys.path]
        try:
            self._link = SessionLink(self._connect(), self.folder)
            self._link.send(Watch())
            self._begin()
        except BaseException:
            held.live.end()
            raise

    def _begin(self) -> None:
        """Forget packets and times, and wait until the initialise hooks have run."""
        self._newest = dict.fromkeys(self._newest, (0, b""))
        self._decoded: dict[str, tuple[int, Any]] = {}
        self._sim_times: Mapping[str, float] = {}
        self._settle()

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
        rounds: int = 1,
        *,
        sim_s: float | None = None,
        until: Callable[[Session], object] | None = None,
        timeout_s: float | None = None,
    ) -> bool:
        """Let the run go on by rounds, each until nothing moves any more.

        Args:
            rounds: so many.
            sim_s: in their place, as many as it takes for so many simulated seconds.
            until: or as many as it takes until ``until(session)`` is true; it is asked before.
            timeout_s: the longest time to wait, in wall seconds; ``None``: for ever.

        Returns:
            Whether the run goes on; ``False`` once the project has ended itself.

        Raises:
            RunError: if it has failed, or had ended before.
            TimeoutError: if it takes longer; what goes on is waited for by the next step, but not
                by :meth:`send`, :meth:`state`, a :meth:`run` of wall time and :meth:`reset`. The
                first look at an output waits for a second, then raises this error, too.
            UsageError: for ``sim_s`` where no node owns simulated time, and for a length that is
                negative or not finite.
        """
        check_length(rounds, sim_s)
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        with self._lock:
            self._check_running()
            if until is not None and self._link.is_behind and not self._advance(0, end_s):
                return False
            for _ in self._rounds(rounds, sim_s, until):
                if not self._advance(1, end_s):
                    return False
        return True

    async def astep(self, rounds: int = 1, **options: Any) -> bool:
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
        _check_seconds("duration_s", duration_s)
        _check_seconds("duration_sim_s", duration_sim_s)
        if (duration_s is None) == (duration_sim_s is None):
            raise UsageError("run: give either duration_s or duration_sim_s")
        with self._lock:
            self._check_running()
            if duration_s is None:
                return self._run_sim(float(duration_sim_s or 0.0))
            self._link.send(Resume())
            try:
                with contextlib.suppress(TimeoutError):
                    self._wait_for(lambda message: False, time.monotonic() + duration_s)
            finally:
                self._link.send(Pause())
            return self._run is None and self._settle()

    def reset(self, seed: int | None = None) -> None:
        """Bring every node back to where it was when the session began, with a seed.

        The same seed gives the same packets from then on. Where all nodes are in one process, and
        nothing is recorded, they are loaded anew in it, or their ``@neuros_reset`` hooks run; else
        the run is ended, drained, and a new one takes its place (see :attr:`runs`). A run that has
        ended or failed can be reset, too.

        Args:
            seed: for every variable with SEED in its name in the environment of a node; ``None``:
                that of before.

        Raises:
            UsageError: if there is a seed, and no node takes one.
            ProjectError, EnvironmentFault, RunError: as for the start of a session.
        """
        with self._lock:
            seed = self._seed if seed is None else seed
            variables = {} if seed is None else seed_variables(self._project, seed)
            if not self._reset_in_place(variables):
                self.runs.append(self.close("the session was reset"))
                self._hold(self._start(seed))
            self._seed = seed

    def _reset_in_place(self, variables: Mapping[str, Mapping[str, str]]) -> bool:
        """Whether the nodes could be reset in their process."""
        answers: list[WasReset] = []

        def is_answer(message: Message) -> bool:
            if isinstance(message, WasReset):
                answers.append(message)
            return bool(answers)

        if self._run is not None or not self._has_come_to_rest():
            return False
        self._link.send(Reset(variables))
        if not self._wait_for(is_answer, None):
            self._check_running()
        if answers[0].why_not:
            return False
        self._begin()
        return True

    def _has_come_to_rest(self) -> bool:
        try:
            # A round that was given up may go on for ever: it ends as a free run does.
            return self.run(duration_s=0.0) if self._link.is_behind else self._advance(0)
        except RunError:
            return False

    # ------------------------------------------------------------------ packets

    def __getitem__(self, output: str) -> SessionOutput:
        """An output, ``robot.imu``. Raises ``UsageError`` if there is none of that name."""
        node, port = port_of(self._project, output, is_input=False)
        return SessionOutput(self, f"{node.name}.{port.name}", port)

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
            self._ports[input_name] = port_of(self._project, input_name, is_input=True)
        node, port = self._ports[input_name]
        name = f"{node.name}.{port.name}"
        if name not in self._inputs:
            feeding = " and ".join(connections_to(self._project, name))
            raise UsageError(
                f"{name}: {feeding} feeds this input: take it over with"
                f' session(take_over="{name}"), or send to another;'
                f" {declared_at(node)}"
            )
        packet = checked(port, message)
        content = self._packets.encode(packet)
        with self._lock:
            self._check_running()
            self._link.deliver(node.name, port.name, content)

    # ------------------------------------------------------------------ state

    def state(self) -> dict[str, NodeStatus]:
        """State and counters of each node, by name.

        ``state()["robot"].counters.metrics`` has ``state``, ``hooks``, ``incoming``, ``outgoing``.

        Raises:
            RunError: if the run has ended.
        """
        found: dict[str, NodeStatus] = {}

        def is_last(message: Message) -> bool:
            if isinstance(message, NodeStatus):
                found[message.node] = message
            return len(found) == len(self._project.nodes)

        with self._lock:
            self._check_running()
            if not self._link.is_behind:  # else a round goes on, perhaps for ever
                self._advance(0)  # what was sent has arrived then
            self._link.send(LookAll({}))
            if not self._wait_for(is_last, None):
                self._check_running()
        return found

    def close(self, reason: str = "the session was closed") -> Run:
        """End the run, drained, and return what it has left behind; a second time the same."""
        with self._lock:
            if self._run is None:
                self._link.leave_nodes()
                self._live.stop(reason)
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
            self._live.fail(error)
            self._end()
        self.close()

    def __repr__(self) -> str:
        time_s = "" if self.sim_time is None else f", {self.sim_time:g} s simulated"
        state = f"held{time_s}" if self.is_running else "ended"
        return f"<Session of {self._project.name}: {state}; {self.folder}>"

    def _repr_html_(self) -> str:
        """For notebooks: the graph, and how often hooks have run."""
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
        return f"{graph_svg(self._project)}<p>{caption}</p><table>{head}{rows}</table>"

    # ------------------------------------------------------------------ inside

    def _connect(self) -> ControlLink:
        while True:
            try:
                stream = connect(self._live.control_address)
            except OSError:
                with contextlib.suppress(TimeoutError):
                    self._run = self._live.wait(_CONNECT_S)
                    self._check_running()
            else:
                return ControlLink(stream, TO_OBSERVERS, "the supervisor")

    def _rounds(
        self, rounds: int, sim_s: float | None, until: Callable[[Session], object] | None
    ) -> Iterator[None]:
        """As many turns as there are rounds to go."""
        if until is not None:
            while not until(self):
                yield
        elif sim_s is not None:
            end_s = self._sim_now() + sim_s
            at_rest = 0
            while (now_s := self._sim_now()) < end_s - _FINE:
                yield
                at_rest = 0 if self._sim_now() > now_s else at_rest + 1
                self._check_progress(at_rest)
        else:
            yield from (None for _ in range(rounds))

    def _run_sim(self, duration_s: float) -> bool:
        """Grant many rounds at once, but none that is to begin after the end.

        In one process the nodes know the end, too. Elsewhere a round is taken to gain twice as much
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
        return self._note(self._link.advance(rounds, self._known, end_s, end_sim_s))

    def _settle(self) -> bool:
        """Wait until nothing moves, after what was said to the supervisor."""
        return self._note(self._link.settle(self._known))

    @property
    def _known(self) -> dict[str, int]:
        return {name: number for name, (number, _) in self._newest.items()}

    def _note(self, settled: AtRest | None) -> bool:
        if settled is not None:
            self._sim_times = settled.sim_times
            self._newest.update(settled.packets)
            return True
        self._end()
        assert self._run is not None
        self._run.check()
        return False

    def _wait_for(self, is_wanted: Callable[[Message], bool], end_s: float | None) -> bool:
        """As :meth:`SessionLink.wait_for`."""
        if self._link.wait_for(is_wanted, end_s):
            return True
        self._end()
        return False

    def _newest_of(self, output: str, wait_s: float | None = _READ_S) -> tuple[int, bytes]:
        """The newest packet of an output; number 0: there is none yet.

        Args:
            wait_s: for so long at most, if a round was given up: it may go on for ever.
        """
        with self._lock:
            if output not in self._newest:
                self._check_running()
                self._newest[output] = (0, b"")
                end_s = None
                if self._link.is_behind and wait_s is not None:
                    end_s = time.monotonic() + wait_s
                try:
                    self._advance(0, end_s)
                except TimeoutError:
                    del self._newest[output]
                    raise
            return self._newest[output]

    def _end(self) -> None:
        self._link.leave_nodes()
        self._run = self._live.wait()
        self._link.close()

    def _check_running(self) -> None:
        if self._run is not None:
            self._run.check()
            raise RunError(f"the run has ended: {self._run.reason}", self._run.exit_code)


@dataclass(frozen=True)
class SessionOutput:
    """An output of a node, as a session sees it: ``session["robot.imu"]``.

    Attributes:
        name: of node and output.
    """

    _session: Session
    name: str
    _port: Port

    @property
    def count(self) -> int:
        """How many packets it has sent."""
        return self._session._newest_of(self.name)[0]

    @property
    def packet(self) -> Any:
        """The newest packet, a message of its type; ``None`` before the first."""
        number, content = self._session._newest_of(self.name)
        if not number:
            return None
        decoded = self._session._decoded
        if decoded.get(self.name, (0,))[0] != number:
            packet = self._session._packets.decode(self._port.type, content)
            decoded[self.name] = number, packet
        return decoded[self.name][1]

    def wait(self, timeout_s: float | None = None) -> Any:
        """Step until it sends a further packet, and return that.

        Raises:
            TimeoutError: if none comes in so many wall seconds.
            RunError: if the run ends before.
        """
        session = self._session
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        before = session._newest_of(self.name, timeout_s)[0]

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
        except TimeoutError:
            count = "an unknown number of"
        return f"<{self.name}: {count} packets of {self._port.type}>"


def check_length(rounds: int, sim_s: float | None) -> None:
    """Refuse a length of a step that is no length; raises ``UsageError``."""
    if rounds < 0:
        raise UsageError(f"rounds={rounds}: give 0 or more")
    _check_seconds("sim_s", sim_s)


def _check_seconds(name: str, seconds: float | None) -> None:
    if seconds is not None and not 0 <= seconds < math.inf:
        raise UsageError(f"{name}={seconds:g}: give 0 or more seconds")
