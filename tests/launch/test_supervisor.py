"""However a run ends, the supervisor brings it to that end: exit code, reason, and nobody left.

The nodes are stand-ins: real processes that keep to the control channel, without ROS.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from neuros.errors import EnvironmentFault
from neuros.launch.host import HostProcess
from neuros.launch.in_process import InProcessLauncher
from neuros.launch.outcome import Outcome
from neuros.launch.process import ProcessLauncher
from neuros.launch.sides import Sides
from neuros.launch.supervisor import Supervisor
from neuros.project.model import Connection, Folders, Node, NodeFile

HOST = [sys.executable, "-S", str(Path(__file__).parent / "stand_in_host.py")]
WELL_BEHAVED = "host.up(); host.serve()"
SHUTS_DOWN = "host.up_last(); host.tell('shutdown', reason='enough', drain_s=5); host.serve()"
DEAF = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)"

Act = Callable[[], object]


@dataclass
class Output:
    """Notes what the supervisor says, and lets a test act when it says something."""

    said: list[str] = field(default_factory=list)
    when: dict[str, Act] = field(default_factory=dict)
    polls: list[Act] = field(default_factory=list)

    def log(self, severity: str, text: str) -> None:
        self.said.append(text)
        for beginning, act in tuple(self.when.items()):
            if text.startswith(beginning):
                del self.when[beginning]
                act()

    def poll(self) -> object:
        for act in self.polls:
            act()
        return None


class Run:
    """Runs stand-ins under a supervisor."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.output = Output()
        self.signals: list[int] = []
        self.hosts: list[HostProcess] = []
        self.lasted_s = 0.0

    def file(self, name: str, act: str, connections: tuple[Connection, ...]) -> NodeFile:
        node = Node(name, "", Path("/plugin.py"), environment={"ACT": f"{act}\n"})
        mine = tuple(c for c in connections if name in (c.source_node, c.destination_node))
        return NodeFile(node, mine, Folders(self.folder, self.folder, self.folder))

    def __call__(
        self,
        *,
        connections: tuple[Connection, ...] = (),
        in_process: bool = False,
        duration_s: float | None = None,
        elsewhere: tuple[str, ...] = (),
        **acts: str,
    ) -> Outcome:
        """Run nodes that do as the text under their names says, to the end."""
        files = [self.file(name, act, connections) for name, act in acts.items()]
        supervisor = Supervisor(
            files,
            _Noting(InProcessLauncher(HOST) if in_process else ProcessLauncher(HOST), self.hosts),
            {"ALL": " ".join(acts)} | ({"ACT": acts["all"]} if in_process else {}),
            self.folder,
            self.output,
            self.signals,
            duration_s=duration_s,
            sides=Sides("this run", elsewhere, files),
        )
        start_s = time.monotonic()
        outcome = supervisor.run()
        self.lasted_s = time.monotonic() - start_s
        for host in self.hosts:
            assert host.wait(5.0) is not None, "nobody is left"
        return outcome

    def clear(self) -> None:
        """Make the folder new."""
        self.hosts.clear()
        (self.folder / "control.sock").unlink()

    def after(self, beginning: str, act: Act) -> None:
        """Do something when the supervisor says something that begins like this."""
        self.output.when[beginning] = act

    def when_file_exists(self, name: str, act: Act) -> None:
        """Do something once a stand-in has made a file in the run folder."""

        def look() -> None:
            if look in self.output.polls and (self.folder / name).exists():
                self.output.polls.remove(look)
                act()

        self.output.polls.append(look)

    def press_ctrl_c(self) -> None:
        self.signals.append(signal.SIGINT)


@dataclass
class _Noting:
    """A launcher whose hosts the test can look after."""

    launcher: Any
    hosts: list[HostProcess]

    def start(self, *arguments: Any) -> Any:
        self.hosts += self.launcher.start(*arguments)
        return list(self.hosts)

    def describe(self, *arguments: Any) -> Any:
        return self.launcher.describe(*arguments)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    run = Run(tmp_path)
    yield run
    for host in run.hosts:
        host.kill()
        host.wait(10)


def wire(text: str, index: int = 0) -> Connection:
    source, destination = text.split(" -> ")
    return Connection(*source.split("."), *destination.split("."), 0, index=index)


