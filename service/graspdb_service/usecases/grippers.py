"""Grippers: the built-in ones, and the user's own."""

from __future__ import annotations

from graspdb.wire import GripperCreate, GripperInfo, GripperProfile, GripperUpdate
from graspdb_geometry.grippers import PANDA, PG70, GripperShape
from graspdb_service import principal
from graspdb_service.problems import conflict, found, invalid
from graspdb_service.storage import grippers
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.grippers import GripperRow
from graspdb_service.trial_columns import gripper_parts
from graspdb_service.usecases.geometry.collision import shape_of
from graspdb_service.usecases.identifiers import is_gripper_name
from graspdb_service.usecases.runtime.idempotency import Created, Sent, replay_or


def seed(database: Database) -> None:
    """Store the built-in grippers where they are missing; several replicas may do so at once."""
    with database.read() as tx:
        if grippers.builtin_ids(tx) >= BUILTIN.keys():
            return
    with database.write(audited=False) as tx:
        for gripper, (name, profile) in sorted(BUILTIN.items()):
            grippers.create(tx, gripper, name, profile.model_dump(mode="json"), builtin=True)


def create(database: Database, request: GripperCreate, sent: Sent) -> Created:
    """Store the user's gripper."""
    principal.refuse_limited("Grippers")
    profile = GripperProfile.model_validate(request.model_dump(exclude={"id", "name"}))
    _check_shape(profile)

    def make(tx: Tx) -> Created:
        if not grippers.create(tx, request.id, request.name, profile.model_dump(mode="json")):
            raise conflict("already-exists", f"There is a gripper {request.id!r} already: choose another id")
        audit.record(tx, "gripper.create", subject=request.id)
        return Created(
            _info(require(tx, request.id)).model_dump(mode="json"), location=f"/grippers/{request.id}"
        )

    return replay_or(database, "POST /grippers", sent, make)


def update(database: Database, gripper: str, request: GripperUpdate) -> GripperInfo:
    """Store a profile as the gripper's newest version; the profile that it has already makes none."""
    _refuse_version(gripper, "PUT")
    principal.refuse_limited("Grippers")
    if request.id not in (None, gripper):
        raise invalid("id", f"this is of gripper {gripper!r}: leave it out, or give the same one")
    profile = GripperProfile.model_validate(request.model_dump(exclude={"id", "name"}))
    _check_shape(profile)
    with database.write() as tx:
        require(tx, gripper)
        grippers.lock(tx, gripper)
        # Once more, for what was committed while the lock was another's.
        row = require(tx, gripper)
        changed = profile.differences(GripperProfile.model_validate(row.profile))
        if changed:
            grippers.add_version(tx, gripper, row.version + 1, profile.model_dump(mode="json"), changed)
        if request.name is not None:
            grippers.rename(tx, gripper, request.name)
        if changed or request.name is not None:
            audit.record(tx, "gripper.change", subject=gripper)
        return _info(require(tx, gripper))


def versions(
    database: Database, gripper: str, *, after: int, limit: int
) -> tuple[list[GripperInfo], int | None]:
    """A page of a gripper's versions, the first one first, and where the next page starts."""
    with database.read() as tx:
        require(tx, gripper)
        rows = grippers.versions(tx, gripper, after=after, limit=limit + 1)
    return [_info(row) for row in rows[:limit]], rows[limit - 1].version if len(rows) > limit else None


def get(database: Database, gripper: str) -> GripperInfo:
    """One gripper, or one version of it, as in ``panda@1``."""
    with database.read() as tx:
        return _info(require(tx, gripper))


def page(database: Database, *, after: str, limit: int) -> tuple[list[GripperInfo], str | None]:
    """A page of grippers by id, and where the next one starts."""
    with database.read() as tx:
        rows = grippers.page(tx, after=after, limit=limit + 1)
    return [_info(row) for row in rows[:limit]], rows[limit - 1].id if len(rows) > limit else None


