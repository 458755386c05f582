"""``graspdb keys`` and ``graspdb audit``: for a key with the scope admin."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

import typer

from graspdb.cli.common import State
from graspdb.cli.options import Commands
from graspdb.wire import KeyMade

keys = Commands(no_args_is_help=True, help="Make, list, rotate and revoke API keys.")

KeyId = Annotated[
    str, typer.Argument(metavar="ID", help="The key's id: keys list shows it.", show_default=False)
]
ExpiresDays = Annotated[int | None, typer.Option(help="In how many days it expires.")]


@keys.command("create")
def create_key(
    state: State,
    name: Annotated[str, typer.Argument(help="Who or what will use it.", show_default=False)],
    scopes: Annotated[
        str, typer.Option(help="Comma-separated: read, trials:write, objects:write, jobs:work, admin (all).")
    ],
    objects: Annotated[
        str | None, typer.Option(metavar="PREFIX", help="Only objects whose ids begin so.")
    ] = None,
    expires_days: ExpiresDays = None,
    requests_per_s: Annotated[float | None, typer.Option(help="Its own limit of requests a second.")] = None,
    burst: Annotated[int | None, typer.Option(help="Requests that it may make at once.")] = None,
) -> None:
    """Make a key and print it, this once."""
    made = state.db.keys.create(
        name,
        scopes=[scope.strip() for scope in scopes.split(",") if scope.strip()],
        objects=objects,
        expires_days=expires_days,
        requests_per_s=requests_per_s,
        burst=burst,
    )
    _show_made(state, made)


@keys.command("list")
def list_keys(state: State) -> None:
    """List all keys, oldest first."""
    state.show_list(
        list(state.db.keys),
        {
            "id": lambda k: k.id,
            "name": lambda k: k.name,
            "scopes": lambda k: ",".join(k.scopes),
            "objects": lambda k: f"{k.objects}*" if k.objects else "all",
            "state": lambda k: k.state,
            "expires": lambda k: _minute(k.expires_at),
            "last used": lambda k: _minute(k.last_used_at),
        },
        empty="No keys.",
    )


@keys.command("rotate")
def rotate_key(
    state: State,
    id: KeyId,
    overlap_s: Annotated[float, typer.Option(help="Seconds for which the old secret works on.")] = 0.0,
    expires_days: ExpiresDays = None,
) -> None:
    """Give a key another secret and print it, this once."""
    _show_made(state, state.db.keys.rotate(id, overlap_s=overlap_s, expires_days=expires_days))


@keys.command("revoke")
def revoke_key(state: State, id: KeyId) -> None:
    """Let a key open nothing any more."""
    state.db.keys.revoke(id)
    state.show({"revoked": id}, f"Key {id} is revoked.")


def audit(
    state: State,
    object: Annotated[str | None, typer.Option(help="Changes of this object only.")] = None,
    key: Annotated[str | None, typer.Option(help="By the key of this name or id only.")] = None,
    action: Annotated[str | None, typer.Option(help="Of this kind only, such as batch.create.")] = None,
    since: Annotated[datetime | None, typer.Option(help="From this time on, UTC.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="At most so many.")] = 20,
) -> None:
    """Show what was changed and which key did it, the newest first."""
    state.show_list(
        state.db.audit.list(object=object, key=key, action=action, since=since).first(limit),
        {
            "at": lambda e: e.at.strftime("%Y-%m-%d %H:%M:%S"),
            "key": lambda e: e.key,
            "action": lambda e: e.action,
            "object": lambda e: e.object,
            "subject": lambda e: e.subject,
            "request": lambda e: e.request_id,
        },
        empty="No changes.",
    )


def _show_made(state: State, made: KeyMade) -> None:
    secret = {"id": made.id, "key": made.key}
    state.show(secret, secret)
    typer.echo("Keep the key: it is told this once. Clients take it as GRASPDB_API_KEY.", err=True)


def _minute(at: datetime | None) -> str:
    return "never" if at is None else at.strftime("%Y-%m-%d %H:%M")
