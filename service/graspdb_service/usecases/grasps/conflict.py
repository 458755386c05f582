"""Why no grasp fulfils a request: the fewest constraints found to exclude each other, and what would do."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graspdb.wire import Grasp, GraspConstraints
from graspdb_density import se3
from graspdb_service.trial_columns import Floats

#: Finds a grasp under other constraints, or none.
Ask = Callable[[GraspConstraints], Grasp | None]

#: Constraints by the field that names them, with the fields that go with it. Those that say most about where
#: a grasp is come last: what is dropped first is told least often.
_FIELDS: dict[str, dict[str, Any]] = {
    "exclude": {"exclude": None},
    "obstacles": {"obstacles": None},
    "pregrasp_distance_m": {"pregrasp_distance_m": None},
    "collision_free": {"collision_free": False, "pregrasp_distance_m": None},
    "min_effective_trials": {"min_effective_trials": None},
    "min_success_probability": {"min_success_probability": None},
    "max_width_m": {"max_width_m": None},
    "half_spaces": {"half_spaces": None},
    "above_plane": {"above_plane": None},
    "sphere": {"sphere": None},
    "closing_cone_deg": {"closing": None, "closing_cone_deg": None},
    "approach_cone_deg": {"approach": None, "approach_cone_deg": None},
    "box_max": {"box_max": None},
    "box_min": {"box_min": None},
}
#: Halvings of the way from a constraint to one that is fulfilled.
_HALVINGS = 8
#: What rounding moves, in the unit of a limit.
_SLACK = 1e-6
#: Values that would do are told in steps of so much, metres where nothing else is said.
_STEPS = {
    "approach_cone_deg": 0.01,
    "closing_cone_deg": 0.01,
    "min_success_probability": 0.001,
    "min_effective_trials": 0.01,
}
_STEP_M = 1e-4

Value = bool | float | list[float]


@dataclass(frozen=True)
class Conflict:
    """Constraints that exclude each other, and a value of each that would do."""

    constraints: list[str] = field(default_factory=list)
    relax: dict[str, Value] = field(default_factory=dict)


def conflict_of(request: GraspConstraints, ask: Ask, *, collisions_known: bool) -> Conflict:
    """Drop constraints one after the other as long as no grasp fulfils the rest; then relax each of these."""
    given = [name for name in _FIELDS if _is_given(request, name, collisions_known)]
    if ask(_without(request, given)) is None or ask(request) is not None:
        # Not the constraints are why, or a thorough enough search finds a grasp after all.
        return Conflict()
    kept = list(given)
    for name in given:
        rest = [other for other in kept if other != name]
        if rest and ask(_without(request, set(given) - set(rest))) is None:
            kept = rest
    relaxed = {name: _relaxed(request, name, ask) for name in kept}
    return Conflict(kept, {name: value for name, value in relaxed.items() if value is not None})


def _is_given(request: GraspConstraints, name: str, collisions_known: bool) -> bool:
    if name == "collision_free":
        return collisions_known and request.collision_free is not False
    return bool(getattr(request, name, None))


def _without(request: GraspConstraints, names: Collection[str]) -> GraspConstraints:
    dropped = [_FIELDS[name] for name in names]
    known = type(request).model_fields
    update = {field: value for fields in dropped for field, value in fields.items() if field in known}
    return request.model_copy(update=update)


def _relaxed(request: GraspConstraints, name: str, ask: Ask) -> Value | None:
    """A value of one constraint that admits a grasp, all others as they are; None where none was found."""
    grasp = ask(_without(request, [name]))
    if grasp is None:
        return None
    if name == "collision_free":
        return False
    needed = _needed(request, name, grasp)
    if needed is None:
        return None
    given = np.array(getattr(request, name), dtype=np.float64)
    fails, does = 0.0, 1.0
    if ask(_with(request, name, needed)) is None:
        return None
    for _ in range(_HALVINGS):
        share = 0.5 * (fails + does)
        if ask(_with(request, name, given + share * (needed - given))) is None:
            fails = share
        else:
            does = share
    return _value(_outward(given, does * (needed - given), _STEPS.get(name, _STEP_M)))


def _outward(given: Floats, change: Floats, step: float) -> Floats:
    """A changed value in whole steps, never changed by less; what does not change stays."""
    wider = np.where(change > 0, np.ceil((given + change) / step), np.floor((given + change) / step)) * step
    return np.where(change == 0.0, given, np.round(wider, 9))


def _with(request: GraspConstraints, name: str, value: Floats) -> GraspConstraints:
    return request.model_copy(update={name: _value(value)})


def _value(value: Floats) -> Value:
    return float(value) if value.ndim == 0 else [float(number) for number in value]


def _needed(request: GraspConstraints, name: str, grasp: Grasp) -> Floats | None:
    """The value of a constraint that a grasp fulfils, and no wider one; None where a number says nothing."""
    pose = grasp.world if request.in_world and grasp.world is not None else grasp
    position = np.array(pose.position)
    _, closing, approach = se3.to_matrix(np.array(pose.quaternion_xyzw)).T
    given = getattr(request, name)
    match name:
        case "box_min":
            return np.asarray(np.minimum(given, position - _SLACK))
        case "box_max":
            return np.asarray(np.maximum(given, position + _SLACK))
        case "sphere":
            radius = float(np.linalg.norm(position - given[:3])) + _SLACK
            return np.array([*given[:3], max(given[3], radius)])
        case "above_plane":
            return np.array([*given[:3], min(given[3], float(position @ given[:3]) - _SLACK)])
        case "approach_cone_deg" if request.approach is not None:
            return _cone(approach, request.approach, given)
        case "closing_cone_deg" if request.closing is not None:
            # A symmetric jaw closes along either direction: the narrower cone is tried.
            return np.minimum(_cone(closing, request.closing, given), _cone(-closing, request.closing, given))
        case "max_width_m" if grasp.width_m is not None:
            return np.array(grasp.width_m + _SLACK)
        case "min_success_probability" if grasp.success_probability is not None:
            return np.array(max(grasp.success_probability - _SLACK, 0.0))
        case "min_effective_trials" if grasp.effective_trials is not None:
            return np.array(max(grasp.effective_trials - _SLACK, 0.0))
        case "pregrasp_distance_m":
            return np.array(1e-3)
    return None


def _cone(axis: Floats, about: tuple[float, float, float], given_deg: float) -> Floats:
    """Half angle of the cone that holds an axis, degrees."""
    cosine = float(axis @ np.array(about)) / float(np.linalg.norm(about))
    angle = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
    return np.array(min(max(given_deg, angle + 1e-4), 180.0))
