"""However a run ends, the supervisor brings it to that end: exit code, reason, and nobody left."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from deadlines import wait_until
from supervised import SHUTS_DOWN, WELL_BEHAVED, Run, supervised, wire

from neuros.backends.process_launchers import ProcessLauncher, RunningProcess
from neuros.control import Begin, Message
from neuros.control.link import ControlLink
from neuros.errors import EnvironmentFault
from neuros.launcher import supervisor
from neuros.launcher.channels import Channels
from neuros.launcher.peers import PeerState, Stage


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    with supervised(tmp_path) as run:
        yield run


@pytest.fixture
def told_to_begin(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[str]]:
    """The nodes of each process that was told to begin."""
    told: list[Sequence[str]] = []
    send_to = Channels.send_to

    def note(self: Channels, link: ControlLink, message: Message) -> None:
        if isinstance(message, Begin):
            told.append(self.nodes_of(link))
        send_to(self, link, message)

    monkeypatch.setattr(Channels, "send_to", note)
    return told


# ------------------------------------------------------------------ drained ends


def test_a_node_ends_the_project(run: Run) -> None:
    outcome = run(a=SHUTS_DOWN, b=WELL_BEHAVED)
    assert (outcome.exit_code, outcome.failures) == (0, [])
    assert outcome.reason == "a ended the project: enough"
    assert all(map(outcome.has_final_report, "ab"))
    assert outcome.started_s < outcome.ending_s < outcome.ended_s


def test_what_is_to_be_done_meanwhile_begins_before_the_nodes_have_ended(
    run: Run, tmp_path: Path
) -> None:
    begun = tmp_path / "begun"
    ends_after_that = f"""
host.up()
host.wait_for("stop")
while not os.path.exists({str(begun)!r}):
    time.sleep(0.005)
host.report(is_final=True)
"""
    outcome = run(a=SHUTS_DOWN, b=ends_after_that, on_stop=begun.touch)
    assert (outcome.exit_code, outcome.failures) == (0, [])


def test_a_node_that_is_loaded_once_the_run_is_stopping_is_not_told_to_begin(
    run: Run, told_to_begin: list[Sequence[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is killed; the kill may be on its way for long."""
    kill = RunningProcess.kill
    late: list[RunningProcess] = []

    def kill_late(process: RunningProcess) -> None:
        if process.names == ("b",) and not late:
            late.append(process)
        else:
            kill(process)

    monkeypatch.setattr(RunningProcess, "kill", kill_late)
    run.when_file_exists("b.loaded", lambda: late[0].kill())
    loads_late = """
host.hello()
Path('b.up').touch()
while host.hear()['kind'] != 'stop':
    pass
host.declare()
host.tell('failed', text='it cannot be imported')
Path('b.loaded').touch()
host.wait_for('never')
"""
    interrupts = """
while not os.path.exists("b.up"):
    time.sleep(0.01)
host.hello()
host.ask("interrupt")
time.sleep(60)
"""
    outcome = run(a=interrupts, b=loads_late)
    assert (outcome.exit_code, outcome.failures) == (130, [])
    assert outcome.reports == {}
    assert told_to_begin == []


@pytest.mark.parametrize(("tells", "goes_on_at"), [("hooks", "begin"), ("ready", "activate")])
def test_no_node_goes_on_before_all_have_caught_up(run: Run, tells: str, goes_on_at: str) -> None:
    """Each notes when it may go on; the last one makes the others wait until it has told."""
    goes_on = f"""
host.hello()
if {tells!r} == "ready":
    host.loaded()
if NAMES == ["c"]:
    time.sleep(0.3)
    Path("c.tells").touch()
host.send("ready", node=NAMES[0]) if {tells!r} == "ready" else host.declare()
host.wait_for({goes_on_at!r})
assert Path("c.tells").exists()
host.ask("end", reason="enough")
host.declare()
host.send("ready", node=NAMES[0])
host.serve()
"""
    outcome = run(a=goes_on, b=goes_on, c=goes_on)
    assert (outcome.exit_code, outcome.failures) == (0, [])


def test_a_drained_end_that_is_asked_for_early_waits_until_all_have_initialised(run: Run) -> None:
    initialises_late = """
host.hello()
host.loaded()
time.sleep(0.3)
host.send("ready", node="b")
kinds = []
while "activate" not in kinds:
    message = host.hear()
    kinds.append(message["kind"])
    host.answer(message)
assert "drain" in kinds, kinds
host.serve()
"""
    shuts_down = """
host.hello()
host.loaded()
host.tell("shutdown", reason="enough", drain_s=5)
host.send("ready", node="a")
host.serve()
"""
    outcome = run(a=shuts_down, b=initialises_late)
    assert (outcome.exit_code, outcome.failures) == (0, [])
    assert outcome.reason == "a ended the project: enough"
    assert "a ended the project: enough; the end comes once every node has initialised" in (
        run.output.said
    )


