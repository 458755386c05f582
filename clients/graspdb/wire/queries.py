"""Questions to a density and their answers: likelihood, best grasp, samples."""

from __future__ import annotations

import math
import re
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from graspdb.wire.base import (
    MANY,
    AskedPosition,
    AskedPositions,
    AskedRotation,
    AskedRotations,
    Ball,
    ChosenGripper,
    ChosenProtocol,
    ChosenSource,
    Direction,
    GripperRef,
    GripperVersions,
    IntervalLevel,
    ObjectId,
    OutcomeCounts,
    Plane,
    Pose,
    Position,
    Quadruple,
    Quaternion,
    Request,
    Response,
    Revision,
    Slug,
    Source,
    SourceWeights,
    Triple,
    Vector7,
    Warnings,
    _split_commas,
    _unit,
)
from graspdb.wire.cells.beliefs import PoseBelief, central
from graspdb.wire.cells.robots import MAX_JOINTS, GraspJoints, JointNumber, RobotReach
from graspdb.wire.frames.asking import (
    ASKED_FRAME,
    AskedConvention,
    AskedFrame,
    AskedNear,
    ToldConvention,
    ToldFrame,
    ToolToFrame,
)
from graspdb.wire.frames.gripper_frames import RESERVED, TOOL, FrameName
from graspdb.wire.support import (
    CalibrationInfo,
    EstimatorInfo,
    ReachInfo,
    SelectionInfo,
    Support,
    SupportColumns,
    SymmetryInfo,
)
from graspdb.wire.trials import Finding

WidthM = Annotated[float, Field(ge=1e-5, le=1.0)]
WidthDeg = Annotated[float, Field(ge=0.1, le=90.0)]
Angle = Annotated[float, Field(gt=0, le=180.0)]
NoiseM = Annotated[float, Field(ge=0, le=1.0)]
NoiseDeg = Annotated[float, Field(ge=0, le=60.0)]
Extent = Annotated[float, Field(ge=1e-6, le=1_000.0)]


NamedKernel = Annotated[
    Slug | None,
    Field(
        description="The density's kernel: ``isotropic``, ``anisotropic`` (the newest fitted for object and"
        " gripper) or a stored kernel's id; by default isotropic."
    ),
]
EstimatorField = Annotated[
    EstimatorInfo | None, Field(description="Who estimated the answer; null from services that do not say.")
]
ReachField = Annotated[
    ReachInfo | None,
    Field(
        description="How far from an attempt success probabilities are told; null before any attempt, and"
        " where none was asked for."
    ),
]
CalibratedFor = Annotated[
    Literal["robot", "human", "import"] | None,
    Field(
        description="Source of real trials that success probabilities of simulated ones are corrected for, as"
        " the sources report tells; simulated trials alone are then selected; by default none."
    ),
]
CalibrationField = Annotated[
    CalibrationInfo | None,
    Field(description="How success probabilities were corrected; null unless ``calibrated_for`` asks."),
]
Symmetry = Annotated[
    Literal["off", "auto"] | None,
    Field(
        description="``auto``: an attempt tells of every pose that a symmetry of the object's mesh takes its"
        " own to, in success probabilities and their support; 409 where outcomes contradict that. By default"
        " ``off``."
    ),
]
SymmetryField = Annotated[
    SymmetryInfo | None,
    Field(description="Which symmetries share attempts; null unless ``symmetry=auto`` asks."),
]
SelectionField = Annotated[
    SelectionInfo | None,
    Field(
        description="Which trials count, and what share of the density's weight came from which source; null"
        " from services that do not say."
    ),
]
PriorProbability = Annotated[
    float | None,
    Field(
        description="What is expected where no attempt is near enough, by ``estimator.prior``: what attempts"
        " at other objects with the gripper tell, or the share of successes among attempts that held"
        " something by geometry; 0 where the open gripper collides or holds nothing; null elsewhere, and"
        " where mesh or gripper are not known."
    ),
]


def _no_answer_id(name: str) -> str:
    if re.fullmatch(ANSWER_ID, name):
        raise ValueError("a name of 20 hexadecimal digits would look like an answer's id: choose another")
    return name


ANSWER_ID = r"[0-9a-f]{20}"
"""What ids of answers look like; no name of a user's does."""
AnswerName = Annotated[
    Slug | None,
    AfterValidator(lambda name: None if name is None else _no_answer_id(name)),
    Field(
        description="Keeps the answer under this name until it is deleted: the same question under the same"
        " name is answered exactly so again. By default it has no name."
    ),
]
TimeoutS = Annotated[
    float | None,
    Field(
        gt=0,
        le=3600,
        description="Answer within this time, seconds from the request on, or with 503 `deadline`, which"
        " tells what was reached; by default within the service's `max_question_seconds`, which is the most.",
    ),
]
AnswerId = Annotated[
    str | None,
    Field(
        description="Id of this answer: `GET /answers/{id}` gives it again exactly, and a trial may name it."
        " Null where it is not kept: of more than 1,000 poses or 4 MiB, and while the database can't be"
        " written."
    ),
]
Stale = Annotated[
    bool,
    Field(
        description="Whether the database did not answer, so that this is from what the service had read"
        " before, of this `revision`: what came since is not in it, and it is not kept."
    ),
]
NewerRevision = Annotated[
    int | None,
    Field(
        description="Revision of the object now, where it is newer than the one that this answer was kept of"
        " under a name: today's trials may answer otherwise. Null elsewhere."
    ),
]


