"""What questions have in common: which trials they are about, and what a best grasp has to fulfil."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from graspdb import wire
from graspdb.options import Corners, Option, PoseFile, Vector
from graspdb.poses import as_poses, as_vector7, pose_frame, pose_trials, vector
from graspdb.resources.pages import validate
from graspdb.wire.frames.gripper_frames import RESERVED

Kernel = wire.KernelSpec | Mapping[str, Any] | str


class TrialSelection(TypedDict, total=False):
    """Which trials a question is about: only those of a ``gripper``, ``protocol`` or ``source``.

    The first two are needed where an object's trials have several. A trial that names no gripper or protocol
    fits every selection.
    """

    gripper: Annotated[str | None, Option("Only trials with this gripper.")]
    protocol: Annotated[str | None, Option("Only trials with this protocol.")]
    source: Annotated[str | None, Option("Only trials from: simulation, robot, human, import.")]


SourceWeight = Annotated[
    Mapping[str, float] | str | None,
    Option("How much trials of each source count, as in robot:1,simulation:0.2; 0 leaves one out."),
]


class Selection(TrialSelection, total=False):
    """Which trials a density is built from (:class:`TrialSelection`), and with which kernel.

    ``source_weight`` is how much trials of each source count, ``{"robot": 1, "simulation": 0.2}``, relative
    to the largest: so many times as much in the density, as so much of an attempt in success probabilities.
    0 leaves a source out; one that is not named counts 1.

    ``kernel`` is ``isotropic`` (the default), ``anisotropic`` (the newest one fitted for this object and
    gripper), a stored kernel's id, or ``{"kind": "isotropic", "sigma_position_m": ..., "cutoff": ...}``.
    ``sigma_position_m`` and ``sigma_rotation_deg`` are the isotropic kernel's standard deviations per axis;
    by default chosen from the trials.
    """

    source_weight: SourceWeight
    kernel: Annotated[Kernel | None, Option("isotropic, anisotropic, or a stored kernel's id.")]
    sigma_position_m: Annotated[float | None, Option("Kernel width in position, metres.")]
    sigma_rotation_deg: Annotated[float | None, Option("Kernel width in rotation, degrees.")]


class PoseFrame(TypedDict, total=False):
    """What poses are of, those that are given and those that are answered.

    ``frame`` is a frame of the gripper by its name: ``base``, ``flange`` or another of its profile's
    ``frames``, by default ``tool``. ``convention`` says along which of their axes they approach and
    close: ``acronym`` and ``graspgen`` z and x, ``graspnet`` x and y, ``vgn`` z and y; ``graspdb`` (the
    default) and ``moveit`` are the frame's own axes.
    Grasps and samples that came in another frame say so themselves where they are given back.
    """

    frame: Annotated[str | None, Option("Frame of the gripper that poses are of: tool, base, flange, ...")]
    convention: Annotated[
        str | None, Option("Whose axes poses have: graspdb, acronym, graspgen, graspnet, vgn, moveit.")
    ]


class AnswerFrame(PoseFrame, total=False):
    """What answered poses are of (:class:`PoseFrame`).

    ``near`` is a unit quaternion (4,): of the two poses that are one grasp for a symmetric jaw the answer has
    the one whose rotation, of ``frame`` in the object frame, is nearer to it.
    """

    near: Annotated[
        ArrayLike | None, Vector("Of a symmetric jaw's two twins that nearer to this turn.", of="qx,qy,qz,qw")
    ]


Symmetry = Annotated[
    str | None,
    Option("auto: attempts tell of where the mesh's symmetries take them, too; by default off."),
]


class DrawSelection(Selection, AnswerFrame, total=False):
    """A :class:`Selection` to draw from, and what the draws are of (:class:`AnswerFrame`); ``symmetry`` as in
    :class:`Constraints`, of their support and of what is uncertain.
    """

    symmetry: Symmetry


def answer_frame(frame: str | None, convention: str | None, near: ArrayLike | None) -> dict[str, str]:
    """What answered poses are to be of, as the parameters of a request that has no body."""
    found = pose_frame(None, frame, convention)
    return found if near is None else found | {"near": ",".join(map(repr, near_of(near)))}


def near_of(near: ArrayLike) -> list[float]:
    """The rotation that twins are chosen by, as requests take it."""
    return vector("near", near, "qx, qy, qz, qw")


CalibratedFor = Annotated[
    str | None,
    Option("Correct simulated success probabilities for these real trials: robot, human or import."),
]


PreOpening = Annotated[
    float | str | None,
    Option("How far open the jaw comes: metres, or auto, what each grasp needs and 5 mm beside a finger."),
]


class LikelihoodSelection(Selection, PoseFrame, total=False):
    """A :class:`Selection`, what the poses are of (:class:`PoseFrame`), and ``calibrated_for``: the source
    of real trials (``robot``, ``human``, ``import``) that success probabilities of simulated trials, which
    are then selected, are corrected for.

    ``pre_opening_m``: how far open the jaw comes, as in :class:`Constraints`; ``opening_m`` of the answer
    tells it. ``symmetry``: ``auto`` shares attempts by the mesh's symmetries, as there.
    """

    calibrated_for: CalibratedFor
    symmetry: Symmetry
    pre_opening_m: PreOpening


class Bounds(TypedDict, total=False):
    """Where a best grasp may be, and the noise that it is to withstand, as in :class:`Constraints`."""

    pose_noise_m: Annotated[float | None, Option("Noise of the object's place, per axis.")]
    pose_noise_deg: Annotated[float | None, Option("... of its turn, about its centre.")]
    tool_noise_m: Annotated[float | None, Option("Noise of the tool's place, per axis.")]
    tool_noise_deg: Annotated[float | None, Option("... of its turn.")]
    box: Annotated[
        tuple[ArrayLike, ArrayLike] | None,
        Corners("Lower corner of the workspace.", upper_help="Upper corner of the workspace."),
    ]
    sphere: Annotated[ArrayLike | None, Vector("Centre and radius.", of="x,y,z,r")]
    above_plane: Annotated[ArrayLike | None, Vector("Keep n.x >= d.", of="nx,ny,nz,d")]
    half_spaces: ArrayLike | None
    approach: Annotated[ArrayLike | None, Vector("Approach direction (tool z).")]
    approach_cone_deg: Annotated[float | None, Option("Half angle about --approach.")]
    closing: Annotated[ArrayLike | None, Vector("Closing direction (tool y).")]
    closing_cone_deg: Annotated[float | None, Option("Half angle about --closing.")]
    collision_free: Annotated[
        bool | None, Option("Whether the gripper must clear the object.", "--collision-free/--any")
    ]
    obstacles: wire.Obstacles | Mapping[str, Any] | None
    pregrasp_distance_m: Annotated[float | None, Option("The straight approach is free from this far back.")]
    max_width_m: Annotated[float | None, Option("Fingers at most this far apart.")]
    object_pose: Annotated[ArrayLike | Any | None, Vector("The object in the world.", of="x,y,z,qx,qy,qz,qw")]
    object_frame: Annotated[str | None, Option("The object's frame that --object-pose is of.")]
    reference: Annotated[str | None, Option("What the constraints are in: world or object.")]


class Constraints(Selection, Bounds, total=False):
    """What a best grasp is chosen by, besides the :class:`Selection`.

    All constraints are in ``reference``: the world if ``object_pose`` is given (which is whatever frame that
    is in, such as the robot's base), else the object's frame. They are about the tool, whatever ``frame`` is.

    - ``objective``: ``density`` (the default), ``success_probability`` (ranks by the lower end of its
      interval), or ``robust``: the mean success probability, or density (``robust_of``), under noise.
    - ``pose_noise_m``, ``pose_noise_deg``, ``tool_noise_m``, ``tool_noise_deg``: that noise, deviations per
      axis: of the object's pose about its bounding box's centre (on the left), of the tool's (on the right).
    - ``box``: lower and upper corner (3,) of where the tool's origin may be, metres.
    - ``sphere``: ``x, y, z, r``: the tool's origin is within ``r`` metres of the centre.
    - ``above_plane``: ``nx, ny, nz, d``: n.x >= d at the tool's origin; ``half_spaces``: more such, (K, 4).
    - ``approach``, ``approach_cone_deg``: direction (3,) of the tool's z axis, its cone's half angle.
    - ``closing``, ``closing_cone_deg``: the same for the tool's y axis, in which the fingers close.
    - ``collision_free``: the gripper does not touch the object before it closes; true where it can be known.
    - ``obstacles``: ``boxes`` (each ``size_m`` and a pose), ``points`` (K, 3) and their ``point_radius_m``:
      what the open gripper must not touch either.
    - ``pregrasp_distance_m``: the straight approach is free from this far back.
    - ``pre_opening_m``: how far open the jaw comes to a grasp, metres, or ``auto``: as far as what is between
      the fingers needs, and 5 mm beside either of them, though the wide-open jaw may collide. Collisions are
      tested so, and ``grasp.opening_m`` is what to command; by default wide open.
    - ``max_width_m``: how far apart the fingers are at most, once both touch the object.
    - ``min_success_probability``, ``min_effective_trials``: how likely a grasp is at least, and from how many
      effective trials; one too far from every attempt for a success probability fails either.
    - ``calibrated_for``: the source of real trials, such as ``robot``, that success probabilities of
      simulated trials, which are then selected, are corrected for; ``calibration`` says whether that helped.
    - ``symmetry``: ``auto`` has an attempt tell of every pose that a symmetry of the object's mesh takes its
      own to; ``symmetry`` of the answer says which were found, `Conflict` that outcomes contradict them.
    - ``candidates``: rank these poses, (N, 4, 4) or (N, 7), as they are; ``grasp.candidate`` is its place.
      Of grasps and samples the gripper and protocol go along where none is named.
    - ``exclude``: poses to stay away from, by the separation; as candidates, of ``frame`` in ``reference``.
    - ``object_pose``: the object in the world: (4, 4) or ``x y z qx qy qz qw``; of its mesh's frame, or of
      ``object_frame``, one of the object's ``frames``. Where it is not known exactly ``{"mean": ...,
      "covariance": (6, 6)}``, translation first, about the object's origin along the world's axes, or
      ``{"poses": [...], "weights": [...]}`` of at most 64: the best grasp on average over that (``robust``).
    - ``reference``: ``world`` or ``object``; ``frame="world"`` and ``"object"`` mean the same.
    - ``frame``, ``convention``: what poses are of, as in :class:`PoseFrame`: the grasps, too.
    - ``near``: unit quaternion (4,): of the two grasps that are one for a symmetric jaw the one whose
      rotation, of ``frame`` in ``reference``, is nearer to it.
    - ``min_separation_m``, ``min_separation_deg``: how far apart, in either, two grasps count as distinct.
    - ``include``: scores to compute, as in `GraspObject.likelihood`. By default the success probability comes
      along where the objective needs it or there are at most 500,000 attempts.
    - ``name``: keeps the answer under this name: the same question is answered exactly so again, until it is
      deleted (``db.answers``).
    - ``timeout_s``: answer within this time, or DeadlineExceeded.
    - ``robot``: id of a stored robot (``db.robots``): only grasps that its arm can take, on the straight
      approach of ``pregrasp_distance_m`` and lifted by ``lift_m``, metres, without a collision;
      ``grasp.joints`` says how. ``robot_base_pose`` is its root in the world, by default the world's frame;
      ``joints_now`` (n,) are where its joints are: of equally good ones the nearest are chosen.
    - ``scene``: id of a stored scene (``db.scenes``), in the world: what else must not be touched.
    - ``prior``: whether an object with geometry and no success yet may answer from its edges; such grasps
      have ``grasp.prior``. By default it does where a gripper is known; True says what is missing where it
      can't.
    """

    calibrated_for: CalibratedFor
    symmetry: Symmetry
    objective: Annotated[
        str | None, Option("density, success_probability (its interval's lower end) or robust.")
    ]
    robust_of: Annotated[str | None, Option("What robust averages: success_probability or density.")]
    pre_opening_m: PreOpening
    min_success_probability: Annotated[float | None, Option("At least so likely to succeed.")]
    min_effective_trials: Annotated[float | None, Option("... from at least so many effective trials.")]
    candidates: Annotated[
        ArrayLike | Any | None, PoseFile("Rank these poses: a file as `likelihood` reads it.")
    ]
    exclude: Annotated[ArrayLike | Any | None, PoseFile("Stay away from these poses: a file.")]
    frame: Annotated[str | None, Option("Frame of the gripper that poses are of: tool, base, flange, ...")]
    convention: Annotated[
        str | None, Option("Whose axes poses have: graspdb, acronym, graspgen, graspnet, vgn, moveit.")
    ]
    near: Annotated[
        ArrayLike | None, Vector("Of a symmetric jaw's two twins that nearer to this turn.", of="qx,qy,qz,qw")
    ]
    scene: Annotated[str | None, Option("A stored scene that must not be touched.")]
    robot: Annotated[str | None, Option("Only what this stored robot's arm can take.")]
    robot_base_pose: Annotated[
        ArrayLike | Any | None, Vector("The robot's root in the world.", of="x,y,z,qx,qy,qz,qw")
    ]
    joints_now: ArrayLike | None
    lift_m: Annotated[float | None, Option("The arm lifts the grasp straight up so far.")]
    include: Sequence[str] | None
    min_separation_m: Annotated[float | None, Option("Distinct from this distance on.")]
    min_separation_deg: Annotated[float | None, Option("Distinct from this angle on.")]
    name: Annotated[str | None, Option("Keep the answer under this name.")]
    timeout_s: Annotated[float | None, Option("Answer within so many seconds.")]
    prior: Annotated[bool | None, Option("Before any success: whether to choose by the edges.")]


class ProposalSelection(DrawSelection, Bounds, total=False):
    """A :class:`DrawSelection`, and the :class:`Bounds` of the best grasp that ``expected_improvement`` is
    about.
    """


def query(selection: Mapping[str, Any]) -> dict[str, Any]:
    """A selection as a query string takes it: the kernel a name, its widths beside it.

    ValueError for widths given twice, or a cut-off, which only questions about poses take.
    """
    fields = dict(selection)
    if isinstance(fields.get("source_weight"), Mapping):
        fields["source_weight"] = ",".join(f"{name}:{x}" for name, x in fields["source_weight"].items())
    if fields.get("kernel") is None or isinstance(fields["kernel"], str):
        return fields
    kernel = fields.pop("kernel")
    spec = validate(wire.KernelSpec, kernel) if isinstance(kernel, Mapping) else kernel
    if spec.cutoff is not None:
        raise ValueError("a cutoff is for questions about poses: leave it out of the kernel here")
    for name in ("sigma_position_m", "sigma_rotation_deg"):
        value = getattr(spec, name)
        if value is not None and fields.get(name) is not None:
            raise ValueError(f"{name} is given twice: in the kernel and beside it")
        fields[name] = fields.get(name) if value is None else value
    return fields | {"kernel": spec.kind}


def best_grasp_request(count: int, given: Mapping[str, Any]) -> wire.BestGraspRequest:
    """The request for ``count`` grasps within :class:`Constraints`; an error names every wrong field."""
    fields = bounded({name: value for name, value in given.items() if value is not None}) | {"count": count}
    if "near" in fields:
        fields["near"] = near_of(fields["near"])
    for name in ("candidates", "exclude"):
        if name in fields:
            asked = None if fields.get("frame") in RESERVED else fields.get("frame")
            fields |= pose_frame(fields[name], asked, fields.get("convention"))
            fields |= pose_trials(fields[name], fields) if name == "candidates" else {}
            fields[name] = as_poses(fields[name]).columns()
    if "robot_base_pose" in fields and not isinstance(fields["robot_base_pose"], dict):
        fields["robot_base_pose"] = as_vector7(fields["robot_base_pose"], "robot_base_pose")
    if "joints_now" in fields:
        fields["joints_now"] = np.asarray(fields["joints_now"], dtype=np.float64).ravel().tolist()
    if "include" in fields:
        fields["include"] = names(fields["include"])
    return validate(wire.BestGraspRequest, fields)


def bounded(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields with the :class:`Bounds` among them as a request takes these."""
    fields = dict(fields)
    box = fields.pop("box", None)
    if box is not None:
        if len(box) != 2:
            raise ValueError("box is a pair: its lower and its upper corner, each x, y, z")
        fields["box_min"] = vector("box's lower corner", box[0], "x, y, z")
        fields["box_max"] = vector("box's upper corner", box[1], "x, y, z")
    for name, of in (
        ("sphere", "x, y, z, r"),
        ("above_plane", "nx, ny, nz, d"),
        ("approach", "x, y, z"),
        ("closing", "x, y, z"),
    ):
        if name in fields:
            fields[name] = vector(name, fields[name], of)
    if "half_spaces" in fields:
        fields["half_spaces"] = _rows("half_spaces", fields["half_spaces"], "nx, ny, nz, d")
    obstacles = fields.get("obstacles")
    if isinstance(obstacles, Mapping) and "points" in obstacles:
        fields["obstacles"] = {**obstacles, "points": _rows("points", obstacles["points"], "x, y, z")}
    believed = fields.get("object_pose")
    if isinstance(believed, Mapping) and {"mean", "poses"} & set(believed):
        fields["object_pose"] = _belief(believed)
    elif "object_pose" in fields and not isinstance(believed, dict):
        fields["object_pose"] = as_vector7(believed, "object_pose")
    return fields


def _belief(given: Mapping[str, Any]) -> dict[str, Any]:
    """Where an object is believed to be, its poses and numbers as requests take them."""
    fields = dict(given)
    if fields.get("mean") is not None:
        fields["mean"] = as_vector7(fields["mean"], "object_pose")
    if fields.get("poses") is not None:
        fields["poses"] = [as_vector7(pose, "object_pose") for pose in fields["poses"]]
    for name in ("covariance", "weights"):
        if fields.get(name) is not None:
            fields[name] = np.asarray(fields[name], dtype=np.float64).tolist()
    return fields


def names(given: Sequence[str] | str) -> list[str]:
    """Names as a list; one may stand alone."""
    return [given] if isinstance(given, str) else list(given)


def _rows(name: str, values: ArrayLike, of: str) -> list[list[float]]:
    array, count = np.asarray(values, dtype=np.float64), of.count(",") + 1
    array = array[None] if array.ndim == 1 and array.size else array
    if array.size and (array.ndim != 2 or array.shape[1] != count):
        raise ValueError(f"{name} has shape {array.shape}; expected rows of {count} numbers: {of}")
    rows: list[list[float]] = array.reshape(-1, count).tolist()
    return rows
