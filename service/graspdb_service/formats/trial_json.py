"""Trials as JSON: one, many, in columns or in lines of a request's body; stored ones as documents."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from graspdb.wire import OUTCOMES
from graspdb.wire.base import MAX_QUALITIES, expand_matrix, no_such_field
from graspdb.wire.trials import BatchDefaults
from graspdb_service.formats.json_pieces import WHOLE, Allowed, LongArray, lenient, loads
from graspdb_service.formats.trial_fields import (
    BLOCK,
    DEFAULTS,
    NAMES,
    QUALITIES,
    REQUIRED,
    SCALARS,
    SEVERAL,
    Faults,
    Fields,
    Place,
    blocks_of,
    check_blocks,
    defaults_of,
    refuse_too_many,
)
from graspdb_service.problems import invalid
from graspdb_service.trial_columns import TrialBatch, TrialPage, gripper_parts

_OF_BATCH = "stands once for a batch: beside trials or columns, or in the address, as ?licence=CC-BY-4.0"


def parse(body: bytes, *, limit: int, allowed: Allowed) -> TrialBatch:
    """Check a JSON body of trials: 413 for more than ``limit``, 422 naming the fields that are wrong."""
    flaws: list[str] = []
    try:
        batch = _parsed(loads(body, allowed=allowed, flaws=flaws), flaws, limit)
    except orjson.JSONDecodeError as error:
        raise invalid("body", f"not valid JSON: {error}") from None
    if flaws:
        raise invalid("body", flaws[0])
    return batch


def _parsed(document: Any, flaws: Sequence[str], limit: int) -> TrialBatch:
    if not isinstance(document, dict):
        told = "the body is a JSON object: a trial, {trials: [...]} or {columns: {...}}"
        raise invalid("body", flaws[0] if flaws else told)
    faults = Faults()
    if "columns" not in document and "trials" not in document:
        return check_blocks([_from_rows([document], faults, _of_one)], BatchDefaults(), _of_one, limit)
    form = "columns" if "columns" in document else "trials"
    given = document.pop(form)
    defaults = defaults_of(document, faults, form)
    if form == "columns":
        return check_blocks(_from_columns(given, faults, limit), defaults, _of_columns, limit)
    return check_blocks(_from_trials(given, faults, limit), defaults, _of_trials, limit)


def _of_one(_: int, name: str) -> str:
    return name


def _of_columns(row: int, name: str) -> str:
    return f"columns.{name}.{row}"


def _of_trials(row: int, name: str) -> str:
    return f"trials.{row}.{name}" if name else f"trials.{row}"


def parse_lines(body: bytes, *, limit: int) -> TrialBatch:
    """As :func:`parse`, for one trial a line."""
    return check_blocks(_from_lines(body), BatchDefaults(), _of_trials, limit)


def _from_lines(body: bytes) -> Iterator[Fields]:
    """Blocks of lines; NaN and Infinity are let through until the fields that hold them can be named."""
    later, first = Faults(), 0
    for lines in _lines(body):
        rows, flaws = [], Faults()
        for number, line in enumerate(lines, first):
            row, flaw = _line(line)
            if flaw:
                flaws.add(f"trials.{number}", flaw)
                later.found += flaws.found[-1:]
            rows.append({} if flaw and row is None else row)
        if any(row == {} for row in rows):
            flaws.raise_if_any()
        yield from _blocks_of_rows([rows], Faults(), first)
        later.raise_if_any()
        first += len(lines)
    if not first:
        raise invalid("body", "no trial in the body: one JSON object a line")


def _lines(body: bytes) -> Iterator[list[bytes]]:
    """Lines that are not blank, a block at a time; 422 for one that is too long to be parsed at once."""
    lines: list[bytes] = []
    start = 0
    while start < len(body):
        stop = body.find(b"\n", start)
        stop = len(body) if stop < 0 else stop
        if stop - start > WHOLE:
            raise invalid("body", f"a line of {stop - start:,} bytes: one trial a line, at most {WHOLE:,}")
        line = body[start:stop]
        if line.strip():
            lines.append(line)
            if len(lines) == BLOCK:
                yield lines
                lines = []
        start = stop + 1
    if lines:
        yield lines


def _line(text: bytes) -> tuple[Any, str | None]:
    """JSON, and what is wrong with it."""
    try:
        return orjson.loads(text), None
    except orjson.JSONDecodeError as error:
        flaws: list[str] = []
        try:
            return lenient(text, error, flaws), flaws[0]
        except orjson.JSONDecodeError:
            return None, f"not valid JSON: {error}"


# --- the three forms to blocks of one list a field ------------------------------------------------------


def _from_columns(columns: Any, faults: Faults, limit: int) -> Iterator[Fields]:
    if not isinstance(columns, dict):
        faults.add("columns", "an object of lists, one a field")
        faults.raise_if_any()
    columns = _with_qualities(columns, faults)
    for name in sorted(name for name in columns if name not in NAMES and not name.startswith(QUALITIES)):
        told = no_such_field(name[:80], NAMES, listed=not faults.found)
        faults.add(f"columns.{name[:80]}", told.replace("field", "column"))
    lists: dict[str, list[Any] | LongArray] = {}
    for name in columns:
        if isinstance(columns[name], list | LongArray):
            lists[name] = columns[name]
        elif columns[name] is not None or name in REQUIRED:
            faults.add(f"columns.{name}", "a list with one value a trial")
    for name in REQUIRED:
        if name not in columns:
            faults.add(f"columns.{name}", "required")
    faults.raise_if_any()
    count = len(lists["position"])
    refuse_too_many(count, limit)
    for name, values in lists.items():
        if len(values) != count:
            faults.add(f"columns.{name}", f"has {len(values)} rows and position {count}")
    if count == 0:
        faults.add("columns.position", "at least one trial")
    faults.raise_if_any()
    return blocks_of({name: _in_blocks(values) for name, values in lists.items()}, _of_columns, faults)


def _with_qualities(columns: dict[str, Any], faults: Faults) -> dict[str, Any]:
    """Columns with those of qualities beside the others, as ``qualities.NAME``."""
    for name in columns:
        if name.startswith(QUALITIES):
            faults.add(f"columns.{name[:80]}", "unknown column: qualities are an object of lists by name")
    faults.raise_if_any()
    scores = columns.get("qualities")
    if scores is None:
        return {name: values for name, values in columns.items() if name != "qualities"}
    if not isinstance(scores, dict) or len(scores) > MAX_QUALITIES:
        faults.add("columns.qualities", f"an object of lists by name, at most {MAX_QUALITIES}")
        faults.raise_if_any()
    others = {name: values for name, values in columns.items() if name != "qualities"}
    return others | {f"{QUALITIES}{name}": values for name, values in scores.items()}


def _in_blocks(values: list[Any] | LongArray) -> Iterator[list[Any]]:
    """A list of a document, in lists of equal length but the last."""
    if isinstance(values, list):
        for start in range(0, len(values), BLOCK):
            yield values[start : start + BLOCK]
        return
    held: list[Any] = []
    for items in values:
        held += items
        while len(held) >= BLOCK:
            yield held[:BLOCK]
            held = held[BLOCK:]
    if held:
        yield held


def _from_trials(trials: Any, faults: Faults, limit: int) -> Iterator[Fields]:
    if not isinstance(trials, list | LongArray) or not len(trials):
        faults.add("trials", "a list of at least one trial")
        faults.raise_if_any()
    refuse_too_many(len(trials), limit)
    return _blocks_of_rows(_in_blocks(trials), faults)


def _blocks_of_rows(blocks: Iterable[list[Any]], faults: Faults, first: int = 0) -> Iterator[Fields]:
    for rows in blocks:

        def place(i: int, name: str, first: int = first) -> str:
            return _of_trials(first + i, name)

        yield _from_rows(rows, faults, place)
        first += len(rows)


def _from_rows(rows: list[Any], faults: Faults, place: Place) -> Fields:
    if set(map(type, rows)) != {dict}:
        for i, row in enumerate(rows):
            if not isinstance(row, dict):
                faults.add(place(i, "").rstrip("."), "a trial is a JSON object")
        faults.raise_if_any()
    names: set[str] = set().union(*rows)
    if "matrix" in names:
        rows = [_expanded(row, i, faults, place) for i, row in enumerate(rows)]
        faults.raise_if_any()
        names = set().union(*rows)
    if not names <= NAMES:
        for i, row in enumerate(rows):
            for name in sorted(row.keys() - NAMES):
                told = _OF_BATCH
                if name not in DEFAULTS:
                    told = no_such_field(str(name), NAMES, listed=not faults.found)
                faults.add(place(i, str(name)), told)
    for name in REQUIRED:
        missing = [i for i, row in enumerate(rows) if row.get(name) is None]
        for i in missing:
            faults.add(place(i, name), "required")
    faults.raise_if_any()
    lists = {name: [row.get(name) for row in rows] for name in sorted(names & NAMES)}
    return Fields(lists, len(rows), place, faults)


def _expanded(row: dict[str, Any], i: int, faults: Faults, place: Place) -> dict[str, Any]:
    try:
        row = expand_matrix(row)
    except ValueError as error:
        faults.add(place(i, "matrix"), str(error))
        return row
    # As JSON would have brought them.
    return {key: list(value) if isinstance(value, tuple) else value for key, value in row.items()}


# --- stored trials --------------------------------------------------------------------------------------


def columns_of(page: TrialPage) -> dict[str, Sequence[Any] | NDArray[Any]]:
    """Stored trials in columns, by the names that :class:`graspdb.wire.TrialOut` has for them.

    A number is NaN, and a pose index -1, where there is none. What stood once beside a batch holds for each
    of its trials that did not say it itself.
    """
    columns = page.columns
    batches = [page.batches[number] for number in columns.batch.tolist()]
    provenances = [page.provenances[number] for number in columns.provenance.tolist()]
    named = [None if item.gripper is None else gripper_parts(item.gripper) for item in provenances]
    own = zip(columns.metadata, batches, strict=True)
    return {
        "seq": columns.seq,
        "revision": columns.revision,
        "batch": [batch.key for batch in batches],
        "position": columns.position,
        "quaternion_xyzw": columns.quaternion_xyzw,
        "outcome": columns.outcome,
        "gripper": [None if name is None else name[0] for name in named],
        "gripper_version": [None if name is None else name[1] for name in named],
        "source": [item.source for item in provenances],
        "protocol": [item.protocol for item in provenances],
        "engine": [item.engine for item in provenances],
        "proposal_density": columns.proposal_density,
        "quality": columns.quality,
        "width_m": columns.width_m,
        "attempts": columns.attempts,
        "successes": columns.successes,
        "pose_covariance": columns.pose_covariance,
        "measured_at": columns.measured_at,
        "metadata": [batch.metadata if value is None else value for value, batch in own],
        "sweep": [batch.sweep for batch in batches],
        "pose_index": columns.pose_index,
        "answer": [page.answers.get(number) for number in columns.answer.tolist()],
        "achieved_pose": [_pose(row) for row in columns.achieved.tolist()],
        "withdrawn": columns.withdrawn,
    }


def documents(page: TrialPage) -> list[dict[str, Any]]:
    """Stored trials as :class:`graspdb.wire.TrialOut` has them."""
    columns = columns_of(page)
    values = {name: x.tolist() if isinstance(x, np.ndarray) else x for name, x in columns.items()}
    values["outcome"] = [OUTCOMES[code] for code in values["outcome"]]
    values["pose_index"] = [None if index < 0 else index for index in values["pose_index"]]
    for name in SCALARS:
        values[name] = [None if value != value else value for value in values[name]]
    for name in SEVERAL:
        values[name] = [None if value is None else int(value) for value in values[name]]
    values["qualities"] = _scores(page)
    return [dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)]


def _scores(page: TrialPage) -> list[dict[str, float] | None]:
    """The named scores of each trial, None where it has none."""
    columns = page.columns
    if not len(columns.qualities):
        return [None] * len(columns)
    scored: list[dict[str, float] | None] = []
    for number, row in zip(columns.batch.tolist(), columns.qualities.tolist(), strict=True):
        known = {n: x for n, x in zip(page.batches[number].qualities, row, strict=False) if x == x}
        scored.append(known or None)
    return scored


def _pose(row: list[float]) -> dict[str, list[float]] | None:
    """An achieved pose, NaN where it is unknown."""
    return None if row[0] != row[0] else {"position": row[:3], "quaternion_xyzw": row[3:]}


def lines(page: TrialPage) -> bytes:
    """Stored trials as one document a line."""
    return b"".join(orjson.dumps(item, option=orjson.OPT_APPEND_NEWLINE) for item in documents(page))