class KernelSpec(Request):
    """A kernel by its widths."""

    kind: Literal["isotropic"] = "isotropic"
    """The kernel's kind: alike in all directions."""
    sigma_position_m: WidthM | None = None
    """Standard deviation of position along each axis, metres; by default chosen from the trials."""
    sigma_rotation_deg: WidthDeg | None = None
    """Standard deviation of rotation about each axis, degrees; by default chosen from the trials."""
    cutoff: Annotated[float, Field(ge=2.0, le=20.0)] | None = None
    """Distance in standard deviations beyond which a kernel is taken as zero; null for none, which is
    exact."""


class TrialSelection(Request):
    """Which trials a question is about."""

    gripper: GripperRef | None = None
    """Only trials with this gripper, of any of its versions or one (``panda@1``), and those that name none;
    by default the one gripper they name. The profile is that of the version, by default the newest."""
    protocol: Slug | None = None
    """Only trials judged by this protocol, and those that name none; by default the one they name."""
    source: Source | None = None
    """Only trials from this source; by default from all."""
    source_weight: SourceWeights | None = None
    """How much trials of each source count, relative to the largest of these, as in
    ``robot:1,simulation:0.2``: so many times as much in the density, and as so much of an attempt in success
    probabilities; 0 leaves a source out. A source that is not named counts 1; by default all do."""


class Selection(TrialSelection):
    """Which trials a density is built from, and with which kernel."""

    kernel: KernelSpec | Slug | None = None
    """The density's kernel: its widths, ``isotropic``, ``anisotropic`` (the newest fitted for object and
    gripper) or a stored kernel's id; by default isotropic."""
    sigma_position_m: WidthM | None = None
    """Standard deviation of the isotropic kernel along each axis, metres; by default chosen from the
    trials."""
    sigma_rotation_deg: WidthDeg | None = None
    """Standard deviation of the isotropic kernel about each axis, degrees; by default chosen from the
    trials."""


class SelectionQuery(Selection):
    """A selection in a query string, where a kernel is a name with widths beside it."""

    kernel: NamedKernel = None


class DensityQuery(SelectionQuery):
    """A selection whose density is asked for."""

    timeout_s: TimeoutS = None


class KernelInfo(Response):
    """The kernel that answered."""

    kind: str
    """What it is: ``isotropic``, or a stored kernel's kind."""
    sigma_position_m: float
    """Standard deviation along each axis, metres; of a stored kernel that of the isotropic one with equal
    determinant."""
    sigma_rotation_deg: float
    """Standard deviation about each axis, degrees; of a stored kernel that of the isotropic one with equal
    determinant."""
    rule: str
    """How the widths were chosen, in words."""
    id: str | None = None
    """Id of a stored kernel; null for one by its widths."""
    alignment: str | None = None
    """Whose axes a stored kernel is along; null for an isotropic one."""
    widths_m: Triple | None = None
    """Standard deviations along x, y, z of the frame of the alignment, metres; null for an isotropic one."""
    widths_deg: Triple | None = None
    """Standard deviations about x, y, z of the gripper's frame, degrees; null for an isotropic one."""


class WeightsInfo(Response):
    """How successes were weighted to undo how poses were chosen (eq 1)."""

    kind: Literal["equal", "mixture", "own", "balance"]
    """Before what was tried several times weighs by its share of successes: ``equal``; ``mixture``:
    1 / sum n_k g_k(x) over grids of different regions or steps; ``own``: 1 / g of each trial's own proposal
    density; ``balance``, where sources are mixed, or grids and other trials: 1 / sum n_s g_s(x) over all that
    tried, g_s estimated from where the attempts lie where it is not told."""
    rule: str
    """The same in words, with numbers."""
    poses_tried: int | None = None
    """How many distinct poses the grids tried, collisions included; null without grids."""
    without_proposal_density: int = 0
    """How many successes no grid tried and no proposal density came with."""