# ------------------------------------------------------------------ drained ends


def test_a_node_ends_the_project(run: Run) -> None:
    outcome = run(a=SHUTS_DOWN, b=WELL_BEHAVED)
    assert (outcome.exit_code, outcome.failures) == (0, [])
    assert outcome.reason == "a ended the project: enough"
    assert all(map(outcome.has_final_report, "ab"))
    assert outcome.started_s < outcome.ending_s < outcome.ended_s


def test_the_first_of_two_that_end_it_is_named(run: Run) -> None:
    too_late = "host.up(); host.wait_for('drain'); host.tell('shutdown', reason='', drain_s=0)"
    outcome = run(a=SHUTS_DOWN, b=f"{too_late}; host.serve()")
    assert (outcome.exit_code, outcome.reason) == (0, "a ended the project: enough")
    assert not any("b ended the project" in text for text in run.output.said)


def test_the_duration_counts_from_the_first_hook_and_ends_drained(run: Run) -> None:
    waits_first = "host.hello(); host.report(); import time; time.sleep(0.4); " + (
        "host.tell('first_hook'); host.serve()"
    )
    outcome = run(a=waits_first, duration_s=0.3)
    assert outcome.exit_code == 0
    assert outcome.reason == "0.3 s are over"
    assert 0.3 <= outcome.ending_s - outcome.started_s < 0.6


def test_a_pause_before_the_first_hook_leaves_the_duration_as_it_is(run: Run) -> None:
    paused = "host.tell('pause'); time.sleep(1.0); host.tell('resume')"
    act = f"host.hello(); host.report(); import time; {paused}; host.tell('first_hook')"
    outcome = run(a=f"{act}; host.serve()", duration_s=0.3)
    assert outcome.reason == "0.3 s are over"
    assert 0.3 <= outcome.ending_s - outcome.started_s < 1.0


def test_a_pause_is_no_part_of_the_duration(run: Run) -> None:
    pauses = "host.up(); import time; host.tell('pause'); time.sleep(0.6); host.tell('resume'); "
    outcome = run(a=f"{pauses} host.serve()", duration_s=0.3)
    assert outcome.reason == "0.3 s are over"
    assert outcome.ending_s - outcome.started_s >= 0.85
    assert 0.55 <= outcome.paused_s <= outcome.ending_s - outcome.started_s - 0.3


def test_a_run_that_is_stopped_while_paused_ended_when_the_pause_began(run: Run) -> None:
    pauses = "host.up(); import time; host.tell('pause'); time.sleep(0.6); host.tell('signal')"
    outcome = run(a=f"{pauses}; host.serve()")
    assert outcome.exit_code == 130
    assert outcome.paused_s >= 0.55
    assert outcome.ending_s + 0.55 <= outcome.ended_s


DRAINED_AFTER_A_LONG_HOOK = """
host.up()
host.wait_for('drain')
import time; time.sleep(0.5)
host.serve()
"""


def test_a_long_hook_is_waited_for(run: Run) -> None:
    run(a=SHUTS_DOWN, b=DRAINED_AFTER_A_LONG_HOOK)
    assert run.lasted_s > 0.5
    assert not any("not drained" in text for text in run.output.said)


def test_but_not_longer_than_it_was_said(run: Run) -> None:
    impatient = SHUTS_DOWN.replace("drain_s=5", "drain_s=0.2")
    outcome = run(a=impatient, b=DRAINED_AFTER_A_LONG_HOOK)
    assert outcome.exit_code == 0
    assert "not drained in time, so packets may be lost: b is busy" in run.output.said


PACKET_IS_LOST = """
host.connections['{side}']['a.o -> b.x'] = {{
    'sent': 3, 'received': 2, 'acknowledged': 2, 'is_blocked': False}}
"""


def test_packets_under_way_are_waited_for_and_named_if_they_do_not_come(run: Run) -> None:
    impatient = SHUTS_DOWN.replace("drain_s=5", "drain_s=0.2")
    run(
        a=PACKET_IS_LOST.format(side="outgoing") + impatient,
        b=PACKET_IS_LOST.format(side="incoming") + WELL_BEHAVED,
        connections=(wire("a.o -> b.x"),),
    )
    (text,) = [text for text in run.output.said if text.startswith("not drained")]
    assert text.endswith("a packet is under way on `a.o -> b.x`")


