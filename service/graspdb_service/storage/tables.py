"""The tables. Rows are the source of truth; everything else is derived and rebuildable.

An object's row is its lock: whoever changes its trials, packed outcomes, mesh, parts or properties first
updates that row, which assigns the new ``revision`` and the next ``seq`` numbers. Revisions and sequence
numbers are therefore in commit order on both databases, which auto-increment ids on PostgreSQL are not.
"""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    DateTime,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    SmallInteger,
    String,
    Table,
    Text,
    TypeDecorator,
    UniqueConstraint,
    text,
)
from sqlalchemy.engine import Dialect

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(column_0_label)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)

# What of a table may not be changed without a row of the audit in the same transaction (see Database.write).
WHOLLY_AUDITED = {"audited": frozenset({"insert", "update", "delete"})}
# Rows come and go by somebody's doing; what changes of them meanwhile follows from work that is under way.
AUDITED_AS_A_WHOLE = {"audited": frozenset({"insert", "delete"})}

# SQLite numbers rows only in a column declared INTEGER.
BigId = BigInteger().with_variant(Integer(), "sqlite")


class UtcDateTime(TypeDecorator[datetime]):
    """A time in UTC. SQLite keeps no zone, so it is put back on reading."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> Any:
        if value is None:
            return None
        if value.tzinfo is None:
            value = value.replace(tzinfo=timezone.utc)
        value = value.astimezone(timezone.utc)
        return value.replace(tzinfo=None) if dialect.name == "sqlite" else value

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        if value is None:
            return None
        return value.replace(tzinfo=timezone.utc) if value.tzinfo is None else value.astimezone(timezone.utc)


grippers = Table(
    "grippers",
    metadata,
    Column("id", String(64), primary_key=True),
    Column("name", Text),
    Column("builtin", Boolean, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    info=WHOLLY_AUDITED,
)

# What a gripper was and is: the newest version is what its id alone stands for. Never changed once stored.
gripper_versions = Table(
    "gripper_versions",
    metadata,
    # AUTOINCREMENT: what was computed with one profile is never taken for another's.
    Column("id", BigId, primary_key=True, autoincrement=True),
    Column("gripper", ForeignKey("grippers.id", ondelete="CASCADE"), nullable=False),
    Column("version", Integer, nullable=False),
    Column("profile", JSON, nullable=False),
    # Fields in which it differs from the version before; null in the first.
    Column("changed", JSON(none_as_null=True)),
    Column("created_at", UtcDateTime, nullable=False),
    UniqueConstraint("gripper", "version"),
    sqlite_autoincrement=True,
    info=WHOLLY_AUDITED,
)

# Arms: what was sent, and the arm that was read from it.
robots = Table(
    "robots",
    metadata,
    Column("id", String(64), primary_key=True),
    Column("info", JSON, nullable=False),
    Column("gripper_mount", JSON(none_as_null=True)),
    Column("sha256", String(64), nullable=False),
    Column("media_type", String(100), nullable=False),
    Column("content", LargeBinary, nullable=False),
    Column("arm", LargeBinary, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Column("updated_at", UtcDateTime, nullable=False),
    info=WHOLLY_AUDITED,
)

# What stands around. Objects in it are named, not referred to: a scene outlives them.
scenes = Table(
    "scenes",
    metadata,
    Column("id", String(64), primary_key=True),
    Column("sha256", String(64), nullable=False),
    # A scene as JSON, in UTF-8.
    Column("content", LargeBinary, nullable=False),
    Column("summary", JSON, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Column("updated_at", UtcDateTime, nullable=False),
    info=WHOLLY_AUDITED,
)

# Content-addressed: meshes and convex parts, stored once whoever uses them.
assets = Table(
    "assets",
    metadata,
    Column("sha256", String(64), primary_key=True),
    Column("media_type", String(100), nullable=False),
    Column("content", LargeBinary, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
)

objects = Table(
    "objects",
    metadata,
    # AUTOINCREMENT: an internal id is never reused, so a cache key made of it never lies.
    Column("id", BigId, primary_key=True, autoincrement=True),
    Column("slug", String(64), nullable=False, unique=True),
    Column("name", Text),
    Column("mass_kg", Double),
    Column("density_kg_m3", Double),
    Column("friction", Double),
    Column("metadata", JSON),
    Column("revision", BigInteger, nullable=False),
    Column("epoch", BigInteger, nullable=False),
    Column("last_seq", BigInteger, nullable=False),
    Column("mesh_sha256", ForeignKey("assets.sha256")),
    Column("mesh_info", JSON),
    Column("parts_sha256", ForeignKey("assets.sha256")),
    Column("parts_info", JSON),
    Column("created_at", UtcDateTime, nullable=False),
    Column("updated_at", UtcDateTime, nullable=False),
    # Of a copy: what it was copied from, and whether its mesh may be, or was, changed in spite of its trials.
    Column("copied_from", JSON(none_as_null=True)),
    # Names of the qualities that its trials have, or had: they leave with the object only.
    Column("quality_names", JSON(none_as_null=True)),
    # By name, each a pose in the frame of the mesh, which itself is not among them.
    Column("frames", JSON(none_as_null=True)),
    sqlite_autoincrement=True,
    info=WHOLLY_AUDITED,
)

# Which gripper, source, protocol and engine a trial had, once per combination instead of once per row. What
# is packed counts under its sweep's, which names no engine.
provenances = Table(
    "provenances",
    metadata,
    Column("id", BigId, primary_key=True, autoincrement=True),
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("gripper", ForeignKey("grippers.id")),
    Column("source", String(16)),
    Column("protocol", String(64)),
    Column("gripper_version", Integer),
    # What simulated it, with its version where that is known.
    Column("engine", String(64)),
)

# Trials by provenance and outcome, kept in the transactions that change them: counting reads no trial.
tallies = Table(
    "tallies",
    metadata,
    Column("provenance_id", ForeignKey("provenances.id", ondelete="CASCADE"), primary_key=True),
    Column("outcome", SmallInteger, primary_key=True, autoincrement=False),
    Column("row_count", BigInteger, nullable=False),
    Column("packed_count", BigInteger, nullable=False),
)

sweeps = Table(
    "sweeps",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("provenance_id", ForeignKey("provenances.id", ondelete="CASCADE"), nullable=False),
    Column("gripper", ForeignKey("grippers.id"), nullable=False),
    Column("protocol", String(16), nullable=False),
    Column("fidelity", String(16), nullable=False),
    Column("purpose", String(16), nullable=False),
    Column("plan", String(16), nullable=False),
    # The request as it came, and the world as it then was: mesh and part hashes, mass, friction, profile.
    Column("request", JSON, nullable=False),
    Column("snapshot", JSON, nullable=False),
    # float64 (n, 7) position and quaternion xyzw, for plans that are no grid.
    Column("poses", LargeBinary),
    Column("pose_count", BigInteger, nullable=False),
    Column("chunk_poses", Integer, nullable=False),
    Column("chunks", Integer, nullable=False),
    Column("cancelled", Boolean, nullable=False),
    # Name of the key that asked for it, where one did.
    Column("made_by", String(64)),
    Column("created_at", UtcDateTime, nullable=False),
    Column("started_at", UtcDateTime),
    Column("finished_at", UtcDateTime),
    # The sweep of the other engine over the same plan, which names this one. No foreign key: both come and go
    # with their object.
    Column("linked", String(36)),
    info=AUDITED_AS_A_WHOLE,
)

batches = Table(
    "batches",
    metadata,
    Column("id", BigId, primary_key=True, autoincrement=True),
    Column("key", String(36), nullable=False, unique=True),
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("sweep_id", ForeignKey("sweeps.id", ondelete="SET NULL"), unique=True),
    Column("revision", BigInteger, nullable=False),
    # The trials of a batch lie between these; those of a sweep's share the range with others.
    Column("first_seq", BigInteger),
    Column("last_seq", BigInteger),
    Column("inserted", BigInteger, nullable=False),
    Column("packed", BigInteger, nullable=False),
    Column("metadata", JSON),
    # Name of the key that posted it, where one did.
    Column("made_by", String(64)),
    Column("created_at", UtcDateTime, nullable=False),
    # Whose the data is and what it was read from, as told.
    Column("licence", String(100)),
    Column("citation", Text),
    Column("origin", JSON(none_as_null=True)),
    # [name, float type] of each quality, in the order in which its trials' `qualities` have them.
    Column("quality_layout", JSON(none_as_null=True)),
    sqlite_autoincrement=True,
    info=AUDITED_AS_A_WHOLE,
)

trials = Table(
    "trials",
    metadata,
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), primary_key=True, autoincrement=False),
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    Column("revision", BigInteger, nullable=False),
    # No foreign keys: deleting a batch would search every trial for each of them, for want of an index that
    # no query needs. A batch's trials lie in its seq range, and leave with it under the object's lock.
    Column("batch_id", BigInteger, nullable=False),
    Column("provenance_id", BigInteger, nullable=False),
    Column("outcome", SmallInteger, nullable=False),
    Column("px", Double, nullable=False),
    Column("py", Double, nullable=False),
    Column("pz", Double, nullable=False),
    Column("qx", Double, nullable=False),
    Column("qy", Double, nullable=False),
    Column("qz", Double, nullable=False),
    Column("qw", Double, nullable=False),
    Column("proposal_density", Double),
    Column("quality", Double),
    Column("width_m", Double),
    Column("pose_index", BigInteger),
    Column("measured_at", UtcDateTime),
    Column("pose_covariance", JSON(none_as_null=True)),
    Column("metadata", JSON(none_as_null=True)),
    # True: kept, and out of every count and estimate. Null otherwise, so that rows from before need no value.
    Column("withdrawn", Boolean),
    # The answer that it tried; no foreign key, as above: an answer that trials name is not deleted.
    Column("answer_number", BigInteger),
    # Where the tool was after all, where that is known: all of it or nothing.
    *(Column(f"achieved_{name}", Double) for name in ("px", "py", "pz", "qx", "qy", "qz", "qw")),
    # Of a pose tried several times under one number: how often, and how often it succeeded. Null: once.
    Column("attempts", Integer),
    Column("successes", Integer),
    # Its named scores, packed as its batch says; names would take more room than the numbers.
    Column("qualities", LargeBinary),
    # Few trials name an answer: found without reading the rest.
    Index(
        "ix_trials_of_answers",
        "object_id",
        "seq",
        sqlite_where=text("answer_number IS NOT NULL"),
        postgresql_where=text("answer_number IS NOT NULL"),
    ),
    # Few were tried several times, and how often they succeeded is read beside the others.
    Index(
        "ix_trials_of_several",
        "object_id",
        "seq",
        sqlite_where=text("attempts IS NOT NULL"),
        postgresql_where=text("attempts IS NOT NULL"),
    ),
    # Successes are what densities are built of and few among the trials: found without reading the rest.
    Index(
        "ix_trials_successes",
        "object_id",
        "seq",
        sqlite_where=text("outcome = 1"),
        postgresql_where=text("outcome = 1"),
    ),
    sqlite_with_rowid=False,
)

# What a trial was before it was corrected or withdrawn: the values that each change replaced.
trial_changes = Table(
    "trial_changes",
    metadata,
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), primary_key=True, autoincrement=False),
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    Column("revision", BigInteger, primary_key=True, autoincrement=False),
    Column("before", JSON, nullable=False),
    Column("reason", Text),
    Column("changed_at", UtcDateTime, nullable=False),
    info=WHOLLY_AUDITED,
)

# What was doubtful about a batch's trials when they came. Who is numbered by `provenance_id` has no foreign
# key: provenances leave with their object only, as the batch does.
findings = Table(
    "findings",
    metadata,
    Column("batch_id", ForeignKey("batches.id", ondelete="CASCADE"), primary_key=True),
    Column("number", SmallInteger, primary_key=True, autoincrement=False),
    # Whose trials it is about; null: any of the batch.
    Column("provenance_id", BigInteger),
    Column("code", String(40), nullable=False),
    # What the code leaves open: a distance, an axis.
    Column("detail", String(40), nullable=False),
    Column("trial_count", BigInteger, nullable=False),
    Column("examined", BigInteger, nullable=False),
    Column("first_indices", JSON, nullable=False),
    # The earlier batch that holds the same rows: without it there is nothing to find.
    Column("other_batch_id", ForeignKey("batches.id", ondelete="CASCADE"), index=True),
)

# Digests of some of the rows that were posted, always the same ones of the same rows: the next batch is
# compared with them.
fingerprints = Table(
    "fingerprints",
    metadata,
    Column("digest", BigInteger, primary_key=True, autoincrement=False),
    Column("batch_id", ForeignKey("batches.id", ondelete="CASCADE"), primary_key=True, index=True),
    sqlite_with_rowid=False,
)

jobs = Table(
    "jobs",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("kind", String(16), nullable=False),
    # What a worker must be able to do to take it: the kind, or a protocol of its own such as lift.
    Column("capability", String(16), nullable=False),
    # The physics engine that it has to have, too; null: any.
    Column("engine", String(16)),
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("sweep_id", ForeignKey("sweeps.id", ondelete="CASCADE"), index=True),
    Column("number", BigInteger, nullable=False),
    Column("start", BigInteger, nullable=False),
    Column("stop", BigInteger, nullable=False),
    Column("state", String(16), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("lease_id", String(36)),
    # Seconds since the epoch by the database's clock.
    Column("lease_expires_at", Double),
    Column("worker", String(200)),
    Column("result_sha256", String(64)),
    Column("answer", JSON(none_as_null=True)),
    Column("counts", JSON(none_as_null=True)),
    # What its worker says of how far it is, where poses can't tell.
    Column("progress", String(200)),
    Column("error", Text),
    Column("completed_at", Double),
    UniqueConstraint("sweep_id", "number"),
    # Waiting: for the convex parts of its object, which a job of the kind decompose makes.
    CheckConstraint("state IN ('waiting', 'queued', 'leased', 'done', 'failed', 'cancelled')", name="state"),
    Index("ix_jobs_claim", "state", "capability", "id"),
    # One decomposition an object, whichever sweeps wait for it.
    Index(
        "uq_jobs_decompose",
        "object_id",
        unique=True,
        sqlite_where=text("kind = 'decompose'"),
        postgresql_where=text("kind = 'decompose'"),
    ),
)

# One uint8 for every pose of a finished chunk, in the plan's order.
packed_outcomes = Table(
    "packed_outcomes",
    metadata,
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("sweep_id", ForeignKey("sweeps.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("number", BigInteger, nullable=False),
    Column("revision", BigInteger, nullable=False),
    Column("outcomes", LargeBinary, nullable=False),
    # Of a sweep that simulates each pose several times: how often each succeeded, one uint8 a pose.
    Column("successes", LargeBinary),
    # What simulated it, with its version; null: the worker did not say.
    Column("engine", String(64)),
    # Of a linked sweep what physics measured, which is compared: see
    # graspdb_service.storage.simulation.linked.
    Column("measured", LargeBinary),
)

workers = Table(
    "workers",
    metadata,
    Column("name", String(200), primary_key=True),
    Column("capabilities", JSON, nullable=False),
    Column("last_seen", Double, nullable=False),
    Column("jobs_done", BigInteger, nullable=False),
    Column("poses_done", BigInteger, nullable=False),
)

# Kernels fitted on an object's trials or given by their components; usable on any object.
kernels = Table(
    "kernels",
    metadata,
    # In the order they were made: which is the newest does not depend on a clock.
    Column("number", BigId, primary_key=True, autoincrement=True),
    Column("id", String(36), nullable=False, unique=True),
    Column("kind", String(16), nullable=False),
    Column("alignment", String(16), nullable=False),
    Column("gripper", ForeignKey("grippers.id")),
    # The object it was fitted on; what it was and at which revision stays in the provenance.
    Column("object_id", ForeignKey("objects.id", ondelete="SET NULL"), index=True),
    Column("components", JSON, nullable=False),
    Column("provenance", JSON, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    # Null: for all versions of the gripper.
    Column("gripper_version", Integer),
    sqlite_autoincrement=True,
    info=WHOLLY_AUDITED,
)

# Widths that the first rows of a selection have chosen, by the SHA-256 of what those rows are.
width_choices = Table(
    "width_choices",
    metadata,
    # In the order they were chosen: the newest stay.
    Column("number", BigId, primary_key=True, autoincrement=True),
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("sigma_position_m", Double, nullable=False),
    # Radians.
    Column("sigma_rotation", Double, nullable=False),
    Column("rule", String(32), nullable=False),
    UniqueConstraint("object_id", "digest"),
)

# What estimators learned of an object's attempts: one row for a selection, kernel and geometry.
learned_estimators = Table(
    "learned_estimators",
    metadata,
    # In the order they were learned: the newest stay.
    Column("number", BigId, primary_key=True, autoincrement=True),
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("epoch", BigInteger, nullable=False),
    Column("attempts", BigInteger, nullable=False),
    # Null where the attempts taught nothing.
    Column("content", LargeBinary, nullable=True),
    UniqueConstraint("object_id", "digest"),
)

# What was learned of all objects that a gripper tried: one row for a gripper and which trials count.
learned_transfers = Table(
    "learned_transfers",
    metadata,
    # AUTOINCREMENT: what was learned anew is never taken for what is known.
    Column("number", BigId, primary_key=True, autoincrement=True),
    Column("digest", String(64), nullable=False, unique=True),
    # Epoch and attempts of every object that it was learned of, by the object's id.
    Column("objects", JSON, nullable=False),
    # Null where they taught nothing.
    Column("content", LargeBinary, nullable=True),
    sqlite_autoincrement=True,
)

# Reports that are computed or have been: one row for an object, revision and set of parameters, leased to
# the process that computes it.
report_runs = Table(
    "report_runs",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), nullable=False),
    Column("revision", BigInteger, nullable=False),
    Column("report", String(32), nullable=False),
    # SHA-256 of report, parameters and the version that computes.
    Column("parameters_key", String(64), nullable=False),
    Column("parameters", JSON, nullable=False),
    Column("state", String(16), nullable=False),
    Column("progress", Double, nullable=False),
    Column("lease_id", String(36)),
    # Seconds since the epoch by the database's clock.
    Column("lease_expires_at", Double),
    # JSON as it is answered.
    Column("result", Text),
    # Why it failed, a problem's members; null where the service itself did.
    Column("problem", JSON(none_as_null=True)),
    Column("created_at", UtcDateTime, nullable=False),
    Column("finished_at", UtcDateTime),
    UniqueConstraint("object_id", "parameters_key", "revision"),
    CheckConstraint("state IN ('running', 'done', 'failed', 'cancelled')", name="state"),
)

# Answers as they were given, each once: what was asked, of which revision, and what was answered.
answers = Table(
    "answers",
    metadata,
    # AUTOINCREMENT: trials name an answer by its number, which is never another's.
    Column("number", BigId, primary_key=True, autoincrement=True),
    Column("id", String(20), nullable=False, unique=True),
    Column("object_id", ForeignKey("objects.id", ondelete="CASCADE"), nullable=False),
    Column("kind", String(16), nullable=False),
    Column("revision", BigInteger, nullable=False),
    # Which trials it was about, as its selection was resolved.
    Column("gripper", String(80)),
    Column("protocol", String(64)),
    Column("source", String(16)),
    Column("version", String(40), nullable=False),
    # JSON, deflated.
    Column("question", LargeBinary, nullable=False),
    Column("result", LargeBinary, nullable=False),
    # How many trials name it: such an answer stays.
    Column("trial_count", BigInteger, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    # When it was given last, to the minute.
    Column("asked_at", UtcDateTime, nullable=False),
    Index("ix_answers_recent", "object_id", "kind", "asked_at"),
    sqlite_autoincrement=True,
)

# Names that users gave answers; an answer may have several.
answer_names = Table(
    "answer_names",
    metadata,
    Column("name", String(64), primary_key=True),
    Column("answer_number", ForeignKey("answers.number", ondelete="CASCADE"), nullable=False, index=True),
)

idempotency_keys = Table(
    "idempotency_keys",
    metadata,
    # Method and path belong to the key: the same UUID at two resources is two requests.
    Column("scope", String(300), primary_key=True),
    Column("key", String(200), primary_key=True),
    Column("request_sha256", String(64), nullable=False),
    Column("status", Integer, nullable=False),
    Column("location", Text),
    Column("answer", JSON, nullable=False),
    Column("batch_key", String(36), index=True),
    # Its batch was deleted: the same request again is no retry but a mistake.
    Column("revoked", Boolean, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
)

# Who may ask. Rows stay when a key is revoked, so that the audit's ids go on meaning something.
api_keys = Table(
    "api_keys",
    metadata,
    Column("number", BigId, primary_key=True, autoincrement=True),
    Column("id", String(12), nullable=False, unique=True),
    Column("name", String(64), nullable=False),
    # Of what is sent. It has 256 random bits: no guessing, so no need for a hash that makes guessing slow.
    Column("sha256", String(64), nullable=False),
    Column("previous_sha256", String(64)),
    Column("previous_until", UtcDateTime),
    Column("scopes", JSON, nullable=False),
    Column("objects", String(64)),
    Column("requests_per_s", Double),
    Column("burst", Integer),
    Column("created_at", UtcDateTime, nullable=False),
    Column("created_by", String(64)),
    Column("expires_at", UtcDateTime),
    Column("revoked_at", UtcDateTime),
    Index(
        "uq_api_keys_name",
        "name",
        unique=True,
        sqlite_where=text("revoked_at IS NULL"),
        postgresql_where=text("revoked_at IS NULL"),
    ),
    sqlite_autoincrement=True,
    info=WHOLLY_AUDITED,
)

# Written now and then in the background, apart from the keys, which nobody then waits for.
key_uses = Table(
    "key_uses",
    metadata,
    Column("key_id", ForeignKey("api_keys.id", ondelete="CASCADE"), primary_key=True),
    Column("last_used_at", UtcDateTime, nullable=False),
)

# Who changed what. Names and no foreign keys: it outlives what it tells of.
audit = Table(
    "audit",
    metadata,
    Column("id", BigId, primary_key=True, autoincrement=True),
    Column("at", UtcDateTime, nullable=False, index=True),
    Column("action", String(40), nullable=False),
    Column("key_id", String(12)),
    Column("key", String(64)),
    Column("object", String(64)),
    Column("subject", String(64)),
    Column("request_id", String(32)),
    Index("ix_audit_object_id", "object", "id"),
    Index("ix_audit_key_name_id", "key", "id"),
    sqlite_autoincrement=True,
)