class DensityInfo(Response):
    """A density and what it is made of."""

    object: ObjectId
    revision: Revision
    epoch: int
    """Revision of the object's last change that was not an append of trials."""
    gripper: ChosenGripper
    gripper_versions: GripperVersions = Field(default_factory=list)
    protocol: ChosenProtocol
    source: ChosenSource
    kernel: KernelInfo
    """The kernel about every success, and the rule that chose its widths."""
    size: int
    """How many successes shape the density, those in few of several attempts included; twins by the jaw's
    symmetry are implicit and not counted."""
    outcomes: OutcomeCounts
    effective_sample_size: float
    """How many successes of equal weight would tell as much."""
    weights: WeightsInfo | None = None
    """How successes were weighted; null where there are none."""
    selection: SelectionField = None
    unit: str = "1/(m^3 rad^3)"
    """Unit of every density that is answered."""
    bytes: int
    """Memory that the density takes in the service, bytes."""
    warnings: Warnings = Field(default_factory=list)
    findings: list[Finding] = Field(default_factory=list)
    """What was doubtful about the selected trials when they came, over all batches."""
    estimator: EstimatorField = None
    stale: Stale = False


class PoseColumns(Request):
    """Poses in columns of equal length."""

    position: Annotated[list[Position], Field(min_length=1), MANY]
    """Origins of the tool frame in the object frame, one x, y, z a pose, metres."""
    quaternion_xyzw: Annotated[list[Quaternion], Field(min_length=1), MANY]
    """Rotations of the tool frame in the object frame, one unit quaternion x, y, z, w a pose."""

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
    "support",
    "prior_success_probability",
]


_Columns = Annotated[list[LikelihoodColumn], Field(max_length=20)]
IncludedColumns = Annotated[_Columns | None, Field(description="Columns to compute; by default all of them.")]
IncludedScores = Annotated[
    _Columns | None,
    Field(
        description="Scores of a grasp to compute; by default all, the success probability where the"
        " objective needs it or the selection has few enough attempts to give it at once."
    ),
]


class LikelihoodRequest(Selection):
    """Poses to say the likelihood of."""

    poses: Annotated[list[Pose], Field(min_length=1), MANY] | PoseColumns
    """Poses of the tool frame, or of ``frame``, in the object frame, in a list or in columns; 1 to
    1,000,000."""
    frame: AskedFrame = None
    convention: AskedConvention = None
    include: IncludedColumns = None
    pre_opening_m: PreOpeningField = None
    name: AnswerName = None
    calibrated_for: CalibratedFor = None
    symmetry: Symmetry = None
    timeout_s: TimeoutS = None


class Intervals(Response):
    """Intervals of the success probability, in columns."""

    level: IntervalLevel
    low: list[float | None]
    """Lower ends, one a pose; null where the probability is."""
    high: list[float | None]
    """Upper ends, one a pose; null where the probability is."""


class Interval(Response):
    """The interval of a success probability."""

    level: IntervalLevel
    low: float
    """Lower end, a probability from 0 to 1."""
    high: float
    """Upper end, a probability from 0 to 1."""


class Likelihoods(Response):
    """Columns in the poses' order; one that was not asked for is null.

    Success probability and interval are null where ``support.enough`` is false.
    """

    revision: Revision
    kernel: KernelInfo
    """The kernel of the density that answered."""
    density: list[float] | None = None
    """Density of successes at each pose, 1/(m^3 rad^3); null if not asked for."""
    log_density: list[float | None] | None = None
    """Natural logarithm of the density in 1/(m^3 rad^3); null for that of an exact zero, or if not asked
    for."""
    relative: list[float] | None = None
    """Density over its global maximum, so that 1 is the best grasp there is; null if not asked for."""
    success_probability: list[float | None] | None = None
    """How likely each grasp holds, 0 to 1; null where attempts do not tell."""
    interval: Intervals | None = None
    """Intervals of the success probability; null if not asked for."""
    effective_trials: list[float] | None = None
    """How many attempts the success probability rests on, weighted by nearness; null if not asked for."""
    collision_free: list[bool | None] | None = None
    """Whether the open gripper clears the object's mesh, or its convex parts where it has no mesh; null until
    mesh and gripper are known."""
    opening_m: list[float] | None = None
    """Opening to command at each pose, metres, at which collisions were tested; null without
    ``pre_opening_m``, and where mesh or gripper are not known."""
    support: SupportColumns | None = None
    """How far every pose is from what was tried; null if not asked for."""
    prior_success_probability: list[float | None] | None = None
    """What geometry alone tells where no attempt is near enough, as a grasp's; null if not asked for."""
    frame: ToldFrame = TOOL
    convention: ToldConvention = "graspdb"
    tool_to_frame: ToolToFrame = None
    reach: ReachField = None
    estimator: EstimatorField = None
    warnings: Warnings = Field(default_factory=list)
    answer: AnswerId = None
    newer_revision: NewerRevision = None
    stale: Stale = False
    calibration: CalibrationField = None
    symmetry: SymmetryField = None
    selection: SelectionField = None


