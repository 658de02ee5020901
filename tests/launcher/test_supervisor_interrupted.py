"""A supervisor whose run gets a signal, or whose nodes do not cooperate, ends it all the same."""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from supervised import DEAF, SHUTS_DOWN, WELL_BEHAVED, Run, supervised


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    with supervised(tmp_path) as run:
        yield run


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
    assert "Ctrl+C: already ending (a second one kills at once)" in run.output.said
    assert outcome.exit_code == 0
    assert outcome.has_final_report("b")


def test_two_do_not(run: Run) -> None:
    run.when_file_exists("stopping", run.press_ctrl_c)
    run.after("Ctrl+C: already ending", run.press_ctrl_c)
    outcome = run(
        a=SHUTS_DOWN, b=f"host.up(); host.wait_for('stop'); open('stopping', 'w'); {DEAF}"
    )
    assert outcome.exit_code == 130
    assert outcome.reason == (
        "killed by Ctrl+C before its nodes had ended: a ended the project: enough"
    )
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
    assert outcome.exit_code == 1
    assert re.fullmatch(
        r"node 'b' had to be killed after 5 s without progress:"
        r" 'b' did not begin to finalise and had not reported for \d s",
        outcome.reason,
    )
    assert 5 <= run.lasted_s < 6.5


@pytest.mark.parametrize(
    ("end", "how"), [("os._exit(3)", "exit code 3"), ("os.kill(os.getpid(), 11)", "SIGSEGV")]
)
def test_a_process_that_ends_badly_after_its_final_report_is_named(
    run: Run, end: str, how: str
) -> None:
    reports = "import os\nhost.up(); host.wait_for('stop'); host.report(is_final=True); "
    outcome = run(a=SHUTS_DOWN, b=reports + end)
    assert outcome.exit_code == 0
    told = [text for text in run.output.said if "after its final report" in text]
    assert len(told) == 1
    assert told[0].startswith("the process of node 'b' ended badly after its final report: ")
    assert how in told[0]


def test_of_one_that_ends_well_nothing_is_said(run: Run) -> None:
    outcome = run(a=SHUTS_DOWN, b=WELL_BEHAVED)
    assert outcome.exit_code == 0
    assert not any("after its final report" in text for text in run.output.said)


def test_of_a_process_that_does_not_end_it_is_said_where_its_threads_were(run: Run) -> None:
    stuck = """
host.up()
host.wait_for('stop')
host.report(is_final=True)
def in_teardown():
    __import__('time').sleep(60)
in_teardown()
"""
    outcome = run(a=SHUTS_DOWN, b=stuck)
    assert outcome.reason == (
        "node 'b' had to be killed 5 s after its final report: its process did not end"
    )
    assert "in in_teardown" in outcome.stacks["b"]
    where = "where the threads of 'b' stood when killed:\n"
    assert where + outcome.stacks["b"] in run.output.said


def test_a_stopped_node_holds_up_nobody(run: Run) -> None:
    stops = "host.up(); host.tell('hooks', hooks=[], finalise=['save', 'close']); " + (
        "host.tell('shutdown', reason='', drain_s=0.2); "
        "import os, signal; os.kill(os.getpid(), signal.SIGSTOP)"
    )
    outcome = run(a=stops, b=WELL_BEHAVED)
    assert outcome.has_final_report("b")
    assert outcome.exit_code == 1
    assert outcome.reason == (
        "node 'a' had to be killed after 5 s without progress:"
        " finalise hooks 'save' and 'close' of 'a' did not run"
    )
    assert run.lasted_s < 7


def test_of_a_node_that_had_to_be_killed_it_is_said_what_it_had_still_to_do(run: Run) -> None:
    hangs = f"""
host.up(plugins={{'b': '<string>'}})
host.tell('hooks', hooks=[], finalise=['save', 'close', 'last'])
host.wait_for('stop')
host.tell('finalising', hook='save')
host.tell('finalising', hook='close')
def close():
    {DEAF}
close()
"""
    outcome = run(a=SHUTS_DOWN, b=hangs)
    assert outcome.reason == (
        "node 'b' had to be killed after 5 s without progress: finalise hook 'close' of 'b' did not"
        " finish; finalise hook 'last' of 'b' did not run"
    )
    assert outcome.stacks["b"].endswith(", in close")
    assert "b was at this point when it was killed:\n" + outcome.stacks["b"] in run.output.said


def test_hooks_that_have_finished_are_not_blamed(run: Run) -> None:
    closes = f"""
host.up()
host.tell('hooks', hooks=[], finalise=['save'])
host.wait_for('stop')
host.tell('finalising', hook='save')
host.tell('finalising', hook='')
{DEAF}
"""
    outcome = run(
        a=SHUTS_DOWN,
        b=closes,
        c=closes.replace("hook='')", "hook='')\nhost.tell('finalising', hook=None)"),
    )
    assert sorted(outcome.failures) == [
        "node 'b' had to be killed after 5 s without progress:"
        " what 'b' has registered with node.on_close did not end",
        "node 'c' had to be killed after 5 s without progress:"
        " 'c' had finalised, but did not make its final report",
    ]


def test_a_report_behind_the_final_one_does_not_count(run: Run) -> None:
    outcome = run(a=SHUTS_DOWN + "; host.report(sim_time=9.0)")
    assert outcome.has_final_report("a")
    assert outcome.reports["a"].sim_time is None