def test_a_node_that_had_not_been_loaded_is_not_waited_for_and_is_no_failure(run: Run) -> None:
    loading = "host.hello(); open('loading', 'w'); import time; time.sleep(60)"
    ends_then = """
import os, time
host.up()
while not os.path.exists('loading'):
    time.sleep(0.01)
host.tell('shutdown', reason='', drain_s=5)
host.serve()
"""
    outcome = run(a=ends_then, b=loading)
    assert (outcome.exit_code, outcome.failures) == (0, [])
    assert "'b' had not started yet: killed" in run.output.said
    assert run.lasted_s < 4


# ------------------------------------------------------------------ failures


def test_a_node_fails(run: Run) -> None:
    fails = (
        "host.up_last(); host.tell('failed', text='p.py:3: hook \\'f\\': ZeroDivisionError\\nmore')"
    )
    outcome = run(a=fails, b=WELL_BEHAVED)
    assert outcome.exit_code == 1
    assert outcome.reason == "node 'a' failed: p.py:3: hook 'f': ZeroDivisionError"
    assert outcome.failures == [outcome.reason], "that it then ended is no second failure"
    assert outcome.has_final_report("b"), "the others finalise"


def test_a_failure_without_words_is_one_all_the_same(run: Run) -> None:
    outcome = run(a="host.up(); host.tell('failed', text='')")
    assert outcome.reason == "node 'a' failed: no reason was given"


@pytest.mark.parametrize(
    ("act", "how"),
    [
        ("import os; os._exit(0)", "exit code 0"),
        ("import os; os._exit(7)", "exit code 7"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "killed by SIGSEGV"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "killed by SIGKILL"),
    ],
)
def test_a_node_that_ends_by_itself_is_a_failure(run: Run, act: str, how: str) -> None:
    outcome = run(a=f"host.up_last(); {act}", b=WELL_BEHAVED)
    assert outcome.exit_code == 1
    assert outcome.reason == f"node 'a' ended unexpectedly: {how}"
    assert outcome.has_final_report("b")


def test_a_node_that_ends_before_it_is_up_is_named_as_such(run: Run) -> None:
    outcome = run(a="raise SystemExit(3)", b=WELL_BEHAVED)
    assert outcome.exit_code == 1
    assert "node 'a' ended before it was up" in outcome.reason


def test_the_last_words_of_a_process_are_heard_however_fast_it_ends(run: Run) -> None:
    for _ in range(5):
        outcome = run(a="host.hello(); host.tell('failed', text='why')")
        assert outcome.reason == "node 'a' failed: why"
        run.clear()


def test_a_forked_child_that_keeps_the_socket_open_holds_up_nobody(
    run: Run, tmp_path: Path
) -> None:
    pid_file = tmp_path / "child.pid"
    forks = f"""
import os, time
host.up()
child = os.fork()
if child == 0:
    time.sleep(60)
with open({str(pid_file)!r}, "w") as file:
    file.write(str(child))
os._exit(0)
"""
    try:
        outcome = run(a=forks)
    finally:
        os.kill(int(pid_file.read_text()), signal.SIGKILL)
    assert outcome.reason == "node 'a' ended unexpectedly: exit code 0"
    assert run.lasted_s < 4


def test_a_node_that_fails_while_the_project_drains_makes_it_fail(run: Run) -> None:
    fails_late = "host.up(); host.wait_for('drain'); host.tell('failed', text='late'); host.serve()"
    outcome = run(a=SHUTS_DOWN, b=fails_late)
    assert (outcome.exit_code, outcome.reason) == (1, "node 'b' failed: late")


def test_so_does_one_that_fails_while_it_finalises(run: Run) -> None:
    fails_last = "host.up(); host.wait_for('stop'); host.tell('failed', text='last')"
    outcome = run(a=SHUTS_DOWN, b=fails_last)
    assert (outcome.exit_code, outcome.reason) == (1, "node 'b' failed: last")


def test_and_one_that_crashes_while_it_finalises(run: Run) -> None:
    crashes_last = (
        "host.up(); host.wait_for('stop'); import os, signal; os.kill(os.getpid(), signal.SIGABRT)"
    )
    outcome = run(a=SHUTS_DOWN, b=crashes_last)
    assert outcome.exit_code == 1
    assert outcome.reason == "node 'b' ended while finalising: killed by SIGABRT"


