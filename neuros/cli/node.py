"""Program of a node process: composes runtime and transport."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import ctypes
import faulthandler
import gc
import json
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from neuros.backends.control_sockets import connect_by
from neuros.node.process import NodeProcess
from neuros.ports import Middleware, PacketRecorder, TransportKind
from neuros.project.model import NodeFile
from neuros.project.split import node_files_from_json
from neuros.recording.provenance import note_versions
from neuros.registry import TRANSPORTS
from neuros.transport.imports_when_used import imports_when_used

# Parameters of mallopt(3), in malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def add_node(node: argparse.ArgumentParser) -> None:
    node.add_argument("node_files", nargs="+")
    node.add_argument("--transport", default="ros")
    node.add_argument("--one-process", action="store_true")
    node.add_argument("--duration-sim", type=float)
    node.add_argument("--duration", type=float)
    node.add_argument("--real-time-factor", type=float)
    node.add_argument("--fork", type=json.loads)
    node.add_argument("--digests", action="store_true")
    node.add_argument("--debug", action="store_true")
    node.add_argument("--record", action="store_true")
    node.add_argument("--held", action="store_true")
    node.set_defaults(command=_run_node)


def load_transport(name: str) -> TransportKind:
    """Import a transport, and what nodes need of ROS."""
    with imports_when_used():
        return TRANSPORTS.load(name)


def load_messages(*names: str) -> None:
    """Import messages, and NumPy if a packet of one has arrays; forks of this process share both.

    Args:
        names: of their types, such as ``std_msgs/msg/String``.
    """
    with imports_when_used():
        from neuros.transport.messages import make_packet

        for name in names:
            make_packet(name)


def keep_freed_memory() -> None:
    """Have glibc keep up to 64 MB of freed memory, unless the environment sets its limits.

    By default it returns what is free at the end of the heap at once. A node with a queue of images
    (0.9 MB each) then has 90 page faults per packet, for a third of the processor time of a packet.
    """
    tuned = os.environ.get("GLIBC_TUNABLES", "")
    if "glibc.malloc" in tuned or any(name.startswith("MALLOC_") for name in os.environ):
        return
    with contextlib.suppress(AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, 32 << 20)  # its largest value; larger blocks are always returned
        mallopt(_M_TRIM_THRESHOLD, 64 << 20)


def _run_node(options: argparse.Namespace) -> int:
    """Run the nodes of the given ``node.json`` files until they are asked to end."""
    keep_freed_memory()
    # At exit Python closes the files that a plugin left open, but not among frozen objects.
    atexit.register(gc.unfreeze)
    faulthandler.enable()  # a plugin that crashes in C leaves its Python stack in the log
    files = node_files_from_json(json.loads(Path(p).read_text()) for p in options.node_files)
    # ROS tools started by a plugin must find the same ROS, so only the guard is taken away.
    os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    if not options.one_process:  # else it is the launcher's Python
        note_versions(files[0].folders.run / files[0].node.name)

    def make_middleware(
        files: Sequence[NodeFile], on_failure: Callable[[BaseException], None]
    ) -> Middleware:
        middleware = load_transport(options.transport).middleware(
            files,
            on_failure,
            digests=options.digests,
            record=options.record,
            debug=options.debug,
        )

        def close(process: int = os.getpid()) -> None:
            if os.getpid() == process:  # a fork has no ROS
                middleware.close()

        atexit.register(close)  # before plugins register functions of their own, which run first
        return middleware

    run_folder = files[0].folders.run
    open_recorder = None
    if options.record:
        from neuros.recording import spool
        from neuros.recording.recording_plan import load_plan

        plan = load_plan(run_folder)

        def open_recorder(file: NodeFile) -> PacketRecorder:
            return spool.open_recorder(plan, run_folder, file.node.name)

    return NodeProcess(
        files,
        make_middleware,
        partial(connect_by, os.environ),
        open_recorder=open_recorder,
        duration_sim_s=options.duration_sim,
        duration_s=options.duration,
        real_time_factor=options.real_time_factor,
        fork=options.fork,
        is_held=options.held,
        own_logs=options.one_process,
    ).run()
