"""The transports on real rclpy pass the checks of all transports."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
from ros_program import RosProgram
from transport_checks import TOPIC, TransportChecks

from neuros.backends.domain import choose_domain
from neuros.ports import Transport, TransportKind
from neuros.project.model import NodeFile
from neuros.runtime.one_process import LOCAL, MEMORY
from neuros.transport.ros_loop import EXECUTOR_VARIABLE
from neuros.transport.ros_process import ROS

SLICE_S = 0.002
SETTLED_AFTER_S = 0.3


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[None]:
    """A ROS domain of our own on this machine."""
    with choose_domain(None, {}, False) as lock, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(lock.id))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


class RosNetwork:
    """Nodes in one or several ROS contexts of this process, which take turns."""

    def __init__(self, groups: Sequence[Sequence[NodeFile]], kind: TransportKind = ROS) -> None:
        self._failures: list[BaseException] = []
        self._listeners: list[RosProgram] = []
        self._processes = []
        self._transports = {}
        for files in groups:
            process = kind.middleware(
                files, self._failures.append, digests=False, record=False, debug=False
            )
            self._processes.append(process)
            for file in files:
                self._transports[file.node.name] = process.transport(file)

    def transport(self, node: str) -> Transport:
        return self._transports[node]

    def run_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline_s:
                return False
            for process in self._processes:
                process.loop.run_for(SLICE_S)
            for listener in self._listeners:
                listener.spin()
            if self._failures:
                raise self._failures[0]
        return True

    def settle(self) -> None:
        self.run_until(lambda: False, SETTLED_AFTER_S)

    def listen(self, topic: str, type_name: str) -> list[Any] | None:
        listener = RosProgram("listener")
        self._listeners.append(listener)
        return listener.listen(topic, type_name)

    def close(self) -> None:
        for process in self._processes:
            process.flush()
        for each in (*self._listeners, *self._processes):
            each.close()


class TestRosTransport(TransportChecks):
    """Each node in a context of its own, as in a process of its own."""

    def network(self, files: Sequence[NodeFile]) -> RosNetwork:
        return RosNetwork([[file] for file in files])


class TestMemoryTransportOnRos(TransportChecks):
    """All nodes in one context, packets handed over in memory."""

    def network(self, files: Sequence[NodeFile]) -> RosNetwork:
        return RosNetwork([files], MEMORY)


class UnseenNetwork(RosNetwork):
    """Nodes whose connections have no topics on the ROS graph."""

    def listen(self, topic: str, type_name: str) -> list[Any] | None:
        return super().listen(topic, type_name) if topic == TOPIC else None


class TestLocalTransport(TransportChecks):
    """All nodes in one process, with ROS for their external topics alone."""

    def network(self, files: Sequence[NodeFile]) -> RosNetwork:
        return UnseenNetwork([files], LOCAL)


class TestRosTransportOnAWaitSet(TestRosTransport):
    """The same, served by the executor that the loop falls back to."""

    @pytest.fixture(autouse=True)
    def wait_set(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv(EXECUTOR_VARIABLE, "wait_set")