def test_how_a_process_ends_after_its_final_report_is_of_no_importance(run: Run) -> None:
    outcome = run(a=SHUTS_DOWN + "; import os; os.abort()")
    assert (outcome.exit_code, outcome.failures) == (0, [])


def test_every_failure_is_noted_and_the_first_decides(run: Run) -> None:
    outcome = run(
        a="host.up_last(); host.tell('failed', text='one'); host.wait_for('stop')",
        b="host.up(); host.wait_for('stop'); host.tell('failed', text='other')",
    )
    assert outcome.failures == ["node 'a' failed: one", "node 'b' failed: other"]
    assert outcome.reason == outcome.failures[0]


def test_a_deadlock_names_its_cycle(run: Run) -> None:
    blocked = "{{'sent': 1, 'acknowledged': 0, 'outstanding': 1, 'is_blocked': True}}"
    unread = "{{'received': 1, 'acknowledged': 0}}"
    stuck = (
        f"host.connections['outgoing']['{{0}}.o -> {{1}}.x'] = {blocked}\n"
        f"host.connections['incoming']['{{1}}.o -> {{0}}.x'] = {unread}\n" + WELL_BEHAVED
    )
    outcome = run(
        a=stuck.format("a", "b"),
        b=stuck.format("b", "a"),
        connections=(wire("a.o -> b.x"), wire("b.o -> a.x", 1)),
    )
    assert outcome.exit_code == 1
    assert outcome.reason.startswith(
        "deadlock: nothing can ever run again: a is blocked on `a.o -> b.x` (1 outstanding);"
        " b is blocked on `b.o -> a.x` (1 outstanding). "
    )


def test_there_is_no_deadlock_while_a_node_could_still_wake(run: Run) -> None:
    outcome = run(a="host.is_idle = False; " + WELL_BEHAVED, b=WELL_BEHAVED, duration_s=2.5)
    assert outcome.exit_code == 0


def test_nor_where_other_nodes_run_elsewhere(run: Run) -> None:
    assert run(a=WELL_BEHAVED, duration_s=2.5, elsewhere=("b",)).exit_code == 0


# ------------------------------------------------------------------ signals


@pytest.mark.parametrize(
    ("number", "exit_code", "name"),
    [
        (signal.SIGINT, 130, "Ctrl+C"),
        (signal.SIGTERM, 143, "SIGTERM"),
        (signal.SIGHUP, 143, "SIGHUP (the terminal was closed)"),
    ],
)
def test_a_signal_ends_the_run_without_draining(
    run: Run, number: int, exit_code: int, name: str
) -> None:
    notes_drain = """
host.up()
heard = []
while (message := host.hear())['kind'] != 'stop':
    heard.append(message['kind'])
assert 'drain' not in heard
host.report(is_final=True)
"""
    run.when_file_exists("a.up", lambda: run.signals.append(number))
    outcome = run(a=notes_drain)
    assert (outcome.exit_code, outcome.reason) == (exit_code, f"ended by {name}")
    assert outcome.has_final_report("a")


def test_a_signal_that_came_before_anything_was_started_starts_nothing(run: Run) -> None:
    run.press_ctrl_c()
    assert run(a=WELL_BEHAVED).exit_code == 130
    assert run.hosts == []


def test_a_signal_during_start_up_kills_what_has_not_been_loaded(run: Run) -> None:
    run.when_file_exists("there", run.press_ctrl_c)
    outcome = run(a=f"open('there', 'w'); {DEAF}", b=f"host.hello(); {DEAF}")
    assert (outcome.exit_code, outcome.failures) == (130, [])
    assert run.lasted_s < 4, "there is nothing to finalise"


def test_a_second_signal_kills_at_once(run: Run) -> None:
    run.when_file_exists("a.up", run.press_ctrl_c)
    run.after("Ctrl+C: stopping", run.press_ctrl_c)
    outcome = run(a=f"host.up(); {DEAF}")
    assert (outcome.exit_code, outcome.failures) == (130, [])
    assert run.lasted_s < 4


