"""A line in the log for every request, and its span: what was asked, by whom, how it ended, what it took."""

from __future__ import annotations

import logging
import time
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from graspdb_service.telemetry import traces
from graspdb_service.telemetry.record import RECORD, RequestRecord

log = logging.getLogger("graspdb.request")

_METHODS = frozenset(("CONNECT", "DELETE", "GET", "HEAD", "OPTIONS", "PATCH", "POST", "PUT", "TRACE"))
#: Asked every few seconds by supervisors: told only where something is wrong.
_ROUTINE = ("/livez", "/readyz", "/metrics")
_PATH_LETTERS = 200
#: As proxies have it: the client went before it was answered.
_HUNG_UP = 499


class RequestLog:
    """The outermost middleware: what is within is timed, counted and told in one line when it has ended.

    The route is the template it matched; the path is shortened, the query and the headers are not told.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        record = RequestRecord(scope.setdefault("state", {}))
        told: dict[str, Any] = {"status": None, "bytes_in": 0, "bytes_out": 0}

        async def counted_receive() -> Message:
            message = await receive()
            told["bytes_in"] += len(message.get("body", b""))
            return message

        async def counted_send(message: Message) -> None:
            if message["type"] == "http.response.start":
                told["status"] = message["status"]
            told["bytes_out"] += len(message.get("body", b""))
            await send(message)

        started = time.perf_counter()
        token = RECORD.set(record)
        try:
            with traces.request_span(scope["headers"]) as span:
                try:
                    await self.app(scope, counted_receive, counted_send)
                finally:
                    seconds = time.perf_counter() - started
                    told["status"] = told["status"] or _HUNG_UP
                    _tell(scope, record, told, seconds)
                    if span is not None:
                        _describe(span, scope, record, told)
        finally:
            RECORD.reset(token)


def _route(scope: Scope) -> str:
    return getattr(scope.get("route"), "path", "unmatched")


def _method(scope: Scope) -> str:
    return scope["method"] if scope["method"] in _METHODS else "other"


def _tell(scope: Scope, record: RequestRecord, told: dict[str, Any], seconds: float) -> None:
    status, route = told["status"], _route(scope)
    if status >= 500:
        level = logging.ERROR if status == 500 else logging.WARNING
    else:
        level = logging.DEBUG if route in _ROUTINE and status < 400 else logging.INFO
    if not log.isEnabledFor(level):
        return
    times = {f"{phase}_ms": round(1e3 * took, 2) for phase, took in record.seconds.items()}
    fields = {
        "method": _method(scope),
        "route": route,
        "path": scope["path"][:_PATH_LETTERS],
        **told,
        "total_ms": round(1e3 * seconds, 2),
        **times,
        "client": (scope.get("client") or ("",))[0],
    }
    log.log(level, "request", extra={"fields": fields})


def _describe(span: Any, scope: Scope, record: RequestRecord, told: dict[str, Any]) -> None:
    span.update_name(f"{_method(scope)} {_route(scope)}")
    span.set_attributes(
        {
            "http.request.method": _method(scope),
            "http.route": _route(scope),
            "http.response.status_code": told["status"],
            **{f"graspdb.{name}": value for name, value in record.names().items()},
        }
    )