def pose_vector(value: Any) -> Any:
    """A pose, by seven numbers or its fields, as x, y, z, qx, qy, qz, qw."""
    if isinstance(value, dict):
        pose = Pose.model_validate(value)
        return (*pose.position, *pose.quaternion_xyzw)
    value = _split_commas(value)
    if isinstance(value, (list, tuple)) and len(value) == 7:
        try:
            numbers = [float(x) for x in value]
        except (TypeError, ValueError, OverflowError):
            return value
        return (*numbers[:3], *_unit(tuple(numbers[3:])))
    return value


ObjectPose = Annotated[Vector7, BeforeValidator(pose_vector)]
"""The object frame in the world frame: x, y, z, qx, qy, qz, qw (a pose's object is accepted too)."""


Reference = Literal["world", "object"]
"""What constraints are in; the world is whatever frame ``object_pose`` is in, such as the robot's base."""


def _pre_opening(value: Any) -> Any:
    """An opening or ``auto``, of a query string, too: one message says what it may be."""
    if value is None or value == "auto":
        return value
    try:
        opening = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        opening = math.nan
    if not 1e-4 <= opening <= 2.0:
        raise ValueError("an opening from 0.0001 to 2, in metres, or auto")
    return opening


PreOpening = Annotated[float, Field(ge=1e-4, le=2.0)] | Literal["auto"] | None
"""How far open a jaw is when it comes to a grasp: metres, ``auto``, or None for wide open."""
PreOpeningField = Annotated[
    PreOpening,
    BeforeValidator(_pre_opening),
    Field(
        description="How far open the jaw comes to a grasp, metres: collisions are tested at that opening; or"
        " `auto`: each grasp as far open as what is between the fingers needs, and 5 mm beside either of"
        " them; where the wide-open jaw collides, at the least opening at which it does not. By default wide"
        " open."
    ),
]
OpeningM = Annotated[
    float | None,
    Field(
        description="Opening to command before the approach, metres: the one that collisions were tested at;"
        " null where no gripper is known, and without collision test for `auto`."
    ),
]

Objective = Literal["density", "success_probability", "robust"]
Averaged = Literal["density", "success_probability"]

MAX_HALF_SPACES = 200
MAX_OBSTACLE_BOXES = 200
MAX_OBSTACLE_POINTS = 50_000
MAX_CANDIDATES = 10_000
MAX_EXCLUDED = 1_000


_FRAME_OR_REFERENCE = (
    ASKED_FRAME + " ``world`` and ``object`` are taken as the ``reference``, which they were called before."
)


class ObstacleBox(Pose):
    """A box that the gripper must not touch."""

    size_m: tuple[Extent, Extent, Extent]
    """Edge lengths along the box's own x, y, z, metres."""
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)
    """Rotation of the box in the ``reference`` frame: a unit quaternion x, y, z, w."""


class Obstacles(Request):
    """What else stands around."""

    boxes: Annotated[list[ObstacleBox], Field(max_length=MAX_OBSTACLE_BOXES)] = Field(default_factory=list)
    """Boxes that the open gripper must not touch, in the ``reference`` frame."""
    points: Annotated[list[Position], Field(max_length=MAX_OBSTACLE_POINTS)] = Field(default_factory=list)
    """Points of a sensor that the open gripper must not touch, x, y, z in the ``reference`` frame, metres."""
    point_radius_m: Annotated[float, Field(ge=0, le=1)] = 0.005
    """Radius of the ball that each point stands for, metres."""


class GraspBounds(Request):
    """Where a grasp may be, and the noise that it is to withstand.

    All constraints are in ``reference``: world if ``object_pose`` is given, else object; and they are about
    the tool frame, its origin and its axes, whatever ``frame`` poses come and go in.
    """

    pose_noise_m: NoiseM | None = None
    """Standard deviation of the object's place along each axis, metres; by default none."""
    pose_noise_deg: NoiseDeg | None = None
    """Standard deviation of the object's rotation about each axis through the centre of its bounding box,
    degrees; by default none."""
    tool_noise_m: NoiseM | None = None
    """Standard deviation of the tool's place along each axis of its frame, metres; by default none."""
    tool_noise_deg: NoiseDeg | None = None
    """Standard deviation of the tool's rotation about each axis of its frame, degrees; by default none."""
    box_min: Position | None = None
    """Lower corner x,y,z of the box that the tool's origin lies in, in the ``reference`` frame, metres; by
    default none."""
    box_max: Position | None = None
    """Upper corner x,y,z of the box that the tool's origin lies in, in the ``reference`` frame, metres; by
    default none."""
    sphere: Ball | None = None
    """Centre x,y,z and radius r of the ball that the tool's origin lies in, in the ``reference`` frame,
    metres; by default none."""
    above_plane: Plane | None = None
    """nx,ny,nz,d: keeps n.x >= d at the tool's origin x, in the ``reference`` frame, d in metres; by default
    none."""
    approach: Direction | None = None
    """Direction x,y,z in the ``reference`` frame that the tool's z axis points in; by default any."""
    approach_cone_deg: Angle | None = None
    """Half angle of the cone about ``approach``, degrees; null without ``approach``, which needs it."""
    closing: Direction | None = None
    """Direction x,y,z in the ``reference`` frame that the tool's y axis points in, with either sign for a
    symmetric jaw; by default any."""
    closing_cone_deg: Angle | None = None
    """Half angle of the cone about ``closing``, degrees; null without ``closing``, which needs it."""
    collision_free: bool | None = None
    """Whether the open gripper must clear the object's mesh, or its convex parts where it has no mesh; by
    default it must where mesh and gripper are known."""
    pregrasp_distance_m: Annotated[float, Field(gt=0, le=2.0)] | None = None
    """How far back along the approach the open gripper's straight way must be free, metres; by default not at
    all."""
    max_width_m: Annotated[float, Field(gt=0, le=2.0)] | None = None
    """How far the fingers may be apart once both touch the object, metres; by default as far as the jaw
    opens."""
    object_pose: ObjectPose | None = None
    """Pose of the object in the world frame: x,y,z in metres and a unit quaternion x,y,z,w; null if not
    known, then there is no world. It is that of the object frame, which is its mesh's, or of
    ``object_frame``."""
    object_frame: FrameName | None = None
    """Frame of the object that ``object_pose`` is of: one of its ``frames`` by name, such as a tracker's; by
    default that of its mesh."""
    reference: Reference | None = None
    """What constraints, candidates and ``near`` are in: the world, which is whatever frame ``object_pose`` is
    in (the robot's base, say), or the object frame; by default the world if ``object_pose`` is given."""


