"""What the commands share: the settings that they are given, and how they end when they can't go on."""

from __future__ import annotations

from typing import Annotated, Any, NoReturn

import typer
from pydantic import ValidationError

from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database

DatabaseUrl = Annotated[
    str | None, typer.Option("--database-url", help="sqlite:///FILE or postgresql://USER@HOST/NAME")
]


def settings_from(**given: Any) -> Settings:
    """The settings of the environment, and above them the options that were given."""
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        fail("; ".join(f"{_variable(e['loc'])}: {e['msg']}, not {e['input']!r}" for e in error.errors()))
    except ValueError as error:
        fail(str(error))


def database_of(settings: Settings) -> Database:
    """The database that a command works on; UnsupportedDatabase where the URL names none."""
    return Database(settings.database_url, password_file=settings.database_password_file)


def _variable(place: tuple[int | str, ...]) -> str:
    return f"GRASPDB_{str(place[0] if place else '').upper()}"


def fail(message: str, code: int = 1) -> NoReturn:
    """End the command with a line on standard error."""
    typer.echo(message, err=True)
    raise SystemExit(code)
