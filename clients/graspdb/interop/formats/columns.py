"""Which columns of a table are a grasp's pose, outcome and qualities: those named, or by their names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from graspdb.files.trials import OUTCOME_COLUMNS

#: Further columns of a trial, by their names on the wire.
MORE = (
    *("attempts", "successes", "width_m", "gripper", "source", "protocol", "engine"),
    *("proposal_density", "measured_at", "answer", "metadata"),
)
#: How often a grasp was tried and succeeded.
_SEVERAL = {"attempts", "successes"}
_PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw")
KEYS = (
    *("position", "quaternion", "quaternion_xyzw", "quaternion_wxyz", "rotation", "matrix"),
    *("object_position", "object_quaternion_xyzw", "object_quaternion_wxyz"),
    *(*_PARTS, "outcome", "quality", *MORE),
)
"""What ``columns`` may name, beside ``quality.NAME``."""
STATED = ("frame", "convention")
"""Columns of our own tables: of which frame of the gripper the poses are, and in which convention."""

_POSITIONS: tuple[str, ...] = (
    "",
    "p",
    "t",
    "p_",
    "t_",
    "p.",
    "t.",
    "pos_",
    "pos.",
    "position_",
    "position.",
    "translation_",
)
_POSITIONS += ("translation.", "tx_", "pose.position.", "pose_position_", "grasp_", "pos")
_QUATERNIONS: tuple[str, ...] = (
    "q",
    "q_",
    "q.",
    "quat_",
    "quat.",
    "quaternion_",
    "quaternion.",
    "orientation_",
    "orientation.",
)
_QUATERNIONS += ("pose.orientation.", "pose_orientation_", "rotation_", "rot_", "quat")


@dataclass(frozen=True)
class Plan:
    """The columns to read: one with all its numbers, or one for each.

    ``order`` is that of a quaternion's numbers, ``rotation`` holds 9 numbers, ``matrix`` 16 or 12.
    ``object_position`` and ``object_quaternion`` (in ``object_order``) are the object's pose at each grasp.
    ``stated`` are columns that say of which frame the poses are, and in which convention.
    """

    position: tuple[str, ...] = ()
    quaternion: tuple[str, ...] = ()
    order: str = "xyzw"
    order_told: bool = False
    rotation: tuple[str, ...] = ()
    matrix: tuple[str, ...] = ()
    outcome: str | None = None
    qualities: Mapping[str, str] = field(default_factory=dict)
    more: Mapping[str, str] = field(default_factory=dict)
    object_position: tuple[str, ...] = ()
    object_quaternion: tuple[str, ...] = ()
    object_order: str = "xyzw"
    stated: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """All columns to read, each once."""
        outcome = () if self.outcome is None else (self.outcome,)
        pose = (*self.position, *self.quaternion, *self.rotation, *self.matrix)
        pose += (*self.object_position, *self.object_quaternion, *self.stated)
        return list(dict.fromkeys([*pose, *outcome, *self.qualities.values(), *self.more.values()]))


def parsed(text: str | Mapping[str, str]) -> dict[str, str]:
    """``position=px:py:pz,quaternion_wxyz=q`` as a mapping; ValueError for what can't be named."""
    if isinstance(text, Mapping):
        found = dict(text)
    else:
        pairs = [pair.partition("=") for pair in text.split(",") if pair.strip()]
        if any(not sign for _, sign, _ in pairs):
            raise ValueError(f"columns are NAME=COLUMN, separated by commas; this is {text!r}")
        found = {key.strip(): value.strip() for key, _, value in pairs}
    for key, value in found.items():
        if key not in KEYS and not key.startswith("quality."):
            raise ValueError(f"columns can't name {key!r}; there are {', '.join(KEYS)}, quality.NAME")
        if not value:
            raise ValueError(f"columns: {key} names no column")
    return found