class GraspConstraints(GraspBounds, Selection):
    """What a best grasp is chosen by, as far as it fits a query string.

    All constraints are in ``reference``: world if ``object_pose`` is given, else object; and they are about
    the tool frame, its origin and its axes, whatever ``frame`` poses come and go in.
    """

    count: Annotated[int, Field(ge=1, le=1_000)] = 1
    """How many distinct grasps to answer at most."""
    objective: Objective = "density"
    """What is best: the ``density``; ``success_probability``, by the lower end of its interval; or
    ``robust``, the mean of ``robust_of`` under noise."""
    robust_of: Averaged | None = None
    """What ``robust`` is the mean of; by default the success probability where attempts tell it, else the
    density."""
    include: IncludedScores = None
    prior: bool | None = None
    """Whether an object with geometry and no success yet may answer from its edges, each grasp marked
    ``prior``. By default it does where a gripper is known; true says what is missing where it can't, false
    leaves it at ``no_successes``."""
    pre_opening_m: PreOpeningField = None
    min_success_probability: Annotated[float, Field(ge=0, le=1)] | None = None
    """Least success probability; a grasp too far from every attempt to have one fails it; by default none."""
    min_effective_trials: Annotated[float, Field(ge=0, le=1e12)] | None = None
    """Fewest effective trials that the success probability rests on, with the nearest attempt within the
    estimator's reach; by default none."""
    frame: Annotated[FrameName | None, Field(description=_FRAME_OR_REFERENCE)] = None
    convention: AskedConvention = None
    near: Quaternion | None = None
    """Unit quaternion x,y,z,w: of the two grasps that are one for a symmetric jaw the answer gives the one
    whose rotation, of ``frame`` in ``reference``, is nearer to this; null for either."""
    min_separation_m: Annotated[float, Field(gt=0, le=10)] | None = None
    """Grasps are distinct from this distance of their origins on, metres; by default 0.01."""
    min_separation_deg: Angle | None = None
    """Grasps are distinct from this angle between them on, degrees; by default 20."""
    name: AnswerName = None
    calibrated_for: CalibratedFor = None
    symmetry: Symmetry = None
    timeout_s: TimeoutS = None

    @property
    def pose_frame(self) -> str | None:
        """The frame of the gripper that poses are of; None for the tool's."""
        return None if self.frame in RESERVED else self.frame

    @property
    def in_world(self) -> bool:
        """Whether constraints are in the world, which takes the object's pose in it."""
        said = self.frame if self.reference is None and self.frame in RESERVED else self.reference
        return said == "world" if said is not None else self.object_pose is not None


class PostedBounds(GraspBounds):
    """Bounds that take a body."""

    half_spaces: Annotated[list[Plane], Field(max_length=MAX_HALF_SPACES)] | None = None
    """Rows nx, ny, nz, d that keep n.x >= d at the tool's origin x, in the ``reference`` frame, d in metres;
    by default none."""
    obstacles: Obstacles | None = None
    """What else the open gripper must not touch, in the ``reference`` frame; null for nothing."""


