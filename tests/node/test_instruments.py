"""Instruments are bound where they are used, and nowhere else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Int32

from neuros.node.instruments import NodeRecorder, Passage
from neuros.node.sampling import Sampler
from neuros.node.simulated_time import CLOCK_TYPE, SimulatedTime
from neuros.ports import Way
from neuros.project.model import Connection, Node, Port
from neuros.runtime.local import LocalLogger

NUMBER, CLOCK = Port("number", "std_msgs/msg/Int32"), Port("clock", CLOCK_TYPE)
CONNECTION = Connection("a", "number", "b", "in", 0)


class Kept:
    """Records the packets of the output ``number``, until it fails."""

    def __init__(self) -> None:
        self.packets: list[tuple[int, bytes, float | None, int | None]] = []
        self.is_full = self.is_closed = False

    def stream(self, way: Way, name: str) -> int | None:
        return 7 if (way, name) == (Way.SENT, "number") else None

    def keep(
        self, stream: int, data: bytes, sim_time_s: float | None, virtual_ns: int | None
    ) -> None:
        if self.is_full:
            raise OSError(28, "No space left on device")
        self.packets.append((stream, data, sim_time_s, virtual_ns))

    def close(self) -> None:
        self.is_closed = True


def show(passage: Passage, packet: Any, data: bytes | None = None) -> None:
    for observe in passage.observers:
        observe(packet, data)


@pytest.mark.parametrize("way", [Way.SENT, Way.TO_ITSELF])
def test_the_sampler_is_on_a_tap_only_while_it_is_asked(way: Way) -> None:
    sampler, passage = Sampler(bytes), Passage(way, NUMBER)
    sampler.attach(passage)
    assert not passage.observers
    sampler.ask({"other": {"all": True}})
    assert not passage.observers
    sampler.ask({"number": {"all": True}})
    show(passage, Int32(data=5))
    assert sampler.ask({})["number"]["all"] == {"data": 5}
    assert not passage.observers


def test_the_sampler_knows_an_external_input_by_its_topic() -> None:
    sampler, passage = Sampler(bytes), Passage(Way.HEARD, Port("scan", NUMBER.type, "/laser"))
    sampler.attach(passage)
    sampler.ask({"/laser": {"all": True}})
    show(passage, Int32(data=6))
    assert sampler.ask({})["/laser"]["all"] == {"data": 6}


def test_the_recorder_is_on_the_taps_that_are_recorded_and_encodes_once() -> None:
    kept, records = Kept(), []
    recorder = NodeRecorder(
        kept,
        lambda packet: b"made",
        lambda: 1.5,
        lambda: 250,
        LocalLogger("a", lambda _, record: records.append(record)),
    )
    ways = (Way.SENT, NUMBER), (Way.SENT, CLOCK), (Way.RECEIVED, NUMBER, CONNECTION)
    passages = [Passage(*way) for way in ways]
    for passage in passages:
        recorder.attach(passage)
    assert [len(passage.observers) for passage in passages] == [1, 0, 0]
    show(passages[0], Int32(), b"published")
    show(passages[0], Int32())
    assert kept.packets == [(7, b"published", 1.5, 250), (7, b"made", 1.5, 250)]


def test_a_recorder_that_fails_says_so_once_and_the_node_goes_on() -> None:
    kept, records = Kept(), []
    recorder = NodeRecorder(
        kept,
        lambda packet: b"",
        lambda: None,
        lambda: None,
        LocalLogger("a", lambda _, record: records.append(record)),
    )
    passage = Passage(Way.SENT, NUMBER)
    recorder.attach(passage)
    kept.is_full = True
    show(passage, Int32())
    show(passage, Int32())
    assert kept.is_closed
    (record,) = records
    assert "No space left on device; the run goes on" in record.text


def test_the_clock_is_taken_from_outputs_of_its_type_unless_a_simulator_owns_the_time() -> None:
    node = Node("a", "neuros_python", Path("plugin.py"), outputs=(NUMBER, CLOCK))
    time = SimulatedTime(node, None, lambda: 0, lambda _: None)
    passages = {port: Passage(Way.SENT, port) for port in node.outputs}
    for passage in passages.values():
        time.attach(passage)
    assert not passages[NUMBER].observers
    packet = Clock()
    packet.clock.sec = 3
    show(passages[CLOCK], packet)
    assert time.now_s == 3.0
    time.own(lambda: 8.0)
    show(passages[CLOCK], packet)
    assert time.now_s == 8.0
