"""Questions to a density and their answers: likelihood, best grasp, samples."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from graspdb.wire.base import (
    Direction,
    Pose,
    Position,
    Quadruple,
    Quaternion,
    Request,
    Response,
    Slug,
    Source,
    Triple,
    Vector4,
    Vector7,
    _split_commas,
    _unit,
)

WidthM = Annotated[float, Field(gt=0, le=1.0)]
WidthDeg = Annotated[float, Field(gt=0, le=90.0)]
Angle = Annotated[float, Field(gt=0, le=180.0)]
NoiseM = Annotated[float, Field(ge=0, le=1.0)]
NoiseDeg = Annotated[float, Field(ge=0, le=60.0)]
Extent = Annotated[float, Field(gt=0, le=1_000.0)]


class KernelSpec(Request):
    """A kernel by its widths: standard deviations per axis. ``cutoff`` in sigmas; null means exact."""

    kind: Literal["isotropic"] = "isotropic"
    sigma_position_m: WidthM | None = None
    sigma_rotation_deg: WidthDeg | None = None
    cutoff: Annotated[float, Field(ge=2.0, le=20.0)] | None = None


class TrialSelection(Request):
    """Which trials a question is about."""

    gripper: Slug | None = None
    protocol: Slug | None = None
    source: Source | None = None


class Selection(TrialSelection):
    """Which trials a density is built from, and with which kernel."""

    kernel: KernelSpec | Slug | None = None
    sigma_position_m: WidthM | None = None
    sigma_rotation_deg: WidthDeg | None = None


class SelectionQuery(Selection):
    """A selection in a query string, where a kernel is a name with widths beside it."""

    kernel: Slug | None = None


class KernelInfo(Response):
    """The kernel that answered; ``rule`` says how its widths were chosen.

    Of a stored kernel ``sigma_*`` are those of the isotropic one with equal determinants; ``widths_*`` are
    its standard deviations along and about x, y and z.
    """

    kind: str
    sigma_position_m: float
    sigma_rotation_deg: float
    rule: str
    id: str | None = None
    alignment: str | None = None
    widths_m: Triple | None = None
    widths_deg: Triple | None = None


class WeightsInfo(Response):
    """How successes were weighted to undo how poses were chosen (eq 1); ``rule`` says it in words.

    ``equal``; ``mixture``: 1 / sum n_k g_k(x) over grids of different regions or steps; ``own``: 1 / g of
    each trial's own proposal density; ``mixture-and-own``: both, the grids as one strategy. ``poses_tried``
    counts the grids' distinct poses, collisions included.
    """

    kind: Literal["equal", "mixture", "own", "mixture-and-own"]
    rule: str
    poses_tried: int | None = None
    without_proposal_density: int = 0


class DensityInfo(Response):
    """``size`` successes shape the density; twins by the jaw's symmetry are implicit and not counted."""

    object: str
    revision: int
    epoch: int
    gripper: str | None
    protocol: str | None
    source: str | None
    kernel: KernelInfo
    size: int
    outcomes: dict[str, int]
    effective_sample_size: float
    weights: WeightsInfo | None = None
    unit: str = "1/(m^3 rad^3)"
    bytes: int
    warnings: list[str] = Field(default_factory=list)


class PoseColumns(Request):
    position: Annotated[list[Position], Field(min_length=1)]
    quaternion_xyzw: Annotated[list[Quaternion], Field(min_length=1)]

    @model_validator(mode="after")
    def _same_length(self) -> PoseColumns:
        if len(self.position) != len(self.quaternion_xyzw):
            raise ValueError(
                f"position has {len(self.position)} rows and quaternion_xyzw {len(self.quaternion_xyzw)}"
            )
        return self


LikelihoodColumn = Literal[
    "density",
    "log_density",
    "relative",
    "success_probability",
    "interval",
    "effective_trials",
    "collision_free",
]


class LikelihoodRequest(Selection):
    poses: Annotated[list[Pose], Field(min_length=1)] | PoseColumns
    include: list[LikelihoodColumn] | None = None


class Intervals(Response):
    level: float
    low: list[float | None]
    high: list[float | None]


class Interval(Response):
    level: float
    low: float
    high: float


