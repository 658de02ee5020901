"""What the server of a dashboard answers to requests that its page would not make."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from neuros.control import TO_OBSERVERS
from neuros.control.link import ControlLink
from neuros.viewers.dashboard.live_metrics import LiveRun
from neuros.viewers.dashboard.pages import Pages
from neuros.viewers.dashboard.server import Dashboard, Sources

TOKEN = "secret"


class Server:
    """The application, asked without a network."""

    def __init__(self) -> None:
        here, self._there = socket.socketpair()
        pages, link = Pages(), ControlLink(here, TO_OBSERVERS, "the supervisor")
        run = LiveRun(pages, link, ("a",), 0.0)
        dashboard = Dashboard({}, Sources(lambda: None, dict), pages, run)  # type: ignore[arg-type]
        self._app = dashboard.app(TOKEN, "0123456789abcdef")
        self._link = link

    def close(self) -> None:
        self._link.close()
        self._there.close()

    def post(self, path: str, body: Any) -> int:
        """The status of the answer."""
        answer: dict[str, Any] = {}
        headers = {"host": "127.0.0.1:1", "cookie": f"neuros_01234567={TOKEN}"}
        scope = {
            "type": "http",
            "method": "POST",
            "path": path,
            "raw_path": path.encode(),
            "query_string": b"",
            "headers": [(key.encode(), value.encode()) for key, value in headers.items()],
        }

        async def receive() -> dict[str, Any]:
            return {
                "type": "http.request",
                "body": b"" if body is None else json.dumps(body).encode(),
            }

        async def send(message: dict[str, Any]) -> None:
            answer.update(message)

        asyncio.run(self._app(scope, receive, send))
        return int(answer["status"])


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


@pytest.mark.parametrize(
    "body",
    [
        None,
        [],
        {},
        {"page": "1"},
        {"page": "1", "wanted": 3},
        {"page": "1", "wanted": {"a": {"o": 5}}},
        {"page": "1", "wanted": {"a": {"o": {"fields": 5}}}},
    ],
)
def test_a_question_that_is_none_is_refused(server: Server, body: Any) -> None:
    assert server.post("/want", body) == 400


def test_a_question_of_a_page_that_has_gone_is_told_so(server: Server) -> None:
    assert server.post("/want", {"page": "1", "wanted": {}}) == 410


@pytest.mark.parametrize("body", [None, {}, {"count": "many"}, {"count": None}, {"count": 1e999}])
def test_steps_are_a_number(server: Server, body: Any) -> None:
    assert server.post("/do/step", body) == 400
    assert server.post("/do/step", {"count": 3}) == 204
