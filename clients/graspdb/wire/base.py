"""Poses, outcomes, pages and problems: the words every other model is made of."""

from __future__ import annotations

import difflib
import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    WithJsonSchema,
    model_validator,
)

Outcome = Literal[
    "failure",
    "success",
    "collision",
    "missed",
    "slipped",
    "dropped",
    "wrench_insufficient",
    "timeout",
    "simulation_error",
]
"""What became of a grasp. Every outcome but ``success`` is a failure; ``simulation_error`` is no attempt."""

OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
OUTCOME_CODES: dict[str, int] = {name: code for code, name in enumerate(OUTCOMES)}
"""The uint8 code of each outcome in packed results. Codes are stored: append, never renumber."""

Source = Literal["simulation", "robot", "human", "import"]
SOURCES: tuple[Source, ...] = get_args(Source)

MAX_COORDINATE_M = 1_000.0
"""Farther from the object's origin than this no grasp can be meant; most likely the unit is wrong."""

UNIT_TOLERANCE = 1e-3
"""A quaternion or rotation matrix this near to exact is normalised; farther off it is refused."""


MAX_NESTING = 32
"""How deep a user's metadata may nest: every JSON library on its way can still read and write that."""

MAX_METADATA_LENGTH = 65_536
"""Most characters of a user's metadata as JSON."""

MAX_COMPONENT = 1e6
"""Numbers of a direction, a plane or a world pose beyond this are most likely a mistake."""


_DEFERRED = ConfigDict(defer_build=True)
"""A program builds the models that it uses, when it first does. The docstring under a field is what it is,
unit, frame, null: the service, which alone writes the OpenAPI document, takes it as the description there."""


class Request(BaseModel):
    """Base of what clients send: unknown fields and non-finite numbers are errors."""

    model_config = _DEFERRED | ConfigDict(
        extra="forbid", allow_inf_nan=False, frozen=True, validate_default=False
    )

    not_yet: ClassVar[Mapping[str, str]] = {}
    """What is said of fields that people look for and that no schema has, by patterns of their names."""


MOST_TOLD = 20
"""Errors of a request that are told."""


def told_of(errors: Iterable[Mapping[str, Any]], model: Any) -> list[dict[str, Any]]:
    """Errors of pydantic, where an unknown field is told what was meant: ``model`` is a model, or an
    annotation that names some, or None, which leaves fields as they are. Our own rules come without a prefix.
    At most :data:`MOST_TOLD` of them; what fields there are is said once.
    """
    models, told = set(_models(model)), list[dict[str, Any]]()
    listed = set[str]()
    for error in islice(errors, MOST_TOLD):
        message = str(error["msg"]).removeprefix("Value error, ")
        if models and error["type"] == "extra_forbidden":
            message = _no_such_field(models, error["loc"])
            short, _, fields = message.partition("; there are ")
            message = short if fields in listed else message
            listed.add(fields or "-")
        told.append({**error, "msg": message})
    return told


def _no_such_field(models: set[type[BaseModel]], place: Sequence[str | int]) -> str:
    name = str(place[-1])
    for part in map(str, place[:-1]):
        # What is no field is the number of an item, or a branch that pydantic tried.
        fields = (each.model_fields[part] for each in models if part in each.model_fields)
        models = {inner for field in fields for inner in _models(field.annotation)} or models
    for pattern, told in ((p, t) for each in models for p, t in getattr(each, "not_yet", {}).items()):
        if re.search(pattern, name, re.IGNORECASE):
            return f"{told}"
    return no_such_field(name, {field for each in models for field in each.model_fields})


def no_such_field(name: str, there: Iterable[str], *, listed: bool = True) -> str:
    """What is said of a field that is not among those there are, which are ``listed``: of many once."""
    near = difflib.get_close_matches(name, there := sorted(there), n=1)
    if near:
        return f"there is no such field; did you mean {near[0]!r}?"
    return "there is no such field" + (f"; there are {', '.join(there)}" if listed else "")


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)


class Response(BaseModel):
    """Base of what the service answers: clients ignore the fields that a newer service adds."""

    model_config = _DEFERRED | ConfigDict(extra="ignore", allow_inf_nan=False)


