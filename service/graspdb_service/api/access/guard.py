"""The guard before every route: the key, its scopes, its rate and its objects, before any body is read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from fastapi import Depends
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute
from starlette.types import Receive, Scope, Send

from graspdb_service import principal
from graspdb_service.api.routing.scopes import accepted_scopes, refuse_unknown_parameters
from graspdb_service.principal import Principal
from graspdb_service.problems import ProblemError
from graspdb_service.usecases.access.key_ring import KeyRing
from graspdb_service.usecases.access.rates import Rates


@dataclass(frozen=True)
class Door:
    """Who gets in; without a ring keys are off, and everybody may do all."""

    ring: KeyRing | None
    rates: Rates

    async def admit(self, scope: Scope, accepted: tuple[str, ...]) -> Principal | None:
        """Who asks, where a key is needed: 401 without a good one, 429 too often, 403 without the scope."""
        if self.ring is None or accepted == ("public",):
            return None
        who = await self.ring.open(_authorization(scope))
        self.rates.take(who)
        if not who.may(accepted):
            raise _lacking(who, accepted)
        return who


class GuardedRoute(APIRoute):
    """A route behind the application's :class:`Door`, which takes the parameters that it declares alone.

    What is below it may ask :mod:`graspdb_service.principal` who asks. RuntimeError without a declared scope.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        known = [Depends(refuse_unknown_parameters), *(options.pop("dependencies", None) or ())]
        super().__init__(*args, dependencies=known, **options)
        self._accepted = accepted_scopes(self)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        door: Door = scope["app"].state.door
        who = await door.admit(scope, self._accepted)
        state = scope.setdefault("state", {})
        if who is not None:
            # What is shared fairly is shared between keys.
            state["key_id"] = who.key_id
            # The log names it, too.
            state["key"] = who.name
        with principal.asking(who, state.get("request_id")):
            if self.path.startswith("/objects/{id}"):
                principal.refuse_hidden(scope["path_params"]["id"])
            await super().handle(scope, receive, send)


def refuse_unguarded(routes: Iterable[BaseRoute]) -> None:
    """RuntimeError for a route that nothing guards: none may be open by oversight."""
    for route in routes:
        if not isinstance(route, GuardedRoute):
            raise RuntimeError(f"{getattr(route, 'path', route)} is not guarded: make it a GuardedRoute")


def _authorization(scope: Scope) -> str | None:
    for name, value in scope["headers"]:
        if name == b"authorization":
            sent: str = value.decode("latin-1")
            return sent
    return None


def _lacking(who: Principal, accepted: tuple[str, ...]) -> ProblemError:
    needed = " or ".join(accepted)
    return ProblemError(
        403,
        "scope-missing",
        f"This needs the scope {needed}; the key {who.name!r} has {', '.join(sorted(who.scopes))}",
        headers={
            "WWW-Authenticate": 'Bearer realm="graspdb", error="insufficient_scope",'
            f' scope="{" ".join(accepted)}"'
        },
        extra={"required_scopes": list(accepted), "scopes": sorted(who.scopes)},
    )