class Likelihoods(Response):
    """Columns in the poses' order. Density in 1/(m^3 rad^3); the log of an exact zero is null."""

    revision: int
    kernel: KernelInfo
    density: list[float] | None = None
    log_density: list[float | None] | None = None
    relative: list[float] | None = None
    success_probability: list[float | None] | None = None
    interval: Intervals | None = None
    effective_trials: list[float] | None = None
    collision_free: list[bool | None] | None = None


def _object_pose(value: Any) -> Any:
    if isinstance(value, dict):
        pose = Pose.model_validate(value)
        return (*pose.position, *pose.quaternion_xyzw)
    value = _split_commas(value)
    if isinstance(value, (list, tuple)) and len(value) == 7:
        try:
            numbers = [float(x) for x in value]
        except (TypeError, ValueError):
            return value
        return (*numbers[:3], *_unit(tuple(numbers[3:])))
    return value


ObjectPose = Annotated[Vector7, BeforeValidator(_object_pose)]
"""The object frame in the world frame: x, y, z, qx, qy, qz, qw (a pose's object is accepted too)."""


Objective = Literal["density", "success_probability", "robust"]
Averaged = Literal["density", "success_probability"]

MAX_HALF_SPACES = 200
MAX_OBSTACLE_BOXES = 200
MAX_OBSTACLE_POINTS = 50_000
MAX_CANDIDATES = 10_000
MAX_EXCLUDED = 1_000


class ObstacleBox(Pose):
    """A box that the gripper must not touch: edge lengths, and the pose of its centre in ``frame``."""

    size_m: tuple[Extent, Extent, Extent]
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)


class Obstacles(Request):
    """What else stands around, in ``frame``: boxes, and points of a sensor, each a ball."""

    boxes: Annotated[list[ObstacleBox], Field(max_length=MAX_OBSTACLE_BOXES)] = Field(default_factory=list)
    points: Annotated[list[Position], Field(max_length=MAX_OBSTACLE_POINTS)] = Field(default_factory=list)
    point_radius_m: Annotated[float, Field(ge=0, le=1)] = 0.005


class GraspConstraints(Selection):
    """What a best grasp is chosen by, as far as it fits a query string.

    All constraints are in ``frame``: world if ``object_pose`` is given, else object.

    ``objective``: the density; ``success_probability``, which ranks by the lower end of its interval; or
    ``robust``, the mean of ``robust_of`` (by default the success probability where attempts tell it, else the
    density) under noise. ``pose_noise_*`` is noise of the object's pose about the centre of its bounding box
    and acts on the left; ``tool_noise_*`` is the tool's own and acts on the right. Deviations per axis.

    ``include`` limits which scores of a grasp are computed. Without it the success probability comes along
    where the objective needs it or the selection has few enough attempts to give it at once.

    ``prior``: whether an object with geometry and no success yet may answer from its edges, by the density
    that proposals of strategy ``edges`` are drawn from; each such grasp is marked ``prior``. By default it
    does where a gripper is known; true says what is missing where it can't, false leaves it at
    ``no_successes``.
    """

    count: Annotated[int, Field(ge=1, le=1_000)] = 1
    objective: Objective = "density"
    robust_of: Averaged | None = None
    pose_noise_m: NoiseM | None = None
    pose_noise_deg: NoiseDeg | None = None
    tool_noise_m: NoiseM | None = None
    tool_noise_deg: NoiseDeg | None = None
    include: list[LikelihoodColumn] | None = None
    prior: bool | None = None
    box_min: Position | None = None
    box_max: Position | None = None
    sphere: Vector4 | None = None
    above_plane: Vector4 | None = None
    approach: Direction | None = None
    approach_cone_deg: Angle | None = None
    closing: Direction | None = None
    closing_cone_deg: Angle | None = None
    collision_free: bool | None = None
    pregrasp_distance_m: Annotated[float, Field(gt=0, le=2.0)] | None = None
    max_width_m: Annotated[float, Field(gt=0, le=2.0)] | None = None
    object_pose: ObjectPose | None = None
    frame: Literal["world", "object"] | None = None
    min_separation_m: Annotated[float, Field(gt=0, le=10)] | None = None
    min_separation_deg: Angle | None = None