def _split_commas(value: Any) -> Any:
    """Accept ``"0,0,1"`` (as a query string gives it, alone or in a list of one) for a vector."""
    if isinstance(value, (list, tuple)) and len(value) == 1 and isinstance(value[0], str):
        value = value[0]
    if isinstance(value, str):
        return [part.strip() for part in value.split(",")]
    return value


def _within_reach(value: tuple[float, ...]) -> tuple[float, ...]:
    if not all(abs(x) <= MAX_COORDINATE_M for x in value):
        raise ValueError(
            f"coordinates are metres and at most {MAX_COORDINATE_M:g} from the origin: is the unit right?"
        )
    return value


def _unit(value: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.hypot(*value)
    if not abs(norm - 1.0) <= UNIT_TOLERANCE:
        raise ValueError(
            f"a quaternion (x, y, z, w) must have norm 1 within {UNIT_TOLERANCE:g}; this one has {norm:.6g}"
        )
    return tuple(x / norm for x in value)


def _direction(value: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.hypot(*value)
    if norm < 1e-9:
        raise ValueError("a direction must not be the zero vector")
    if not norm <= 2 * MAX_COMPONENT:
        raise ValueError(f"the numbers of a direction are at most {MAX_COMPONENT:g}: only their ratio counts")
    return tuple(x / norm for x in value)


def _limits(lower: float, upper: float, **more: Any) -> WithJsonSchema:
    """Limits that the schema tells; a validator of all the numbers together says why in better words."""
    return WithJsonSchema({"type": "number", "minimum": lower, "maximum": upper, **more})


_Coordinate = Annotated[float, _limits(-MAX_COORDINATE_M, MAX_COORDINATE_M)]
_OfUnit = Annotated[float, _limits(-1.0 - UNIT_TOLERANCE, 1.0 + UNIT_TOLERANCE)]
_Component = Annotated[float, _limits(-MAX_COMPONENT, MAX_COMPONENT)]
_Radius = Annotated[
    float, WithJsonSchema({"type": "number", "exclusiveMinimum": 0, "maximum": MAX_COMPONENT})
]

Triple = tuple[float, float, float]
Quadruple = tuple[float, float, float, float]

Position = Annotated[
    tuple[_Coordinate, _Coordinate, _Coordinate],
    BeforeValidator(_split_commas),
    AfterValidator(_within_reach),
]
"""Three coordinates in metres."""
Quaternion = Annotated[
    tuple[_OfUnit, _OfUnit, _OfUnit, _OfUnit], BeforeValidator(_split_commas), AfterValidator(_unit)
]
"""A unit quaternion (x, y, z, w); ``q`` and ``-q`` are the same rotation."""
Direction = Annotated[
    tuple[_Component, _Component, _Component], BeforeValidator(_split_commas), AfterValidator(_direction)
]
"""A direction; normalised on arrival."""
Plane = Annotated[tuple[_Component, _Component, _Component, _Component], BeforeValidator(_split_commas)]
"""A normal and a distance."""
Ball = Annotated[tuple[_Component, _Component, _Component, _Radius], BeforeValidator(_split_commas)]
"""A centre and a radius, metres."""
Vector7 = Annotated[
    tuple[_Component, _Component, _Component, _OfUnit, _OfUnit, _OfUnit, _OfUnit],
    BeforeValidator(_split_commas),
]
Slug = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
"""An identifier that stands in a URL: letters, digits, ``.``, ``_``, ``-``; at most 64 characters."""
GripperRef = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}(@[1-9][0-9]{0,8})?$")]
"""A gripper's id, or one version of it, as in ``panda@1``."""
Text = Annotated[str, Field(max_length=4_000), AfterValidator(lambda s: no_nul(s))]
Metadata = Annotated[dict[str, Any], Field(max_length=1_000), AfterValidator(lambda value: _storable(value))]
"""Any JSON object of the user's: finite numbers, whole ones within 64 bits; at most 1,000 names, 32 levels
and 65,536 characters."""
MAX_QUALITIES = 32
"""Most names of qualities among the trials of one batch."""
Quality = Annotated[float, Field(ge=-1e9, le=1e9)]
QualityName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._/-]{0,63}$")]
"""Names a quality: letters, digits, ``.``, ``_``, ``/``, ``-``; at most 64 characters."""
Licence = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(lambda s: no_nul(s))]
"""A licence's name, best as SPDX has it: ``CC-BY-NC-4.0``."""
StoredMetadata = dict[str, Any]
"""A user's JSON object as it was stored, whatever the limits are now."""

