"""Values of a gripper's joints in files: kept with each grasp, and told as the jaw's opening where they say
it.

A trial has them in its metadata: ``joints`` of the grasp itself, ``joints_before`` of the jaw that comes to
it; by name, or in the file's order where it names none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from graspdb.interop.grasps import Report, problem
from graspdb.wire import GripperProfile

AT, BEFORE = "joints", "joints_before"
KINDS = (AT, BEFORE)

#: How many fingers may move by the value of one joint; relative error of a travel in metres.
_FINGERS, _SAME = (1, 2), 0.01
#: As a share of its travel, how far a joint's value may lie beyond it.
_BEYOND = 0.02
#: As a share of its travel, how far it may be open and counts as closed.
_CLOSED = 1e-6


def values_of(file: str, where: str, names: Any, values: Any) -> dict[str, float] | list[float] | None:
    """A posture as a file has it, checked: numbers by name, or without ``names`` in the file's order; None
    for none; FileProblem names what is wrong.
    """
    numbers = list(values) if isinstance(values, (list, tuple)) else None
    if numbers is None or not all(isinstance(x, (int, float)) and abs(x) <= 1e9 for x in numbers):
        raise problem(file, f"{where} must be finite numbers")
    found = [float(x) for x in numbers]
    if names is None:
        return found or None
    if len(names) != len(found):
        raise problem(file, f"{where} has {len(found)} values for {len(names)} joints")
    return dict(zip(map(str, names), found, strict=True)) or None


def by_name(file: str, where: str, values: Any) -> dict[str, float] | None:
    """A posture that a file has as a mapping of names, checked as in :func:`values_of`; None for none."""
    if values is None:
        return None
    if not isinstance(values, dict):
        raise problem(file, f"{where} must map joints to numbers")
    found = values_of(file, where, list(values), list(values.values()))
    assert not isinstance(found, list)
    return found


def kept(
    more: Mapping[str, Sequence[Any]], gripper: GripperProfile | None, report: Report
) -> dict[str, list[Any]]:
    """A run's further columns with its joints' values where a trial has them: in ``metadata``, and as
    ``width_m`` where the gripper's joints tell the opening.
    """
    columns = {name: list(values) for name, values in more.items() if name not in KINDS}
    given = {name: list(more[name]) for name in KINDS if name in more}
    postures = {name: values for name, values in given.items() if any(x is not None for x in values)}
    if not postures:
        return columns
    report.map(f"joints' values to {' and '.join(postures)} of the metadata")
    count = len(next(iter(postures.values())))
    others = columns.get("metadata", [None] * count)
    together = ({**(other if isinstance(other, dict) else {}), **{
        name: values[row] for name, values in postures.items() if values[row] is not None
    }} for row, other in enumerate(others))  # fmt: skip
    columns["metadata"] = [entry or None for entry in together]
    if "width_m" in columns or AT not in postures:
        return columns
    widths = [None if values is None else opening_m(gripper, values) for values in postures[AT]]
    told = sum(width is not None for width in widths)
    if told:
        report.map("joints' values to width_m, by the named gripper's joints open and closed")
        columns["width_m"] = widths
    if told < sum(values is not None for values in postures[AT]):
        why = "has no joints" if gripper is None or not gripper.joints else "does not say it of such values"
        report.drop(
            f"how far the jaw is open in some grasps: the named gripper's profile {why}"
            + ("" if gripper is None or not gripper.joints else " (closed is a command, not a width)")
        )
    return columns


def opening_m(gripper: GripperProfile | None, values: Mapping[str, float] | Sequence[float]) -> float | None:
    """How far the jaw is open, metres, by values of its joints; None where these don't say it.

    They do where the fingers slide by as much as the joints' values change, in metres; not where they swing,
    nor where they are closed: that is what a jaw is commanded, whatever it then holds.
    """
    if gripper is None or not _slide(gripper):
        return None
    named = values if isinstance(values, Mapping) else dict(zip(gripper.joints, values, strict=False))
    if not isinstance(values, Mapping) and len(values) != len(gripper.joints):
        return None
    shares = [
        (named[name] - ends.closed) / (ends.open - ends.closed)
        for name, ends in gripper.joints.items()
        if name in named
    ]
    if not shares or min(shares) < -_BEYOND or max(shares) > 1 + _BEYOND:
        return None
    share = float(np.clip(np.mean(shares), 0.0, 1.0))
    return share * gripper.max_opening_m if share > _CLOSED else None


def values_at(gripper: GripperProfile | None, opening: float) -> dict[str, float] | None:
    """The joints' values that open the jaw so far, metres; None where that is not known."""
    if gripper is None or not _slide(gripper) or not 0.0 <= opening <= gripper.max_opening_m:
        return None
    share = opening / gripper.max_opening_m
    return {name: ends.closed + share * (ends.open - ends.closed) for name, ends in gripper.joints.items()}


def _slide(gripper: GripperProfile) -> bool:
    """Whether the joints' values are metres that the fingers slide: together they make the opening."""
    travels = [abs(ends.open - ends.closed) for ends in gripper.joints.values()]
    if not travels or min(travels) <= 0:
        return False
    made = [fingers * sum(travels) for fingers in (_FINGERS if len(travels) == 1 else (1,))]
    return any(abs(travel - gripper.max_opening_m) <= _SAME * gripper.max_opening_m for travel in made)
