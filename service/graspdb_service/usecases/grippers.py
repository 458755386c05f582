"""Grippers: the built-in ones, and the user's own."""

from __future__ import annotations

from graspdb.wire import GripperCreate, GripperInfo, GripperProfile, GripperUpdate
from graspdb.wire.presets.grippers import PRESETS
from graspdb_geometry.grippers import shape_of
from graspdb_service import principal
from graspdb_service.problems import conflict, found, invalid
from graspdb_service.storage import grippers
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.grippers import GripperRow
from graspdb_service.trial_columns import gripper_parts
from graspdb_service.usecases.identifiers import is_gripper_name
from graspdb_service.usecases.runtime.idempotency import Created, Sent, replay_or

#: What a profile says beside what grasps depend on.
_SAID = {"source", "unverified", "frames", "joints"}


def seed(database: Database) -> None:
    """Store the built-in grippers where they are missing, and what they say of themselves where an older
    version stored them without; several replicas may do so at once. One of the user's own that has the id of
    a built-in one stays as it is.
    """
    with database.read() as tx:
        first = grippers.first_versions(tx, PRESETS)
    wanted = {
        gripper: preset.profile.model_dump(mode="json")
        for gripper, preset in sorted(PRESETS.items())
        if gripper not in first or _said_less(first[gripper], preset.profile)
    }
    if not wanted:
        return
    with database.write(audited=False) as tx:
        for gripper, profile in wanted.items():
            if gripper in first:
                grippers.complete(tx, gripper, profile)
            else:
                grippers.create(tx, gripper, PRESETS[gripper].name, profile, builtin=True)


def _said_less(row: GripperRow, preset: GripperProfile) -> bool:
    """Whether a built-in gripper's first version, which no user changes, has the preset's values without all
    that is said of them.
    """
    if not row.builtin:
        return False
    stored = GripperProfile.model_validate(row.profile)
    values, same = (GripperProfile.model_validate(p.model_dump(exclude=_SAID)) for p in (stored, preset))
    return bool(stored.differences(preset)) and not values.differences(same)


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
