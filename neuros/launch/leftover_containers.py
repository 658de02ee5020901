"""Removes the containers of a run whose launcher could not: it was killed, or is about to end.

Speaks the engine's HTTP itself, since the guardian runs this: standard library only.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import time
import urllib.parse
from collections.abc import Sequence
from typing import Any

RUN_LABEL = "neuros.run"
"""The label of every container of a run, with the run's id."""

_API = "/v1.41"
_TIMEOUT_S = 5.0
_POLL_S = 0.05


def remove_containers(engine_socket: str, run_id: str, *, settle_s: float, give_up_s: float) -> int:
    """Kill and remove what carries the label of a run, until nothing does; how many are left.

    ``settle_s``: how long nothing must have been there, since what a killed launcher had asked
    the engine for may still be on its way. With 0 it had ended by itself; then an engine that is
    away is not waited for, since all nodes have ended. After ``give_up_s`` seconds it ends in any
    case.
    """
    now_s = time.monotonic()
    give_up_at, clean_since = now_s + give_up_s, now_s
    left: Sequence[str] = ()
    while time.monotonic() < give_up_at:
        try:
            left = _containers(engine_socket, run_id)
            for container in left:
                _request(engine_socket, "DELETE", f"/containers/{container}?force=1&v=1")
        except (ConnectionRefusedError, FileNotFoundError):
            if not settle_s:
                break
        except (OSError, http.client.HTTPException, ValueError):
            pass  # it is busy, or just going away
        else:
            if not left and time.monotonic() - clean_since >= settle_s:
                break
        if left:
            clean_since = time.monotonic()
        time.sleep(_POLL_S)
    return len(left)


def _containers(engine_socket: str, run_id: str) -> Sequence[str]:
    filters = urllib.parse.quote(json.dumps({"label": [f"{RUN_LABEL}={run_id}"]}))
    found = json.loads(_request(engine_socket, "GET", f"/containers/json?all=1&filters={filters}"))
    return [container["Id"] for container in found]


def _request(engine_socket: str, method: str, path: str) -> bytes:
    with contextlib.closing(_Connection(engine_socket)) as connection:
        connection.request(method, _API + path)
        return connection.getresponse().read()


class _Connection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: str) -> None:
        super().__init__("localhost", timeout=_TIMEOUT_S)
        self._path = path

    def connect(self) -> None:
        connected: Any = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connected.settimeout(_TIMEOUT_S)
        try:
            connected.connect(self._path)
        except OSError:
            connected.close()
            raise
        self.sock = connected
