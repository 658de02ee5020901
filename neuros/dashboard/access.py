"""Who may see the dashboard: whoever has the token that the launcher printed.

The server listens on 127.0.0.1 only, but other users of the machine, and any page that the user's
browser shows, can reach that, too. So every request needs the token: once in the URL, from then on
in a cookie that no script can read. A request that a page of another origin has made is refused,
and so is one under another name for this machine (DNS rebinding).
"""

from __future__ import annotations

import secrets
from urllib.parse import urlencode, urlsplit

from starlette.datastructures import URL
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

_LOCAL_NAMES = {"127.0.0.1", "localhost", "[::1]", "::1"}


class Access:
    """ASGI middleware that lets only the user's own browser through.

    Args:
        run: the run's id, for the name of the cookie: cookies do not tell ports apart.
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
        if urlsplit(f"//{host}").hostname not in _LOCAL_NAMES:
            return PlainTextResponse("this dashboard answers to localhost only", 403)
        if origin is not None and urlsplit(origin).netloc != host:
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
        """Move the token from the address, which others may see, into a cookie."""
        if "token" not in request.query_params:
            return None
        rest = [pair for pair in request.query_params.multi_items() if pair[0] != "token"]
        url = URL(request.url.path).replace(query=urlencode(rest))
        answer = RedirectResponse(str(url), 303)
        answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
        return answer
