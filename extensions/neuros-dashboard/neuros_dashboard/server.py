"""Web server of a run: a page, a stream of events, and a few requests.

======== ============= ===========================================================
method   path          what it does
======== ============= ===========================================================
GET      /             the page
GET      /static/...   its scripts, styles and images
GET      /world/NODE   the geometry of a node's simulated world
GET      /events       a stream of server-sent events, as long as the page is open
POST     /want         the samples that the page shows: ``{"page": ..., "wanted": ...}``
POST     /do/pause     pauses the run
POST     /do/resume    resumes it
POST     /do/step      ``{"count": n}`` steps of a paused run
POST     /do/stop      ends the run, drained, with exit code 0
======== ============= ===========================================================
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import SplitResult, quote, urlencode, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from neuros.control import End, Message, Pause, Resume, Step
from neuros_dashboard.live_metrics import ObservedRun
from neuros_dashboard.pages import Pages, wanted_of

STATIC = Path(__file__).parent / "static"
_SHARED: Any = [("neuros", "javascript")]  # pages of recorded runs use these scripts, too
_LOG_S = 0.2
_LOAD_S = 1.0
_KEPT_LINES = 1000
_CLOSING_S = 1
_MOST_STEPS = 1_000_000
_HEADERS = {
    "Cache-Control": "no-store",
    # Another page could frame this one and trick its user into clicking buttons.
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:;"
    " style-src 'self' 'unsafe-inline'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
}


_REQUESTS: Mapping[str, Message] = {
    "pause": Pause(),
    "resume": Resume(),
    "stop": End("ended from the dashboard"),
}
_NOT_UNDERSTOOD = (
    *(ValueError, LookupError, TypeError, AttributeError, OverflowError),
    RecursionError,
)


class LogSource(Protocol):
    """New lines of the logs of a run."""

    def read(self) -> list[str]: ...
    def close(self) -> None: ...


class Dashboard:
    """Serves one run until it is over.

    Args:
        plan: the result of :func:`neuros_dashboard.web.project_view`.
        open_log: opens the logs, at their last lines.
        load: returns the load of the machine and of each node since its last call, for JSON.
        pages: shared with ``run``.
    """

    def __init__(
        self,
        plan: Mapping[str, Any],
        open_log: Callable[[], LogSource],
        load: Callable[[], Mapping[str, Any]],
        pages: Pages,
        run: ObservedRun,
    ) -> None:
        self._plan, self._open_log, self._load = plan, open_log, load
        self._pages, self._run = pages, run
        self._lines: deque[str] = deque(maxlen=_KEPT_LINES)

    async def serve(self, listening: socket.socket, token: str, run: str) -> None:
        """Answer requests until the run is over."""
        config = uvicorn.Config(
            self.app(token, run),
            log_level="error",  # any user of this machine can cause warnings
            access_log=False,
            lifespan="off",
            timeout_graceful_shutdown=_CLOSING_S,
        )
        server = uvicorn.Server(config)
        serving = asyncio.create_task(server.serve([listening]))
        tasks = [asyncio.create_task(each) for each in (self._read_logs(), self._read_load())]
        try:
            await self._run.run()
        finally:
            for task in tasks:
                task.cancel()
            self._pages.end()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._pages.are_gone.wait(), _CLOSING_S)
            server.should_exit = True
            await serving

    def app(self, token: str, run: str) -> Starlette:
        app = Starlette(
            routes=[
                Route("/", self._index),
                Route("/events", self._events),
                Route("/world/{node}", self._world),
                Route("/want", self._want, methods=["POST"]),
                Route("/do/{what}", self._do, methods=["POST"]),
                Mount("/static", StaticFiles(directory=STATIC, packages=_SHARED)),
            ],
            middleware=[Middleware(Access, token=token, run=run)],
        )
        # Redirecting from a path with an extra slash, Starlette would decode the query as UTF-8.
        app.router.redirect_slashes = False
        return app

    # ------------------------------------------------------------------ requests

    async def _index(self, _: Request) -> Response:
        return FileResponse(STATIC / "index.html", headers=_HEADERS)

    async def _events(self, _: Request) -> Response:
        return StreamingResponse(self._stream(), media_type="text/event-stream", headers=_HEADERS)

    async def _world(self, request: Request) -> Response:
        geometry = await self._run.geometry(request.path_params["node"])
        if geometry is None:
            return JSONResponse({"error": "this node shows no world"}, 404)
        return Response(geometry, media_type="application/json", headers=_HEADERS)

    async def _stream(self) -> AsyncIterator[str]:
        name, page = self._pages.open()
        try:
            page.send("begin", {"page": name, **self._plan})
            page.send("phase", self._run.phase)
            page.send("log", list(self._lines))
            while (event := await page.next_event()) is not None:
                yield event
        finally:
            self._pages.close(name)

    async def _want(self, request: Request) -> Response:
        try:
            asked = await request.json()
            name, wanted = str(asked["page"]), wanted_of(asked["wanted"])
        except _NOT_UNDERSTOOD:
            return JSONResponse({"error": "this is not a request of the dashboard's page"}, 400)
        is_there = self._pages.set_wanted(name, wanted)
        return Response(status_code=204 if is_there else 410)

    async def _do(self, request: Request) -> Response:
        what = request.path_params["what"]
        if what in _REQUESTS:
            self._run.send(_REQUESTS[what])
        elif what == "step":
            try:
                count = int((await request.json())["count"])
            except _NOT_UNDERSTOOD:
                return JSONResponse({"error": "how many steps?"}, 400)
            self._run.send(Step(min(count, _MOST_STEPS)))
        else:
            return JSONResponse({"error": f"nothing is called '{what}'"}, 404)
        return Response(status_code=204)

    # ------------------------------------------------------------------ logs and load

    async def _read_logs(self) -> None:
        while True:
            await self._pages.are_watched.wait()
            log = self._open_log()
            try:
                while self._pages.are_watched.is_set():
                    lines = log.read()
                    if lines:
                        self._lines.extend(lines)
                        self._pages.send("log", lines)
                    else:
                        await asyncio.sleep(_LOG_S)
                    await asyncio.sleep(0)
            finally:
                log.close()
                self._lines.clear()  # the next page begins with the last lines of its time

    async def _read_load(self) -> None:
        while True:
            await self._pages.are_watched.wait()
            self._pages.send("load", await asyncio.to_thread(self._load))
            await asyncio.sleep(_LOAD_S)


_LOCAL_NAMES = {"127.0.0.1", "localhost", "[::1]", "::1"}


def _split(address: str) -> SplitResult:
    """The parts of an address, empty ones for an invalid address."""
    try:
        return urlsplit(address)
    except ValueError:  # "//[" has half a pair of brackets
        return urlsplit("")


class Access:
    """ASGI middleware that admits only the user's own browser, by the printed token.

    The server listens on 127.0.0.1 only, but other users of the machine, and any page in the
    user's browser, can reach it. So every request needs the token: once in the URL, then in a
    cookie that scripts cannot read. Requests of pages of other origins are refused, and so are
    those under another host name (DNS rebinding).

    Args:
        run: the run's id, part of the cookie's name, since cookies do not tell ports apart.
    """

    def __init__(self, app: ASGIApp, token: str, run: str) -> None:
        self._app = app
        self._token = token
        self._cookie = f"neuros_{run[:8]}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope, receive)
        answer = self._refusal(request) or self._welcome(request)
        await (answer or self._app)(scope, receive, send)

    def _refusal(self, request: Request) -> Response | None:
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if _split(f"//{host}").hostname not in _LOCAL_NAMES:
            return PlainTextResponse("this dashboard answers to localhost only", 403)
        if origin is not None and _split(origin).netloc != host:
            return PlainTextResponse("another page may not speak for this one", 403)
        given = request.query_params.get("token") or request.cookies.get(self._cookie, "")
        if not secrets.compare_digest(given.encode(), self._token.encode()):
            return PlainTextResponse(
                "wrong or missing token: open the whole address that NeuROS printed,"
                " http://127.0.0.1:.../?token=...",
                403,
            )
        return None

    def _welcome(self, request: Request) -> Response | None:
        """Move the token from the address, which others may see, to a cookie by a redirection."""
        if "token" not in request.query_params:
            return None
        rest = [pair for pair in request.query_params.multi_items() if pair[0] != "token"]
        path, query = f"/{quote(request.scope['path'].lstrip('/'))}", urlencode(rest)
        answer = RedirectResponse(f"{path}?{query}" if query else path, 303)
        answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
        return answer
