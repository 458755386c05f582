"""HTTP's own methods: HEAD wherever GET is, OPTIONS, and what a 405 says is allowed."""

from __future__ import annotations

from starlette.responses import Response
from starlette.routing import Match, Mount
from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: Methods that routes have and metrics tell apart: a client may invent any number of others.
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")


def allowed(scope: Scope) -> str:
    """The methods that a path takes, as ``Allow`` lists them; empty for a path that is nothing."""
    found = set()
    # As it was before a mount took its part of the path away.
    scope = {**scope, "root_path": scope.get("app_root_path", scope.get("root_path", ""))}
    for route in scope["app"].routes:
        # What is mounted are files, whatever it says that it matches.
        for method in ("GET",) if isinstance(route, Mount) else METHODS:
            if route.matches({**scope, "method": method})[0] is Match.FULL:
                found.add(method)
    if "GET" in found:
        found.add("HEAD")
    return ", ".join([method for method in METHODS if method in found or (found and method == "OPTIONS")])


class Methods:
    """Answers HEAD as GET without its body (RFC 9110, 9.3.2), and OPTIONS by what a path allows."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        method = scope["method"] if scope["type"] == "http" else None
        if method == "HEAD":
            await self._head(scope, receive, send)
            return
        allow = ""
        if method == "OPTIONS":
            allow = ", ".join(METHODS) if scope["path"] == "*" else allowed(scope)
        if allow:
            await Response(status_code=204, headers={"Allow": allow})(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    async def _head(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def without_body(message: Message) -> None:
            if message["type"] == "http.response.body":
                message = {**message, "body": b""}
            await send(message)

        # A copy, for the server reads in its own that no body is to follow.
        get = {**scope, "method": "GET"}
        try:
            await self.app(get, receive, without_body)
        finally:
            if "route" in get:
                scope["route"] = get["route"]
