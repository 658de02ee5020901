"""Program of a node process: composes runtime and transport."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import ctypes
import faulthandler
import gc
import io
import json
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from neuros.backends.control_sockets import SESSION_SOCKET_NAME, UnixListener, connect_by
from neuros.errors import EnvironmentFault
from neuros.node.process import NodeProcess
from neuros.ordinary_files import leave_out_what_has_no_room
from neuros.ports import ControlListener, Middleware, PacketRecorder
from neuros.project.model import NodeFile
from neuros.project.split import node_files_from_json
from neuros.recording.provenance import note_versions
from neuros.registry import TRANSPORTS
from neuros.transport.imports_when_used import imports_when_used

_FILE = io.IOBase.__base__ or io.IOBase  # what all files are, in C: quicker to ask for
_STANDARD = (0, 1, 2)
# For closing the middleware, when all else is done. 17 processes that do so at once take up to
# 0.2 s; with busy processes beside them, and threads that were starved, one took 3.8 s.
_CLOSING_S = 2


def add_node(node: argparse.ArgumentParser) -> None:
    """Add the arguments of the program; ``launch`` starts it, in a container or a process."""
    node.add_argument("node_files", nargs="+")
    node.add_argument("--transport", default="ros")
    node.add_argument("--one-process", action="store_true")
    node.add_argument("--duration-sim", type=float)
    node.add_argument("--digests", action="store_true")
    node.add_argument("--debug", action="store_true")
    node.add_argument("--record", action="store_true")
    node.add_argument("--held", action="store_true")
    node.set_defaults(command=_run_node)


def _run_node(options: argparse.Namespace) -> int:
    """Run the nodes of the given ``node.json`` files until they are asked to end."""
    leave = _Leave()
    atexit.register(leave)  # first, so that it comes last, after what plugins have registered
    faulthandler.enable()  # a plugin that crashes in C leaves its Python stack in the log
    for name in ("stdout", "stderr"):
        leave_out_what_has_no_room(name)
    files = node_files_from_json(json.loads(Path(p).read_text()) for p in options.node_files)
    # ROS tools started by a plugin must find the same ROS, so only the guard is taken away.
    os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    if not options.one_process:  # else it is the launcher's Python
        note_versions(files[0].folders.run / files[0].node.name)

    def make_middleware(
        files: Sequence[NodeFile], on_failure: Callable[[BaseException], None]
    ) -> Middleware:
        with imports_when_used():
            transport = TRANSPORTS.load(options.transport)
        middleware = transport.middleware(
            files,
            on_failure,
            digests=options.digests,
            record=options.record,
            debug=options.debug,
        )
        leave.middleware = middleware
        return middleware

    run_folder = files[0].folders.run
    has_session = options.held and options.one_process
    leave.exit_code = NodeProcess(
        files,
        make_middleware,
        partial(connect_by, os.environ),
        open_recorder=_recorders(run_folder) if options.record else None,
        duration_sim_s=options.duration_sim,
        is_held=options.held,
        session=_session_listener(run_folder) if has_session else None,
        own_logs=options.one_process,
    ).run()
    return leave.exit_code


def _session_listener(run_folder: Path) -> ControlListener | None:
    """Listens to the session; where that cannot be, it steps by the supervisor, only slower."""
    listener = UnixListener(run_folder, SESSION_SOCKET_NAME)
    try:
        listener.open()
    except EnvironmentFault:
        return None
    return listener


def _recorders(run: Path) -> Callable[[NodeFile], PacketRecorder]:
    """Makes the packet recorders of nodes by the recording plan of the run."""
    from neuros.recording.recording_plan import load_plan
    from neuros.recording.spool import open_recorder

    plan = load_plan(run)
    return lambda file: open_recorder(plan, run, file.node.name)


class _Leave:
    """Python's last act: files and middleware are closed; it ends here where ROS is not given up.

    Python would close files by itself, but not on :func:`os._exit`, and not those that it finds
    only through objects which the garbage collector leaves alone (:mod:`neuros.node.process`).
    """

    def __init__(self) -> None:
        self.exit_code: int | None = None
        self.middleware: Middleware | None = None
        self._pid = os.getpid()

    def __call__(self) -> None:
        gc.unfreeze()
        files = [each for each in gc.get_objects() if issubclass(type(each), _FILE)]
        gc.freeze()  # else Python goes through all of it once more, for a fifth of a second
        for file in sorted(files, key=_is_inner):  # what is compressed ends only when it is closed
            with contextlib.suppress(Exception):  # it is closed already, or its reader has gone
                file.flush()
                if file.fileno() not in _STANDARD:
                    file.close()
        ctypes.CDLL(None).fflush(None)  # what libraries in C have printed
        if self.middleware is None or os.getpid() != self._pid:  # a fork of it has no ROS
            return
        with _given(_CLOSING_S):
            self.middleware.close()
        if self.exit_code is not None and getattr(self.middleware, "has_leftovers", False):
            os._exit(self.exit_code)


@contextlib.contextmanager
def _given(limit_s: int) -> Iterator[None]:
    """End the process by SIGALRM if the block takes longer, be it in C and with the GIL."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGALRM})
    signal.alarm(limit_s)
    try:
        yield
    finally:
        signal.alarm(0)


def _is_inner(file: Any) -> bool:
    """Whether another file may write to it when that is closed."""
    return type(file).__module__ == "_io" and not isinstance(file, io.TextIOBase)