def remove(database: Database, gripper: str) -> None:
    """Delete a gripper; 409 while trials, sweeps or kernels use it, and for a built-in one."""
    _refuse_version(gripper, "DELETE")
    principal.refuse_limited("Grippers")
    with database.write() as tx:
        grippers.lock(tx, gripper, deleting=True)
        if require(tx, gripper).builtin:
            raise conflict("gripper-built-in", f"Gripper {gripper!r} is built in: it can't be deleted")
        if grippers.is_used(tx, gripper):
            raise conflict(
                "gripper-in-use",
                f"Trials, sweeps or kernels use gripper {gripper!r}: delete those first, or make another"
                " gripper (POST /grippers)",
            )
        grippers.remove(tx, gripper)
        audit.record(tx, "gripper.delete", subject=gripper)


def require(tx: Tx, gripper: str) -> GripperRow:
    """The gripper, or the version of it, or a 404."""
    row = grippers.find(tx, gripper) if is_gripper_name(gripper) else None
    return found(row, "gripper", gripper, "GET /grippers lists them, POST /grippers makes one")


def named(tx: Tx, gripper: str) -> GripperRow:
    """The gripper that a request's field names, or a 422."""
    row = grippers.find(tx, gripper)
    if row is None:
        told = f"there is no gripper {gripper!r}: GET /grippers lists them, POST /grippers makes one"
        raise invalid("gripper", told)
    return row


def hold(tx: Tx, gripper: str) -> None:
    """Keep the gripper that a request's field names from being deleted before the transaction ends; 422 where
    it has been.
    """
    if not grippers.held(tx, [gripper]):
        named(tx, gripper)


def _refuse_version(gripper: str, method: str) -> None:
    """422 for one version where a gripper is meant: what trials were made with stays as it was."""
    name, version = gripper_parts(gripper) if is_gripper_name(gripper) else (gripper, None)
    if version is not None:
        told = "a version stays as it was: "
        told += (
            f"PUT /grippers/{name} makes a new one" if method == "PUT" else "a gripper is deleted with all"
        )
        raise invalid("gripper", told)


def _check_shape(profile: GripperProfile) -> None:
    try:
        shape_of(profile)
    except ValueError as error:
        # What can't be tested for collisions must not be stored: every later query would fail on it.
        field = str(error).partition(" ")[0].replace("finger_", "finger.", 1)
        raise invalid(field, str(error)) from None


def _info(row: GripperRow) -> GripperInfo:
    return GripperInfo.model_validate({**vars(row), "changed": row.changed or []})


def _profile(shape: GripperShape, base_offset_m: float, **facts: float) -> GripperProfile:
    return GripperProfile.model_validate(
        {
            "max_opening_m": shape.max_opening_m,
            "finger": {
                "width_m": shape.finger_width_m,
                "thickness_m": shape.finger_thickness_m,
                "length_m": shape.finger_length_m,
            },
            "tip_offset_m": shape.tip_offset_m,
            "palm_size_m": shape.palm_size_m,
            "base_to_tool": {"position": [0, 0, base_offset_m], "quaternion_xyzw": [0, 0, 0, 1]},
            "symmetric": True,
            **facts,
        }
    )


BUILTIN: dict[str, tuple[str, GripperProfile]] = {
    # RobWork's public device files: 60 mm/s and 40 N, 0.1 kg a finger, plastic on plastic; the hardware
    # driver's acceleration limit is 39 mm/s^2.
    "pg70": (
        "Schunk PG70",
        _profile(
            PG70,
            0.140,
            finger_mass_kg=0.1,
            max_speed_m_s=0.06,
            max_acceleration_m_s2=0.039,
            force_n=40.0,
            friction=0.4,
        ),
    ),
    # Franka's hand: 50 mm/s and 70 N continuous by its data sheet; the tool 103.4 mm from the hand's frame.
    "panda": (
        "Franka Panda hand",
        _profile(PANDA, 0.1034, finger_mass_kg=0.015, max_speed_m_s=0.05, force_n=70.0, friction=0.4),
    ),
}
