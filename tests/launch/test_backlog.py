"""What the launcher says of nodes that fall behind."""

from __future__ import annotations

from typing import Any

from neuros.launch.backlog import Backlog
from neuros.project.model import Connection

KEY = "camera.image -> brain.image"
CONNECTION = Connection("camera", "image", "brain", "image", 0, 100, 0)


def report(
    *,
    sent: int | None = None,
    received: int | None = None,
    unread: int = 0,
    taker: str | None = "look",
) -> dict[str, Any]:
    """Of the sender or of the receiver."""
    incoming = {"received": received, "unread": unread, "taker": taker if unread else None}
    return {
        "metrics": {
            "outgoing": {} if sent is None else {KEY: {"sent": sent, "is_reliable": True}},
            "incoming": {} if received is None else {KEY: incoming},
        }
    }


def said(backlog: Backlog, now_s: float) -> list[str]:
    return [text for _, text in backlog.remarks(now_s)]


def test_a_node_whose_packets_wait_for_long_has_fallen_behind_which_is_said_once() -> None:
    backlog = Backlog([CONNECTION])
    for second in range(5):
        backlog.report(report(received=100 * second, unread=90 * second), float(second))
        assert said(backlog, float(second)) == []
    backlog.report(report(received=1000, unread=950), 6.0)
    (text,) = said(backlog, 6.0)
    assert text.startswith(f"brain has fallen behind: the oldest of 950 unread packets on `{KEY}`")
    assert "hook 'look' is ready for it" in text
    assert said(backlog, 7.0) == []


def test_a_node_that_keeps_up_has_not_however_many_packets_it_gets() -> None:
    backlog = Backlog([CONNECTION])
    for second in range(60):
        backlog.report(report(received=100 * second + 1, unread=1), float(second))
        assert said(backlog, float(second)) == []


def test_nor_has_one_that_waits_for_another_input_or_is_blocked() -> None:
    backlog = Backlog([CONNECTION])
    for second in range(60):
        backlog.report(report(received=1, unread=1, taker=None), float(second))
        assert said(backlog, float(second)) == []


def test_packets_that_are_not_taken_in_are_said_too() -> None:
    backlog = Backlog([CONNECTION])
    for second in range(7):
        backlog.report(report(sent=3), float(second))
        backlog.report(report(received=2), float(second))
    (text,) = said(backlog, 6.0)
    assert text.startswith("brain has fallen behind: it has taken nothing in for over 5 s")
    assert f"`{KEY}`" in text


def test_a_pause_does_not_count() -> None:
    backlog = Backlog([CONNECTION])
    backlog.report(report(received=5, unread=5), 0.0)
    backlog.begin_anew()
    backlog.report(report(received=5, unread=5), 8.0)
    assert said(backlog, 9.0) == []