def plan(
    there: Sequence[str],
    given: Mapping[str, str],
    order: str | None,
    qualities: Sequence[str] = (),
    stated: Sequence[str] = (),
) -> Plan:
    """Which of these columns are what; ValueError names what is missing and how to name it.

    ``given`` is what somebody named (:func:`parsed`), ``qualities`` are needed for a rule, ``stated`` some
    of :data:`STATED`.
    """
    known = set(there)
    pose = _pose(there, known, given, order)
    outcome = given.get("outcome") or next((name for name in OUTCOME_COLUMNS if name in known), None)
    if outcome is not None and outcome not in known:
        raise ValueError(_lacks(outcome, there))
    scores = {key[8:]: name for key, name in given.items() if key.startswith("quality.")}
    if "quality" in given or "quality" in known:
        scores["quality"] = given.get("quality", "quality")
    scores |= {name[10:]: name for name in there if name.startswith("qualities.")}
    scores |= {name[8:]: name for name in there if name.startswith("quality.")}
    scores |= {name: name for name in qualities if name not in scores}
    more = {name: given.get(name, name) for name in MORE if name in given or name in known}
    if len(_SEVERAL & more.keys()) == 1:
        # One of the two is of something else.
        more = {name: column for name, column in more.items() if name not in _SEVERAL}
    for name in (*scores.values(), *more.values()):
        if name not in known:
            raise ValueError(_lacks(name, there))
    pose |= _object(there, known, given)
    return Plan(
        **pose,  # type: ignore[arg-type]
        outcome=outcome,
        qualities=scores,
        more=more,
        stated=tuple(stated),
    )


def _object(there: Sequence[str], known: set[str], given: Mapping[str, str]) -> dict[str, object]:
    """The columns of the object's pose at each grasp, where they are named."""
    orders = [order for order in ("xyzw", "wxyz") if f"object_quaternion_{order}" in given]
    if not orders and "object_position" not in given:
        return {}
    if len(orders) != 1 or "object_position" not in given:
        raise ValueError(
            "the object's pose at each grasp is object_position and one of object_quaternion_xyzw and"
            " object_quaternion_wxyz: name both"
        )
    turn = _expanded(given[f"object_quaternion_{orders[0]}"], known, there, (4,), orders[0])
    place = _expanded(given["object_position"], known, there, (3,))
    return {"object_position": place, "object_quaternion": turn, "object_order": orders[0]}


def _pose(
    there: Sequence[str], known: set[str], given: Mapping[str, str], order: str | None
) -> dict[str, object]:
    if "matrix" in given:
        return {"matrix": _expanded(given["matrix"], known, there, (16, 12))}
    position = _position(there, known, given)
    if "rotation" in given:
        return {"position": position, "rotation": _expanded(given["rotation"], known, there, (9,))}
    for key in ("quaternion", "quaternion_xyzw", "quaternion_wxyz"):
        if key in given:
            own = key.partition("_")[2]
            names = _expanded(given[key], known, there, (4,), own or "xyzw")
            return _turn(position, names, own, order)
    if any(part in given for part in _PARTS[3:]):
        names = tuple(given.get(part, part) for part in _PARTS[3:])
        return _named(position, names, known, there, order)
    for prefix in _QUATERNIONS:
        names = tuple(f"{prefix}{letter}" for letter in "xyzw")
        if known.issuperset(names):
            return _named(position, names, known, there, order)
    for name in ("quaternion_xyzw", "quaternion_wxyz", "quaternion", "quat", "orientation", "q"):
        if found := _found(name, known, (4,), "xyzw"):
            return _turn(position, found, name.partition("_")[2], order)
    for name in ("rotation", "rotation_matrix", "R", "r"):
        if position and (found := _found(name, known, (9,))):
            return {"position": position, "rotation": found}
    for name in ("matrix", "transform", "pose", "T", "grasp_pose", "m"):
        if found := _found(name, known, (16, 12)):
            return {"matrix": found}
    shown = ", ".join(there[:20])
    raise ValueError(
        f"which columns are the pose? There are {shown}: name them, as in"
        " --columns position=px:py:pz,quaternion_wxyz=qw:qx:qy:qz, or --columns matrix=T"
    )


