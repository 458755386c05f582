"""The worker's protocol: claim under a lease, renew, hand in a result or a failure."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Base64Bytes, Field

from graspdb.wire.base import MANY, ObjectId, Request, Response, Text, ToolPositions, ToolRotations, Triple
from graspdb.wire.grippers import GripperProfile
from graspdb.wire.sweeps import Engine, Fidelity, Protocol, Randomise

WorkerName = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f]+$")]
Capability = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f]+$")]
EngineVersion = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[a-z0-9_-]+ [\w.+-]+$")]
JobKind = Literal["simulate", "decompose"]


class ClaimRequest(Request):
    """A worker asks for jobs."""

    worker: WorkerName
    """The worker's name, as ``GET /workers`` lists it."""
    capabilities: Annotated[list[Capability], Field(min_length=1, max_length=32)] = Field(
        default_factory=lambda: ["simulate"]
    )
    """Job kinds the worker can do, ``lift`` and ``shake`` where it has these protocols, ``drawn-wrench``,
    ``drawn-lift`` and ``drawn-shake`` where it can simulate a pose under what is drawn, ``stated-shake``
    where it shakes, drawn or not, as hard as the protocol's name says, and its physics engines: a chunk
    that names none goes to any worker."""
    limit: Annotated[int, Field(ge=1, le=64)] = 1
    """How many jobs it takes at most."""


class GridPlan(Response):
    """A grid as the worker generates it: see :class:`graspdb_geometry.grids.PoseGrid`."""

    lower: Triple
    """Lower corner of the mesh's bounding box, object frame, metres."""
    upper: Triple
    """Upper corner of the mesh's bounding box, object frame, metres."""
    position_step_m: float
    """Distance of neighbouring positions, metres."""
    rotation_step_deg: float
    """Angle between neighbouring rotations, degrees."""
    margin_m: float
    """How far positions reach beyond the bounding box, metres."""
    region: tuple[Triple, Triple] | None = None
    """Lower and upper corner of the box the grid is cut to, object frame, metres; null for none."""
    max_poses: int | None = None
    """Size of the random part of the grid that is simulated; null for the whole grid."""
    seed: int = 0
    """Chooses which random part of the grid is simulated."""
    symmetric: bool = True
    """Whether only one of each pair of poses is simulated that the jaw's half turn makes the same."""


class PosePlan(Response):
    """The poses of this chunk only, in order."""

    position: ToolPositions
    quaternion_xyzw: ToolRotations


class SimulatePayload(Response):
    """One chunk: the poses ``start`` to ``stop`` of a sweep's plan."""

    sweep: str
    """Id of the sweep that the chunk is of."""
    object: ObjectId
    convex_parts: str
    """Path of the service to fetch the convex parts from, a GLB in metres."""
    parts_sha256: str
    """SHA-256 of the convex parts' bytes, in hexadecimal digits."""
    mass_kg: float
    """Mass of the object, kilograms."""
    friction: float
    """Coulomb's coefficient of friction of the object, without a unit."""
    gripper: GripperProfile
    """Profile of the gripper as it was when the sweep was planned."""
    protocol: Protocol
    """How an outcome is judged: by the contact wrench, by a lift, or by shaking."""
    fidelity: Fidelity
    """Time step and iterations of the physics: ``standard``, or ``fine``."""
    engine: Engine | None = None
    """Physics engine to simulate with; null for the worker's own."""
    randomise: Randomise | None = None
    """What to draw anew in each of several simulations of every pose; null: one of what is known."""
    grid: GridPlan | None = None
    """The grid that the chunk is cut from; null where poses are given."""
    poses: PosePlan | None = None
    """The chunk's own poses, in the object frame; null for a grid."""
    start: int
    """Index in the plan of the chunk's first pose."""
    stop: int
    """Index in the plan after the chunk's last pose."""