MAX_SOURCE_WEIGHT = 1e6


def _source_weights(value: Any) -> str:
    """Weights by source, in a string or an object, as the one string that means them."""
    if isinstance(value, str):
        parts = [part.split(":") for part in value.split(",")]
        if not all(len(part) == 2 for part in parts):
            raise ValueError("source weights are names and numbers, as in robot:1,simulation:0.2")
        pairs = [(name.strip(), number.strip()) for name, number in parts]
    elif isinstance(value, Mapping):
        pairs = list(value.items())
    else:
        raise ValueError('source weights are names and numbers, as in {"robot": 1, "simulation": 0.2}')
    found: dict[str, float] = {}
    for name, number in pairs:
        if name not in SOURCES:
            raise ValueError(f"{str(name)[:40]!r} is no source: there are {', '.join(SOURCES)}")
        if name in found:
            raise ValueError(f"{name} has two weights")
        try:
            weight = math.nan if isinstance(number, bool) else float(number)
        except (TypeError, ValueError, OverflowError):
            weight = math.nan
        if not 0.0 <= weight <= MAX_SOURCE_WEIGHT:
            raise ValueError(f"the weight of {name} is a number from 0 to {MAX_SOURCE_WEIGHT:g}")
        found[name] = weight
    if not found or (len(found) == len(SOURCES) and not any(found.values())):
        raise ValueError("at least one source needs a weight above 0")
    return ",".join(f"{name}:{found[name]!r}" for name in SOURCES if name in found)


def source_weights(text: str | None) -> dict[str, float]:
    """The weights that a :data:`SourceWeights` names, by source."""
    pairs = (part.split(":") for part in text.split(",")) if text else ()
    return {name: float(number) for name, number in pairs}


SourceWeights = Annotated[
    str,
    BeforeValidator(_source_weights),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string", "maxLength": 400},
                {
                    "type": "object",
                    "maxProperties": len(SOURCES),
                    "additionalProperties": {"type": "number", "minimum": 0, "maximum": MAX_SOURCE_WEIGHT},
                },
            ],
            "examples": ["robot:1,simulation:0.2"],
        }
    ),
]
"""How much trials of each source count: ``robot:1,simulation:0.2``, or an object of the same."""

MANY = Field(json_schema_extra={"maxItems": 1_000_000})
"""A list whose length the service limits by a setting, which ``GET /info`` tells; this is the default."""

# -- fields that many models have, described once

ObjectId = Annotated[str, Field(description="Id of the object that this is about.")]
Revision = Annotated[int, Field(description="Revision of the object that the answer rests on.")]
StoredRevision = Annotated[int, Field(description="Revision of the object that stored it.")]
ChosenGripper = Annotated[
    str | None, Field(description="Gripper whose trials count; null where the trials name none.")
]
OneGripperVersion = Annotated[
    int | None, Field(description="Version of the gripper, counted from 1; null where no gripper is named.")
]
GripperVersions = Annotated[
    list[int],
    Field(description="Versions of the gripper that the selected trials were made with; none without one."),
]
ChosenProtocol = Annotated[
    str | None, Field(description="Protocol whose trials count; null where the trials name none.")
]
ChosenSource = Annotated[
    str | None, Field(description="Source whose trials count; null where those of all sources do.")
]
OutcomeCounts = Annotated[
    dict[str, int], Field(description="How many trials had each outcome, by the outcome's name.")
]
Warnings = Annotated[list[str], Field(description="What a person should know before relying on this.")]
IntervalLevel = Annotated[float, Field(description="How probably an interval holds the truth: 0.9 is 90 %.")]
ToolPosition = Annotated[
    Triple, Field(description="Origin of the tool frame in the object frame: x, y, z, metres.")
]
ToolRotation = Annotated[
    Quadruple,
    Field(description="Rotation of the tool frame in the object frame: unit quaternion x, y, z, w."),
]
ToolPositions = Annotated[
    list[Triple],
    Field(description="Origins of the tool frame in the object frame, one x, y, z a pose, metres."),
]
ToolRotations = Annotated[
    list[Quadruple],
    Field(
        description="Rotations of the tool frame in the object frame, one unit quaternion x, y, z, w a pose."
    ),
]