class BestGraspRequest(PostedBounds, GraspConstraints):
    """The constrained maximum (figure 2)."""

    candidates: Annotated[list[Pose], Field(min_length=1, max_length=MAX_CANDIDATES)] | PoseColumns | None = (
        None
    )
    """Only these poses, of ``frame`` in ``reference``, are ranked, as they are; a grasp's ``candidate`` is
    its place among them; null for any pose."""
    exclude: Annotated[list[Pose], Field(max_length=MAX_EXCLUDED)] | PoseColumns | None = None
    """No grasp within both separations of one of these poses, of ``frame`` in ``reference``; null for
    none."""
    scene: Slug | None = None
    """Id of a stored scene, in the world: what else the gripper, and the robot's links, must not touch; null
    for none. Needs ``object_pose``."""
    robot: Slug | None = None
    """Id of a stored robot: only grasps that its arm can take, on a straight approach where
    ``pregrasp_distance_m`` is given, and lifted where ``lift_m`` is, without a collision; null for any. Needs
    ``object_pose`` and a gripper. Of a symmetric jaw's twins the answer has the one that the joints take."""
    robot_base_pose: ObjectPose | None = None
    """Pose of the robot's root link in the world: x, y, z in metres and a unit quaternion x, y, z, w; null
    for the world's own frame."""
    joints_now: Annotated[list[JointNumber], Field(max_length=MAX_JOINTS)] | None = None
    """Where the robot's joints are, in its order, radians and metres: of grasps and joint values that are
    equally good the nearest are chosen; null if not known."""
    lift_m: Annotated[float, Field(gt=0, le=2.0)] | None = None
    """How far the arm must lift the grasped object straight up, along the world's z, metres; null for not at
    all."""
    object_belief: PoseBelief | None = None
    """Where the object may be beside ``object_pose``: the grasp of the highest mean over that, by the
    objective ``robust``. ``object_pose`` takes it as well, as ``{mean, covariance}`` or ``{poses, weights}``;
    of poses that in their midst then stands for it. Null where the pose is taken as exact."""

    @model_validator(mode="before")
    @classmethod
    def _believed(cls, data: Any) -> Any:
        """``object_pose`` with what is believed of it, as the two that it is."""
        given = data.get("object_pose") if isinstance(data, dict) else None
        if not isinstance(given, dict) or not {"mean", "covariance", "poses", "weights"} & set(given):
            return data
        if data.get("object_belief") is not None:
            raise ValueError("object_pose says what is believed of it: leave object_belief out")
        belief = {name: value for name, value in given.items() if name != "mean"}
        poses, mean = given.get("poses"), given.get("mean")
        if poses is not None and isinstance(poses, list):
            belief["poses"] = [pose_vector(pose) for pose in poses]
            known = PoseBelief.model_validate(belief)
            assert known.poses is not None
            mean = known.poses[central(known.poses, known.weights)]
        if mean is None:
            raise ValueError("object_pose with a covariance needs its mean")
        settled = {"object_pose": mean, "object_belief": belief}
        return {"objective": "robust", **data, **settled}


class WorldPose(Response):
    """The pose of a grasp in the world frame."""

    position: Triple
    """Origin of the tool frame, or of the ``frame`` that was asked for, in the world: x, y, z, metres."""
    quaternion_xyzw: Quadruple
    """Rotation of the tool frame, or of the ``frame`` that was asked for, in the world: unit quaternion x, y,
    z, w."""


class Grasp(Response):
    """A grasp in the object frame, and in the world's where the object's pose was given."""

    position: AskedPosition
    quaternion_xyzw: AskedRotation
    world: WorldPose | None = None
    """The same grasp in the world frame; null unless the object's pose was given."""
    score: float | None = None
    """What it was ranked by, as ``ranking`` says; null where nothing was ranked."""
    density: float
    """Density of successes there, 1/(m^3 rad^3); of a ``prior`` grasp that of the edges."""
    log_density: float
    """Natural logarithm of the density in 1/(m^3 rad^3)."""
    relative: float
    """Density over its global maximum, so that 1 is the best grasp there is."""
    success_probability: float | None = None
    """How likely it holds, 0 to 1; null where attempts do not tell, or it was not asked for."""
    interval: Interval | None = None
    """Interval of the success probability; null where that is."""
    effective_trials: float | None = None
    """How many attempts the success probability rests on, weighted by nearness; null where it was not asked
    for."""
    support: Support | None = None
    """How far the grasp is from what was tried; null where no chance was asked for."""
    prior_success_probability: PriorProbability = None
    collision_free: bool | None = None
    """Whether the open gripper clears the object's mesh, or its convex parts where it has no mesh; null until
    mesh and gripper are known."""
    prior: bool = False
    """Whether it was chosen by the object's edges, before any success."""
    candidate: int | None = None
    """Its place among the candidates, from 0; null where none were given."""
    width_m: float | None = None
    """Distance between the fingers once both touch the object, metres; null where geometry or gripper are
    unknown or nothing is between the fingers."""
    opening_m: OpeningM = None
    nearest_trials: list[int] = Field(default_factory=list)
    """The trials nearest to it, by their ``seq``."""
    active_constraints: list[str] = Field(default_factory=list)
    """The constraints that hold it where it is: relax one to do better."""
    joints: GraspJoints | None = None
    """Joint values by which the robot takes it; null where no robot was named."""
    joint_margin: float | None = None
    """Least distance of a joint to its limit, all the way from pregrasp to lift, radians or metres; null
    where no robot was named, and without limits."""
    manipulability: float | None = None
    """Yoshikawa's measure at the grasp, sqrt(det(J J^T)) in metres cubed of an arm whose joints turn, 0 where
    it is singular; null where no robot was named."""


