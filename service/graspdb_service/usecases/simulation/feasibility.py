"""What can't be simulated, said before a worker starts, with the way out in numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from graspdb.wire import GridPlan, GripperProfile
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.meshes import UNITS
from graspdb_service.problems import ProblemError, invalid
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.geometry.mesh_form import form_of
from graspdb_service.usecases.trials import sweep_plan

#: An object's longest side in openings of the gripper, beyond which its unit is wrong or its gripper.
MAX_SIZE_IN_OPENINGS, MIN_SIZE_IN_OPENINGS = 40.0, 0.01
#: Between these an object looks made for the gripper.
_USUAL_SIZE_IN_OPENINGS = (0.2, 12.0)
MIN_OPENING_M = 1e-3
#: A gripper that takes longer to close, at full speed or from rest, would still close when the simulation
#: gives up.
MAX_CLOSING_S = 20.0
#: A finger faster than this would jump by 2 mm at a step of the simulation.
MAX_SPEED_M_S = 0.5
MIN_FORCE_N, MIN_FINGER_KG = 1e-2, 1e-3
#: What weighs less than a gram between fingers that press with newtons is thrown about by rounding.
MIN_MASS_KG = 1e-3


def check_gripper(profile: GripperProfile) -> None:
    """Refuse a gripper that no physics can be done with (422)."""
    reason = next(_troubles(profile), None)
    if reason is not None:
        raise invalid("gripper", reason, "This gripper can't be simulated")


def warnings(gripper: str, profile: Mapping[str, Any]) -> list[str]:
    """What of a gripper, by its profile as JSON, the physics leaves out."""
    known = profile.get("tip_offsets")
    if not known:
        return []
    ahead = max(abs(tip["tip_offset_m"] - profile["tip_offset_m"]) for tip in known)
    return [
        f"the fingertips of {gripper} move on arcs, by up to {1e3 * ahead:.0f} mm towards the object as they"
        " close; the simulation closes them straight, as far ahead as wide open: what happens at the tips may"
        " differ"
    ]


def _troubles(profile: GripperProfile) -> Iterator[str]:
    try:
        shape_of(profile)
    except ValueError as error:
        yield str(error)
    opening, speed = profile.max_opening_m, profile.max_speed_m_s
    if opening < MIN_OPENING_M:
        yield f"max_opening_m is {opening:g}, below {MIN_OPENING_M:g}: metres are meant"
    if speed > MAX_SPEED_M_S:
        yield (
            f"max_speed_m_s is {speed:g}, above {MAX_SPEED_M_S:g}, at which a finger jumps in the simulation:"
            " give the speed with which it closes on an object, in metres per second"
        )
    least = 0.5 * opening / MAX_CLOSING_S
    if speed < least:
        yield (
            f"max_speed_m_s is {speed:g}, below {least:.2g}, so that closing takes more than"
            f" {MAX_CLOSING_S:.0f} s: metres per second are meant"
        )
    least = opening / MAX_CLOSING_S**2
    if profile.max_acceleration_m_s2 is not None and profile.max_acceleration_m_s2 < least:
        yield (
            f"max_acceleration_m_s2 is {profile.max_acceleration_m_s2:g}, below {least:.2g}, so that closing"
            f" from rest takes more than {MAX_CLOSING_S:.0f} s: metres per second squared are meant; leave it"
            " out if it is not known"
        )
    if profile.force_n < MIN_FORCE_N:
        yield f"force_n is {profile.force_n:g}, below {MIN_FORCE_N:g}: newtons are meant"
    if profile.finger_mass_kg < MIN_FINGER_KG:
        yield f"finger_mass_kg is {profile.finger_mass_kg:g}, below {MIN_FINGER_KG:g}: kilograms are meant"


def check_mass(row: ObjectRow, mass_kg: float | None, sides_m: Sequence[float]) -> None:
    """Refuse an object too light to be simulated (422).

    The mass is None where it follows from the density once the volume is known; the mesh's bounding box, of
    these sides, bounds that volume.
    """
    by_density = row.mass_kg is None and row.density_kg_m3 is not None
    most = mass_kg
    if most is None:
        most = (row.density_kg_m3 or 0.0) * math.prod(sides_m)
    if most >= MIN_MASS_KG:
        return
    field = "density_kg_m3" if by_density else "mass_kg"
    of = f"{row.density_kg_m3:g}, which makes its mass {most:.3g} kg" if by_density else f"{most:g}"
    unit = "kilograms per cubic metre" if by_density else "kilograms"
    raise invalid(
        field,
        f"is {of}, below {MIN_MASS_KG:g} kg: {unit} are meant; PATCH /objects/{row.slug}",
        f"Object {row.slug!r} is too light to be simulated",
    )


def check_size(row: ObjectRow, longest_m: float, profile: GripperProfile) -> None:
    """Refuse an object far larger or smaller than the gripper (422), and say in which unit it would fit."""
    opening = profile.max_opening_m
    if MIN_SIZE_IN_OPENINGS * opening <= longest_m <= MAX_SIZE_IN_OPENINGS * opening:
        return
    size = "large" if longest_m > opening else "small"
    raise ProblemError(
        422,
        "mesh-size",
        f"The mesh of {row.slug!r} is {longest_m:g} m long, far too {size} for a gripper that opens"
        f" {opening:g} m. {_unit_hint(row, longest_m, profile)}",
        errors=[("mesh", f"{longest_m:g} m long")],
    )


def _unit_hint(row: ObjectRow, longest_m: float, profile: GripperProfile) -> str:
    """Which unit would make an object of usual size of it."""
    form = None if row.mesh_info is None else form_of(row)
    sent, scale = ("m", 1.0) if form is None else (form.unit, form.scale)
    low, high = (share * profile.max_opening_m for share in _USUAL_SIZE_IN_OPENINGS)
    sizes = {unit: longest_m / UNITS[sent] * metres for unit, metres in UNITS.items() if unit != sent}
    fitting = [f"{size:.3g} m with unit={unit}" for unit, size in sizes.items() if low <= size <= high]
    scaled = "" if scale == 1.0 else f" and scale={scale:g}"
    if not fitting:
        return f"It was sent with unit={sent}{scaled}, and no other fits: scale it, or take another gripper"
    return (
        f"It was sent with unit={sent}{scaled}; it would be {' or '.join(fitting)}:"
        f" PUT /objects/{row.slug}/mesh?unit=... again, or take another gripper"
    )


def too_many_poses(row: ObjectRow, plan: GridPlan, profile: GripperProfile, limit: int) -> ProblemError:
    """The grid is beyond the limit: every way to shrink it that is enough by itself, with its number."""
    count = sweep_plan.pose_grid(plan).total
    ways = [f"max_poses={limit} or fewer (a random part of this grid)", *_ways(plan, limit)]
    title = (
        f"The grid has {count:,} poses, and a sweep at most {limit:,} (max_sweep_poses in /info)."
        f" Each of these is enough: {'; '.join(ways)}; or a region"
    )
    longest = max(high - low for low, high in zip(plan.lower, plan.upper, strict=True))
    if longest > _USUAL_SIZE_IN_OPENINGS[1] * profile.max_opening_m:
        title += f". Or is the mesh's unit wrong? It is {longest:.3g} m long. "
        title += _unit_hint(row, longest, profile)
    return ProblemError(
        422,
        "too-many-poses",
        title,
        errors=[("grid", f"{count} poses")],
        extra={"limit": limit, "poses": count},
    )


def _ways(plan: GridPlan, limit: int) -> Iterator[str]:
    """Changes of one field after which the grid holds at most ``limit`` poses."""
    step_mm = round(1000 * plan.position_step_m)
    for field, values in (
        ("position_step_m", (mm / 1000 for mm in range(max(1, step_mm), 1001))),
        ("rotation_step_deg", (deg for deg in (10, 12, 15, 20, 30, 60) if deg > plan.rotation_step_deg)),
        ("margin_m", (mm / 1000 for mm in range(int(1000 * plan.margin_m), -1, -1))),
    ):
        for value in values:
            try:
                total = sweep_plan.pose_grid(plan.model_copy(update={field: value})).total
            except ValueError:
                break
            if total <= limit:
                yield f"{field}={value:g} ({total:,} poses)"
                break
