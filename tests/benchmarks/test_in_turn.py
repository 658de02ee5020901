"""Parts of NeuROS that are taken out of a run and put back: what is taken out, and the sums."""

from __future__ import annotations

import runpy
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import in_turn
from neuros.engine.connection_ends import SendWindow
from neuros.engine.engine import Engine
from neuros.engine.event_log import LoggedEngine
from neuros.node.instruments import NodeRecorder
from neuros.project.model import Connection


@pytest.fixture(scope="module")
def switch() -> Any:
    """What every Python of such a run imports."""
    return SimpleNamespace(**runpy.run_path(str(in_turn.SWITCH / "sitecustomize.py")))


@pytest.mark.parametrize("part", ["ledger", "recording"])
def test_all_that_is_taken_out_is_there(switch: Any, part: str) -> None:
    assert not [name for owner, name in switch.PARTS[part]() if not hasattr(owner, name)]


def test_without_its_books_a_connection_counts_and_notes_no_times(switch: Any) -> None:
    taken_out = switch.without_ledger()
    window: Any = SendWindow(Connection("a", "out", "b", "in_", 0))
    window.spend(5)
    taken_out[SendWindow, "spend"](window, 6)
    assert window.sent == 2
    assert window.sent_ns.tolist() == [5]


def test_without_the_recording_neither_packets_nor_events_are_kept(switch: Any) -> None:
    taken_out = switch.without_recording()
    assert (NodeRecorder, "keep") in taken_out
    for event in ("on_packet", "on_acknowledgement", "_run"):
        assert taken_out[LoggedEngine, event] is getattr(Engine, event)


def test_code_that_is_no_longer_there_to_be_taken_out_is_an_error(switch: Any) -> None:
    with pytest.raises(AssertionError, match=r"spend has no 'self\.gone'"):
        switch.rewritten(SendWindow.spend, {"self.gone": ""})


def test_slices_are_compared_in_pairs_and_half_pairs_are_left_out() -> None:
    lines = ["3 0 50 10 5", "4 1 30 10 6", "5 0 40 10 8", "6 0 20 10 10", "7 1 10 10 10"]
    assert in_turn.pairs_of(lines) == [((3.0, 5.0), (4.0, 5.0)), ((1.0, 1.0), (2.0, 2.0))]