class Ranking(Response):
    """What grasps were ranked by."""

    objective: Objective
    """The objective that was asked for."""
    score: str
    """What ``score`` is, in words."""
    robust_of: Averaged | None = None
    """What ``robust`` was the mean of; null for other objectives."""
    pose_noise: str | None = None
    """Noise of the object's pose as it was taken into account, in words; null for none."""
    tool_noise: str | None = None
    """Noise of the tool as it was taken into account, in words; null for none."""


class BestGrasps(Response):
    """The best distinct grasps within constraints."""

    status: Literal["ok", "fewer", "infeasible", "no_successes"]
    """``ok``; ``fewer``: less than ``count`` distinct grasps exist; ``infeasible``: none within any kernel's
    reach; or ``no_successes``."""
    grasps: list[Grasp]
    """The grasps in the object frame, best first."""
    nearest: Grasp | None = None
    """Where infeasible, the best grasp in the object frame that ignores the constraints' region but lies
    closest to it; else null."""
    conflict: list[str] = Field(default_factory=list)
    """Where infeasible, the fewest constraints found that exclude each other within reach of what was tried,
    by their fields; one alone excludes all that was tried."""
    relax: dict[str, bool | float | list[float]] = Field(default_factory=dict)
    """Where infeasible, a value for each of these that would do, all other constraints as they are; without
    those that no such value was found for."""
    ranking: Ranking | None = None
    """What the grasps were ranked by; null where there was nothing to rank."""
    frame: ToldFrame = TOOL
    convention: ToldConvention = "graspdb"
    tool_to_frame: ToolToFrame = None
    reference: Reference = "object"
    """What the constraints were in, and ``near``: the object frame, or the world; ``position`` and
    ``quaternion_xyzw`` of a grasp are in the object frame whatever this is."""
    revision: Revision
    kernel: KernelInfo
    """The kernel of the density that answered."""
    reach: RobotReach | ReachField = None
    """How far from an attempt success probabilities are told, null before any attempt and where none was
    asked for; where infeasible by the robot, why its arm takes none of the grasps."""
    estimator: EstimatorField = None
    warnings: Warnings = Field(default_factory=list)
    answer: AnswerId = None
    newer_revision: NewerRevision = None
    stale: Stale = False
    calibration: CalibrationField = None
    symmetry: SymmetryField = None
    selection: SelectionField = None


