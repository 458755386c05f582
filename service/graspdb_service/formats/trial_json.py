"""Trials as JSON: one, many, in columns or in lines of a request's body; stored ones as documents."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from graspdb.wire import OUTCOMES
from graspdb.wire.base import expand_matrix
from graspdb.wire.trials import TrialDefaults
from graspdb_service.formats.trial_fields import (
    NAMES,
    REQUIRED,
    SCALARS,
    Faults,
    Fields,
    check,
    defaults_of,
    refuse_too_many,
)
from graspdb_service.problems import invalid
from graspdb_service.trial_columns import TrialBatch, TrialPage, gripper_parts


def parse(body: bytes, *, limit: int) -> TrialBatch:
    """Check a JSON body of trials: 413 for more than ``limit``, 422 naming the fields that are wrong."""
    document, flaw = _loads(body)
    if not isinstance(document, dict):
        raise invalid(
            "body", flaw or "the body is a JSON object: a trial, {trials: [...]} or {columns: {...}}"
        )
    faults = Faults()
    defaults = TrialDefaults()
    if "columns" in document or "trials" in document:
        form = "columns" if "columns" in document else "trials"
        given = document.pop(form)
        defaults = defaults_of(document, faults, form)
        fields = (_from_columns if form == "columns" else _from_trials)(given, faults, limit)
    else:
        fields = _from_rows([document], faults, lambda _, name: name)
    batch = check(fields, defaults)
    if flaw:
        raise invalid("body", flaw)
    return batch


def parse_lines(body: bytes, *, limit: int) -> TrialBatch:
    """As :func:`parse`, for one trial a line."""
    lines = [line for line in body.split(b"\n") if line.strip()]
    refuse_too_many(len(lines), limit)
    rows, faults, flaws = [], Faults(), Faults()
    for number, line in enumerate(lines):
        row, flaw = _loads(line)
        if flaw:
            flaws.add(f"trials.{number}", flaw)
        rows.append({} if flaw and row is None else row)
    if not rows:
        raise invalid("body", "no trial in the body: one JSON object a line")
    if any(row == {} for row in rows):
        flaws.raise_if_any()
    batch = check(_from_rows(rows, faults, lambda i, name: f"trials.{i}.{name}"), TrialDefaults())
    flaws.raise_if_any()
    return batch


def _loads(text: bytes) -> tuple[Any, str | None]:
    """JSON, and what is wrong with it.

    Python's own parser takes NaN, Infinity and 1e999, which are no JSON: they are let through with the flaw
    so that the fields that hold them can be named.
    """
    try:
        return orjson.loads(text), None
    except orjson.JSONDecodeError as error:
        flaw = f"not valid JSON: {error}"
    try:
        return json.loads(text), flaw
    except (ValueError, RecursionError):
        return None, flaw


# --- the three forms to one list a field ----------------------------------------------------------------


def _from_columns(columns: Any, faults: Faults, limit: int) -> Fields:
    if not isinstance(columns, dict):
        faults.add("columns", "an object of lists, one a field")
        faults.raise_if_any()
    for name in sorted(set(columns) - NAMES):
        faults.add(f"columns.{name}", f"unknown column; there are {', '.join(sorted(NAMES))}")
    lists: dict[str, Sequence[Any]] = {}
    for name in sorted(set(columns) & NAMES):
        if isinstance(columns[name], list):
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
    return Fields(lists, count, lambda i, name: f"columns.{name}.{i}", faults)


def _from_trials(trials: Any, faults: Faults, limit: int) -> Fields:
    if not isinstance(trials, list) or not trials:
        faults.add("trials", "a list of at least one trial")
        faults.raise_if_any()
    refuse_too_many(len(trials), limit)
    return _from_rows(trials, faults, lambda i, name: f"trials.{i}.{name}" if name else f"trials.{i}")


def _from_rows(rows: list[Any], faults: Faults, place: Callable[[int, str], str]) -> Fields:
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
                faults.add(place(i, str(name)), "unknown field")
    for name in REQUIRED:
        missing = [i for i, row in enumerate(rows) if row.get(name) is None]
        for i in missing:
            faults.add(place(i, name), "required")
    faults.raise_if_any()
    lists = {name: [row.get(name) for row in rows] for name in sorted(names & NAMES)}
    return Fields(lists, len(rows), place, faults)


def _expanded(
    row: dict[str, Any], i: int, faults: Faults, place: Callable[[int, str], str]
) -> dict[str, Any]:
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
        "proposal_density": columns.proposal_density,
        "quality": columns.quality,
        "width_m": columns.width_m,
        "pose_covariance": columns.pose_covariance,
        "measured_at": columns.measured_at,
        "metadata": [batch.metadata if value is None else value for value, batch in own],
        "sweep": [batch.sweep for batch in batches],
        "pose_index": columns.pose_index,
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
    return [dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)]


def lines(page: TrialPage) -> bytes:
    """Stored trials as one document a line."""
    return b"".join(orjson.dumps(item, option=orjson.OPT_APPEND_NEWLINE) for item in documents(page))
