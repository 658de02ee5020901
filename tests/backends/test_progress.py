"""How far a run has come: the line that is shown of it."""

from __future__ import annotations

from typing import Any

from neuros.backends.console import Progress
from neuros.control import Report
from neuros.launcher.outcome import Outcome


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def report(
    sim_s: float | None, sent: int, discarded: int = 0, expected: float | None = None
) -> Report:
    metrics: Any = {
        "outgoing": {"a.o -> b.i": {"sent": sent}},
        "incoming": {"b.o -> a.i": {"discarded": discarded}},
    }
    return Report(node="a", sim_time=sim_s, expected_end_s=expected, metrics=metrics)


def run(clock: Clock, reports: list[Report], **end: float) -> Progress:
    """The progress of a run whose reports have come, one per second."""
    outcome = Outcome(started_s=clock())
    progress = Progress(outcome, **end, clock=clock)
    for each in reports:
        outcome.reports["a"] = each
        progress.text()
        clock.now_s += 1.0
    clock.now_s -= 1.0
    return progress


def test_before_the_first_hook_there_is_nothing_to_show() -> None:
    assert Progress(Outcome(), 10.0).text() == ""
    assert Progress(Outcome(), 10.0).bar(80, is_ascii=True) == ""


def test_simulated_time_has_its_speed_and_the_time_that_is_left() -> None:
    progress = run(Clock(), [report(0.0, 0), report(4.0, 400), report(8.0, 800, 3)], sim_s=20.0)
    assert progress.text() == (
        "8.0 of 20 s simulated, 4.00 x real time, 400 packets/s, 3 discarded, 0:03 left"
    )


def test_after_a_reset_the_speed_is_that_of_the_time_since() -> None:
    reports = [report(4.0, 0), report(8.0, 400), report(0.0, 800), report(2.0, 1200)]
    assert run(Clock(), reports).text() == (
        "2.0 s simulated, 2.00 x real time, 400 packets/s, 0 discarded"
    )


def paused_run(clock: Clock, **end: float) -> tuple[Outcome, Progress]:
    """Four simulated seconds in one of wall time, and then a pause of a minute."""
    outcome = Outcome(started_s=clock())
    progress = Progress(outcome, **end, clock=clock)
    for sim_s in (0.0, 4.0):
        outcome.reports["a"] = report(sim_s, 0)
        progress.text()
        clock.now_s += sim_s / 4
    clock.now_s += 60.0
    outcome.paused_s, outcome.is_paused = 60.0, True
    return outcome, progress


def test_a_pause_is_said_and_takes_nothing_from_the_time_that_is_left() -> None:
    _, progress = paused_run(Clock(), wall_s=10.0)
    assert progress.text() == "4.0 s simulated, paused, 0 discarded, 0:09 left"


def test_after_a_pause_the_speed_is_that_of_the_time_it_has_run() -> None:
    clock = Clock()
    outcome, progress = paused_run(clock, sim_s=20.0)
    outcome.is_paused = False
    clock.now_s += 1.0
    outcome.reports["a"] = report(12.0, 0)
    text = "12.0 of 20 s simulated, 6.00 x real time, 0 packets/s, 0 discarded, 0:01 left"
    assert progress.text() == text


def test_an_experiment_that_knows_its_end_tells_it() -> None:
    progress = run(Clock(), [report(0.0, 0, expected=40.0), report(10.0, 100, expected=40.0)])
    assert progress.has_end
    assert progress.text().startswith("10.0 of 40 s simulated, 10.00 x real time")
    assert progress.text().endswith("0:03 left")


def test_wall_time_ends_when_it_is_over_whatever_is_simulated() -> None:
    progress = run(Clock(), [report(0.0, 0), report(3.0, 10)], wall_s=7201.0)
    text = "3.0 s simulated, 3.00 x real time, 10 packets/s, 0 discarded, 2:00:00 left"
    assert progress.text() == text


def test_rates_are_those_of_the_last_seconds() -> None:
    slow, fast = [report(None, n) for n in range(10)], [report(None, 9 + 100 * n) for n in range(9)]
    assert ", 100 packets/s," in run(Clock(), [*slow, *fast], wall_s=60.0).text()


def test_without_an_end_there_is_no_bar_and_nothing_is_said_to_be_left() -> None:
    progress = run(Clock(), [report(None, 0), report(None, 50)])
    assert not progress.has_end
    assert progress.bar(80, is_ascii=True) == "1 s, 50 packets/s, 0 discarded"


def test_on_a_narrow_terminal_the_bar_and_the_time_that_is_left_stay() -> None:
    progress = run(Clock(), [report(0.0, 0), report(4.0, 400), report(8.0, 800, 3)], sim_s=20.0)
    bar = progress.bar(80, is_ascii=True)
    assert bar.startswith(" 40%|#")
    assert bar.endswith("| 8.0 of 20 s simulated, 4.00 x real time, 0:03 left")


def test_while_packets_under_way_arrive_no_more_time_passes_than_was_asked_for() -> None:
    progress = run(Clock(), [report(None, n) for n in range(9)], wall_s=7.0)
    assert progress.text().startswith("7 of 7 s, ")


def test_a_bar_shows_the_share_and_never_is_wider_than_the_terminal() -> None:
    progress = run(Clock(), [report(0.0, 0), report(5.0, 10)], sim_s=20.0)
    bar = progress.bar(120, is_ascii=True)
    assert bar.startswith(" 25%|#")
    assert bar.endswith("| " + progress.text())
    assert all(len(progress.bar(n, is_ascii=False)) < n for n in range(20, 200, 7))