def test_one_ctrl_c_leaves_nodes_that_already_finalise_alone(run: Run) -> None:
    run.when_file_exists("stopping", run.press_ctrl_c)
    finalises = """
import time
host.up()
host.wait_for('stop')
open('stopping', 'w')
time.sleep(0.5)
host.report(is_final=True)
"""
    outcome = run(a=SHUTS_DOWN, b=finalises)
    assert "Ctrl+C: already ending (once more kills at once)" in run.output.said
    assert outcome.exit_code == 0
    assert outcome.has_final_report("b")


def test_two_do_not(run: Run) -> None:
    run.when_file_exists("stopping", run.press_ctrl_c)
    run.after("Ctrl+C: already ending", run.press_ctrl_c)
    outcome = run(
        a=SHUTS_DOWN, b=f"host.up(); host.wait_for('stop'); open('stopping', 'w'); {DEAF}"
    )
    assert outcome.exit_code == 0
    assert run.lasted_s < 4


def test_a_failure_while_a_signal_ends_the_run_is_noted(run: Run) -> None:
    run.when_file_exists("a.up", run.press_ctrl_c)
    fails = "host.up(); host.wait_for('stop'); host.tell('failed', text='why')"
    outcome = run(a=fails)
    assert (outcome.exit_code, outcome.reason) == (130, "ended by Ctrl+C")
    assert outcome.failures == ["node 'a' failed: why"]


# ------------------------------------------------------------------ nodes that do not cooperate


def test_a_node_that_does_not_end_is_killed_after_five_seconds(run: Run) -> None:
    outcome = run(a=SHUTS_DOWN, b=f"host.up(); host.wait_for('stop'); {DEAF}")
    assert "'b': not ended after 5 s, killed" in run.output.said
    assert outcome.exit_code == 0
    assert 5 <= run.lasted_s < 6.5


def test_a_stopped_node_holds_up_nobody(run: Run) -> None:
    stops = "host.up_last(); host.tell('shutdown', reason='', drain_s=0.2); " + (
        "import os, signal; os.kill(os.getpid(), signal.SIGSTOP)"
    )
    outcome = run(a=stops, b=WELL_BEHAVED)
    assert outcome.has_final_report("b")
    assert "'a': not ended after 5 s, killed" in run.output.said
    assert run.lasted_s < 7


def test_a_report_behind_the_final_one_does_not_count(run: Run) -> None:
    outcome = run(a=SHUTS_DOWN + "; host.report(late=True)")
    assert outcome.has_final_report("a")


def test_what_is_none_of_ours_on_the_socket_is_hung_up_on(run: Run) -> None:
    outcome = run(
        a="import socket; s = socket.socket(socket.AF_UNIX); s.connect('control.sock'); "
        "s.sendall(b'GET / HTTP/1.1\\n'); assert s.recv(1) == b''; " + SHUTS_DOWN
    )
    assert outcome.exit_code == 0


def test_explanations_are_shown_one_line_per_node(run: Run) -> None:
    explains = "host.up(); host.tell('explanation', lines=['waits for `x` from b', 'and more']); "
    run(a=explains + "host.tell('shutdown', reason='', drain_s=5); host.serve()")
    assert "a waits for `x` from b; and more" in run.output.said


# ------------------------------------------------------------------ several nodes in one process


def test_all_nodes_of_one_process_are_named_if_it_dies(run: Run) -> None:
    outcome = run(in_process=True, a="", b="", all="host.up(); import os; os._exit(1)")
    assert outcome.reason == "nodes 'a' and 'b' and 'all' ended unexpectedly: exit code 1"


def test_and_report_one_by_one(run: Run) -> None:
    outcome = run(in_process=True, a="", b="", all=SHUTS_DOWN)
    assert outcome.exit_code == 0
    assert set(outcome.reports) == {"a", "b", "all"}


# ------------------------------------------------------------------ the machine


def test_a_folder_that_another_run_uses_is_said_to_be_so(run: Run) -> None:
    (run.folder / "control.sock").touch()
    with pytest.raises(EnvironmentFault, match="is the folder used by another run"):
        run(a=WELL_BEHAVED)


def test_a_long_folder_is_no_obstacle(run: Run) -> None:
    run.folder = run.folder / ("deep" * 20) / ("deeper" * 20)
    run.folder.mkdir(parents=True)
    assert run(a=SHUTS_DOWN).exit_code == 0