AskedPosition = Annotated[
    Triple,
    Field(
        description="Origin of the tool frame, or of the gripper's ``frame`` asked for, in the object frame:"
        " x, y, z, metres."
    ),
]
AskedRotation = Annotated[
    Quadruple,
    Field(
        description="Rotation of the tool frame, or of the ``frame`` and ``convention`` that were asked for,"
        " in the object frame: unit quaternion x, y, z, w."
    ),
]
AskedPositions = Annotated[
    list[Triple],
    Field(
        description="Origins of the tool frame, or of the gripper's ``frame`` that was asked for, in the"
        " object frame, one x, y, z a pose, metres."
    ),
]
AskedRotations = Annotated[
    list[Quadruple],
    Field(
        description="Rotations of the tool frame, or of the ``frame`` and ``convention`` that were asked for,"
        " in the object frame, one unit quaternion x, y, z, w a pose."
    ),
]


def no_nul(text: str) -> str:
    """The text, or ValueError for what no database stores."""
    if "\x00" in text:
        raise ValueError("text must not contain the NUL character")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError("text must be valid Unicode: a lone surrogate is none") from None
    return text


def _is_deeper(value: Any, depth: int) -> bool:
    """Whether lists and objects nest more than ``depth`` deep; level by level, so it can't overflow."""
    level = [value]
    for _ in range(depth):
        level = [
            inner
            for item in level
            if isinstance(item, (dict, list, tuple))
            for inner in (item.values() if isinstance(item, dict) else item)
        ]
    return any(isinstance(item, (dict, list, tuple)) for item in level)


_NUL = re.compile(r"(?<!\\)(?:\\\\)*\\u0000")
_LONG_NUMBER = re.compile(r"\d{19}")


def _fits(value: Any) -> bool:
    """Whether all whole numbers in it fit in 64 bits: no JSON library reads longer ones as they are."""
    if isinstance(value, (dict, list, tuple)):
        return all(_fits(item) for item in (value.values() if isinstance(value, dict) else value))
    return not isinstance(value, int) or -(2**63) <= value < 2**64


def _storable(value: dict[str, Any]) -> dict[str, Any]:
    if _is_deeper(value, MAX_NESTING):
        raise ValueError(f"metadata nests at most {MAX_NESTING} lists and objects")
    try:
        text = json.dumps(value, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError, RecursionError):
        raise ValueError("metadata must be JSON with finite numbers") from None
    if len(text) > MAX_METADATA_LENGTH:
        raise ValueError(f"metadata is at most {MAX_METADATA_LENGTH:,} characters of JSON")
    if _LONG_NUMBER.search(text) and not _fits(value):
        raise ValueError("a whole number of metadata fits in 64 bits: send a longer one as text")
    if _NUL.search(text):
        raise ValueError("text must not contain the NUL character")
    no_nul(text)
    return value


def rotation_to_quaternion(matrix: list[list[float]]) -> Quadruple:
    """The unit quaternion (x, y, z, w) of a 3x3 rotation matrix (Shepperd's method, 1978).

    ValueError if the matrix is not a rotation within :data:`UNIT_TOLERANCE`.
    """
    for i in range(3):
        for j in range(i, 3):
            dot = sum(matrix[k][i] * matrix[k][j] for k in range(3))
            if not abs(dot - (1.0 if i == j else 0.0)) <= 2 * UNIT_TOLERANCE:
                raise ValueError(
                    "the upper left 3x3 block must be a rotation: its columns are not orthonormal"
                )
    (a, b, c), (d, e, f), (g, h, i_) = (row[:3] for row in matrix[:3])
    if a * (e * i_ - f * h) - b * (d * i_ - f * g) + c * (d * h - e * g) < 0:
        raise ValueError("the upper left 3x3 block must be a rotation: this one is a reflection")
    candidates = (
        (1 + a - e - i_, (1 + a - e - i_, b + d, c + g, h - f)),
        (1 - a + e - i_, (b + d, 1 - a + e - i_, f + h, c - g)),
        (1 - a - e + i_, (c + g, f + h, 1 - a - e + i_, d - b)),
        (1 + a + e + i_, (h - f, c - g, d - b, 1 + a + e + i_)),
    )
    _, best = max(candidates)
    norm = math.sqrt(sum(x * x for x in best))
    x, y, z, w = (value / norm for value in best)
    return x, y, z, w


