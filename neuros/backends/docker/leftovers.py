"""Resumes and removes the containers that a launcher leaves; the guardian runs this.

It speaks HTTP with the engine itself: the guardian has only the standard library.
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
_RESUME_TIMEOUT_S = 1.0
_POLL_S = 0.05


def remove(engine_socket: str, run_id: str, *, settle_s: float, give_up_s: float) -> int:
    """Kill and remove the containers of a run until none is left; returns how many are left.

    Args:
        settle_s: how long no container must appear, since requests of a killed launcher may still
            be under way. 0 means that the launcher ended by itself: all nodes have ended then,
            and an absent engine is not waited for.
        give_up_s: end after this time in any case.
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


def resume(engine_socket: str, run_id: str) -> None:
    """Resume the paused containers of a run.

    A paused process (``docker pause``) cannot end, and with control groups of version 1 no signal
    reaches it, not even SIGKILL. An engine that does not answer soon is left alone.
    """
    with contextlib.suppress(OSError, http.client.HTTPException, ValueError):
        for container in _containers(engine_socket, run_id, _RESUME_TIMEOUT_S, status=["paused"]):
            path = f"/containers/{container}/unpause"
            _request(engine_socket, "POST", path, _RESUME_TIMEOUT_S)


def _containers(
    engine_socket: str, run_id: str, timeout_s: float = _TIMEOUT_S, **filters: list[str]
) -> Sequence[str]:
    wanted = urllib.parse.quote(json.dumps({"label": [f"{RUN_LABEL}={run_id}"], **filters}))
    path = f"/containers/json?all=1&filters={wanted}"
    found = json.loads(_request(engine_socket, "GET", path, timeout_s))
    return [container["Id"] for container in found]


def _request(engine_socket: str, method: str, path: str, timeout_s: float = _TIMEOUT_S) -> bytes:
    with contextlib.closing(_Connection(engine_socket, timeout_s)) as connection:
        connection.request(method, _API + path)
        return connection.getresponse().read()


class _Connection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: str, timeout_s: float) -> None:
        super().__init__("localhost", timeout=timeout_s)
        self._path = path

    def connect(self) -> None:
        connected: Any = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connected.settimeout(self.timeout)
        try:
            connected.connect(self._path)
        except OSError:
            connected.close()
            raise
        self.sock = connected