def _turn(
    position: tuple[str, ...], names: tuple[str, ...], own: str, order: str | None
) -> dict[str, object]:
    """A quaternion in these columns, ``own`` the order that somebody named for it."""
    told = own or _told_order(names)
    if not own and _lettered(names):
        names, told = tuple(sorted(names, key=lambda name: "xyzw".index(name[-1].lower()))), "xyzw"
    return {
        "position": position,
        "quaternion": names,
        "order": order or told or "xyzw",
        "order_told": bool(told),
    }


def _named(
    position: tuple[str, ...],
    names: tuple[str, ...],
    known: set[str],
    there: Sequence[str],
    order: str | None,
) -> dict[str, object]:
    for name in (*position, *names):
        if name not in known:
            raise ValueError(_lacks(name, there))
    return {"position": position, "quaternion": names, "order": order or "xyzw", "order_told": True}


def _position(there: Sequence[str], known: set[str], given: Mapping[str, str]) -> tuple[str, ...]:
    if "position" in given:
        return _expanded(given["position"], known, there, (3,))
    if any(part in given for part in _PARTS[:3]):
        names = tuple(given.get(part, part) for part in _PARTS[:3])
        for name in names:
            if name not in known:
                raise ValueError(_lacks(name, there))
        return names
    for prefix in _POSITIONS:
        names = tuple(f"{prefix}{letter}" for letter in "xyz")
        if known.issuperset(names):
            return names
    for name in ("position", "translation", "pos", "t", "xyz"):
        if found := _found(name, known, (3,)):
            return found
    return ()


def _expanded(
    value: str, known: set[str], there: Sequence[str], counts: tuple[int, ...], letters: str = "xyz"
) -> tuple[str, ...]:
    """The columns that somebody means: one, several with colons between, or those that begin so."""
    if found := _found(value, known, counts, letters):
        return found
    names = tuple(part.strip() for part in value.split(":"))
    for name in names:
        if name not in known:
            raise ValueError(_lacks(name, there))
    if len(names) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ValueError(f"columns {value!r} are {len(names)}; expected one with all numbers, or {wanted}")
    return names


def _found(name: str, known: set[str], counts: tuple[int, ...], letters: str = "xyz") -> tuple[str, ...]:
    """The column of this name, or those that begin with it, in order; none for neither."""
    if name in known:
        return (name,)
    for count in counts:
        for names in _spellings(name, count, letters):
            if known.issuperset(names):
                return names
    return ()


def _spellings(name: str, count: int, letters: str) -> Iterator[tuple[str, ...]]:
    for between in ("_", ".", ""):
        if count == len(letters):
            yield tuple(f"{name}{between}{letter}" for letter in letters)
        if count <= 4:
            yield tuple(f"{name}{between}{index}" for index in range(count))
            continue
        rows = {16: (4, 4), 12: (3, 4), 9: (3, 3)}[count]
        for form in ("{0}{1}{2}{3}", "{0}{1}{2}_{3}", "{0}{1}{2}.{3}"):
            yield tuple(form.format(name, between, i, j) for i in range(rows[0]) for j in range(rows[1]))
        yield tuple(f"{name}{between}{index}" for index in range(count))
    yield tuple(f"{name}[{index}]" for index in range(count))


def _told_order(names: Sequence[str]) -> str | None:
    """The order that a column's own name tells."""
    found = re.search(r"(wxyz|xyzw)$", names[0].lower()) if len(names) == 1 else None
    return found[1] if found else None


def _lettered(names: Sequence[str]) -> bool:
    """Whether the names tell which number is which."""
    return len(names) == 4 and sorted(name[-1].lower() for name in names) == ["w", "x", "y", "z"]


def _lacks(name: str, there: Sequence[str]) -> str:
    return f"has no column {name!r}; there are {', '.join(there[:20])}"