def pose_from_matrix(matrix: Any) -> tuple[Triple, Quadruple]:
    """Position and quaternion of a 4x4 homogeneous matrix, row-major, metres.

    ValueError if the shape, the last row or the rotation block is not that of a rigid motion.
    """
    if not (isinstance(matrix, (list, tuple)) and len(matrix) == 4):
        raise ValueError("a pose's matrix has shape (4, 4)")
    rows: list[list[float]] = []
    for row in matrix:
        if not (isinstance(row, (list, tuple)) and len(row) == 4):
            raise ValueError("a pose's matrix has shape (4, 4)")
        numbers = [x for x in row if isinstance(x, (int, float)) and not isinstance(x, bool)]
        if len(numbers) < 4 or not all(abs(x) <= sys.float_info.max for x in numbers):
            raise ValueError("a pose's matrix holds 16 finite numbers")
        rows.append([float(x) for x in numbers])
    if any(abs(x - y) > 1e-6 for x, y in zip(rows[3], (0.0, 0.0, 0.0, 1.0), strict=True)):
        raise ValueError("the last row of a pose's matrix is 0, 0, 0, 1")
    position = rows[0][3], rows[1][3], rows[2][3]
    _within_reach(position)
    return position, rotation_to_quaternion(rows)


def expand_matrix(data: Any) -> Any:
    """Replace ``matrix`` in a pose's fields by ``position`` and ``quaternion_xyzw``; a `before` validator."""
    if isinstance(data, dict) and data.get("matrix") is not None:
        if "position" in data or "quaternion_xyzw" in data:
            raise ValueError("give either matrix, or position and quaternion_xyzw, not both")
        position, quaternion = pose_from_matrix(data["matrix"])
        rest = {key: value for key, value in data.items() if key != "matrix"}
        return {**rest, "position": position, "quaternion_xyzw": quaternion}
    return data


class Pose(Request):
    """The tool frame in the object frame: ``{position, quaternion_xyzw}`` or a row-major 4x4 ``{matrix}``."""

    position: Position
    """Origin of the tool frame: x, y, z, metres; in the object frame where nothing else is said."""
    quaternion_xyzw: Quaternion
    """Rotation of the tool frame: a unit quaternion x, y, z, w; in the same frame as the position."""

    @model_validator(mode="before")
    @classmethod
    def _from_matrix(cls, data: Any) -> Any:
        return expand_matrix(data)


class FieldError(Response):
    """A field of a request, and what is wrong with it."""

    field: str
    """Path to the field, its names and indices joined by dots, as in ``trials.1.position``."""
    message: str
    """What is wrong with it, in words."""


class Problem(Response):
    """An RFC 9457 problem.

    What else a type of problem has (``calls``, ``kernels``) is in ``model_extra``.
    """

    model_config = ConfigDict(extra="allow")

    type: str
    """Stable name of the kind of problem, for programs."""
    title: str
    """What is wrong and what to do about it, for people."""
    status: int
    """HTTP status of the answer."""
    detail: str | None = None
    """More about this case; null where the title says it all."""
    request_id: str | None = None
    """Finds the request in the service's log; null where the answer is not the service's."""
    errors: list[FieldError] = Field(default_factory=list)
    """The fields of the request that are wrong."""


T = TypeVar("T")


class Page(Response, Generic[T]):
    """One page of a list."""

    items: list[T]
    """What the list holds, in its order."""
    next: str | None = None
    """Cursor of the following page; null at the end."""
