"""The worker's protocol: claim under a lease, renew, hand in a result or a failure."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Base64Bytes, Field

from graspdb.wire.base import Quadruple, Request, Response, Text, Triple
from graspdb.wire.grippers import GripperProfile
from graspdb.wire.sweeps import Fidelity, Protocol

WorkerName = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f]+$")]
Capability = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f]+$")]
JobKind = Literal["simulate", "decompose"]


class ClaimRequest(Request):
    worker: WorkerName
    capabilities: Annotated[list[Capability], Field(max_length=32)] = Field(
        default_factory=lambda: ["simulate"]
    )
    """Job kinds the worker can do, and ``lift`` where it has that protocol."""
    limit: Annotated[int, Field(ge=1, le=64)] = 1


class GridPlan(Response):
    """A grid as the worker generates it: see :class:`graspdb_geometry.grids.PoseGrid`."""

    lower: Triple
    upper: Triple
    position_step_m: float
    rotation_step_deg: float
    margin_m: float
    region: tuple[Triple, Triple] | None = None
    max_poses: int | None = None
    seed: int = 0
    symmetric: bool = True


class PosePlan(Response):
    """The poses of this chunk only, in order."""

    position: list[Triple]
    quaternion_xyzw: list[Quadruple]


class SimulatePayload(Response):
    """One chunk: the poses ``start`` to ``stop`` of the plan.

    ``convex_parts`` is the path to fetch them from; their bytes have the SHA-256 ``parts_sha256``.
    """

    sweep: str
    object: str
    convex_parts: str
    parts_sha256: str
    mass_kg: float
    friction: float
    gripper: GripperProfile
    protocol: Protocol
    fidelity: Fidelity
    grid: GridPlan | None = None
    poses: PosePlan | None = None
    start: int
    stop: int


class DecomposePayload(Response):
    """A mesh to split into convex parts: ``mesh`` is the path to fetch it from.

    The result is a GLB in metres with one geometry a part, sent as ``model/gltf-binary``.
    """

    object: str
    mesh: str
    mesh_sha256: str
    media_type: str = "model/stl"
    unit: str = "m"
    max_parts: int = 1024


class ClaimedJob(Response):
    id: str
    kind: JobKind
    lease_id: str
    lease_expires_at: datetime
    lease_s: float
    """Seconds the lease lasts from the answer on: what a worker should count by, its clock may differ."""
    payload: SimulatePayload | DecomposePayload


class ClaimResponse(Response):
    jobs: list[ClaimedJob]
    retry_after_s: float


class LeaseRenewed(Response):
    lease_expires_at: datetime
    lease_s: float
    cancel: bool = False


class ResultRows(Request):
    """What physics measured, for the poses of the chunk that met it: ascending ``pose_index``."""

    pose_index: list[Annotated[int, Field(ge=0)]]
    width_m: list[Annotated[float, Field(ge=0, le=10)] | None]
    quality: list[Annotated[float, Field(ge=-1e9, le=1e9)] | None]


class SimulateResult(Request):
    """``outcomes``: base64 of one uint8 code a pose of the chunk (:data:`graspdb.wire.OUTCOME_CODES`)."""

    outcomes: Base64Bytes
    rows: ResultRows


class ResultAccepted(Response):
    job: str
    revision: int
    inserted: int


class FailureReport(Request):
    """``permanent``: another attempt would end the same way, so none is made."""

    error: Text
    permanent: bool = False


class FailureNoted(Response):
    """``state`` is ``queued`` while attempts are left, then ``failed``."""

    job: str
    state: str
    attempts: int


class WorkerInfo(Response):
    worker: str
    capabilities: list[str]
    last_seen: datetime
    jobs_leased: int
    jobs_done: int
    poses_done: int