class SamplesRequest(Selection):
    """Poses to draw from a density."""

    count: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """How many poses to draw."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] | None = None
    """The same seed and revision give the same poses; by default a new one."""
    frame: AskedFrame = None
    convention: AskedConvention = None
    near: AskedNear = None
    name: AnswerName = None
    symmetry: Symmetry = None
    timeout_s: TimeoutS = None


class Samples(Response):
    """Poses drawn from a density, in columns."""

    revision: Revision
    kernel: KernelInfo
    """The kernel of the density that they were drawn from."""
    seed: int
    """The seed that draws the same poses again."""
    position: AskedPositions
    quaternion_xyzw: AskedRotations
    frame: ToldFrame = TOOL
    convention: ToldConvention = "graspdb"
    tool_to_frame: ToolToFrame = None
    proposal_density: list[float]
    """Density that each pose was drawn with, 1/(m^3 rad^3); sent back with the trial, it weights it."""
    support: SupportColumns | None = None
    """How far every draw is from what was tried; null before any attempt, and where there are too many
    attempts to read at once."""
    prior: bool = False
    """Whether geometry drew them, no trial."""
    warnings: Warnings = Field(default_factory=list)
    answer: AnswerId = None
    newer_revision: NewerRevision = None
    stale: Stale = False
    symmetry: SymmetryField = None
    selection: SelectionField = None


Strategy = Literal["density", "uncertainty", "edges", "expected_improvement"]


class ProposalsRequest(SamplesRequest, PostedBounds):
    """Grasps to try next; bounds and noise are those of the best grasp that ``expected_improvement`` is
    about, the other strategies refuse them.
    """

    strategy: Strategy = "density"
    """``density``: where successes lie; ``uncertainty``: where one more trial teaches most; ``edges``: where
    the jaw can close on opposed surfaces or edges, before anything is known; ``expected_improvement``: where
    trials are expected to raise the success probability of the best grasp within bounds most."""
    pre_opening_m: PreOpeningField = None


class Proposals(Samples):
    """Poses to try, in columns."""

    strategy: Strategy
    """The strategy that was asked for."""
    criterion: str
    """How they were drawn, in words."""
    opening_m: list[float] | None = None
    """How far open the jaw comes to each pose, metres: the opening to command; null without
    ``pre_opening_m``."""
    expected_gain: list[float] | None = None
    """By how much the success probability of the best grasp is expected to rise, 0 to 1, were that of the
    grasp which each pose is drawn about known, besides those chosen before it; null for other strategies than
    ``expected_improvement``."""


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
    """Origin of the tool frame, or of ``frame``, in the object frame: x,y,z in metres."""
    quaternion_xyzw: Quaternion
    """Rotation of the tool frame, or of ``frame``, in the object frame: a unit quaternion x,y,z,w."""
    frame: AskedFrame = None
    convention: AskedConvention = None
    include: Annotated[IncludedColumns, BeforeValidator(_listed)] = None
    pre_opening_m: PreOpeningField = None
    name: AnswerName = None
    calibrated_for: CalibratedFor = None
    symmetry: Symmetry = None
    timeout_s: TimeoutS = None


class PictureQuery(TrialSelection):
    """A picture of an object; with a pose, also of the gripper there."""

    position: Position | None = None
    """Origin of the tool frame, or of ``frame``, in the object frame: x,y,z in metres; null without a
    gripper."""
    quaternion_xyzw: Quaternion | None = None
    """Rotation of the tool frame, or of ``frame``, in the object frame: a unit quaternion x,y,z,w; null
    without a gripper."""
    frame: AskedFrame = None
    convention: AskedConvention = None
    opening_m: Annotated[float, Field(ge=0, le=2)] | None = None
    """How far open the jaw is, metres; by default closed as far as the object lets it, and wide open where
    nothing is between the fingers or they collide."""
    width: Annotated[int, Field(ge=16, le=1_280)] = 480
    """Width of the picture in pixels."""
    height: Annotated[int, Field(ge=16, le=960)] = 360
    """Height of the picture in pixels."""
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Where it is seen from, degrees about the object's z axis from its x axis; by default from where the
    fingers are seen best, of an object alone from -55."""
    elevation_deg: Annotated[float, Field(ge=-85, le=85)] | None = None
    """Where it is seen from, degrees above the object's x-y plane; by default from where the fingers are seen
    best, of an object alone from 24."""
    timeout_s: TimeoutS = None

    @model_validator(mode="after")
    def _one_grasp(self) -> PictureQuery:
        if (self.position is None) != (self.quaternion_xyzw is None):
            raise ValueError("a grasp is a position and a quaternion_xyzw: give both, or neither")
        of_grasp = {"frame": self.frame, "convention": self.convention, "opening_m": self.opening_m}
        said = [name for name, value in of_grasp.items() if value is not None]
        if self.position is None and said:
            raise ValueError(f"{said[0]} is of a grasp: give its position and quaternion_xyzw")
        return self


class BestGraspQuery(GraspConstraints):
    """The best grasp's constraints in a query string."""

    kernel: NamedKernel = None
    include: Annotated[IncludedScores, BeforeValidator(_listed)] = None


class LikelihoodOptions(Selection):
    """A likelihood request without its poses, which are read as arrays."""

    frame: AskedFrame = None
    convention: AskedConvention = None
    include: IncludedColumns = None
    pre_opening_m: PreOpeningField = None
    name: AnswerName = None
    calibrated_for: CalibratedFor = None
    symmetry: Symmetry = None
    timeout_s: TimeoutS = None


# -- answers that are kept

AnswerKind = Literal["best-grasp", "likelihood", "samples", "proposals"]


class AnswerInfo(Response):
    """An answer that is kept: what it was about."""

    answer: str
    """Id of the answer."""
    names: list[str] = Field(default_factory=list)
    """Names that it was given, by which it is found, too."""
    object: ObjectId
    kind: AnswerKind
    """What was asked: the last part of the request's path."""
    revision: Revision
    object_revision: int
    """Revision of the object now: where it is newer, the same question may be answered otherwise."""
    gripper: ChosenGripper = None
    protocol: ChosenProtocol = None
    source: ChosenSource = None
    version: str
    """Version of the service that answered."""
    trials: int
    """How many trials name it as the answer that they tried; it can't be deleted then."""
    created_at: datetime
    """When it was first given, UTC."""
    asked_at: datetime
    """When it was last given, UTC, to the minute."""


class Answer(AnswerInfo):
    """An answer that is kept: the question, and the answer exactly as it was given."""

    question: dict[str, Any]
    """The question, as `POST /objects/{id}/{kind}` takes it, the seed that was drawn included."""
    kernel: KernelInfo
    """The kernel of the density that answered."""
    estimator: EstimatorField = None
    result: dict[str, Any]
    """The answer as it was given, whatever became of the object's trials since."""