def test_a_node_that_fails_as_it_is_loaded_ends_the_run_of_those_that_wait(run: Run) -> None:
    fails = "host.hello(); host.tell('failed', text='no such module'); host.wait_for('never')"
    outcome = run(a="host.hello(); host.loaded(); host.serve()", b=fails)
    assert (outcome.exit_code, outcome.reason) == (1, "node 'b' failed: no such module")


def test_nothing_begins_where_not_all_could_be_started(
    run: Run,
    told_to_begin: list[Sequence[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = ProcessLauncher.start

    def start_and_fail(*arguments: Any) -> Any:
        started = start(*arguments)
        wait_until((tmp_path / "a.loaded").exists)
        run.hosts += started
        raise EnvironmentFault("the third one cannot be started")

    monkeypatch.setattr(ProcessLauncher, "start", start_and_fail)
    loads = "host.hello(); host.declare(); Path('a.loaded').touch(); host.wait_for('begin')"
    with pytest.raises(EnvironmentFault):
        run(a=loads)
    assert told_to_begin == []


def test_one_that_has_not_started_and_outlasts_its_kill_is_named_so(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill = RunningProcess.kill
    ignored: list[RunningProcess] = []

    def kill_at_the_second_time(process: RunningProcess) -> None:
        if process.names == ("b",) and not ignored:
            ignored.append(process)
        else:
            kill(process)

    monkeypatch.setattr(RunningProcess, "kill", kill_at_the_second_time)
    monkeypatch.setattr(supervisor, "_KILLED_S", 0.5)
    interrupts = "host.hello(); host.ask('interrupt'); host.wait_for('never')"
    outcome = run(a=interrupts, b="host.hello(); time.sleep(60)")
    assert outcome.exit_code == 130
    assert outcome.failures == ["node 'b' had not ended 0.5 s after it was killed"]


def test_of_two_plugins_that_cannot_be_imported_both_are_told(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the first one ends the run, and the other one is killed as not started."""
    wait = Channels.wait

    def wait_for_both(self: Channels, timeout_s: float) -> None:
        wait_until(lambda: (tmp_path / "a.told").exists() and (tmp_path / "b.told").exists())
        wait(self, timeout_s)

    monkeypatch.setattr(Channels, "wait", wait_for_both)
    fails = "host.hello(); host.tell('failed', text='no'); Path(f'{NAMES[0]}.told').touch()"
    outcome = run(a=fails, b=fails)
    assert outcome.exit_code == 1
    assert sorted(outcome.failures) == ["node 'a' failed: no", "node 'b' failed: no"]


def test_the_first_of_two_that_end_it_is_named(run: Run) -> None:
    too_late = "host.up(); host.wait_for('drain'); host.tell('shutdown', reason='', drain_s=0)"
    outcome = run(a=SHUTS_DOWN, b=f"{too_late}; host.serve()")
    assert (outcome.exit_code, outcome.reason) == (0, "a ended the project: enough")
    assert not any("b ended the project" in text for text in run.output.said)


def test_the_duration_counts_from_when_all_are_ready_and_ends_drained(run: Run) -> None:
    waits_first = "host.hello(); host.loaded(); time.sleep(0.4); " + (
        "host.send('ready', node='a'); host.serve()"
    )
    outcome = run(a=waits_first, duration_s=0.3)
    assert outcome.exit_code == 0
    assert outcome.reason == "0.3 s are over"
    assert 0.3 <= outcome.ending_s - outcome.started_s < 0.6


def test_a_pause_before_all_are_ready_leaves_the_duration_as_it_is(run: Run) -> None:
    paused = "host.ask('pause'); time.sleep(1.0); host.ask('resume')"
    act = f"host.hello(); host.loaded(); {paused}; host.send('ready', node='a')"
    outcome = run(a=f"{act}; host.serve()", duration_s=0.3)
    assert outcome.reason == "0.3 s are over"
    assert 0.3 <= outcome.ending_s - outcome.started_s < 1.0


def test_a_pause_is_no_part_of_the_duration(run: Run) -> None:
    pauses = "host.up(); import time; host.ask('pause'); time.sleep(0.6); host.ask('resume'); "
    outcome = run(a=f"{pauses} host.serve()", duration_s=0.3)
    assert outcome.reason == "0.3 s are over"
    assert outcome.ending_s - outcome.started_s >= 0.85
    assert 0.55 <= outcome.paused_s <= outcome.ending_s - outcome.started_s - 0.3


def test_a_run_that_is_stopped_while_paused_ended_when_the_pause_began(run: Run) -> None:
    pauses = "host.up(); import time; host.ask('pause'); time.sleep(0.6); host.ask('interrupt')"
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


@pytest.mark.parametrize("is_lossy", [False, True])
def test_where_packets_come_uncounted_all_hooks_stop_before_any_node_does(
    run: Run, is_lossy: bool
) -> None:
    """A hook that one of them starts could send to a node that has stopped."""
    looks = """
host.connections["outgoing"]["a.o -> b.x"] = SENT
host.connections["incoming"]["a.o -> b.x"] = RECEIVED
host.up()
if NAMES == ["a"]:
    host.tell("shutdown", reason="enough", drain_s=5)
told = []
while "stop" not in told:
    message = host.hear()
    told.append(message["kind"])
    host.answer(message)
Path(f"{NAMES[0]}.told").write_text(" ".join(told))
host.report(is_final=True)
"""
    connection = wire("a.o -> b.x")
    if is_lossy:
        connection = replace(connection, discard_limit=None)
    outcome = run(a=looks, b=looks, connections=(connection,))
    assert (outcome.exit_code, outcome.failures) == (0, [])
    for name in "ab":
        told = (run.folder / f"{name}.told").read_text().split()
        assert ("stop_hooks" in told) == is_lossy
        if is_lossy:
            assert "probe" in told[told.index("stop_hooks") : told.index("stop")]


def test_but_not_longer_than_it_was_said(run: Run) -> None:
    impatient = SHUTS_DOWN.replace("drain_s=5", "drain_s=0.2")
    outcome = run(a=impatient, b=DRAINED_AFTER_A_LONG_HOOK)
    assert outcome.exit_code == 0
    assert "not drained in time: b does not answer" in run.output.said


PACKET_IS_LOST = """
host.connections['outgoing']['a.o -> b.x'] = SENT | {'sent': 3, 'acknowledged': 2}
host.connections['incoming']['a.o -> b.x'] = RECEIVED | {'received': 2, 'acknowledged': 2}
"""


def test_packets_under_way_are_waited_for_and_named_if_they_do_not_come(run: Run) -> None:
    impatient = SHUTS_DOWN.replace("drain_s=5", "drain_s=0.2")
    run(
        a=PACKET_IS_LOST + impatient,
        b=PACKET_IS_LOST + WELL_BEHAVED,
        connections=(wire("a.o -> b.x"),),
    )
    (text,) = [text for text in run.output.said if text.startswith("not drained")]
    assert text.endswith("a packet is under way on `a.o -> b.x`")


def test_a_node_that_is_still_loading_is_waited_for(run: Run) -> None:
    """Here by a user of the dashboard, who ends the run before it has begun."""
    starts = "host.loaded(); host.ready(); host.serve()"
    ends = f"host.hello(); host.ask('end', reason='enough'); {starts}"
    outcome = run(a=ends, b=f"host.hello(); time.sleep(1); {starts}")
    assert (outcome.exit_code, outcome.failures, outcome.reason) == (0, [], "enough")
    assert all(outcome.has_final_report(name) for name in "ab")


# ------------------------------------------------------------------ failures


def test_a_node_fails(run: Run) -> None:
    fails = "host.up(); host.tell('failed', text='p.py:3: hook \\'f\\': ZeroDivisionError\\nmore')"
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
    outcome = run(a=f"host.up(); {act}", b=WELL_BEHAVED)
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
        a="host.up(); host.tell('failed', text='one'); host.wait_for('stop')",
        b="host.up(); host.wait_for('stop'); host.tell('failed', text='other')",
    )
    assert outcome.failures == ["node 'a' failed: one", "node 'b' failed: other"]
    assert outcome.reason == outcome.failures[0]


def test_a_deadlock_names_its_cycle(run: Run) -> None:
    blocked = "SENT | {{'sent': 1, 'outstanding': 1, 'is_blocked': True}}"
    unread = "RECEIVED | {{'received': 1, 'unread': 1}}"
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
    state = PeerState("another run", "far", 1, Stage.READY).to_text()
    hears = f"host.hello(); host.send('state_of_peer', node='b', text={state!r}); host.loaded()"
    outcome = run(a=f"{hears}; host.ready(); host.serve()", duration_s=2.5, elsewhere=("b",))
    assert outcome.exit_code == 0


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
