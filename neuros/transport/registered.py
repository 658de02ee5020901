"""The registered transports, ours: ``ros`` on rclpy, ``memory`` for nodes of one process."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from neuros.ports import Middleware, TransportKind
from neuros.project.model import NodeFile
from neuros.registry import Registry

TRANSPORTS: Registry[TransportKind] = Registry("neuros.transports", "transport", TransportKind)


class _Rclpy(TransportKind):
    def __init__(self, name: str, *, in_memory: bool) -> None:
        self.name = name
        self._in_memory = in_memory

    def middleware(
        self,
        files: Sequence[NodeFile],
        on_failure: Callable[[BaseException], None],
        *,
        digests: bool,
        record: bool,
        debug: bool,
    ) -> Middleware:
        from neuros.transport.ros_process import RosProcess

        return RosProcess(
            files,
            on_failure,
            in_memory=self._in_memory,
            digests=digests,
            record=record,
            debug=debug,
        )


ROS = _Rclpy("ros", in_memory=False)
MEMORY = _Rclpy("memory", in_memory=True)
