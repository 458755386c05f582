"""``graspdb-server keys``: on the database itself, so that the first key needs no other."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import Annotated, Any

import typer
from pydantic import BaseModel, ValidationError

from graspdb.wire.access.keys import KeyCreate, KeyInfo, KeyRotate
from graspdb_service.commands.options import DatabaseUrl, database_of, fail, settings_from
from graspdb_service.problems import ProblemError
from graspdb_service.storage import schema
from graspdb_service.storage.database import CANNOT_OPEN, Database, UnsupportedDatabase, why
from graspdb_service.usecases.access import keys as stored

keys = typer.Typer(no_args_is_help=True, help="Make, list, rotate and revoke API keys.")

KeyId = Annotated[str, typer.Argument(metavar="ID", help="The key's id: keys list shows it.")]
AsJson = Annotated[bool, typer.Option("--json", help="JSON for machines.")]
ExpiresDays = Annotated[int | None, typer.Option(help="In how many days it expires; never by default.")]
_PAGE = 1_000


@keys.command("create")
def create_key(
    name: Annotated[str, typer.Argument(help="Who or what will use it.")],
    scopes: Annotated[
        str, typer.Option(help="Comma-separated: read, trials:write, objects:write, jobs:work, admin (all).")
    ],
    objects: Annotated[
        str | None, typer.Option(metavar="PREFIX", help="Only objects whose ids begin so.")
    ] = None,
    expires_days: ExpiresDays = None,
    requests_per_s: Annotated[float | None, typer.Option(help="Its own limit of requests a second.")] = None,
    burst: Annotated[int | None, typer.Option(help="Requests that it may make at once.")] = None,
    json: AsJson = False,
    database_url: DatabaseUrl = None,
) -> None:
    """Make a key and print it, this once."""
    with _opened(database_url) as database:
        request = KeyCreate.model_validate(
            {
                "name": name,
                "scopes": [scope.strip() for scope in scopes.split(",") if scope.strip()],
                "objects": objects,
                "expires_days": expires_days,
                "requests_per_s": requests_per_s,
                "burst": burst,
            }
        )
        made = stored.create(database, request)
    _tell_secret(made.id, made.key, json)


@keys.command("list")
def list_keys(json: AsJson = False, database_url: DatabaseUrl = None) -> None:
    """List the keys, oldest first."""
    found: list[KeyInfo] = []
    after: int | None = 0
    with _opened(database_url) as database:
        while after is not None:
            items, after = stored.page(database, after=after, limit=_PAGE)
            found += items
    if json:
        _print_json(found)
        return
    for item in found:
        limited = f" of {item.objects}*" if item.objects else ""
        typer.echo(
            f"{item.id}  {item.state:8}  {item.name}: {','.join(item.scopes)}{limited};"
            f" expires {_day(item.expires_at)}, last used {_day(item.last_used_at)}"
        )
    if not found:
        typer.echo("There are no keys: graspdb-server keys create makes one.", err=True)


@keys.command("rotate")
def rotate_key(
    id: KeyId,
    overlap_s: Annotated[
        float, typer.Option(help="Seconds for which the old secret works on, so that clients can follow.")
    ] = 0.0,
    expires_days: Annotated[
        int | None, typer.Option(help="In how many days from now it expires; as before by default.")
    ] = None,
    json: AsJson = False,
    database_url: DatabaseUrl = None,
) -> None:
    """Give a key another secret and print it, this once."""
    with _opened(database_url) as database:
        request = KeyRotate.model_validate({"overlap_s": overlap_s, "expires_days": expires_days})
        made = stored.rotate(database, id, request)
    _tell_secret(made.id, made.key, json)


@keys.command("revoke")
def revoke_key(id: KeyId, database_url: DatabaseUrl = None) -> None:
    """Let a key open nothing any more; running services follow within two seconds."""
    with _opened(database_url) as database:
        stored.revoke(database, id)
    typer.echo(f"Key {id} is revoked.")


@contextmanager
def _opened(database_url: str | None) -> Iterator[Database]:
    """The database, its schema current; one line for what a person can mend."""
    database = None
    try:
        database = database_of(settings_from(database_url=database_url))
        if database.is_sqlite:
            schema.upgrade(database)
        else:
            schema.check(database)
        yield database
    except ProblemError as error:
        fields = "; ".join(f"{field}: {message}" for field, message in error.errors)
        fail(": ".join(part for part in (error.title, fields) if part))
    except ValidationError as error:
        fail("; ".join(f"--{_option(e['loc'])}: {e['msg']}" for e in error.errors()))
    except (schema.StaleSchema, UnsupportedDatabase) as error:
        fail(str(error))
    except CANNOT_OPEN as error:
        fail(f"The database cannot be opened: {why(error)}")
    finally:
        if database is not None:
            database.dispose()


def _option(place: tuple[Any, ...]) -> str:
    return str(place[0] if place else "").replace("_", "-")


def _tell_secret(id: str, key: str, as_json: bool) -> None:
    if as_json:
        _print_json({"id": id, "key": key})
        return
    typer.echo(f"id   {id}\nkey  {key}")
    typer.echo("Keep the key: it is told this once. Clients take it as GRASPDB_API_KEY.", err=True)


def _print_json(value: Any) -> None:
    def plain(item: BaseModel) -> Any:
        return item.model_dump(mode="json")

    typer.echo(json.dumps(value, default=plain))


def _day(at: datetime | None) -> str:
    return "never" if at is None else at.strftime("%Y-%m-%d %H:%M UTC")
