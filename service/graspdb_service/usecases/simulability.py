"""What can't be simulated, said before a worker starts, with the way out in numbers."""

from __future__ import annotations

from collections.abc import Iterator

from graspdb.wire import GridPlan, GripperProfile
from graspdb_geometry.meshes import UNITS
from graspdb_service.problems import ProblemError, invalid
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases import plans
from graspdb_service.usecases.scenes import shape_of

#: An object's longest side in openings of the gripper, beyond which its unit is wrong or its gripper.
MAX_SIZE_IN_OPENINGS, MIN_SIZE_IN_OPENINGS = 40.0, 0.01
#: Between these an object looks made for the gripper.
_USUAL_SIZE_IN_OPENINGS = (0.2, 12.0)
MIN_OPENING_M = 1e-3
#: A gripper slower than this would still be closing when the simulation gives up.
MAX_CLOSING_S = 60.0
MIN_FORCE_N = 1e-2


def check_gripper(profile: GripperProfile) -> None:
    """Refuse a gripper that no physics can be done with.

    Raises
    ------
    ProblemError
        422 naming what is wrong.
    """
    closing_s = 0.5 * profile.max_opening_m / profile.max_speed_m_s
    reason = None
    try:
        shape_of(profile)
    except ValueError as error:
        reason = str(error)
    if reason is None and profile.max_opening_m < MIN_OPENING_M:
        reason = f"max_opening_m is {profile.max_opening_m:g}, below {MIN_OPENING_M:g}: metres are meant"
    if reason is None and closing_s > MAX_CLOSING_S:
        reason = (
            f"max_speed_m_s is {profile.max_speed_m_s:g}, so that closing takes {closing_s:.0f} s, more than"
            f" {MAX_CLOSING_S:.0f}: metres per second are meant"
        )
    if reason is None and profile.force_n < MIN_FORCE_N:
        reason = f"force_n is {profile.force_n:g}, below {MIN_FORCE_N:g}: newtons are meant"
    if reason is not None:
        raise invalid("gripper", reason, "This gripper can't be simulated")


def check_size(row: ObjectRow, longest_m: float, profile: GripperProfile) -> None:
    """Refuse an object far larger or smaller than the gripper, and say in which unit it would fit.

    Raises
    ------
    ProblemError
        422 ``mesh-size``.
    """
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
    sent = str((row.mesh_info or {}).get("unit", "m"))
    low, high = (share * profile.max_opening_m for share in _USUAL_SIZE_IN_OPENINGS)
    sizes = {unit: longest_m / UNITS[sent] * metres for unit, metres in UNITS.items() if unit != sent}
    fitting = [f"{size:.3g} m with unit={unit}" for unit, size in sizes.items() if low <= size <= high]
    if not fitting:
        return f"It was sent with unit={sent}, and no other fits: scale it, or take another gripper"
    return (
        f"It was sent with unit={sent}; it would be {' or '.join(fitting)}:"
        f" PUT /objects/{row.slug}/mesh?unit=... again, or take another gripper"
    )


def too_many_poses(row: ObjectRow, plan: GridPlan, profile: GripperProfile, limit: int) -> ProblemError:
    """The grid is beyond the limit: every way to shrink it that is enough by itself, with its number."""
    count = plans.pose_grid(plan).total
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
                total = plans.pose_grid(plan.model_copy(update={field: value})).total
            except ValueError:
                break
            if total <= limit:
                yield f"{field}={value:g} ({total:,} poses)"
                break
