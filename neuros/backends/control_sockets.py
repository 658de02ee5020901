"""Control channel over a Unix socket in the run folder: for back ends on this machine.

A distribution adds addresses ``scheme:place`` by an entry point of the group ``neuros.control``
with the name of the scheme: a function from the place to a :class:`neuros.ports.ControlStream`.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path

from neuros.control import CONTROL_VARIABLE
from neuros.errors import EnvironmentFault
from neuros.ports import ControlStream

SOCKET_NAME = "control.sock"
_GROUP = "neuros.control"
_SCHEME = "unix"
_MOST_WAITING = 256


class UnixListener:
    """Listens at a Unix socket in the run folder (:class:`neuros.ports.ControlListener`)."""

    def __init__(self, run_folder: Path) -> None:
        self._path = run_folder / SOCKET_NAME
        self.address = f"{_SCHEME}:{self._path}"
        self.files = (self._path,)

    def open(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            with _short_path(self._path) as name:
                self._socket.bind(name)
                os.chmod(name, 0o600)  # before listen(): nobody can connect yet
        except OSError as error:
            self._socket.close()
            raise EnvironmentFault(
                f"{self._path.parent}: cannot make the control socket there ({error.strerror}): is"
                " the folder used by another run, or on a file system without sockets? Name another"
                " one with -o"
            ) from error
        self._socket.listen(_MOST_WAITING)
        self._socket.setblocking(False)

    def fileno(self) -> int:
        return self._socket.fileno()

    def accept(self) -> socket.socket | None:
        try:
            return self._socket.accept()[0]
        except BlockingIOError:
            return None
        except OSError as error:
            raise EnvironmentFault(
                f"nodes cannot connect to their launcher ({error.strerror}): allow it more open"
                " files (ulimit -n)"
            ) from error

    def close(self) -> None:
        self._socket.close()


def connect(address: str) -> ControlStream:
    """Connect to a supervisor.

    Raises:
        EnvironmentFault: if no such address is known.
        OSError: if no supervisor listens there.
    """
    scheme, _, place = address.partition(":")
    if scheme == _SCHEME:
        connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            with _short_path(Path(place)) as name:
                connected.connect(name)
        except OSError:
            connected.close()
            raise
        return connected
    from importlib.metadata import entry_points

    found = {each.name: each for each in entry_points(group=_GROUP)}
    if scheme not in found:
        known = ", ".join([_SCHEME, *found])
        raise EnvironmentFault(
            f"control address '{address}': no way to connect to '{scheme}:' (known are {known});"
            " install the distribution of the back end beside NeuROS"
        )
    stream: ControlStream = found[scheme].load()(place)
    return stream


def connect_by(environ: Mapping[str, str]) -> ControlStream:
    """Connect to the supervisor of this process. Raises as :func:`connect`."""
    address = environ.get(CONTROL_VARIABLE)
    if not address:
        raise EnvironmentFault(
            f"{CONTROL_VARIABLE} is not set: do not start this program by hand; `neuros launch`"
            " starts it, and sets the variable"
        )
    return connect(address)


@contextlib.contextmanager
def _short_path(path: Path) -> Iterator[str]:
    """A name for ``path`` that fits into the 107 bytes which Unix sockets allow."""
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)
