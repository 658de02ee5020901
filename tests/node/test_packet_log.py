"""The lists of packets that a node writes."""

from __future__ import annotations

import json
from array import array
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neuros.api.packets import read_packets
from neuros.engine.connection_ends import SendWindow, Subscription
from neuros.engine.hook import Hook
from neuros.engine.schedule import ExecutionLog
from neuros.hooks import HookKind, HookSpec
from neuros.node.logs import PacketLog
from neuros.project.model import Connection

LEAVING = Connection("node", "out", "other", "in", 0, index=3)
ARRIVING = Connection("other", "out", "node", "in", 0, index=4)


@pytest.fixture
def node() -> Any:
    """What an engine has of its connections: one each way, and an external topic."""
    subscriptions = {key: Subscription(key, str(key), "in", 1) for key in (ARRIVING, "topic")}
    return SimpleNamespace(
        send_windows={LEAVING: SendWindow(LEAVING)},
        subscriptions=subscriptions,
        execution_log=ExecutionLog(),
        pauses=SimpleNamespace(still_ns=array("q")),
        event_log=None,
    )


def numbers(folder: Path, name: str) -> list[int]:
    found = array("q")
    found.frombytes((folder / "packets" / name).read_bytes())
    return list(found)


def test_what_was_noted_is_written_and_taken_away(tmp_path: Path, node: Any) -> None:
    digests = {LEAVING: array("Q", [7]), ARRIVING: array("Q", [8])}
    node.send_windows[LEAVING].spend(1000)
    node.subscriptions[ARRIVING].taken.append(1)
    node.subscriptions[ARRIVING].taken_ns.append(2000)
    PacketLog(node, digests, tmp_path).write()
    written = {path.name: numbers(tmp_path, path.name) for path in (tmp_path / "packets").iterdir()}
    assert written == {
        "3.sent_ns": [1000],
        "3.digests": [7],
        "4.digests": [8],
        "4.taken": [1],
        "4.taken_ns": [2000],
    }
    assert not node.send_windows[LEAVING].sent_ns
    assert not digests[LEAVING]


def test_what_comes_later_goes_behind_it(tmp_path: Path, node: Any) -> None:
    log = PacketLog(node, {}, tmp_path)
    for time_ns in (1, 2, 3):
        node.send_windows[LEAVING].spend(time_ns)
        log.write()
    assert numbers(tmp_path, "3.sent_ns") == [1, 2, 3]


def test_a_node_that_sends_nothing_has_no_files(tmp_path: Path, node: Any) -> None:
    PacketLog(node, {}, tmp_path).write()
    assert list(tmp_path.iterdir()) == []


def test_of_external_topics_nothing_is_kept(tmp_path: Path, node: Any) -> None:
    node.subscriptions["topic"].taken.append(1)
    node.subscriptions["topic"].taken_ns.append(5)
    PacketLog(node, {}, tmp_path).write()
    assert list(tmp_path.iterdir()) == []
    assert not node.subscriptions["topic"].taken


def test_first_executions_are_written_with_the_names_of_their_hooks(
    tmp_path: Path, node: Any
) -> None:
    hook = Hook(HookSpec(HookKind.FUNCTION, numbers, (), ()), (), {})
    node.execution_log.record_execution(hook, 100, 250)
    node.execution_log.record_credit(LEAVING, 1, 300)
    PacketLog(node, {}, tmp_path).write()
    assert numbers(tmp_path, "executions") == [0, 100, 250]
    assert numbers(tmp_path, "credits") == [3, 1, 300]
    assert json.loads((tmp_path / "packets/hooks.json").read_text()) == [
        {"name": "numbers", "kind": "function"}
    ]
    assert not node.execution_log.executions


@pytest.mark.parametrize("at_once", [1, 3, 50])
def test_a_list_keeps_the_newest_packets_and_no_more_than_it_may(
    tmp_path: Path, node: Any, at_once: int
) -> None:
    digests = {ARRIVING: array("Q")}
    log = PacketLog(node, digests, tmp_path, list_bytes=8 * 8)
    arrived = node.subscriptions[ARRIVING]
    for number in range(1, 51):
        node.send_windows[LEAVING].spend(1000 + number)
        digests[ARRIVING].append(number)
        arrived.taken.append(number)
        arrived.taken_ns.append(2000 + number)
        if number % at_once == 0:
            log.write()
            assert sum(f.stat().st_size for f in (tmp_path / "packets").iterdir()) <= 4 * 8 * 8
    log.write()
    (tmp_path / "node").mkdir()
    (tmp_path / "packets").rename(tmp_path / "node/packets")
    (tmp_path / "node/node.json").touch()
    sent, received = (read_packets(tmp_path, each) for each in (LEAVING, ARRIVING))
    assert sent.sent_before == received.received_before == received.taken_before == 42
    assert sent.sent_ns.tolist() == [*range(1043, 1051)]
    assert received.taken.tolist() == received.received.tolist() == [*range(43, 51)]
    assert received.consumed.tolist() == [*range(43, 51)]
    assert received.consumed_ns.tolist() == [*range(2043, 2051)]


def test_in_a_recorded_run_a_list_keeps_the_first_packets(tmp_path: Path, node: Any) -> None:
    node.event_log = array("q", [-1, -2, -3])
    log = PacketLog(node, {}, tmp_path, list_bytes=16)
    for time_ns in (1, 2, 3):
        node.send_windows[LEAVING].spend(time_ns)
        log.write()
    assert numbers(tmp_path, "3.sent_ns") == [1, 2]
    assert numbers(tmp_path, "event_log") == [-1, -2, -3]
    assert not node.send_windows[LEAVING].sent_ns


def test_no_list_is_kept_where_none_is_wanted(tmp_path: Path, node: Any) -> None:
    log = PacketLog(node, {LEAVING: array("Q", [7])}, tmp_path, list_bytes=0)
    node.send_windows[LEAVING].spend(1)
    hook = Hook(HookSpec(HookKind.FUNCTION, numbers, (), ()), (), {})
    node.execution_log.record_execution(hook, 100, 250)
    log.write()
    assert list(tmp_path.iterdir()) == []
    assert not node.send_windows[LEAVING].sent_ns


def test_a_full_disk_is_noted_and_the_run_goes_on(tmp_path: Path, node: Any) -> None:
    (tmp_path / "packets").mkdir()
    (tmp_path / "packets/3.sent_ns").symlink_to("/dev/full")
    log = PacketLog(node, {}, tmp_path)
    node.send_windows[LEAVING].spend(1)
    log.write()
    assert log.failure is not None
    assert "No space left on device" in log.failure
    node.send_windows[LEAVING].spend(2)
    log.write()
    assert not node.send_windows[LEAVING].sent_ns
