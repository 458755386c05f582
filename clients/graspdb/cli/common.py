"""What the commands share: the connection, tables and JSON."""

from __future__ import annotations

import csv
import dataclasses
import functools
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from pydantic import BaseModel
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from graspdb.client import Client
from graspdb.wire import Finding
from graspdb.wire.reports import ReportRun

ERRORS = Console(stderr=True)
ObjectId = Annotated[str, typer.Argument(metavar="OBJECT", help="The object's id.", show_default=False)]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")]
T = TypeVar("T")


@dataclasses.dataclass
class State:
    """The global options, and the one connection of this run, which ends with it."""

    context: typer.Context
    url: str | None
    api_key: str | None
    json: bool

    @functools.cached_property
    def db(self) -> Client:
        """A person waits in front of it, so fewer retries than a program's."""
        return self.context.with_resource(Client(self.url, api_key=self.api_key, retries=2))

    def show(self, value: Any, words: Mapping[str, Any] | str) -> None:
        """The value with --json, else these names and values, or this line."""
        if self.json:
            out(value)
        elif isinstance(words, str):
            typer.echo(words)
        else:
            show_rows(words)

    def show_list(self, items: Sequence[T], columns: Mapping[str, Callable[[T], Any]], *, empty: str) -> None:
        """The items with --json, else a table of them."""
        if self.json:
            out(items)
        else:
            show_table(items, columns, empty=empty)


def console() -> Console:
    """Standard output; wide where nobody looks, so that pipes get whole lines."""
    return Console() if sys.stdout.isatty() or "COLUMNS" in os.environ else Console(width=160)


def plain(value: Any) -> Any:
    """As JSON can hold it: models, arrays and dataclasses as mappings and lists, no infinities."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {
            f.name: getattr(value, f.name)
            for f in dataclasses.fields(value)
            if f.name not in ("raw", "reporter", "drawer")
        }
        return {name: plain(item) for name, item in fields.items()}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def out(value: Any) -> None:
    """JSON on standard output."""
    sys.stdout.write(json.dumps(plain(value), allow_nan=False, ensure_ascii=False) + "\n")


def out_csv(columns: Mapping[str, Any]) -> None:
    """Equally long columns as CSV on standard output, under their names; an empty cell is not known."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(columns)
    # NaN, which differs from itself, is not known either.
    cells = [["" if x != x else x for x in np.asarray(column).tolist()] for column in columns.values()]
    writer.writerows(zip(*cells, strict=True))


def flat(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Names and values, those of a mapping in it as ``name.key``."""
    return {
        f"{name}.{key}".rstrip("."): item
        for name, value in fields.items()
        for key, item in (value.items() if isinstance(value, dict) else [("", value)])
    }


def show_rows(rows: Mapping[str, Any]) -> None:
    """Names and values below each other; brackets, as those of units, are no markup."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows.items():
        table.add_row(escape(name), escape(str(value)))
    console().print(table)


def show_table(items: Sequence[T], columns: Mapping[str, Callable[[T], Any]], *, empty: str) -> None:
    """A row an item, and in each column what it says of the item; numbers stand to the right."""
    rows = [[cell(item) for cell in columns.values()] for item in items]
    body = [["" if cell is None else cell for cell in row] for row in rows]
    if not body:
        console().print(empty)
        return
    texts = [[f"{cell:,}" if isinstance(cell, int) else str(cell) for cell in row] for row in body]
    screen = console()
    widths = _widths([[name, *column] for name, *column in zip(columns, *texts, strict=True)], screen.width)
    # A line that is wider than the screen is still one line to who copies it.
    screen.width = max(screen.width, sum(widths) + _GAP * len(widths))
    table = Table(header_style="bold", box=None, pad_edge=False)
    for index, (name, width) in enumerate(zip(columns, widths, strict=True)):
        numeric = all(isinstance(row[index], (int, float)) or row[index] == "" for row in body)
        table.add_column(escape(name), justify="right" if numeric else "left", overflow="fold", width=width)
    for row in texts:
        table.add_row(*map(escape, row))
    screen.print(table)


_GAP = 2


def _widths(columns: Sequence[Sequence[str]], screen: int) -> list[int]:
    """How wide columns are: as their texts; where the screen is too narrow as their longest words at least,
    for an identifier over two lines can't be copied.
    """
    full = [max(map(cell_len, texts)) for texts in columns]
    least = [max((cell_len(word) for text in texts for word in text.split()), default=0) for texts in columns]
    give = sum(full) - sum(least)
    spare = max(screen - _GAP * len(full) - sum(least), 0)
    share = min(spare / give, 1.0) if give else 0.0
    return [low + int((high - low) * share) for low, high in zip(least, full, strict=True)]


def confirm(question: str) -> None:
    """Ask, and end the command unless the answer is yes; told of --yes where nobody is there to answer."""
    try:
        agreed = typer.confirm(question, err=True)
    except typer.Abort:
        if sys.stdin.isatty():
            raise
        ERRORS.print()
        raise ValueError("nobody is there to answer: --yes does it without asking") from None
    if not agreed:
        raise typer.Abort


def show_findings(findings: Iterable[Finding]) -> None:
    """What is doubtful about trials, and what to do about it."""
    for finding in findings:
        # Plain: a message may hold brackets, which rich would take for markup.
        typer.echo(f"Doubtful ({finding.code}): {finding.message}.\n  {finding.remedy}.")


def numbers(values: Any, digits: int = 4) -> str:
    """A vector in a cell."""
    return " ".join(f"{float(value):+.{digits}f}" for value in values)


@contextmanager
def run_bar(title: str) -> Iterator[Callable[[ReportRun], None]]:
    """How far a run is, for a person to see, once it is told."""
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=ERRORS, transient=True
    )
    task = bar.add_task(title, total=1.0, visible=False)
    with bar:
        yield lambda run: bar.update(task, completed=run.progress, visible=True)
