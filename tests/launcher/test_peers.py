"""What one launcher knows of the others of its project, and says to them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from neuros.control import NodeProbe, Report
from neuros.launcher.peers import (
    DRAINED,
    DRAINING,
    OVER,
    RUNNING,
    STOPPING,
    Peers,
    PeerState,
    Stage,
    state_from,
)
from neuros.project.model import Connection, Folders, Node, NodeFile

FOLDER = Path("/")
HERE_TO_THERE = Connection("a", "o", "b", "x", 0)
ELSEWHERE = PeerState("other", "far", 1)
GONE_S = 0.3
WAITS_S = 2.0


class Launcher:
    """This launcher, with node ``a``; ``b`` and ``c`` are elsewhere, and ``a`` sends to ``b``."""

    def __init__(self, timeout_s: float | None = None) -> None:
        file = NodeFile(
            Node("a", "", Path("/a.py")), (HERE_TO_THERE,), Folders(FOLDER, FOLDER, FOLDER)
        )
        self.said: list[PeerState] = []
        self.peers = Peers("own", ["b", "c"], [file], " (hint)", timeout_s)
        self.peers.publish_through(self._note)

    def _note(self, text: str) -> None:
        state = state_from(text)
        assert state is not None
        self.said.append(state)

    def hears(self, node: str, state: PeerState | None, now_s: float = 0.0) -> None:
        self.peers.receive(node, None if state is None else state.to_text(), now_s)

    def remarks(self, now_s: float) -> list[str]:
        return [text for _, text in self.peers.remarks(now_s)]


@pytest.fixture
def launcher() -> Launcher:
    return Launcher()


def sent(number: int, acknowledged: int | None = None) -> dict[str, NodeProbe]:
    """Where ``a`` stands."""
    counts = number, number if acknowledged is None else acknowledged
    return {"a": NodeProbe(sent={str(HERE_TO_THERE): counts})}


def reported(number: int) -> dict[str, Report]:
    """The last report of ``a``."""
    counters = {"sent": number, "acknowledged": number}
    metrics: Any = {"outgoing": {str(HERE_TO_THERE): counters}, "incoming": {}}
    return {"a": Report(node="a", metrics=metrics)}


def received(number: int) -> dict[str, Any]:
    """The counters of ``b``."""
    counters = {"received": number, "acknowledged": number}
    return {"b": {"outgoing": {}, "incoming": {str(HERE_TO_THERE): counters}}}


def said_last(launcher: Launcher) -> PeerState:
    return launcher.said[-1]


# ------------------------------------------------------------------ finding each other


def test_nodes_that_are_missing_are_named_after_five_seconds_and_then_every_ten(
    launcher: Launcher,
) -> None:
    waits = "still waiting for nodes elsewhere: b, c (hint)"
    heard = {now_s: texts for now_s in range(20) if (texts := launcher.remarks(float(now_s)))}
    assert heard == {5: [waits], 15: [waits]}


def test_who_has_come_is_said_once_and_not_waited_for(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    assert launcher.remarks(0.0) == ["found elsewhere: b (far)"]
    assert launcher.remarks(100.0) == ["still waiting for nodes elsewhere: c (hint)"]


def test_nodes_elsewhere_have_come_as_far_as_the_last_of_them(launcher: Launcher) -> None:
    launcher.hears("b", replace(ELSEWHERE, stage=Stage.READY))
    launcher.hears("c", replace(ELSEWHERE, run="third", stage=Stage.LOADED))
    assert launcher.peers.have_reached(Stage.LOADED)
    assert not launcher.peers.have_reached(Stage.READY)
    launcher.peers.reach(Stage.READY)
    assert said_last(launcher).stage == Stage.READY
    launcher.remarks(0.0)
    assert launcher.remarks(5.0) == ["nodes elsewhere are still starting: c"]
    launcher.hears("c", replace(ELSEWHERE, run="third", number=2, stage=Stage.READY))
    assert launcher.peers.have_reached(Stage.READY)
    assert launcher.remarks(100.0) == []


def test_a_node_that_was_not_heard_of_has_come_nowhere(launcher: Launcher) -> None:
    launcher.hears("b", replace(ELSEWHERE, stage=Stage.READY))
    assert not launcher.peers.have_reached(Stage.LOADING)


def test_the_rest_of_a_run_before_this_one_is_not_heeded(launcher: Launcher) -> None:
    for phase in (STOPPING, OVER):
        launcher.hears("b", replace(ELSEWHERE, phase=phase, exit_code=1))
    launcher.hears("b", None)
    assert launcher.peers.end(100.0) is None
    assert launcher.remarks(100.0) == []
    assert launcher.remarks(105.0) != []


def test_nodes_elsewhere_are_waited_for_no_longer_than_asked() -> None:
    launcher = Launcher(timeout_s=7)
    assert [launcher.peers.overdue(now_s) for now_s in (100.0, 106.9)] == ["", ""]
    assert launcher.peers.overdue(107.0).startswith("not found elsewhere within 7 s: b, c (hint): ")
    launcher.hears("b", ELSEWHERE)
    launcher.hears("c", ELSEWHERE)
    assert launcher.peers.overdue(200.0) == ""


def test_without_a_limit_nodes_elsewhere_are_waited_for_for_ever(launcher: Launcher) -> None:
    assert [launcher.peers.overdue(now_s) for now_s in (0.0, 1e9)] == ["", ""]


def test_nor_is_what_is_none_of_ours(launcher: Launcher) -> None:
    for text in ("", "ready", "[1]", '{"a": 1}'):
        launcher.peers.receive("b", text, 0.0)
    assert launcher.peers.end(100.0) is None


def test_alone_there_is_nothing_to_say() -> None:
    alone = Peers("own", [], [])
    said: list[str] = []
    alone.publish_through(said.append)
    alone.drain("enough", 5.0)
    assert alone.agree_on_end({})
    alone.stop(0, "enough")
    assert not alone.exist
    assert said == []


# ------------------------------------------------------------------ ending


@pytest.mark.parametrize(("phase", "code"), [(DRAINING, 0), (STOPPING, 130), (STOPPING, 1)])
def test_the_end_elsewhere_is_the_end_here_with_the_same_code(
    launcher: Launcher, phase: str, code: int
) -> None:
    launcher.hears("b", ELSEWHERE)
    assert launcher.peers.end(0.0) is None
    ending = replace(
        ELSEWHERE, number=2, phase=phase, exit_code=code, reason="why", origin="far", drain_s=3.0
    )
    launcher.hears("b", ending)
    assert launcher.peers.end(0.0) == (code, "the project ended elsewhere (far): why", 3.0)


def test_a_state_that_was_overtaken_changes_nothing(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    launcher.hears("b", replace(ELSEWHERE, number=3, phase=STOPPING, reason="why", origin="far"))
    launcher.hears("c", replace(ELSEWHERE, number=2))
    assert launcher.peers.end(0.0) is not None


def test_a_cause_is_passed_on_with_the_place_where_it_was_known_first(launcher: Launcher) -> None:
    launcher.hears("b", replace(ELSEWHERE, phase=DRAINING, reason="why", origin="far"))
    end = launcher.peers.end(0.0)
    assert end is not None
    launcher.peers.drain(end.reason, 5.0)
    assert (said_last(launcher).reason, said_last(launcher).origin) == ("why", "far")


def test_a_node_that_is_gone_ends_the_project_unless_it_has_said_why(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    launcher.hears("b", None, 10.0)
    assert launcher.peers.end(10.0) is None, "its last state may still be on its way"
    end = launcher.peers.end(10.0 + GONE_S)
    assert end is not None
    assert end.exit_code == 1
    assert end.reason.startswith("node 'b' on far is gone: it was killed, or far or the network")


def test_a_node_that_is_gone_after_its_launcher_has_ended_is_no_failure(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    launcher.hears("b", replace(ELSEWHERE, number=2, phase=OVER, reason="why", origin="far"))
    launcher.hears("b", None, 10.0)
    assert launcher.peers.end(20.0) == (0, "the project ended elsewhere (far): why", 0.0)


def test_a_node_that_was_replaced_is_gone(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    launcher.hears("b", replace(ELSEWHERE, run="third"), 10.0)
    end = launcher.peers.end(10.0 + GONE_S)
    assert end is not None
    assert "node 'b' on far is gone" in end.reason


# ------------------------------------------------------------------ draining together


def test_it_is_drained_when_both_launchers_are_and_nothing_is_between(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    launcher.peers.drain("enough", 5.0)
    assert not launcher.peers.agree_on_end(sent(3)), "the peer has not heard of it yet"
    assert said_last(launcher).phase == DRAINED
    drained = replace(ELSEWHERE, phase=DRAINED)
    launcher.hears("b", replace(drained, number=2, received={str(HERE_TO_THERE): (2, 2)}))
    assert not launcher.peers.agree_on_end(sent(3)), "a packet is under way"
    launcher.hears("b", replace(drained, number=3, received={str(HERE_TO_THERE): (3, 3)}))
    assert not launcher.peers.agree_on_end(sent(3, acknowledged=2)), "an acknowledgement is"
    assert launcher.peers.agree_on_end(sent(3))


def test_it_says_so_when_it_has_something_to_do_again(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    launcher.peers.drain("enough", 5.0)
    launcher.peers.agree_on_end(sent(3))
    launcher.peers.go_on()
    assert said_last(launcher).phase == DRAINING
    number = len(launcher.said)
    launcher.peers.go_on()
    assert len(launcher.said) == number, "once"


def test_a_peer_that_has_stopped_is_not_asked(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    launcher.hears("b", replace(ELSEWHERE, number=2, phase=STOPPING))
    assert launcher.peers.agree_on_end(sent(3))


# ------------------------------------------------------------------ the counters


def test_each_launcher_waits_for_the_final_counters_of_its_peer(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    assert not launcher.peers.finish(reported(3), 10.0)
    assert said_last(launcher).phase == OVER
    assert said_last(launcher).counters["a"]["outgoing"][str(HERE_TO_THERE)]["sent"] == 3
    assert launcher.peers.counters() == {}
    launcher.hears("b", replace(ELSEWHERE, number=2, phase=OVER, counters=received(3)))
    assert launcher.peers.finish(reported(3), 10.1)
    assert launcher.peers.counters() == received(3)


def test_but_not_for_long_and_not_for_one_that_is_gone(launcher: Launcher) -> None:
    launcher.hears("b", ELSEWHERE)
    assert not launcher.peers.finish(reported(3), 10.0)
    assert launcher.peers.finish(reported(3), 10.0 + WAITS_S)
    launcher.hears("b", None, 10.0)
    assert launcher.peers.finish(reported(3), 10.0)


def test_a_state_comes_through_as_it_was() -> None:
    ends = {"a.o -> b.x": (3, 2)}
    state = PeerState("r", "h", 4, Stage.LOADED, RUNNING, 0, "é", "o", 1.5, received(3), ends, ends)
    assert state_from(state.to_text()) == state


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"run": "r"}',
        '{"run": "r", "machine": "m", "number": "1"}',
        '{"run": "r", "machine": "m", "counters": []}',
        "[" * 100_000,
    ],
)
def test_what_is_no_state_is_passed_over(text: str) -> None:
    assert state_from(text) is None