class DecomposePayload(Response):
    """A mesh to split into convex parts.

    The result is a GLB in metres with one geometry a part, sent as ``model/gltf-binary``.
    """

    object: ObjectId
    mesh: str
    """Path of the service to fetch the mesh from."""
    mesh_sha256: str
    """SHA-256 of the mesh's bytes, in hexadecimal digits."""
    media_type: str = "model/stl"
    """Format of the mesh as a media type."""
    unit: str = "m"
    """Unit of the mesh's coordinates: m, mm, cm or in."""
    scale: float = 1.0
    """Factor to the mesh's coordinates beside their unit, without a unit."""
    max_parts: int = 1024
    """How many parts there may be at most."""


class ClaimedJob(Response):
    """A job, leased to the worker that claimed it."""

    id: str
    """Id of the job."""
    kind: JobKind
    """What to do: ``simulate`` a chunk, or ``decompose`` a mesh."""
    lease_id: str
    """Proves that the job is the worker's, in every call about it."""
    lease_expires_at: datetime
    """When the lease ends by the service's clock, UTC."""
    lease_s: float
    """Seconds the lease lasts from the answer on: what a worker should count by, its clock may differ."""
    payload: SimulatePayload | DecomposePayload
    """What the work needs, by its kind."""


class ClaimResponse(Response):
    """The jobs that a worker got."""

    jobs: list[ClaimedJob]
    """The jobs, none where there is nothing to do."""
    retry_after_s: float
    """Seconds to wait before asking again; 0 where there was a job."""


class LeaseRenewed(Response):
    """A lease goes on, or the job is not wanted any more."""

    lease_expires_at: datetime
    """When the lease ends by the service's clock, UTC."""
    lease_s: float
    """Seconds the lease lasts from the answer on."""
    cancel: bool = False
    """Whether the work should stop: nobody wants its result any more."""


class ResultRows(Request):
    """What physics measured, for the poses of the chunk that met it, in columns."""

    pose_index: Annotated[list[Annotated[int, Field(ge=0, lt=2**53)]], MANY]
    """Index of each pose in the sweep's plan, ascending."""
    width_m: Annotated[list[Annotated[float, Field(ge=0, le=10)] | None], MANY]
    """Distance between the fingers at the end, metres; null where it was not measured."""
    quality: Annotated[list[Annotated[float, Field(ge=-1e9, le=1e9)] | None], MANY]
    """Margin by which the protocol was met, without a unit; null where it was not measured."""


class SimulateResult(Request):
    """What became of a chunk's poses."""

    outcomes: Base64Bytes
    """One uint8 code of an outcome for every pose of the chunk, in order, as base64: ``success`` where a pose
    succeeded in at least half of its draws, else the failure that most of them ended in."""
    successes: Base64Bytes | None = None
    """How many draws of every pose succeeded, one uint8 each, as base64; null where nothing is drawn."""
    rows: ResultRows
    """What was measured of the poses that met physics, in any draw: medians over the draws that did."""
    engine: EngineVersion | None = None
    """Physics engine that simulated the chunk and its version, as in ``pybullet 3.2.7``; null where the
    worker does not say."""


class ResultAccepted(Response):
    """A result is stored and its job done."""

    job: str
    """Id of the job."""
    revision: int
    """The object's revision now that the result is stored."""
    inserted: int
    """How many trials were stored as rows."""


class FailureReport(Request):
    """A worker could not do a job."""

    error: Text
    """What went wrong, in words."""
    permanent: bool = False
    """Whether another attempt would end the same way, so that none is made."""


class FailureNoted(Response):
    """What becomes of a job after a failure."""

    job: str
    """Id of the job."""
    state: str
    """``queued`` while attempts are left, then ``failed``."""
    attempts: int
    """How many attempts have been made."""


class WorkerInfo(Response):
    """A worker that has asked for jobs."""

    worker: str
    """Name the worker gave itself."""
    capabilities: list[str]
    """Job kinds it can do, protocols beyond ``wrench``, and physics engines it has."""
    last_seen: datetime
    """When it last called, UTC."""
    jobs_leased: int
    """How many jobs it holds now."""
    jobs_done: int
    """How many jobs it has completed."""
    poses_done: int
    """How many poses it has simulated."""
