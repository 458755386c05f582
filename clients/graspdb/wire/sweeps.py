"""Sweeps: what to simulate around an object, and how far it has come."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from graspdb.wire.base import (
    MANY,
    AskedPositions,
    AskedRotations,
    GripperRef,
    ObjectId,
    OneGripperVersion,
    OutcomeCounts,
    Pose,
    Position,
    Request,
    Response,
    Slug,
    Warnings,
)
from graspdb.wire.frames.asking import (
    AskedConvention,
    AskedFrame,
    ToldConvention,
    ToldFrame,
    ToolToFrame,
)
from graspdb.wire.frames.gripper_frames import TOOL
from graspdb.wire.queries import KernelSpec, PoseColumns
from graspdb.wire.states import AnySweepState
from graspdb.wire.trials import ProposalDensity

PROTOCOLS = ("wrench", "lift", "shake")
"""How workers judge an outcome; of ``shake`` accelerations may be stated: ``shake-5-100``."""
SHAKEN = 20, 100
"""The accelerations of ``shake`` itself: m/s^2 along the jaw's axes and rad/s^2 about them."""
_STATED = re.compile(r"shake-([1-9][0-9]{0,3})-([1-9][0-9]{0,3})")


def stated_accelerations(protocol: str) -> tuple[int, int] | None:
    """What a protocol's name says of how hard it shakes: along the jaw's axes at most, m/s^2, and about them,
    rad/s^2; None where it says nothing.
    """
    found = _STATED.fullmatch(protocol)
    return None if found is None else (int(found[1]), int(found[2]))


def is_simulated(protocol: str | None) -> bool:
    """Whether workers have a protocol of this name."""
    return protocol in PROTOCOLS or (protocol is not None and stated_accelerations(protocol) is not None)


def simulated_protocol(protocol: str) -> str:
    """The protocol by its one name, if workers have it; ValueError says what there is."""
    if not is_simulated(protocol):
        raise ValueError(
            f"no protocol {protocol!r}: there are {', '.join(PROTOCOLS)}, and shake-ALONG-ABOUT, which shakes"
            " with up to so many whole m/s^2 and rad/s^2 (1 to 9999), as in shake-5-100"
        )
    return "shake" if stated_accelerations(protocol) == SHAKEN else protocol


Protocol = Annotated[
    str,
    Field(
        json_schema_extra={
            "pattern": "^(wrench|lift|shake(-[1-9][0-9]{0,3}-[1-9][0-9]{0,3})?)$",
            "examples": ["wrench", "lift", "shake", "shake-5-100"],
        }
    ),
    AfterValidator(simulated_protocol),
]
Fidelity = Literal["standard", "fine"]
Engine = Literal["pybullet", "mujoco"]
AskedEngine = Literal["pybullet", "mujoco", "both"]
Purpose = Literal["collect", "check"]


