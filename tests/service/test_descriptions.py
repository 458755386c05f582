"""Everything in the OpenAPI document says what it is: units and frames included, and what null means."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

DOCUMENT: dict[str, Any] = json.loads((Path(__file__).parents[2] / "docs" / "openapi.json").read_text())

UNITS = {
    "_kg_m3": r"kg/m\^3",
    "_per_m2": r"per square metre",
    "_per_m": r"per metre",
    "_poses_s": r"poses a second",
    "_m_s2": r"metres a second squared",
    "_m_s": r"metres a second",
    "_m3": r"cubic metres",
    "_m5": r"m\^5",
    "_m": r"metres",
    "_rad": r"radians",
    "_deg": r"degrees",
    "_kg": r"kilograms",
    "_s": r"seconds",
    "_n": r"newtons",
}
"""What the description of a field says whose name ends so; the longest ending counts."""

IN_A_FRAME = {
    *("position", "quaternion_xyzw", "pose", "poses", "candidates", "exclude", "world", "object_pose"),
    *("base_to_tool", "box_min", "box_max", "sphere", "above_plane", "half_spaces", "approach", "closing"),
    *("lower", "upper", "bounding_box", "centre_of_mass", "pose_covariance", "covariance", "obstacles"),
    *("points", "normal", "across", "upward", "outline", "inertia_m5", "nearest", "grasps", "direction"),
}
"""Names of what has coordinates, where their schema holds numbers or poses."""

NOT_IN_A_FRAME = {
    # Probabilities, counts and columns of other things that have the same names.
    *(
        "PromiseBin.lower",
        "PromiseBin.upper",
        "CalibrationBin.lower",
        "CalibrationBin.upper",
        "ConvergencePoint.grasps",
        "Verdict.grasps",
    ),
    *("AnisotropyReport.grasps", "CheckedGrasps.grasps", "ProjectionReport.grasps", "SweepInfo.poses"),
    *("ConvergenceCurve.points", "EngineOutcomes.poses", "EnginePair.poses", "EngineReason.poses"),
}


def _described() -> Iterator[tuple[str, dict[str, Any]]]:
    """Every property and every parameter, by its full name."""
    for schema, content in DOCUMENT["components"]["schemas"].items():
        for name, field in content.get("properties", {}).items():
            yield f"{schema}.{name}", field
    for path, operations in DOCUMENT["paths"].items():
        for method, operation in operations.items():
            for parameter in operation.get("parameters", ()):
                yield f"{method} {path}.{parameter['name']}", parameter


def _can_be_null(field: dict[str, Any]) -> bool:
    return any(kind.get("type") == "null" for kind in field.get("anyOf", ()))


def _fault(full_name: str, field: dict[str, Any]) -> str | None:
    """What the description of a field lacks, in words for who wrote it; None where nothing."""
    name = full_name.rpartition(".")[2]
    text = " ".join(field.get("description", "").lower().split())
    words = re.findall(r"[a-z0-9]+", text)
    if len(words) < 3:
        return "has no description of three words or more: write a docstring under the field"
    if set(words) <= {*name.split("_"), "the", "a", "of", "its", "an"}:
        return "only repeats its name"
    unit = next((UNITS[end] for end in sorted(UNITS, key=len, reverse=True) if name.endswith(end)), None)
    if unit is not None and not re.search(unit, text):
        return f"does not say its unit ({unit})"
    if name in IN_A_FRAME and full_name not in NOT_IN_A_FRAME and not re.search("frame|world", text):
        return "does not say its frame"
    if _can_be_null(field) and not re.search(r"\bnull\b|by default", text):
        return "can be null and does not say what that means"
    return None


def test_everything_is_described() -> None:
    described = list(_described())
    assert len(described) > 700
    faults = {name: fault for name, field in described if (fault := _fault(name, field)) is not None}
    assert not faults, "\n".join(f"{name} {fault}" for name, fault in faults.items())


@pytest.mark.parametrize(
    ("name", "field", "fault"),
    [
        ("Finger.width_m", {}, "no description"),
        ("Finger.width_m", {"description": "The width of a finger."}, "unit"),
        ("Finger.width_m", {"description": "Width, m"}, "three words"),
        ("Finger.finger_width", {"description": "The finger's width of it"}, None),
        ("Finger.finger_width", {"description": "The width of the finger"}, "repeats"),
        ("Gripper.max_speed_m_s", {"description": "Speed of the fingers, metres."}, "unit"),
        ("Grasp.position", {"description": "Where the tool is, metres."}, "frame"),
        ("Grasp.score", {"description": "What it is ranked by.", "anyOf": [{"type": "null"}]}, "null"),
    ],
)
def test_what_counts_as_a_description(name: str, field: dict[str, Any], fault: str | None) -> None:
    found = _fault(name, field)
    assert found is None if fault is None else fault in str(found)
