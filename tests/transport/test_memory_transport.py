"""The memory transport, without ROS around it, passes the checks of all transports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from neuros.ports import Transport
from neuros.project.model import NodeFile
from neuros.testing.stand_ins import ManualClock, StepLoop, Topics, Workbench
from neuros.testing.transports import TransportChecks


class MemoryNetwork:
    """Nodes in one process, on a loop that goes step by step."""

    def __init__(self, files: Sequence[NodeFile]) -> None:
        self._loop = StepLoop(ManualClock())
        bench = Workbench(self._loop, Topics(), [])
        self._transports = {file.node.name: bench.transport(file) for file in files}

    def transport(self, node: str) -> Transport:
        return self._transports[node]

    def run_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        while not condition():
            if not self._loop.step():
                return condition()
        return True

    def settle(self) -> None:
        self._loop.run()

    def listen(self, topic: str, type_name: str) -> list[Any] | None:
        return None

    def close(self) -> None:
        for transport in self._transports.values():
            transport.close()


class TestMemoryTransport(TransportChecks):
    def network(self, files: Sequence[NodeFile]) -> MemoryNetwork:
        return MemoryNetwork(files)
