"""What a web page may make a browser send: nothing, where there are no keys that it would not have.

Without keys, whoever reaches the service may do all, and a browser on the same machine reaches it for any
page that it shows. Such a page comes under a name of its own, which it may have resolved to this machine (DNS
rebinding): so only known Hosts are served. Or it posts across origins, which the browser says: that is
refused.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Collection
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from graspdb_service.problems import ProblemError
from graspdb_service.settings import is_loopback

#: Supervisors ask for these by whatever address a container has.
_HEALTH = {"/livez", "/readyz"}
#: Prometheus as well, at addresses that it looked up: no page that had its name resolved comes under one.
_BY_ADDRESS = "/metrics"
ANY_HOST = "*"


class BrowserGuard:
    """Refuses bodies of no declared type, and without keys unknown Hosts and foreign Origins.

    ``hosts`` are names served beside loopback, or ``*``; None where there are keys. ``answer`` makes a
    problem the response to a request of this id.
    """

    def __init__(
        self,
        app: ASGIApp,
        hosts: Collection[str] | None,
        answer: Callable[[ProblemError, str], Response],
    ) -> None:
        self.app = app
        self._hosts = None if hosts is None else frozenset(host.lower() for host in hosts)
        self._answer = answer

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope["path"].removeprefix(scope.get("root_path", "")) if scope["type"] == "http" else None
        if path is not None and path not in _HEALTH:
            headers = Headers(scope=scope)
            problem = self._untyped(headers)
            if problem is None and self._hosts is not None:
                problem = self._unknown_host(headers, path) or self._foreign(headers)
            if problem is not None:
                request_id = scope.get("state", {}).get("request_id", "")
                await self._answer(problem, request_id)(scope, receive, send)
                return
        await self.app(scope, receive, send)

    @staticmethod
    def _untyped(headers: Headers) -> ProblemError | None:
        has_body = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
        if not has_body or headers.get("content-type"):
            return None
        return ProblemError(
            415, "unsupported-media-type", "Say by Content-Type what the body is, such as application/json"
        )

    def _unknown_host(self, headers: Headers, path: str) -> ProblemError | None:
        host = headers.get("host", "")
        if self._is_known(_name(host)) or (path == _BY_ADDRESS and _is_address(_name(host))):
            return None
        return ProblemError(
            421,
            "unknown-host",
            f"Without keys only loopback is served, and not as {host[:100]!r}: name it in"
            " GRASPDB_ALLOWED_HOSTS, or have callers bring keys (GRASPDB_AUTH=keys)",
        )

    def _foreign(self, headers: Headers) -> ProblemError | None:
        """A page of another origin asks, by what browsers say of that."""
        origin = headers.get("origin")
        if origin is None:
            crosses = headers.get("sec-fetch-site") == "cross-site"
            if not crosses or headers.get("sec-fetch-mode") == "navigate":
                return None
        elif self._is_own(origin, headers.get("host", "")):
            return None
        return ProblemError(
            403,
            "foreign-origin",
            f"A web page of {(origin or 'another site')[:100]} asks: without keys that is refused."
            " Name its host in GRASPDB_ALLOWED_HOSTS if it is yours",
        )

    def _is_own(self, origin: str, host: str) -> bool:
        place, hosts = urlsplit(origin).netloc.lower(), self._hosts or ()
        # Another port of this machine is another's page, unlike another port of a host that was named.
        is_named = _name(place) in hosts and not is_loopback(_name(place))
        return place == host.lower() or is_named or ANY_HOST in hosts

    def _is_known(self, name: str) -> bool:
        assert self._hosts is not None
        return is_loopback(name) or name in self._hosts or ANY_HOST in self._hosts


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _name(host: str) -> str:
    """A host without its port, lower case; an IPv6 address without its brackets."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower()
