"""What the server of a dashboard answers to requests that its page would not make."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Iterator
from typing import Any

import pytest
from neuros_dashboard.live_metrics import ObservedRun
from neuros_dashboard.pages import Pages
from neuros_dashboard.server import Dashboard

from neuros.control import TO_OBSERVERS
from neuros.control.link import ControlLink

TOKEN = "secret"


class Server:
    """The application, asked without a network."""

    def __init__(self) -> None:
        here, self._there = socket.socketpair()
        pages, link = Pages(), ControlLink(here, TO_OBSERVERS, "the supervisor")
        run = ObservedRun(pages, link, ("a",), 0.0)
        dashboard = Dashboard({}, lambda: None, dict, pages, run)  # type: ignore[arg-type]
        self._app = dashboard.app(TOKEN, "0123456789abcdef")
        self._link = link

    def close(self) -> None:
        self._link.close()
        self._there.close()

    def post(self, path: str, body: Any, **headers: str) -> int:
        """The status of the answer; a body is JSON, or bytes as they are."""
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        own = {"cookie": f"neuros_01234567={TOKEN}"}
        return self._answer("POST", path, b"", b"" if body is None else data, own | headers)[0]

    def ask(self, path: str, query: bytes) -> tuple[int, str | None]:
        """The status of the answer to a request without a cookie, and where that leads."""
        return self._answer("GET", path, query, b"", {})

    def _answer(
        self, method: str, path: str, query: bytes, body: bytes, headers: dict[str, str]
    ) -> tuple[int, str | None]:
        answer: dict[str, Any] = {}
        scope = {
            "type": "http",
            "method": method,
            "path": path,
            "raw_path": path.encode(),
            "query_string": query,
            "headers": [
                (key.encode(), value.encode("latin-1"))
                for key, value in ({"host": "127.0.0.1:1"} | headers).items()
            ],
        }

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body}

        async def send(message: dict[str, Any]) -> None:
            answer.update(message)

        asyncio.run(self._app(scope, receive, send))
        location = dict(answer.get("headers", ())).get(b"location")
        return int(answer["status"]), location and location.decode()


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
        {"page": "1", "wanted": {"a": {"o": {"arrays": 5}}}},
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


@pytest.mark.parametrize("host", ["[", "127.0.0.1[", "", "\xff", "evil.org"])
def test_a_host_that_is_none_is_refused_without_a_word(
    server: Server, caplog: pytest.LogCaptureFixture, host: str
) -> None:
    assert server.post("/do/stop", {}, host=host) == 403
    assert server.post("/do/stop", {}, origin=f"http://{host}") == 403
    assert not caplog.records


def test_a_body_may_be_nested_as_deeply_as_it_likes(server: Server) -> None:
    assert server.post("/want", b"[" * 100_000) == 400
    assert server.post("/do/step", b'{"count": ' + b"[" * 100_000) == 400


def test_a_token_in_any_address_leads_to_a_path_of_this_server(server: Server) -> None:
    for path, to in (("//evil.org", "/evil.org"), ("/[", "/%5B"), ("/ä", "/%C3%A4")):
        assert server.ask(path, b"token=secret&x=\xff") == (303, f"{to}?x=%C3%BF")