class BestGraspRequest(GraspConstraints):
    """The constrained maximum (figure 2).

    ``half_spaces``: rows nx, ny, nz, d that keep n.x >= d at the tool's origin. ``candidates``: only these
    poses are ranked, as they are; a grasp's ``candidate`` is its place among them. ``exclude``: no grasp
    within both separations of one of these.
    """

    half_spaces: Annotated[list[Vector4], Field(max_length=MAX_HALF_SPACES)] | None = None
    obstacles: Obstacles | None = None
    candidates: Annotated[list[Pose], Field(min_length=1, max_length=MAX_CANDIDATES)] | PoseColumns | None = (
        None
    )
    exclude: Annotated[list[Pose], Field(max_length=MAX_EXCLUDED)] | PoseColumns | None = None


class WorldPose(Response):
    position: Triple
    quaternion_xyzw: Quadruple


class Grasp(Response):
    """A grasp in the object frame, and in the world's where the object's pose was given.

    ``score`` is what it was ranked by. ``width_m`` is the jaw's opening once both fingers touch the object,
    null where geometry or gripper is unknown or nothing is between the fingers. ``prior``: chosen by the
    object's edges before any success; its density is that of the edges.
    """

    position: Triple
    quaternion_xyzw: Quadruple
    world: WorldPose | None = None
    score: float | None = None
    density: float
    log_density: float
    relative: float
    success_probability: float | None = None
    interval: Interval | None = None
    effective_trials: float | None = None
    collision_free: bool | None = None
    prior: bool = False
    candidate: int | None = None
    width_m: float | None = None
    nearest_trials: list[int] = Field(default_factory=list)
    active_constraints: list[str] = Field(default_factory=list)


class Ranking(Response):
    """What grasps were ranked by; ``score`` in words, noise as it was taken into account."""

    objective: Objective
    score: str
    robust_of: Averaged | None = None
    pose_noise: str | None = None
    tool_noise: str | None = None


class BestGrasps(Response):
    """``fewer``: less than ``count`` distinct grasps exist; ``infeasible``: none within any kernel's reach,
    and ``nearest`` is the best grasp that ignores the constraints' region but lies closest to it."""

    status: Literal["ok", "fewer", "infeasible", "no_successes"]
    grasps: list[Grasp]
    nearest: Grasp | None = None
    ranking: Ranking | None = None
    revision: int
    kernel: KernelInfo


class SamplesRequest(Selection):
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] | None = None


class Samples(Response):
    """Poses drawn from a density, in columns; sent back with the trial, ``proposal_density`` weights it."""

    revision: int
    kernel: KernelInfo
    seed: int
    position: list[Triple]
    quaternion_xyzw: list[Quadruple]
    proposal_density: list[float]


Strategy = Literal["density", "uncertainty", "edges"]


class ProposalsRequest(SamplesRequest):
    """Grasps to try next. ``density``: where successes lie. ``uncertainty``: where one more trial teaches
    most. ``edges``: where the jaw can close on opposed surfaces or edges, before anything is known."""

    strategy: Strategy = "density"


class Proposals(Samples):
    """Poses to try, in columns; ``criterion`` says how they were drawn."""

    strategy: Strategy
    criterion: str


# -- in query strings, and beside poses that are read as arrays


def _listed(value: Any) -> Any:
    """``include=density,relative`` and ``include=density&include=relative`` mean the same."""
    if isinstance(value, list):
        return [
            part.strip() for item in value for part in (item.split(",") if isinstance(item, str) else [item])
        ]
    return value


class LikelihoodQuery(SelectionQuery):
    """One pose in a query string."""

    position: Position
    quaternion_xyzw: Quaternion
    include: Annotated[list[LikelihoodColumn] | None, BeforeValidator(_listed)] = None


class BestGraspQuery(GraspConstraints):
    """The best grasp's constraints in a query string."""

    kernel: Slug | None = None
    include: Annotated[list[LikelihoodColumn] | None, BeforeValidator(_listed)] = None


class LikelihoodOptions(Selection):
    """A likelihood request without its poses, which are read as arrays."""

    include: list[LikelihoodColumn] | None = None
