"""Sweeps: what to simulate around an object, and how far it has come."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, model_validator

from graspdb.wire.base import Pose, Position, Quadruple, Request, Response, Slug, Triple
from graspdb.wire.queries import KernelSpec, PoseColumns
from graspdb.wire.states import AnySweepState

Protocol = Literal["wrench", "lift"]
Fidelity = Literal["standard", "fine"]
Purpose = Literal["collect", "check"]


class Region(Request):
    """A box of tool positions, object frame, metres."""

    lower: Position
    upper: Position

    @model_validator(mode="after")
    def _ordered(self) -> Region:
        if any(low > high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError("lower must not exceed upper on any axis")
        return self


class GridSpec(Request):
    """Positions at integer multiples of the step within the mesh's bounding box plus a margin, times Hopf
    rotations. ``max_poses`` takes the prefix of a seeded permutation of the same grid."""

    position_step_m: Annotated[float, Field(gt=1e-4, le=1.0)] = 0.01
    rotation_step_deg: Annotated[float, Field(ge=2.0, le=60.0)] = 15.0
    margin_m: Annotated[float, Field(ge=0, le=1.0)] = 0.02
    region: Region | None = None
    max_poses: Annotated[int, Field(ge=1)] | None = None
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0


class SampleSpec(Request):
    """Draws from the object's density for the sweep's gripper; ``protocol`` names whose trials it is built
    from, where there are several. ``kernel``: by its widths, ``anisotropic``, or a stored kernel's id."""

    kernel: KernelSpec | Slug | None = None
    protocol: Slug | None = None
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0


class SweepCreate(Request):
    """Exactly one of ``grid``, ``poses`` and ``sample``; none of them means the default grid.

    ``protocol`` ``wrench``: the contact forces can counter gravity in every direction; ``lift``: still held
    after a lift and a shake. ``purpose`` ``check``: outcomes are stored but enter no density.
    """

    grid: GridSpec | None = None
    poses: Annotated[list[Pose], Field(min_length=1)] | PoseColumns | None = None
    sample: SampleSpec | None = None
    gripper: Slug = "pg70"
    protocol: Protocol = "wrench"
    fidelity: Fidelity = "standard"
    purpose: Purpose = "collect"
    chunk_poses: Annotated[int, Field(ge=1, le=1_000_000)] | None = None

    @model_validator(mode="after")
    def _one_plan(self) -> SweepCreate:
        if sum(plan is not None for plan in (self.grid, self.poses, self.sample)) > 1:
            raise ValueError("give one of grid, poses and sample")
        return self


class WaitingFor(Response):
    """The job that a sweep's chunks wait for: ``decompose`` makes the object's convex parts.

    ``progress`` is what its worker says of it, ``error`` why it or its last attempt failed.
    """

    kind: Literal["decompose"]
    job: str
    state: AnySweepState
    attempts: int
    worker: str | None = None
    progress: str | None = None
    error: str | None = None


class FailedChunk(Response):
    chunk: int
    attempts: int
    error: str


class SweepInfo(Response):
    """``poses`` counts what is simulated (one of each jaw-symmetric pair); ``rate_poses_s`` over the last
    minutes; ``time_left_s`` by that rate."""

    id: str
    object: str
    batch: str
    gripper: str
    protocol: str
    fidelity: str
    purpose: str
    plan: Literal["grid", "poses", "sample"]
    grid: GridSpec | None = None
    seed: int | None = None
    state: AnySweepState
    chunks: int
    chunks_done: int
    chunks_failed: int
    poses: int
    poses_done: int
    full_grid_poses: int | None = None
    waiting_for: WaitingFor | None = None
    outcomes: dict[str, int] = Field(default_factory=dict)
    rate_poses_s: float | None = None
    time_left_s: float | None = None
    failed_chunks: list[FailedChunk] = Field(default_factory=list)
    created_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None


class SweepOutcomes(Response):
    """Columns: every pose of the finished chunks, collisions included, ascending within a chunk."""

    sweep: str
    pose_index: list[int]
    position: list[Triple]
    quaternion_xyzw: list[Quadruple]
    outcome: list[str]
    next: str | None = None
