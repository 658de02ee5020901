"""Asks the server of a dashboard over plain HTTP, as no browser would."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from http.client import HTTPConnection
from typing import Any

import requests
from launching import REPOSITORY, Running

from benchmarks.viewer import events_of

WATCHED = REPOSITORY / "extensions" / "neuros-dashboard" / "tests" / "watched"
IMU = "world.imu -> brain.imu"
TIMEOUT_S = 20


def address(running: Running) -> str:
    """What the launcher has printed."""
    running.wait_for("dashboard: http://")
    (found,) = re.findall(r"dashboard: (\S+)\n", running.output)
    return str(found)


class Visitor:
    """Asks the server as no browser would."""

    def __init__(self, url: str) -> None:
        self._origin, _, self._token = url.partition("/?token=")
        welcome = requests.get(url, allow_redirects=False, timeout=TIMEOUT_S)
        assert welcome.status_code == 303
        (self._cookie,) = welcome.cookies.keys()

    def get(self, path: str, token: str | None = None, **headers: str) -> int:
        return self._status("GET", path, token, headers)

    def post(self, path: str, token: str | None = None, **headers: str) -> int:
        return self._status("POST", path, token, headers)

    def get_as_it_is(self, path: str) -> int:
        """The status of an answer to a path that ``requests`` would tidy up beforehand."""
        connection = HTTPConnection(self._origin.partition("//")[2], timeout=TIMEOUT_S)
        with contextlib.closing(connection):
            connection.request("GET", path, headers={"Cookie": f"{self._cookie}={self._token}"})
            return connection.getresponse().status

    def _status(self, method: str, path: str, token: str | None, headers: dict[str, str]) -> int:
        cookies = {self._cookie: self._token if token is None else token}
        url = self._origin + path
        return requests.request(
            method, url, headers=headers, cookies=cookies, timeout=TIMEOUT_S
        ).status_code

    @contextlib.contextmanager
    def events(self) -> Iterator[Iterator[tuple[str, Any]]]:
        """The events of a page, until its stream ends."""
        with requests.get(
            f"{self._origin}/events",
            cookies={self._cookie: self._token},
            stream=True,
            timeout=TIMEOUT_S,
        ) as answer:
            assert answer.status_code == 200
            yield events_of(answer.iter_lines(decode_unicode=True))


def is_full(figures: Any) -> bool:
    """Whether all that moves has been seen moving."""
    shown = figures["connections"].get(IMU, {})
    return bool(shown.get("rate_hz") and shown.get("latency_ms") and figures["real_time_factor"])
