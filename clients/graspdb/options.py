"""Options that the SDK's methods and the command line share, each declared once.

A method takes a TypedDict of keywords, ``**selection: Unpack[Selection]``: editors complete them, type
checkers check them, and :func:`known_keywords` refuses a name that is none of them. A field that is an option
of a command too is ``Annotated[float | None, Option("Its help.")]``; :mod:`graspdb.cli.options` makes
parameters of such a TypedDict, so that a new option is one line.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["Corners", "Option", "PoseFile", "Vector", "known_keywords"]


@dataclass(frozen=True)
class Option:
    """``--name-of-the-field``, unless it has another ``flag``; ``default`` where a command has one."""

    help: str
    flag: str | None = None
    min: int | None = None
    default: Any = None


@dataclass(frozen=True)
class Vector(Option):
    """Comma-separated numbers, named by ``of``."""

    of: str = "x,y,z"


@dataclass(frozen=True)
class Corners(Option):
    """A box by two options, ``--<lower>`` and ``--<upper>``, that go together."""

    lower: str = "box_min"
    upper: str = "box_max"
    upper_help: str = "Its upper corner."


@dataclass(frozen=True)
class PoseFile(Option):
    """Poses in a file."""


def known_keywords(model: type[Any], given: Mapping[str, Any], method: str) -> dict[str, Any]:
    """Keywords that a method was given, all of which ``model``, a TypedDict, must name (TypeError)."""
    known: frozenset[str] = model.__optional_keys__
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            meant = f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(sorted(known))}"
            raise TypeError(f"{method}() got an unexpected keyword argument {name!r}{meant}")
    return dict(given)
