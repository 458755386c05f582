"""Trials as one list a field, checked as arrays: what every form of a request is brought to.

A large batch is never validated row by row: each field's types, shapes and ranges are checked at once; only
where that fails does a loop look for the places to name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from graspdb.wire import OUTCOME_CODES, OUTCOMES, SOURCES
from graspdb.wire.base import MAX_QUALITIES, Metadata, QualityName, expand_matrix
from graspdb.wire.trials import BatchDefaults, TrialDefaults
from graspdb_service.formats.poses import near, no_vectors, unit, vectors
from graspdb_service.problems import ProblemError, invalid_fields
from graspdb_service.trial_columns import Floats, Ints, Provenance, TrialBatch, TrialColumns, json_text

DEFAULTS = frozenset(BatchDefaults.model_fields)
REQUIRED = ("position", "quaternion_xyzw", "outcome")
SEVERAL = ("attempts", "successes")
SCALARS = ("proposal_density", "quality", "width_m", *SEVERAL)
_OPTIONAL = (*SEVERAL, "quality", "width_m", "pose_covariance", "measured_at", "achieved_pose", "qualities")
NAMES = frozenset(REQUIRED) | frozenset(_OPTIONAL) | frozenset(TrialDefaults.model_fields)
#: What a column of one quality is called, with its name after it.
QUALITIES = "qualities."
_SLUG = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_GRIPPER = re.compile(_SLUG.pattern + r"(@[1-9][0-9]{0,8})?")
_GRIPPER_RULE = "a gripper's id, or one version of it, as in panda@1"
_ENGINE = re.compile(r"(?=.{1,64}$)[a-z0-9_-]+( [\w.+-]+)?")
_ENGINE_RULE = "a physics engine, perhaps with its version, as in 'pybullet 3.2.7'; at most 64 characters"
_SLUG_RULE = "letters, digits, '.', '_', '-'; at most 64 characters, the first a letter or digit"
_NAME_RULES = {
    "gripper": (_GRIPPER, _GRIPPER_RULE),
    "source": (re.compile("|".join(SOURCES)), f"one of {', '.join(SOURCES)}"),
    "protocol": (_SLUG, _SLUG_RULE),
    "engine": (_ENGINE, _ENGINE_RULE),
    "answer": (_SLUG, _SLUG_RULE),
}
_QUALITY_NAME: TypeAdapter[str] = TypeAdapter(QualityName)
_METADATA: TypeAdapter[Any] = TypeAdapter(Metadata)
_TIME: TypeAdapter[datetime] = TypeAdapter(datetime)
_MOST_ERRORS = 20
#: Attempts that one trial may stand for.
MOST_ATTEMPTS = 1_000_000
#: Trials that are looked at together.
BLOCK = 16_384

Place = Callable[[int, str], str]
"""What a field of a trial is called in the request."""
#: Answers, and combinations of gripper, source, protocol and engine, of one request, whatever the settings
#: allow.
MOST_NAMES = 10_000


@dataclass
class Faults:
    """What is wrong so far; ends the search for more at a number that helps."""

    found: list[tuple[str, str]] = field(default_factory=list)

    def add(self, place: str, message: str) -> None:
        self.found.append((place, message))
        if len(self.found) >= _MOST_ERRORS:
            self.raise_if_any()

    def raise_if_any(self) -> None:
        if self.found:
            raise invalid_fields(self.found, "The trials are not valid; none was stored")


@dataclass
class Fields:
    """Trials as one list a field, how a field of a trial is called in the request, and what is wrong with it.

    Numbers and outcome codes may be arrays already, finite, with NaN for null.
    """

    lists: Mapping[str, Sequence[Any] | NDArray[Any]]
    count: int
    place: Place
    faults: Faults

    def fault(self, name: str, row: int, message: str) -> None:
        self.faults.add(self.place(row, name), message)

    def refuse(self, name: str, good: Callable[[Any], bool], message: str) -> None:
        """Name the trials whose value of a field is not good."""
        for row, value in enumerate(self.lists[name]):
            if not good(value):
                self.fault(name, row, message)


def refuse_too_many(count: int, limit: int) -> None:
    """413 for more trials than one request may have."""
    if count > limit:
        raise ProblemError(
            413,
            "too-many-trials",
            f"{count:,} trials in one request are too many: send them in batches of at most {limit:,},"
            " each with an Idempotency-Key of its own",
            extra={"limit": limit},
        )


def defaults_of(beside: Mapping[str, Any], faults: Faults, form: str) -> BatchDefaults:
    """What stands once for the whole batch, beside its ``form``: ``columns`` or ``trials``."""
    for name in sorted(set(beside) - DEFAULTS):
        faults.add(name[:80], f"unknown field beside {form}")
    try:
        return BatchDefaults.model_validate({name: beside[name] for name in DEFAULTS & set(beside)})
    except ValidationError as error:
        for item in error.errors(include_input=False, include_context=False):
            faults.add(".".join(map(str, item["loc"])), item["msg"].removeprefix("Value error, "))
    return BatchDefaults()


def check_blocks(blocks: Iterable[Fields], defaults: BatchDefaults, place: Place, limit: int) -> TrialBatch:
    """Checked trials, block by block, so that no more of them than of one block are Python's at a time.

    422 naming the fields that are wrong in the first block that has any; 413 for more trials than ``limit``.
    """
    fields_of_gripper: list[Callable[[str], str]] = []
    numbers: dict[Provenance, int] = {}
    answers: dict[str, int] = {}
    names: dict[str, int] = {}
    columns = []
    count = 0
    for block in blocks:
        count += block.count
        refuse_too_many(count, limit)
        part = _check(block, defaults)
        own = [numbers.setdefault(item, len(numbers)) for item in part.provenances]
        # The last one stands for none, whose place is -1.
        tried = [*(answers.setdefault(name, len(answers)) for name in part.answers), -1]
        provenance = np.array(own, dtype=np.int64)[part.columns.provenance]
        answer = np.array(tried, dtype=np.int64)[part.columns.answer]
        _refuse_made_up_names(block, provenance, answer)
        for name in part.qualities:
            names.setdefault(name, len(names))
        _refuse_many_qualities(names, block)
        fields_of_gripper.append(part.field_of_gripper)
        columns.append(
            replace(
                part.columns,
                provenance=provenance,
                answer=answer,
                qualities=_widened(part.columns.qualities, part.qualities, names),
            )
        )

    def field_of_gripper(gripper: str) -> str:
        named = (field_of(gripper) for field_of in fields_of_gripper)
        return next((name for name in named if name != "gripper"), "gripper")

    width = len(names)
    columns = [replace(part, qualities=_padded(part.qualities, width)) for part in columns]
    joined = TrialColumns.joined(columns)
    return TrialBatch(joined, list(numbers), defaults, field_of_gripper, place, list(answers), list(names))


def _widened(scores: Floats, own: Sequence[str], names: Mapping[str, int]) -> Floats:
    """Scores of a block (n, k) under ``own`` names as columns of all the ``names`` so far."""
    if not own:
        return scores
    table = np.full((len(scores), len(names)), np.nan)
    table[:, [names[name] for name in own]] = scores
    return table


def _padded(scores: Floats, width: int) -> Floats:
    """Scores with columns for the names that later blocks brought."""
    if not len(scores) or scores.shape[1] == width:
        return scores
    more = np.full((len(scores), width - scores.shape[1]), np.nan)
    return np.concatenate([scores, more], axis=1)


def _refuse_many_qualities(names: Collection[str], block: Fields) -> None:
    if len(names) > MAX_QUALITIES:
        raise ProblemError(
            422,
            "too-many-qualities",
            f"Trials of one request have at most {MAX_QUALITIES} names of qualities together: what differs"
            " from trial to trial belongs in their metadata",
            errors=[(block.place(0, "qualities"), f"over the limit of {MAX_QUALITIES}")],
            extra={"limit": MAX_QUALITIES},
        )


def _refuse_made_up_names(block: Fields, provenance: Ints, answer: Ints) -> None:
    """422, before later blocks cost any time, for more names than an object may have."""
    for what, field_name, places, told in (
        ("provenances", "protocol", provenance, "combinations of gripper, source, protocol and engine"),
        ("answers", "answer", answer, "answers"),
    ):
        if places.max(initial=0) >= MOST_NAMES:
            row = int(np.argmax(places >= MOST_NAMES))
            raise ProblemError(
                422,
                f"too-many-{what}",
                f"Trials of one request are of at most {MOST_NAMES:,} {told}, those of an object of fewer"
                " (see /info): what differs from trial to trial belongs in their metadata",
                errors=[(block.place(row, field_name), f"over the limit of {MOST_NAMES:,}")],
                extra={"limit": MOST_NAMES},
            )


def blocks_of(
    lists: Mapping[str, Iterable[Sequence[Any] | NDArray[Any]]], place: Place, faults: Faults
) -> Iterator[Fields]:
    """Columns in consecutive blocks, as the fields of these; all have the same blocks."""
    first = 0
    for row in zip(*lists.values(), strict=True):
        count = len(row[0])

        def here(i: int, name: str, first: int = first) -> str:
            return place(first + i, name)

        yield Fields(dict(zip(lists, row, strict=True)), count, here, faults)
        first += count


def sliced(values: Sequence[Any] | NDArray[Any]) -> Iterator[Sequence[Any] | NDArray[Any]]:
    """A column in blocks."""
    return (values[start : start + BLOCK] for start in range(0, len(values), BLOCK))


def _check(fields: Fields, defaults: BatchDefaults) -> TrialBatch:
    """Checked trials, or 422 naming the fields that are wrong, those found before included."""
    position, quaternion = _vectors(fields, "position", 3), _vectors(fields, "quaternion_xyzw", 4)
    refuse = fields.fault
    outcome = _outcomes(fields)
    attempts, successes = _several(fields, outcome)
    columns = TrialColumns(
        position=near(position, refuse),
        quaternion_xyzw=unit(quaternion, refuse),
        outcome=outcome,
        attempts=attempts,
        successes=successes,
        proposal_density=_scalars(fields, "proposal_density", 1e-30, 1e15),
        quality=_scalars(fields, "quality", -1e9, 1e9),
        width_m=_scalars(fields, "width_m", 0.0, 10.0),
        measured_at=_each(fields, "measured_at", _time),
        pose_covariance=_each(fields, "pose_covariance", _covariance),
        metadata=_each(fields, "metadata", _metadata),
        achieved=_achieved(fields),
    )
    scores, qualities = _qualities(fields)
    answers, answer = _answers(fields, defaults)
    provenances, provenance = _provenances(fields, defaults)
    fields.faults.raise_if_any()
    proposal = columns.proposal_density
    if defaults.proposal_density is not None:
        proposal = proposal if len(proposal) else np.full(fields.count, np.nan)
        proposal = np.where(np.isnan(proposal), defaults.proposal_density, proposal)
    return TrialBatch(
        replace(
            columns, provenance=provenance, proposal_density=proposal, answer=answer, qualities=qualities
        ),
        provenances,
        defaults,
        _fields_of_grippers(fields),
        fields.place,
        answers,
        scores,
    )


def _vectors(fields: Fields, name: str, width: int) -> Floats:
    """(n, width) finite numbers; none of them with the faults."""
    values = fields.lists[name]
    if isinstance(values, np.ndarray):
        return values
    try:
        return vectors(values, width)
    except ValueError:
        for row, told in no_vectors(values, width):
            fields.fault(name, row, told)
    return np.empty((0, width))


def _float(number: float) -> float:
    try:
        return float(number)
    except OverflowError:
        return np.inf


def _scalars(fields: Fields, name: str, lower: float, upper: float) -> Floats:
    """(n,) numbers between the bounds with NaN for null; empty where the field is absent."""
    values = fields.lists.get(name)
    if values is None:
        return np.empty(0)
    if isinstance(values, np.ndarray):
        table, given = values, ~np.isnan(values)
    elif set(map(type, values)) <= {int, float, type(None)}:
        given = np.array([value is not None for value in values])
        table = np.array([np.nan if value is None else _float(value) for value in values])
    else:
        fields.refuse(name, lambda value: type(value) in (int, float, type(None)), "a number or null")
        return np.empty(0)
    inside = (table >= lower) & (table <= upper)
    for row in np.flatnonzero(given & ~inside):
        fields.fault(name, int(row), f"a finite number from {lower:g} to {upper:g}")
    return table


def _outcomes(fields: Fields) -> NDArray[np.uint8]:
    """(n,) codes; none of them with the faults."""
    values = fields.lists["outcome"]
    if isinstance(values, np.ndarray):
        return values
    if set(map(type, values)) <= {str, bool}:
        codes = [int(v) if v is True or v is False else OUTCOME_CODES.get(v, -1) for v in values]
        if min(codes) >= 0:
            return np.array(codes, dtype=np.uint8)
    names = {*OUTCOMES, True, False}
    told = f"one of {', '.join(OUTCOMES)}, true or false"
    fields.refuse("outcome", lambda value: isinstance(value, str | bool) and value in names, told)
    return np.empty(0, dtype=np.uint8)


def _several(fields: Fields, outcome: NDArray[np.uint8]) -> tuple[Floats, Floats]:
    """How often each trial was tried, and succeeded, (n,) whole numbers, NaN for once; empty without any."""
    given = [
        _scalars(fields, name, float(least), MOST_ATTEMPTS)
        for name, least in zip(SEVERAL, (1, 0), strict=True)
    ]
    tried, won = (column if len(column) else np.full(fields.count, np.nan) for column in given)
    if np.isnan(tried).all() and np.isnan(won).all():
        return np.empty(0), np.empty(0)
    for name, column in zip(SEVERAL, (tried, won), strict=True):
        for row in np.flatnonzero(~np.isnan(column) & (column != np.round(column))):
            fields.fault(name, int(row), "a whole number")
    for row in np.flatnonzero(np.isnan(tried) != np.isnan(won)):
        missing = SEVERAL[int(np.isnan(won[row]))]
        fields.fault(missing, int(row), "attempts and successes come together: k successes of n attempts")
    for row in np.flatnonzero(won > tried):
        fields.fault("successes", int(row), f"{won[row]:g} successes of {tried[row]:g} attempts")
    if len(outcome):
        half = 2.0 * won >= tried
        known = (tried >= 1.0) & (won <= tried)
        for row in np.flatnonzero(known & (half != (outcome == OUTCOME_CODES["success"]))):
            told = "success" if half[row] else "a failure"
            fields.fault(
                "outcome",
                int(row),
                f"{won[row]:g} successes of {tried[row]:g} attempts are {told}: it is one from half on",
            )
    return tried, won


def _provenances(fields: Fields, defaults: TrialDefaults) -> tuple[list[Provenance], Ints]:
    """The combinations of names that the trials have, and which of them each has (n,)."""
    shared = {name: getattr(defaults, name) for name in Provenance._fields}
    columns = {name: _names(fields, name, default) for name, default in shared.items()}
    own = {name: names for name, names in columns.items() if names is not None}
    if not own:
        return [Provenance(**shared)], np.zeros(fields.count, dtype=np.int64)
    rows = list(zip(*own.values(), strict=True))
    number = {names: i for i, names in enumerate(dict.fromkeys(rows))}
    found = [Provenance(**{**shared, **dict(zip(own, names, strict=True))}) for names in number]
    return found, np.array([number[row] for row in rows], dtype=np.int64)


def _names(fields: Fields, name: str, default: str | None) -> list[str | None] | None:
    """A name or None a trial; None where all have the default."""
    values = fields.lists.get(name)
    if values is None:
        return None
    allowed, rule = _NAME_RULES[name]

    def good(value: Any) -> bool:
        return value is None or (isinstance(value, str) and allowed.fullmatch(value) is not None)

    if not set(map(type, values)) <= {str, type(None)} or not all(map(good, set(values))):
        fields.refuse(name, good, rule)
        return None
    return [default if value is None else value for value in values]


def _answers(fields: Fields, defaults: TrialDefaults) -> tuple[list[str], Ints]:
    """The answers that trials name, and which of them each has (n,), -1 for none; empty where none has."""
    names = _names(fields, "answer", defaults.answer) or (
        [] if defaults.answer is None else [defaults.answer] * fields.count
    )
    number = {name: i for i, name in enumerate(dict.fromkeys(name for name in names if name is not None))}
    if not number:
        return [], np.empty(0, dtype=np.int64)
    return list(number), np.array([-1 if name is None else number[name] for name in names], dtype=np.int64)


def _achieved(fields: Fields) -> Floats:
    """(n, 7) position and quaternion of the poses that were achieved, NaN for null; empty without any."""
    rows, poses = [], []
    for row, value in enumerate(fields.lists.get("achieved_pose", ())):
        if value is None:
            continue
        try:
            pose = expand_matrix(value)
        except ValueError as error:
            fields.fault("achieved_pose", row, str(error))
            continue
        if not isinstance(pose, dict) or pose.keys() != {"position", "quaternion_xyzw"}:
            fields.fault(
                "achieved_pose", row, "a pose: {position, quaternion_xyzw} or {matrix}; null if unknown"
            )
            continue
        rows.append(row)
        poses.append(pose)
    if not rows:
        return np.empty(0)

    def refuse(name: str, row: int, message: str) -> None:
        fields.faults.add(f"{fields.place(rows[row], 'achieved_pose')}.{name}", message)

    parts = []
    for name, width in (("position", 3), ("quaternion_xyzw", 4)):
        values = [list(x) if isinstance(x := pose[name], tuple) else x for pose in poses]
        try:
            parts.append(vectors(values, width))
        except ValueError:
            for row, told in no_vectors(values, width):
                refuse(name, row, told)
            return np.empty(0)
    table = np.full((fields.count, 7), np.nan)
    table[rows] = np.concatenate([near(parts[0], refuse), unit(parts[1], refuse)], axis=1)
    return table


def _qualities(fields: Fields) -> tuple[list[str], Floats]:
    """Names of scores in the order in which they come, and the scores (n, k), NaN for none."""
    lists = {name: x for name, x in fields.lists.items() if name.startswith(QUALITIES)}
    rows = fields.lists.get("qualities", ())
    if not set(map(type, rows)) <= {type(None)}:
        lists |= _quality_lists(fields, rows)
    names = [name.removeprefix(QUALITIES) for name in lists]
    for name in names:
        try:
            _QUALITY_NAME.validate_python(name)
        except ValidationError:
            told = "letters, digits, '.', '_', '/', '-'; at most 64 characters, the first a letter or digit"
            fields.fault("qualities", 0, f"{name[:80]!r} is no name of a quality: {told}")
    scored = replace(fields, lists=lists)
    columns = [_scalars(scored, name, -1e9, 1e9) for name in lists]
    fields.faults.raise_if_any()
    given = [place for place, column in enumerate(columns) if not np.isnan(column).all()]
    if not given:
        return [], np.empty(0)
    return [names[place] for place in given], np.stack([columns[place] for place in given], axis=1)


def _quality_lists(fields: Fields, rows: Iterable[Any]) -> dict[str, list[Any]]:
    """Scores that come as one object a trial, as one list a name."""
    lists: dict[str, list[Any]] = {}
    for row, scores in enumerate(rows):
        if scores is None:
            continue
        if not isinstance(scores, dict):
            fields.fault("qualities", row, "an object of numbers by name")
            continue
        for name, value in scores.items():
            if f"{QUALITIES}{name}" not in lists:
                _refuse_many_qualities([*lists, name], fields)
                lists[f"{QUALITIES}{name}"] = [None] * fields.count
            lists[f"{QUALITIES}{name}"][row] = value
    return lists


def _fields_of_grippers(fields: Fields) -> Callable[[str], str]:
    """The field that each gripper is named in first; nothing else of the request is kept for it."""
    first: dict[Any, str] = {}
    for i, value in enumerate(fields.lists.get("gripper", ())):
        if value not in first:
            first[value] = fields.place(i, "gripper")
    return lambda gripper: first.get(gripper, "gripper")


def _each(fields: Fields, name: str, check: Callable[[Any], Any]) -> list[Any]:
    """Values of a field that has no array form, each checked; empty where it is absent throughout."""
    values = fields.lists.get(name, ())
    if set(map(type, values)) <= {type(None)}:
        return []
    checked: list[Any] = []
    for i, value in enumerate(values):
        try:
            checked.append(None if value is None else check(value))
        except ValidationError as error:
            first = error.errors(include_input=False, include_context=False)[0]
            fields.fault(name, i, first["msg"].removeprefix("Value error, "))
        except (ValueError, OverflowError) as error:
            fields.fault(name, i, str(error))
    return checked


def _time(value: Any) -> datetime:
    if not isinstance(value, str | datetime):
        raise ValueError("a time as text, such as 2026-01-31T12:00:00Z")
    time = _TIME.validate_python(value)
    if not 1900 <= time.year <= 2500:
        raise ValueError("a time between the years 1900 and 2500")
    return time.replace(tzinfo=timezone.utc) if time.tzinfo is None else time.astimezone(timezone.utc)


def _metadata(value: Any) -> str:
    return json_text(_METADATA.validate_python(value))


def _covariance(value: Any) -> str:
    if not isinstance(value, list) or len(value) != 6:
        raise ValueError("a 6x6 list of numbers, translation first")
    matrix = vectors(value, 6)
    if np.abs(matrix).max() > 1e6:
        raise ValueError("every number must be finite, at most 1e6 (m^2, m rad, rad^2)")
    scale = max(float(np.abs(matrix).max()), 1e-300)
    if np.abs(matrix - matrix.T).max() > 1e-6 * scale:
        raise ValueError("a covariance is symmetric")
    if np.linalg.eigvalsh((matrix + matrix.T) / (2 * scale)).min() < -1e-6:
        raise ValueError("a covariance has no negative eigenvalue")
    return json_text(matrix.tolist())
