"""Real-time factor of a run: what its simulator did while all nodes ran."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from msgspec.structs import replace

from neuros.control import Report
from neuros.launcher.outcome import Outcome


def outcome(sim_time: float, points: Sequence[tuple[float, float]], paused_s: float = 0) -> Outcome:
    """A simulator that has initialised after 10 s, a plot after 12 s; the end begins at 22 s."""
    ended = Outcome(ending_s=22.0, paused_s=paused_s)
    ended.reports = {
        "robot": Report(node="robot", sim_time=sim_time, running_since_s=10.0 + paused_s),
        "plot": Report(node="plot", running_since_s=12.0 + paused_s),
    }
    ended.timelines = {"robot": [list(point) for point in points]}
    return ended


@pytest.mark.parametrize(
    ("points", "sim_time"),
    [
        ([(0.0, 10.0), (1.0, 11.0), (2.0, 12.0), (3.0, 13.0)], 12.0),
        ([(0.0, 10.0), (4.0, 14.0)], 12.0),
        ([(0.0, 10.0), (0.0, 12.0)], 10.0),
        ([(0.0, 12.5)], 10.0),
        ([], 10.0),
    ],
    ids=["it ran ahead", "between two points", "it waited", "it began later", "nothing is known"],
)
def test_what_passed_while_others_initialised_does_not_count(
    points: Sequence[tuple[float, float]], sim_time: float
) -> None:
    assert outcome(sim_time, points).real_time_factor == pytest.approx(1.0)


def test_a_pause_does_not_count() -> None:
    points = [(0.0, 10.0), (1.0, 11.0), (2.0, 12.0), (2.0, 17.0)]
    assert outcome(7.0, points, paused_s=5.0).real_time_factor == pytest.approx(1.0)


def test_without_simulated_time_there_is_none() -> None:
    ended = outcome(1.0, [])
    ended.reports["robot"] = replace(ended.reports["robot"], sim_time=None)
    assert ended.real_time_factor is None


def test_what_a_reset_takes_back_has_passed() -> None:
    points = [(0.0, 10.0), (2.0, 12.0), (8.0, 18.0), (0.0, 18.0), (1.0, 19.0)]
    assert outcome(4.0, points).real_time_factor == pytest.approx(1.0)
    points = [(0.0, 10.0), (3.0, 11.0), (0.0, 13.0)]  # reset while the plot initialised
    assert outcome(10.0, points).real_time_factor == pytest.approx(1.0)
