"""The memory transport, without ROS around it, passes the checks of all transports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from transport_checks import TransportBench, TransportChecks

from neuros.ports import Transport
from neuros.project.model import NodeFile
from neuros.testing.harness import ManualClock, StepLoop, Topics, Workbench, wire


class MemoryNetwork:
    """Nodes in one process, on a loop that goes step by step."""

    def __init__(self, files: Sequence[NodeFile]) -> None:
        self.loop = StepLoop(ManualClock())
        bench = Workbench(self.loop, Topics(), [])
        self._transports = {file.node.name: bench.transport(file) for file in files}

    def transport(self, node: str) -> Transport:
        return self._transports[node]

    def run_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        while not condition():
            if not self.loop.step():
                return condition()
        return True

    def settle(self) -> None:
        self.loop.run_until_idle()

    def listen(self, topic: str, type_name: str) -> list[Any] | None:
        return None

    def close(self) -> None:
        for transport in self._transports.values():
            transport.close()


class TestMemoryTransport(TransportChecks):
    def network(self, files: Sequence[NodeFile]) -> MemoryNetwork:
        return MemoryNetwork(files)


def test_who_gives_way_starts_after_what_waits_for_other_nodes_and_what_they_answer() -> None:
    with TransportBench(MemoryNetwork, wire("a.out -> b.in", 0), wire("c.out -> b.in", 0)) as bench:
        network, (from_a, from_c) = bench.network, bench.connections
        assert isinstance(network, MemoryNetwork)
        bench.meet()
        bench.inboxes["b"].on_arrival = lambda *_: bench.acknowledge(from_c, 1)
        busy = network.transport("c")
        bench.send(1, from_a)
        busy.note_execution()
        assert busy.has_taken_in()
        busy.give_way()
        may_start = [busy.has_taken_in()]
        while network.loop.step():
            may_start.append(busy.has_taken_in())
        # At first, after the packet for b, after the turn of the others, after the answer to c.
        assert may_start == [False, False, False, True]


def test_with_nothing_under_way_it_starts_at_once() -> None:
    with TransportBench(MemoryNetwork) as bench:
        bench.meet()
        busy = bench.network.transport("c")
        busy.give_way()
        assert busy.has_taken_in()