class Region(Request):
    """A box of tool positions."""

    lower: Position
    """Lower corner x, y, z, object frame, metres."""
    upper: Position
    """Upper corner x, y, z, object frame, metres."""

    @model_validator(mode="after")
    def _ordered(self) -> Region:
        if any(low > high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError("lower must not exceed upper on any axis")
        return self


class GridSpec(Request):
    """Positions at integer multiples of the step within the mesh's bounding box plus a margin, times Hopf
    rotations."""

    position_step_m: Annotated[float, Field(gt=1e-4, le=1.0)] = 0.01
    """Distance of neighbouring positions, metres."""
    rotation_step_deg: Annotated[float, Field(ge=2.0, le=60.0)] = 15.0
    """Angle between neighbouring rotations, degrees."""
    margin_m: Annotated[float, Field(ge=0, le=1.0)] = 0.02
    """How far positions reach beyond the mesh's bounding box, metres."""
    region: Region | None = None
    """Box that positions are cut to, object frame, metres; null for the whole grid."""
    max_poses: Annotated[int, Field(ge=1, le=10**12)] | None = None
    """Takes so many first poses of a seeded permutation of the same grid; null for all."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    """Chooses the permutation that ``max_poses`` cuts."""


class SampleSpec(Request):
    """Draws from the object's density for the sweep's gripper."""

    kernel: KernelSpec | Slug | None = None
    """The density's kernel: by its widths, ``anisotropic``, or a stored kernel's id; by default isotropic."""
    protocol: Slug | None = None
    """Protocol whose trials the density is built from; by default the one they name."""
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """How many poses to draw."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    """The same seed and revision draw the same poses."""


_LogSpread = Annotated[float, Field(ge=0, le=1.0)]


class Randomise(Request):
    """Each pose is simulated several times under what is not known exactly, and succeeds k times of n.

    What a spread is of is drawn from a normal distribution of that standard deviation about what object and
    gripper say; of friction, mass and compliance their logarithms, so that .2 is about 20 %. The draws of
    these, and of the centre of mass, are the same for all poses, which are thereby compared in the same
    worlds; each pose has noise of its own.
    """

    draws: Annotated[int, Field(ge=2, le=100)] = 10
    """How many times each pose is simulated."""
    friction: _LogSpread = 0.2
    """Standard deviation of the friction coefficient's natural logarithm; 0: as it is."""
    mass: _LogSpread = 0.1
    """Standard deviation of the mass's natural logarithm; 0: as it is."""
    centre_of_mass_m: Annotated[float, Field(ge=0, le=1.0)] = 0.002
    """Standard deviation of the centre of mass along each axis of the object, metres; 0: where it is."""
    pose_noise_m: Annotated[float, Field(ge=0, le=0.1)] = 0.002
    """Standard deviation of the tool's position along each of its axes, metres; 0: none."""
    pose_noise_deg: Annotated[float, Field(ge=0, le=90.0)] = 2.0
    """Standard deviation of the tool's rotation about each of its axes, degrees; 0: none."""
    finger_compliance: _LogSpread = 0.0
    """Standard deviation of the natural logarithm of how compliant the fingers' pads are; 0: as they are. Of
    ``lift`` and ``shake``: pads have no part in the force test of ``wrench``."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    """The same seed draws the same."""

    @model_validator(mode="after")
    def _something(self) -> Randomise:
        spreads = (self.friction, self.mass, self.centre_of_mass_m, self.pose_noise_m, self.pose_noise_deg)
        if not any((*spreads, self.finger_compliance)):
            raise ValueError("nothing is drawn: every spread is 0")
        return self


class SweepCreate(Request):
    """Exactly one of ``grid``, ``poses`` and ``sample``; none of them means the default grid."""

    grid: GridSpec | None = None
    """Simulate a grid about the object; null for another plan."""
    poses: Annotated[list[Pose], Field(min_length=1), MANY] | PoseColumns | None = None
    """Simulate exactly these poses of the tool frame, or of ``frame``, in the object frame; null for another
    plan."""
    frame: AskedFrame = None
    convention: AskedConvention = None
    proposal_density: Annotated[list[ProposalDensity | None], MANY] | ProposalDensity | None = None
    """Density that each of ``poses`` was drawn with, or all of them, 1/(m^3 rad^3), as proposals have it: it
    weighs their trials; null where it is not known."""
    sample: SampleSpec | None = None
    """Simulate draws from the density; null for another plan."""
    gripper: GripperRef = "pg70"
    """Id of the gripper that grasps, in its newest version, or one version of it, as in ``panda@1``."""
    protocol: Protocol = "wrench"
    """``wrench``: the contact forces can counter gravity in every direction; ``lift``: still held, and
    where it was, after the jaw lifted it and moved it about; ``shake``: not lost when the jaw shakes it,
    without gravity, with up to 20 m/s^2 and 100 rad/s^2, or what its name says: ``shake-5-100``."""
    fidelity: Fidelity = "standard"
    """Time step and iterations of the physics: ``standard``, or ``fine``."""
    engine: AskedEngine | None = None
    """Physics engine that simulates it: only workers that have it take its chunks. ``both``: two linked
    sweeps over the same poses; the first, which is answered, has ``pybullet`` and alone stores trials, what
    the second says with ``mujoco`` is compared. Null for the engine of whichever workers come."""
    randomise: Randomise | None = None
    """What is drawn anew in each of several simulations of every pose; null: one simulation of what is
    known."""
    purpose: Purpose = "collect"
    """``collect``, or ``check``: outcomes are stored but enter no density."""
    chunk_poses: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """How many poses one job simulates; by default the service decides."""

    @model_validator(mode="after")
    def _one_plan(self) -> SweepCreate:
        if sum(plan is not None for plan in (self.grid, self.poses, self.sample)) > 1:
            raise ValueError("give one of grid, poses and sample")
        if self.proposal_density is not None and self.poses is None:
            raise ValueError("proposal_density is of given poses: grids and samples have their own")
        if (self.frame, self.convention) != (None, None) and self.poses is None:
            raise ValueError("frame and convention are of given poses: leave them out")
        if self.randomise is not None and self.randomise.finger_compliance and self.protocol == "wrench":
            raise ValueError("randomise.finger_compliance is of lift and shake: wrench has no pads")
        return self


class WaitingFor(Response):
    """The job that a sweep's chunks wait for."""

    kind: Literal["decompose"]
    """What the job does: ``decompose`` makes the object's convex parts."""
    job: str
    """Id of the job."""
    state: AnySweepState
    """How far the job is, as a sweep's state."""
    attempts: int
    """How many attempts have been made."""
    worker: str | None = None
    """Name of the worker that has it; null while none has."""
    progress: str | None = None
    """What its worker says of it, in words; null while it says nothing."""
    error: str | None = None
    """Why it or its last attempt failed; null where none did."""


class FailedChunk(Response):
    """A chunk of a sweep that failed for good."""

    chunk: int
    """Number of the chunk in the sweep, from 0."""
    attempts: int
    """How many attempts were made."""
    error: str
    """What went wrong the last time."""


class SweepInfo(Response):
    """A sweep and how far it has come."""

    id: str
    """Id of the sweep."""
    object: ObjectId
    batch: str
    """Id of the batch that its outcomes are stored in."""
    key: str | None = None
    """Name of the API key that asked for it; null where keys were off."""
    gripper: str
    """Id of the gripper that grasps."""
    gripper_version: OneGripperVersion = None
    protocol: str
    """How an outcome is judged: ``wrench``, ``lift`` or ``shake``, with its accelerations if stated."""
    fidelity: str
    """Time step and iterations of the physics: ``standard``, or ``fine``."""
    engine: str | None = None
    """Physics engine that was asked for; null for that of whichever workers come."""
    engines: list[str] = Field(default_factory=list)
    """Engines that have simulated chunks of it, with their versions, as in ``pybullet 3.2.7``; none of chunks
    from before workers told."""
    linked: str | None = None
    """Id of the sweep that simulates the same poses with the other engine; null where one engine does."""
    randomise: Randomise | None = None
    """What is drawn anew in each of several simulations of a pose; null: each is simulated once."""
    purpose: str
    """``collect``; ``check``: outcomes enter no density; or ``compare``, of the second of two linked sweeps:
    they are no trials, but say how far the first one's can be believed."""
    plan: Literal["grid", "poses", "sample"]
    """Whether it simulates a grid, given poses or draws from the density."""
    grid: GridSpec | None = None
    """The grid as it was asked for; null for other plans."""
    seed: int | None = None
    """Seed of the draws or of the random part of the grid; null for given poses."""
    state: AnySweepState
    """``queued``, ``running``, ``done``, ``failed`` or ``cancelled``."""
    chunks: int
    """How many chunks it is cut into, each a job."""
    chunks_done: int
    """How many chunks are simulated and stored."""
    chunks_failed: int
    """How many chunks failed for good."""
    poses: int
    """How many poses are simulated, one of each jaw-symmetric pair."""
    poses_done: int
    """How many poses are simulated and stored."""
    full_grid_poses: int | None = None
    """How many poses the whole grid has; null for other plans."""
    waiting_for: WaitingFor | None = None
    """The job that its chunks wait for; null where they wait for nothing but a worker."""
    outcomes: OutcomeCounts = Field(default_factory=dict)
    rate_poses_s: float | None = None
    """Poses a second over the last minutes; null where nothing was done in them."""
    time_left_s: float | None = None
    """Seconds it will take by that rate; null where the rate is."""
    failed_chunks: list[FailedChunk] = Field(default_factory=list)
    """Chunks that failed for good, and why."""
    warnings: Warnings = Field(default_factory=list)
    created_at: datetime
    """When it was planned, UTC."""
    started_at: datetime | None = None
    """When a worker took its first chunk, UTC; null before."""
    finished_at: datetime | None = None
    """When its last chunk ended, UTC; null before."""

    @property
    def sole_engine(self) -> str | None:
        """The engine that simulated it, of whatever versions; None where several did, or none is known."""
        names = {told.split()[0] for told in self.engines}
        return names.pop() if len(names) == 1 else None


class SweepOutcomes(Response):
    """Every pose of the finished chunks, collisions included, in columns, ascending within a chunk."""

    sweep: str
    """Id of the sweep."""
    pose_index: list[int]
    """Index of each pose in the sweep's plan."""
    position: AskedPositions
    quaternion_xyzw: AskedRotations
    frame: ToldFrame = TOOL
    convention: ToldConvention = "graspdb"
    tool_to_frame: ToolToFrame = None
    warnings: Warnings = Field(default_factory=list)
    outcome: list[str]
    """What became of each pose, by name: ``success`` where it succeeded in at least half of its attempts."""
    attempts: list[int] | None = None
    """How often each pose was simulated; null where the sweep simulates each once."""
    successes: list[int] | None = None
    """How many of these succeeded; null where the sweep simulates each once."""
    next: str | None = None
    """Cursor of the following page; null at the end."""
