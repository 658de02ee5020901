"""The transports of nodes that share a process: in real or virtual time, with or without ROS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from neuros.ports import TransportKind
from neuros.project.model import NodeFile
from neuros.project.timing import VIRTUAL
from neuros.runtime.local import LocalLoop, LocalMiddleware
from neuros.runtime.virtual import VirtualLoop, VirtualMiddleware
from neuros.transport.digests import TriedDigest, digest_of
from neuros.transport.rclpy_patches import do_without_code_generator


class _OneProcess(TransportKind):
    """``memory``, with topics on the ROS graph, and ``local``, with ROS where nodes ask for it."""

    def __init__(self, name: str, *, has_ros: bool) -> None:
        self.name = name
        self._has_ros = has_ros

    def middleware(
        self,
        files: Sequence[NodeFile],
        on_failure: Callable[[BaseException], None],
        *,
        digests: bool,
        record: bool,
        debug: bool,
    ) -> LocalMiddleware:
        do_without_code_generator()
        is_lossless = all(c.discard_limit == 0 for file in files for c in file.connections)
        tried = TriedDigest() if is_lossless and not record else None
        keywords: dict[str, Any] = {
            "files": files,
            "exposes": self._has_ros,
            "debug": debug,
            "digest": digest_of if digests or record else tried,
            # Of what is recorded, digests only tell which packets have arrived.
            "digests_of": lambda c: digests or not (record and c.is_reliable),
        }
        if files[0].time == VIRTUAL:
            loop = VirtualLoop(files[0].seed)
            return VirtualMiddleware(loop, None, on_failure, **keywords | {"digest": digest_of})
        return LocalMiddleware(None if self._has_ros else LocalLoop(), None, on_failure, **keywords)


MEMORY = _OneProcess("memory", has_ros=True)
LOCAL = _OneProcess("local", has_ros=False)
