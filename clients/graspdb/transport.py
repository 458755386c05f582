"""HTTP to the service with retries: the part that the SDK and the worker share.

A request is retried on connection errors, timeouts and 429, 502, 503 and 504, with exponential backoff
and jitter, honouring Retry-After. That is safe for every verb the service has: GET, PUT and DELETE are
idempotent, and every creating POST carries one Idempotency-Key through all its attempts.
"""

from __future__ import annotations

import ipaddress
import json
import os
import random
import re
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from datetime import date
from functools import partial
from typing import Any, TypeVar

import httpx
import numpy as np
from pydantic import BaseModel, ValidationError

from graspdb.errors import GraspDBError, Unreachable, error_for
from graspdb.wire import Problem

__all__ = ["DEFAULT_URL", "Transport"]

Model = TypeVar("Model", bound=BaseModel)
DEFAULT_URL = "http://127.0.0.1:8000"
_PROXY_VARIABLES = frozenset({"http_proxy", "https_proxy", "all_proxy", "no_proxy"})
_RETRIED = frozenset({429, 502, 503, 504})


class Transport:
    """One connection pool to one service; safe to share between threads, and after fork: a child connects
    anew. See :class:`graspdb.Client`.
    """

    def __init__(
        self,
        url: str | None = None,
        *,
        api_key: str | None = None,
        timeout_s: float = 120.0,
        retries: int = 5,
        user_agent: str = "graspdb",
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.url = (url or os.environ.get("GRASPDB_URL") or DEFAULT_URL).rstrip("/")
        headers = {"User-Agent": user_agent, **_authorization(api_key)}
        self._retries = retries
        self._sleep = sleep
        self._make = partial(_pool, self.url, headers, httpx.Timeout(timeout_s, connect=10.0))
        self._process, self._made = os.getpid(), self._make()
        self._inherited: httpx.Client | None = None

    @property
    def _http(self) -> httpx.Client:
        """This process's pool: on a connection inherited by fork, one would read the answers of others."""
        if self._process != os.getpid():
            # The inherited pool is left as it is: closing it would end connections of the parent's.
            self._inherited, self._process, self._made = self._made, os.getpid(), self._make()
        return self._made

    def close(self) -> None:
        self._http.close()

    def __enter__(self) -> Transport:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def request(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        body: BaseModel | Mapping[str, Any] | list[Any] | None = None,
        content: bytes | None = None,
        headers: Mapping[str, str] | None = None,
        idempotent: bool = False,
        idempotency_key: str | None = None,
        retries: int | None = None,
    ) -> httpx.Response:
        """Send and return a 2xx or 304 answer; other answers raise their typed error, none Unreachable.

        ``body`` is sent as JSON (a model without its unset fields), ``content`` as it is with its type in
        ``headers``. ``idempotent`` gives a creating POST an Idempotency-Key, the same in every attempt.
        """
        send = dict(headers or {})
        if body is not None:
            if isinstance(body, BaseModel):
                content = body.model_dump_json(exclude_unset=True).encode()
            else:
                content = json.dumps(body, allow_nan=False, default=_plain).encode()
            send.setdefault("Content-Type", "application/json")
        if idempotency_key or idempotent:
            send["Idempotency-Key"] = idempotency_key or str(uuid.uuid4())
        query = _given(params)
        return self._answered(
            lambda: self._http.request(method, path, params=query, content=content, headers=send), retries
        )

    def lines(self, path: str, *, params: Mapping[str, Any] | None = None) -> Iterator[bytes]:
        """The lines of a list as the service sends them (``application/x-ndjson``), of which one is held at a
        time; Unreachable where they end too early.
        """
        headers = {"Accept": "application/x-ndjson"}

        def sent() -> httpx.Response:
            response = self._http.send(
                self._http.build_request("GET", path, params=_given(params), headers=headers), stream=True
            )
            if not response.is_success:
                response.read()
            return response

        response = self._answered(sent, None)
        rest = b""
        try:
            for piece in response.iter_bytes():
                *whole, rest = (rest + piece).split(b"\n")
                yield from filter(None, whole)
        except httpx.TransportError as error:
            raise Unreachable(f"{self.url} stopped in the middle of its answer: {error}") from error
        finally:
            response.close()
        if rest:
            yield rest

    def _answered(self, send: Callable[[], httpx.Response], retries: int | None) -> httpx.Response:
        """What is answered to a request that is sent until something is, a few times."""
        attempts = 1 + (self._retries if retries is None else retries)
        for attempt in range(attempts):
            last = attempt == attempts - 1
            wait = min(0.2 * 2.0**attempt, 10.0) * random.uniform(0.5, 1.0)
            try:
                response = send()
            except httpx.TransportError as error:
                if last:
                    raise Unreachable(
                        f"no answer from {self.url}: {error or type(error).__name__}."
                        " Is the service running (graspdb-server serve), and is GRASPDB_URL right?"
                    ) from error
            else:
                if response.is_success or response.status_code == 304:
                    return response
                if last or response.status_code not in _RETRIED or _is_deadline(response):
                    raise error_for(_problem(response))
                wait = max(wait, _retry_after(response))
            self._sleep(wait)
        raise AssertionError("unreachable: the last attempt returns or raises")

    def json(self, method: str, path: str, **options: Any) -> Any:
        """:meth:`request`, and the answer's JSON."""
        return self.request(method, path, **options).json()

    def model(self, model: type[Model], method: str, path: str, **options: Any) -> Model:
        """:meth:`request`, and the answer as this model."""
        return model.model_validate_json(self.request(method, path, **options).content)


def _given(params: Mapping[str, Any] | None) -> dict[str, Any]:
    return {key: value for key, value in (params or {}).items() if value is not None}


def _authorization(api_key: str | None) -> dict[str, str]:
    """The header that shows the key given, or ``$GRASPDB_API_KEY``; ValueError for what can't be a key."""
    key = (api_key or os.environ.get("GRASPDB_API_KEY") or "").strip()
    if not key:
        return {}
    if not re.fullmatch(r"[\x21-\x7e]+", key):
        raise ValueError("an API key is printable ASCII without spaces: is api_key (GRASPDB_API_KEY) one?")
    return {"Authorization": f"Bearer {key}"}


def _pool(url: str, headers: dict[str, str], timeout: httpx.Timeout) -> httpx.Client:
    """Connections to a service: straight to this machine's own, else as the environment's proxies say."""
    host = httpx.URL(url).host
    # A proxy has its own loopback: what it would reach there is not the service that is meant.
    transport = httpx.HTTPTransport() if _is_loopback(host) else None
    try:
        return httpx.Client(base_url=url, headers=headers, timeout=timeout, transport=transport)
    except (httpx.InvalidURL, ValueError, ImportError) as error:
        names = [name for name in os.environ if name.lower() in _PROXY_VARIABLES]
        if not names:
            raise
        raise GraspDBError(
            f"a proxy variable ({', '.join(sorted(names))}) can't be used for {host}: {error}."
            " Mend it, or unset it"
        ) from error


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _plain(value: object) -> Any:
    """What NumPy and the calendar hand over, as JSON has it; TypeError for anything else."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, date):
        return value.isoformat()
    raise TypeError(f"{value!r} of type {type(value).__name__} can't be sent as JSON")


def _retry_after(response: httpx.Response) -> float:
    try:
        return min(float(response.headers.get("Retry-After", "0")), 60.0)
    except ValueError:
        return 0.0


def _is_deadline(response: httpx.Response) -> bool:
    """Whether time ran out for a question: asked again, it would take as long again."""
    return response.status_code == 503 and b":deadline" in response.content


def _problem(response: httpx.Response) -> Problem:
    try:
        return Problem.model_validate(response.json())
    except (ValueError, ValidationError):
        return Problem(
            type="about:blank",
            title=f"{response.status_code} {response.reason_phrase}",
            status=response.status_code,
            detail=response.text[:300] or None,
        )