def test_what_is_none_of_ours_on_the_socket_is_hung_up_on(run: Run) -> None:
    outcome = run(
        a="import socket; s = socket.socket(socket.AF_UNIX); s.connect('control.sock'); "
        "s.sendall(b'GET / HTTP/1.1\\n'); assert s.recv(1) == b''; " + SHUTS_DOWN
    )
    assert outcome.exit_code == 0
    (text,) = [text for text in run.output.said if text.startswith("control channel")]
    assert text == (
        "control channel: a connection was closed: an unknown program sent something that is not"
        " a control message:"
        " b'GET / HTTP/1.1\\n'"
    )


def test_many_of_them_are_not_shown_one_by_one(run: Run) -> None:
    outcome = run(
        a="import socket\nfor _ in range(200):\n    s = socket.socket(socket.AF_UNIX)\n"
        "    s.connect('control.sock')\n    s.sendall(b'hello\\n')\n    assert s.recv(1) == b''\n"
        + SHUTS_DOWN
    )
    assert outcome.exit_code == 0
    said = [text for text in run.output.said if text.startswith("control channel")]
    assert len(said) == 10
    assert said[-1].endswith("; further ones are not shown")


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        ("host.tell('applaud')", "sent a wrong control message: Invalid value 'applaud'"),
        (
            "host.tell('failed')",
            "sent a wrong control message: Object missing required field `text`",
        ),
        (
            "host.report(sim_time='noon')",
            "sent a wrong control message: Expected `float | null`, got `str` - at `$.sim_time`",
        ),
    ],
)
def test_a_node_that_is_not_understood_makes_the_run_fail(
    run: Run, message: str, complaint: str
) -> None:
    outcome = run(a=f"host.up(); {message}; {message}; host.serve()", b=WELL_BEHAVED)
    assert outcome.exit_code == 1
    assert outcome.reason.startswith(f"control channel: the process of a {complaint}")
    assert outcome.failures == [outcome.reason], "it is said once"
    assert all(map(outcome.has_final_report, "ab"))


# ------------------------------------------------------------------ time to finalise


def finalises(body: str) -> str:
    """A node that does this in a finalise hook, which takes 2 s in all."""
    return f"""
host.up()
host.send("hooks", node="a", hooks=[], finalise=["save"])
host.tell("shutdown", reason="", drain_s=5)
host.wait_for("stop")
host.tell("finalising", hook="save")
for count in range(8):
    {body}
    time.sleep(0.25)
host.tell("finalising", hook=None)
host.report(is_final=True)
"""


@pytest.mark.parametrize(
    "shows",
    [
        "host.tell('progress', text=f'{count} of 8')",
        "open('a/weights', 'a').write('w')",
        "Path('a', f'picture_{count}.png').touch()",
        "os.makedirs(f'a/b/{count}'); open(f'a/b/{count}/file', 'w').write('w')",
    ],
)
def test_a_node_that_shows_progress_as_it_finalises_is_not_killed(run: Run, shows: str) -> None:
    outcome = run(a=finalises(shows), finalise_s=0.8)
    assert (outcome.exit_code, outcome.failures) == (0, [])
    assert "saving: 'a' (finalise hook 'save')" in run.output.said


@pytest.mark.parametrize("shows", ["pass", "host.report()", "open('weights', 'a').write('w')"])
def test_a_node_that_shows_none_is_killed_when_its_time_is_over(run: Run, shows: str) -> None:
    outcome = run(a=finalises(shows), finalise_s=0.8)
    assert outcome.exit_code == 1
    assert outcome.failures == [
        "node 'a' had to be killed after 0.8 s without progress: finalise hook 'save' of 'a' did"
        " not finish"
    ]


def test_a_node_that_shows_none_is_killed_alone(run: Run) -> None:
    outcome = run(
        a=finalises("host.tell('progress', text='saving')"),
        b="host.up(); host.wait_for('stop'); time.sleep(60)",
        finalise_s=0.8,
    )
    assert len(outcome.failures) == 1
    assert outcome.failures[0].startswith("node 'b' had to be killed after 0.8 s without progress")
    assert outcome.has_final_report("a")


def test_what_a_plugin_tells_of_its_progress_is_shown_at_most_once_per_second(run: Run) -> None:
    run(a=finalises("host.tell('progress', text=f'{count} of 8')"))
    told = [text for text in run.output.said if text.startswith("a: ")]
    assert told[0] == "a: 0 of 8"
    assert 2 <= len(told) <= 3


def test_a_second_ctrl_c_ends_a_node_that_shows_progress_for_ever(run: Run) -> None:
    def press_twice() -> None:
        run.press_ctrl_c()
        run.press_ctrl_c()

    run.after("saving: 'a'", press_twice)
    act = finalises("host.tell('progress', text='saving')").replace("range(8)", "range(10**6)")
    outcome = run(a=act, finalise_s=0.8)
    assert outcome.exit_code == 130
    assert run.lasted_s < 6


def test_a_run_that_was_stopped_while_it_ended_has_its_time_afterwards(run: Run) -> None:
    def stand_still() -> None:
        time.sleep(1.5)  # as under SIGSTOP
        (run.folder / "goes on").touch()

    run.when_file_exists("told", stand_still)
    waits = """
import os, time
host.up(); host.tell('shutdown', reason='', drain_s=5); host.wait_for('stop')
open('told', 'w')
while not os.path.exists('goes on'):
    time.sleep(0.01)
host.report(is_final=True)
"""
    outcome = run(a=waits, finalise_s=1.0)
    assert (outcome.exit_code, outcome.failures) == (0, [])
