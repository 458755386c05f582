"""Reports: tolerance around a success, whether there are enough trials, whether numbers can be believed.

Each is declared here once, in `REPORTS`: what it answers, by which options, with which model. Routes, runs,
the SDK and the command line follow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import BeforeValidator, Field

from graspdb.wire.base import (
    ChosenGripper,
    ChosenProtocol,
    ChosenSource,
    Direction,
    GripperRef,
    GripperVersions,
    IntervalLevel,
    ObjectId,
    OneGripperVersion,
    OutcomeCounts,
    Request,
    Response,
    Revision,
    Slug,
    ToolPosition,
    ToolRotation,
    Triple,
    Warnings,
)
from graspdb.wire.kernels import Alignment
from graspdb.wire.queries import KernelInfo, SelectionQuery, TrialSelection, WidthDeg, WidthM
from graspdb.wire.states import AnyRunState
from graspdb.wire.support import EstimatorInfo

ReportName = Literal[
    "convergence",
    "anisotropy",
    "calibration",
    "projection",
    "bandwidth",
    "kernel-similarity",
    "sources",
    "promises",
    "engines",
]
REPORT_NAMES: tuple[ReportName, ...] = get_args(ReportName)
Method = Literal["empirical", "density"]
Matching = Literal["determinants", "likelihood", "success"]


class Report(Response):
    """What every report says first.

    A kind of report declares the ``question`` that it answers, and the model of the options it is asked by.
    """

    question: ClassVar[str]
    options: ClassVar[type[Request]]
    report: ReportName
    """Name of the report, as in its path."""
    object: ObjectId
    revision: Revision
    gripper: ChosenGripper = None
    gripper_versions: GripperVersions = Field(default_factory=list)
    protocol: ChosenProtocol = None
    source: ChosenSource = None
    text: str
    """The answer in words."""
    warnings: Warnings = Field(default_factory=list)


class ReportRange(Response):
    """A value with its interval."""

    value: float | None
    """The estimate; null where nothing can be said."""
    low: float | None
    """Lower end of its interval; null where nothing can be said."""
    high: float | None
    """Upper end of its interval; null where nothing can be said."""


class ConvergencePoint(Response):
    """How good the density is at a number of grasps."""

    grasps: int
    """How many successes the density was made of."""
    similarity: float
    """Similarity s (eq 9) of densities of as many other successes: 1 is the same."""
    deviation: float
    """Standard deviation of the similarity over bootstrap replicates."""
    log_likelihood: float
    """Held-out mean log likelihood, nats of 1/(m^3 rad^3)."""
    log_likelihood_error: float
    """Standard error of the log likelihood, nats."""


class Verdict(Response):
    """Whether there are enough grasps."""

    state: Literal["enough", "more", "borderline"]
    """``enough``, ``more`` are needed, or ``borderline``."""
    grasps: int
    """How many successes there are."""
    target: float
    """Similarity that counts as enough."""
    similarity: ReportRange
    """Similarity with all grasps there are."""
    needed: ReportRange
    """Grasps in total for the target; null values where the curve does not rise enough to say."""
    more: ReportRange
    """Grasps needed beyond what there is; null values where the curve does not rise enough to say."""
    extrapolated: bool
    """Whether the target lies beyond the curve's last point."""
    exponent: float
    """Exponent a of 1 - s ~ N^-a, by which similarity s nears 1 with N grasps."""


class ConvergenceCurve(Response):
    """Convergence under one kernel."""

    label: str
    """What the kernel is, in words, for a legend."""
    kernel: KernelInfo
    """The kernel that the densities have."""
    points: list[ConvergencePoint]
    """Similarity and likelihood at rising numbers of grasps."""
    verdict: Verdict
    """Whether there are enough grasps, by this curve."""


class ConvergenceOptions(SelectionQuery):
    """Of which trials, and under which kernel."""

    matching: Matching | None = None
    """How the isotropic kernel beside a stored one is chosen: by equal ``determinants``, equal ``likelihood``
    of left-out grasps, or equal ``success`` of simulated draws; by default by what is known."""


class ConvergenceReport(Report):
    """Have we tried enough? N counts successes; twins by the jaw's symmetry are not counted."""

    question: ClassVar[str] = (
        "Have we tried enough? Similarity and held-out likelihood against the number of successes."
    )
    options: ClassVar[type[Request]] = ConvergenceOptions
    report: Literal["convergence"] = "convergence"
    """Name of the report, as in its path."""
    level: IntervalLevel
    held_out: int
    """How many successes were left out to judge the likelihood."""
    subsets: int
    """How many ways the successes were divided."""
    replicates: int
    """How many bootstrap replicates the deviation is taken over."""
    method: str = ""
    """How the numbers were made: which bootstrap, which subsets, and what stays while trials are added."""
    curves: list[ConvergenceCurve]
    """One curve, or with a stored kernel a second of the isotropic kernel matched to it."""
    matching: Matching | None = None
    """How the isotropic kernel was matched; null without a stored kernel."""
    matched: bool | None = None
    """Whether a kernel that matches was found; null without a stored kernel."""
    ratio: ReportRange | None = None
    """Grasps that the stored kernel needs over those the isotropic one needs; null without a stored
    kernel."""


class AnisotropyHistogram(Response):
    """P(success) over two displacements, first axis first."""

    axes: tuple[str, str]
    """The two axes: x, y, z along, or rx, ry, rz about those of the frame of the alignment."""
    edges: tuple[list[float], list[float]]
    """Edges of the cells along both axes, metres (x, y, z) or radians (rx, ry, rz)."""
    slice_m: tuple[float, float] | None
    """Range of the displacement along z, metres; null where it is not cut."""
    probability: list[list[float | None]]
    """Share of trials that succeeded in each cell; null where nothing was tried."""
    low: list[list[float | None]]
    """Lower end of each cell's interval; null where nothing was tried."""
    high: list[list[float | None]]
    """Upper end of each cell's interval; null where nothing was tried."""
    count: list[list[int]]
    """How many pairs of trials fall in each cell."""


class AnisotropyTolerance(Response):
    """How far a success may be displaced along or about one axis until the chance of success falls to one
    half."""

    axis: str
    """x, y, z along, or rx, ry, rz about an axis of the frame of the alignment."""
    unit: Literal["m", "rad"]
    """Unit of every displacement here: metres or radians."""
    half_width: float | None
    """Displacement at which half of the grasps still hold, in ``unit``; null where it is not known, or the
    density's kernel hides it."""
    low: float | None
    """Lower end of its interval, in ``unit``; null where it is not known."""
    high: float | None
    """Upper end of its interval, in ``unit``; null where it is not known."""
    minus: float | None
    """The same towards the negative side, in ``unit``; null where it is not known."""
    plus: float | None
    """The same towards the positive side, in ``unit``; null where it is not known."""
    beyond: bool
    """Whether success does not fall to one half within what was tried: ``half_width`` is at least so much."""
    within: bool = False
    """Whether it has at the smallest displacement tried, which ``half_width`` then is."""
    tried: tuple[float, float] | None = None
    """The farthest displacements that a pair of trials had, the others nearly unchanged, towards minus (0 or
    less) and plus (0 or more), as far as was looked at, in ``unit``; 0 where nothing was tried that way, null
    in a report of an earlier version. ``half_width``, ``minus`` and ``plus`` do not go beyond."""
    displacement: list[float]
    """Displacements of the profile, in ``unit``."""
    probability: list[float]
    """Chance of success at each displacement."""
    profile_low: list[float]
    """Lower end of the interval at each displacement."""
    profile_high: list[float]
    """Upper end of the interval at each displacement."""
    count: list[int]
    """How many pairs of trials lie at each displacement."""

    @property
    def least(self) -> float | None:
        """The half width is at least so much, in ``unit``, where that is all that trials tell: of what lies
        beyond what was tried nothing is known. Else None.
        """
        if self.half_width is None or self.within or not self.beyond:
            return None
        return self.half_width if self.low is None else self.low

    def in_words(self) -> str:
        """The half width, mm or degrees, with its interval or as the bound that it is."""
        factor, unit = (math.degrees(1.0), "deg") if self.unit == "rad" else (1e3, "mm")
        if self.half_width is None:
            some = "too little tried" if any(self.tried or ()) else "nothing tried"
            return "hidden by the kernel" if self.within else some
        width, low, high = (factor * (value or 0.0) for value in (self.half_width, self.low, self.high))
        least = self.least
        if self.within:
            return f"less than {width:.0f} {unit}"
        if least is not None:
            least = round(factor * least)
            ends = [round(factor * at) for at in self.tried or (0.0, 0.0)]
            tried = f"to {ends[1]}" if ends[0] == -ends[1] else f"{ends[0]} to {ends[1]}"
            return f"at least {least} {unit}" + (
                f" (tried {tried})" if max(-ends[0], ends[1]) > least else ""
            )
        between = "" if self.low is None or self.high is None else f" ({low:.0f} to {high:.0f})"
        return f"{width:.0f} {unit}{between}"


class AnisotropyRelation(Response):
    """How many attempts succeeded that lay alike to a pair the jaw can close on, collisions included."""

    relation: str
    """``surfaces`` (two opposite faces), ``coplanar-edges`` (two parallel edges of one face),
    ``parallel-edges`` (two that point apart), or ``none`` (at no pair)."""
    angle_deg: tuple[float, float] | None
    """Range of the angle between the closing axis and the way from one side of the pair to the other,
    degrees; null at no pair."""
    attempts: int
    """How many attempts lay so."""
    collisions: int
    """How many of them collided."""
    successes: int
    """How many of them succeeded."""
    probability: float | None
    """Share that succeeded; null where nothing was tried."""
    low: float | None
    """Lower end of its interval; null where nothing was tried."""
    high: float | None
    """Upper end of its interval; null where nothing was tried."""
    free_probability: float | None
    """Share that succeeded of those that did not collide; null where all did."""
    free_low: float | None
    """Lower end of that share's interval; null where all collided."""
    free_high: float | None
    """Upper end of that share's interval; null where all collided."""


class AnisotropyHypothesis(Response):
    """An expectation of the paper as a quotient of half widths, above 1 where it holds."""

    name: str
    """``x-wide`` and ``z-wide``: x or z over y; ``ry-wide``: turns about y over the wider of the others;
    ``alignment-sharpens``: widest over narrowest translation, aligned over the gripper's axes."""
    ratio: float | None
    """The quotient of half widths; null where nothing can be said."""
    low: float | None
    """Lower end of its interval; null where nothing can be said."""
    high: float | None
    """Upper end of its interval; null where nothing can be said."""
    verdict: Literal["confirmed", "denied", "undecided"]
    """``confirmed`` or ``denied`` where the interval excludes 1, else ``undecided``."""
    bound: Literal["lower", "upper", "both"] | None = None
    """Where a half width reaches beyond what was tried, or is less than the nearest of it, which end the
    quotient is; null elsewhere."""


class AnisotropyOptions(SelectionQuery):
    """Of which trials, by which method, along whose axes."""

    method: Method = "empirical"
    """``empirical`` counts pairs of trials; ``density`` compares the density of successes with attempts'."""
    alignment: Alignment = "gripper"
    """Whose axes translations are measured along; rotations are about the gripper's."""


class AnisotropyReport(Report):
    """What a success tells about its vicinity, by displacement in the frame of ``alignment``."""

    question: ClassVar[str] = (
        "How far off may the gripper be? Success by displacement from successes, tolerances by axis."
    )
    options: ClassVar[type[Request]] = AnisotropyOptions
    report: Literal["anisotropy"] = "anisotropy"
    """Name of the report, as in its path."""
    method: Method
    """How it was counted: by pairs of trials, or by densities."""
    alignment: str
    """Whose axes translations were measured along: ``gripper``, ``object``, ``edge`` or ``surface-pair``."""
    level: IntervalLevel
    grasps: int
    """How many successes displacements were measured from."""
    attempts: int
    """How many attempts they were measured to."""
    translation_pairs: int
    """How many pairs tell about translations."""
    rotation_pairs: int
    """How many pairs tell about rotations."""
    kernel: KernelInfo | None = None
    """Kernel of the densities; null where pairs were counted."""
    tolerances: list[AnisotropyTolerance]
    """Half widths and profiles along and about every axis."""
    translations: list[AnisotropyHistogram]
    """Chance of success over pairs of translations."""
    rotations: list[AnisotropyHistogram]
    """Chance of success over pairs of rotations."""
    aligned: int | None = None
    """How many of the grasps have axes of that alignment, the others the gripper's; null for the
    gripper's."""
    hypotheses: list[AnisotropyHypothesis] = Field(default_factory=list)
    """Whether the paper's expectations hold; none without half widths."""
    relations: list[AnisotropyRelation] = Field(default_factory=list)
    """Success by how grasps lie to surfaces and edges; none without mesh and gripper."""


class CalibrationBin(Response):
    """Predictions within ``[lower, upper)`` and how often they came true."""

    lower: float
    """Smallest prediction of the bin, a probability."""
    upper: float
    """End of the bin, a probability beyond it."""
    count: int
    """How many attempts it holds."""
    weight: float
    """Share of all attempts, by weight."""
    predicted: float | None
    """Mean prediction; null in an empty bin."""
    observed: float | None
    """Share that succeeded; null in an empty bin."""
    low: float | None
    """Lower end of the interval of ``observed``; null in an empty bin."""
    high: float | None
    """Upper end of the interval of ``observed``; null in an empty bin."""


class CheckCall(Response):
    """A request that makes what a report lacks: it has workers simulate, which no GET does."""

    method: str
    """HTTP method of the request."""
    path: str
    """Path of the request on this service."""
    body: dict[str, Any]
    """JSON body of the request."""


class CheckedGrasps(Response):
    """Grasps that were simulated again as checks, which no prediction rests on."""

    grasps: int
    """How many grasps were simulated again."""
    successes: int
    """How many of them succeeded."""
    rate: ReportRange
    """Share that succeeded, with its interval."""
    predicted: float
    """Mean prediction for them as it is now."""
    outcomes: OutcomeCounts
    bins: list[CalibrationBin] = Field(default_factory=list)
    """The same by prediction."""


class LearnedCalibration(Response):
    """Whether what an estimator learned can be believed: attempts that did not collide, predicted from those
    of other blocks of space.
    """

    estimator: EstimatorInfo
    """Who learned, and from how many attempts."""
    judged: int
    """How many attempts were left out and predicted."""
    blocks: int
    """How many blocks of space they lie in."""
    skill: ReportRange
    """Brier's skill: 1 perfect, 0 no better than the share of successes."""
    kernel_skill: float | None
    """Brier's skill of the plain kernel estimate on the same attempts; null where all fared alike."""
    ece: float | None
    """Expected calibration error over predictions above 0.1; null where there are none."""
    auc: float | None
    """Chance that a success ranks above a failure; null without both."""
    coverage: float | None
    """Share of the blocks, of those predicted between 0.05 and 0.95, whose successes the 90 % intervals and
    chance explain; null where there are no such blocks."""
    told_share: float
    """Share of the attempts within reach of an attempt of another block: elsewhere probabilities are null."""
    told_skill: float | None
    """Brier's skill where they are within reach; null where all fared alike."""
    untold_skill: float | None
    """Brier's skill of what is not told, where none is within reach; null where all fared alike."""
    bins: list[CalibrationBin]
    """Predictions and how often they came true."""


class CalibrationReport(Report):
    """Whether ``success_probability`` can be believed, on outcomes it has not seen (blocks left out)."""

    question: ClassVar[str] = (
        "Can success probabilities be believed? Judged on outcomes of blocks of space left out."
    )
    options: ClassVar[type[Request]] = SelectionQuery
    report: Literal["calibration"] = "calibration"
    """Name of the report, as in its path."""
    level: IntervalLevel
    kernel: KernelInfo
    """The kernel that predicts success."""
    attempts: int
    """How many attempts the selection has."""
    successes: int
    """How many of them succeeded."""
    judged: int
    """How many attempts were left out and predicted."""
    blocks: int
    """How many blocks of space were left out."""
    block_edge_m: float
    """Edge of a block of space, metres."""
    folds: int
    """In how many rounds blocks were left out."""
    collisions_known: bool
    """Whether the collision test told which attempts collide."""
    share: float
    """Share of the attempts that succeeded."""
    brier: float
    """Mean squared error of the predictions (Brier's score): 0 perfect."""
    skill: ReportRange
    """Brier's skill: 1 perfect, 0 no better than the share of successes."""
    free_skill: ReportRange | None
    """The skill over attempts that did not collide; null where that is not known."""
    ece: float | None
    """Expected calibration error over predictions above 0.1; null where there are none."""
    auc_probability: float | None
    """Chance that a success ranks above a failure by the probability; null without both."""
    auc_density: float | None
    """Chance that a success ranks above a failure by the density; null without both."""
    bins: list[CalibrationBin]
    """Predictions and how often they came true."""
    checked: CheckedGrasps | None = None
    """Grasps whose poses were given to checks, as verified best grasps are; null where there are none, a
    warning says how to make some."""
    learned: LearnedCalibration | None = None
    """What was learned and answers in place of the kernel estimate; null where nothing was, or is no
    better."""


class ProjectionProfile(Response):
    """The projected density on one axis of the plane."""

    axis: str
    """Which axis of the plane it is on."""
    at_m: list[float]
    """Coordinates along the axis, object frame, metres."""
    density_per_m: list[float]
    """Share of all grasps per metre at each coordinate."""
    low: list[float]
    """Lower end of the interval at each coordinate, per metre."""
    high: list[float]
    """Upper end of the interval at each coordinate, per metre."""


def _alone(value: Any) -> Any:
    """The text in a list of one, as a query string gives it."""
    if isinstance(value, (list, tuple)) and len(value) == 1 and isinstance(value[0], str):
        return value[0].strip()
    return value


def _axis(value: Any) -> Any:
    """``x``, ``-z`` ... for a unit vector."""
    value = _alone(value)
    text = value.strip() if isinstance(value, str) else ""
    letter = text.removeprefix("-").removeprefix("+")
    if letter not in ("x", "y", "z"):
        return value
    sign = -1.0 if text.startswith("-") else 1.0
    return [sign if letter == name else 0.0 for name in "xyz"]


Axis = Annotated[Direction, BeforeValidator(_axis)]
"""A direction, or the name of an axis such as ``-z``."""


class ProjectionOptions(SelectionQuery):
    """Of which trials, onto which plane, and of which grasps."""

    plane: Annotated[Literal["xy", "xz", "yz"] | Axis | None, BeforeValidator(_alone)] = None
    """``xy``, ``xz`` or ``yz`` of the object frame, or its normal nx,ny,nz; by default the one that shows
    most."""
    approach: Axis | None = None
    """Only grasps whose tool z points this way in the object frame: x,y,z or an axis as ``-z``; by default
    all."""
    approach_cone_deg: Annotated[float, Field(gt=0, le=180)] = 30.0
    """Half angle of the cone about ``approach``, degrees."""
    direction: Axis | None = None
    """Only grasps whose tool x, across the jaw, points this way in the object frame with either sign: x,y,z
    or an axis as ``z``; by default all."""
    direction_cone_deg: Annotated[float, Field(gt=0, le=90)] = 30.0
    """Half angle of the cone about ``direction``, degrees."""


class ProjectionReport(Report):
    """The density on a plane, depth and rotation integrated out; of grasps that point one way, or of all."""

    question: ClassVar[str] = (
        "Where do grasps succeed? The density on a plane, of all grasps or of those that point one way."
    )
    options: ClassVar[type[Request]] = ProjectionOptions
    report: Literal["projection"] = "projection"
    """Name of the report, as in its path."""
    level: IntervalLevel
    kernel: KernelInfo
    """The kernel of the density."""
    grasps: int
    """How many successes there are."""
    passing: int
    """How many of them point the way asked for."""
    share: ReportRange
    """Share of the density that points the way asked for."""
    plane: str
    """The plane: ``xy``, ``xz``, ``yz``, or by its normal."""
    normal: Triple
    """Normal of the plane, towards who looks, object frame."""
    across: Triple
    """Unit vector to the right in the picture, object frame."""
    upward: Triple
    """Unit vector upward in the picture, object frame."""
    approach: Triple | None = None
    """The way tool z points, object frame; null for any."""
    approach_cone_deg: float | None = None
    """Half angle of the cone about ``approach``, degrees; null for any."""
    direction: Triple | None = None
    """The way tool x points, across the jaw, with either sign, object frame; null for any."""
    direction_cone_deg: float | None = None
    """Half angle of the cone about ``direction``, degrees; null for any."""
    across_m: list[float]
    """Edges of the cells along ``across``, metres."""
    upward_m: list[float]
    """Edges of the cells along ``upward``, metres."""
    values: list[list[float]]
    """``values[i][j]`` over ``across_m[i]`` and ``upward_m[j]``: the density, 1 at the highest cell."""
    peak_per_m2: float
    """Density of the highest cell: share of all grasps per square metre."""
    profiles: list[ProjectionProfile]
    """The density on each of the plane's axes."""
    outline: list[list[tuple[float, float]]] = Field(default_factory=list)
    """The object's silhouette as polygons, object frame, metres: one for each convex part, or the hull of its
    mesh."""
    drawn: int = 0
    """How many grasps were drawn where it could not be computed; 0 where it was."""
    outside: int = 0
    """Successful grasps so far from all others that the picture leaves them out; a warning names them.
    ``share``, ``passing`` and the shares a metre count them."""


class BandwidthPoint(Response):
    """How likely left-out grasps are under a pair of widths."""

    sigma_position_m: float
    """Standard deviation of position along each axis, metres."""
    sigma_rotation_deg: float
    """Standard deviation of rotation about each axis, degrees."""
    log_likelihood: float | None
    """Mean log density of left-out grasps, nats of 1/(m^3 rad^3); null where it was not judged."""
    error: float | None
    """Its standard error over blocks, nats; null where it was not judged."""
    below_best: float | None
    """How far below the best pair's it is, nats; null where it was not judged."""
    below_best_error: float | None
    """Standard error of that over blocks, nats; null where it was not judged."""


class SimulatedDraws(Response):
    """What became of draws from the density under a kernel, simulated as checks; collisions apart."""

    kernel: KernelInfo
    """The kernel of the density that was drawn from."""
    protocol: str
    """How their outcomes were judged: ``wrench``, ``lift`` or ``shake``."""
    draws: int
    """How many draws were simulated."""
    outcomes: OutcomeCounts
    success: ReportRange
    """Share of all draws that succeeded."""
    collision: ReportRange
    """Share of all draws that collided."""
    free_success: ReportRange
    """Share that succeeded of those that did not collide."""


class BandwidthReport(Report):
    """Which widths the kernel should have: those left-out blocks are likeliest under. How often draws
    succeed."""

    question: ClassVar[str] = (
        "How wide should the kernel be? By left-out blocks, and by draws that were simulated as checks."
    )
    options: ClassVar[type[Request]] = TrialSelection
    report: Literal["bandwidth"] = "bandwidth"
    """Name of the report, as in its path."""
    level: IntervalLevel
    kernel: KernelInfo
    """The kernel that queries use by default."""
    rows: int
    """How many successes the widths were judged by."""
    held_out: int
    """How many of them were left out to judge."""
    grid: list[BandwidthPoint]
    """The pairs of widths that were judged."""
    recommended: KernelInfo
    """The kernel that left-out grasps are likeliest under."""
    range_m: tuple[float, float]
    """Widths in position of which the trials can't say that they are worse, metres."""
    range_deg: tuple[float, float]
    """Widths in rotation of which the trials can't say that they are worse, degrees."""
    draws: list[SimulatedDraws] = Field(default_factory=list)
    """What became of draws that were simulated as checks."""
    calls: list[CheckCall] = Field(default_factory=list)
    """Requests that would simulate the draws that lack."""


class SimilarityPoint(Response):
    """How like the full statistics a kernel of so many samples, or Gaussians, is."""

    count: int
    """How many samples, or Gaussians; those off the jaw's plane of symmetry come in pairs."""
    similarity: float
    """Bhattacharyya coefficient to the full statistics: 1 is the same."""
    error: float
    """Standard error of the similarity."""


class KernelSimilarityOptions(TrialSelection):
    """Of which trials, which displacements count, and how wide a component is."""

    window_position_m: Annotated[float, Field(ge=1e-4, le=1.0)] = 0.04
    """Largest translation along any axis that counts, metres."""
    window_rotation_deg: Annotated[float, Field(ge=0.1, le=180.0)] = 180.0
    """Largest angle of rotation that counts, degrees."""
    component_position_m: Annotated[float, Field(ge=0.001, le=0.2)] = 0.01
    """Standard deviation of a component along each axis, metres."""
    component_rotation_deg: Annotated[float, Field(ge=1.0, le=40.0)] = 10.0
    """Standard deviation of a component about each axis, degrees."""


class KernelSimilarityReport(Report):
    """Figure 13: how many samples, or Gaussians, the kernel needs to be like the statistics it comes from.

    It has a meaning only with its window and with the width of the components.
    """

    question: ClassVar[str] = (
        "How many samples, or Gaussians, does a kernel need to be like its statistics? (figure 13)"
    )
    options: ClassVar[type[Request]] = KernelSimilarityOptions
    report: Literal["kernel-similarity"] = "kernel-similarity"
    """Name of the report, as in its path."""
    level: IntervalLevel
    window_position_m: float
    """Largest translation along any axis that counts, metres."""
    window_rotation_deg: float
    """Largest angle of rotation that counts, degrees."""
    component_position_m: float
    """Standard deviation of a component along each axis, metres."""
    component_rotation_deg: float
    """Standard deviation of a component about each axis, degrees."""
    successes: int
    """How many successes the displacements lie between."""
    displacements: int
    """How many displacements lie in the window."""
    reference: int
    """How many of them stand for the full statistics."""
    samples: list[SimilarityPoint]
    """Similarity by the number of samples."""
    mixtures: list[SimilarityPoint]
    """Similarity by the number of Gaussians."""


class SourceSimilarity(Response):
    """How alike two sources' densities are under one kernel."""

    kernel: KernelInfo
    """The kernel of both densities."""
    value: float
    """Their Bhattacharyya coefficient: 1 is the same."""
    error: float
    """Standard error of the coefficient."""
    expected: ReportRange
    """What as many grasps drawn from simulation would have had: below that range, the sources differ by more
    than chance."""


class SourceMap(Response):
    """How a simulated success probability p should be corrected for a source: sigmoid(shift + slope logit p).

    Fitted to its trials within the reach of simulation's predictions, those that collide by geometry left
    out, with a prior on no correction, so that few trials change little. Trials of one spot are not
    independent: a block of space counts as ten at most, and blocks are left out whole to judge.
    """

    shift: float
    """Added to the logit; 0 changes nothing."""
    slope: float
    """What the logit is multiplied by: 1 changes nothing, 0 says that simulation tells nothing."""
    trials: int
    """How many trials it is fitted to."""
    effective_trials: float
    """As how many independent trials they count."""
    blocks: int
    """How many blocks of space they lie in."""
    judged: Literal["better", "worse", "undecided"]
    """Whether it predicts trials of left-out blocks ``better`` than the uncorrected probabilities, ``worse``,
    or it can't be told."""
    brier: float | None
    """Mean squared error on left-out blocks, corrected; null where too few trials or blocks tell."""
    uncorrected_brier: float | None
    """The same of the uncorrected probabilities; null where too few tell."""
    share_brier: float | None
    """The same of the share of successes in the other blocks alone; null where too few tell."""
    gain: ReportRange
    """By how much the corrected error is smaller, with its interval by blocks."""
    informative: bool
    """Whether the better of corrected and uncorrected predicts better than the share alone."""
    predicted: list[float]
    """Simulated probabilities that the next three are of, 0 to 1."""
    corrected: list[float]
    """Corrected probabilities of these."""
    low: list[float]
    """Lower ends of the map's own interval at these."""
    high: list[float]
    """Upper ends of the map's own interval at these."""


class SourceComparison(Response):
    """One source of real trials against simulation."""

    source: str
    """The source that is compared: ``robot``, ``human`` or ``import``."""
    protocols: list[str]
    """The protocols that its trials name."""
    trials: int
    """How many trials it has."""
    successes: int
    """How many of them succeeded."""
    outcomes: OutcomeCounts
    share: ReportRange
    """Share of its trials that succeeded."""
    predicted: float | None
    """Mean of what simulation predicts at its poses; null where it predicts nothing there."""
    predicted_at_successes: float | None
    """Mean of what simulation predicts where it succeeded; null where it predicts nothing there."""
    within_reach: int
    """How many of its trials lie where simulation predicts."""
    agreement: ReportRange | None = None
    """Share of trials where simulation says more than one half and it held, or less and it did not; null
    where the source posts successes only, or has too few."""
    confusion: dict[str, int] | None = None
    """Trials counted by (simulation, trial); null where the agreement is."""
    brier: float | None = None
    """Mean squared error of the predictions; null where the agreement is."""
    skill: ReportRange | None = None
    """Brier's skill of the predictions; null where the agreement is."""
    auc: float | None = None
    """Chance that a success ranks above a failure; null where the agreement is."""
    bins: list[CalibrationBin] = Field(default_factory=list)
    """Predictions and how often they came true."""
    correction: SourceMap | None = None
    """How a simulated probability should be corrected for this source; null where it posts successes only, or
    no trial is within reach of simulation's predictions."""
    similarity: SourceSimilarity | None = None
    """How alike its density and simulation's are; null where it has too few."""


class SourcesOptions(Request):
    """The simulated trials that predict, and the widths of their kernel."""

    source: ClassVar[Literal["simulation"]] = "simulation"
    gripper: GripperRef | None = None
    """Only trials with this gripper; by default the one that they name."""
    protocol: Slug | None = None
    """Only simulated trials judged by this protocol; by default the one that they name."""
    sigma_position_m: WidthM | None = None
    """Standard deviation of the kernel along each axis, metres; by default chosen from the trials."""
    sigma_rotation_deg: WidthDeg | None = None
    """Standard deviation of the kernel about each axis, degrees; by default chosen from the trials."""


class PromisesOptions(TrialSelection):
    """Which trials count, and from where on one is of no grasp of the answer that it names."""

    match_position_m: Annotated[float, Field(gt=0, le=1.0)] = 0.02
    """A trial commanded farther than this from every grasp of its answer tried none of them, metres."""
    match_rotation_deg: Annotated[float, Field(gt=0, le=180.0)] = 20.0
    """A trial turned farther than this from every grasp of its answer tried none of them, degrees."""


ReportOptions = TrialSelection | SourcesOptions


class SourcesReport(Report):
    """Does simulation tell what real trials find?"""

    question: ClassVar[str] = (
        "Does simulation tell what robots find? Predictions at real poses, and how alike densities are."
    )
    options: ClassVar[type[Request]] = SourcesOptions
    report: Literal["sources"] = "sources"
    """Name of the report, as in its path."""
    level: IntervalLevel
    kernel: KernelInfo
    """The kernel that predicts."""
    attempts: int
    """How many simulated attempts predict."""
    successes: int
    """How many of them succeeded."""
    simulation_outcomes: OutcomeCounts
    collisions_known: bool
    """Whether the collision test told which attempts collide."""
    sources: list[SourceComparison]
    """Every source of real trials against simulation."""


class SummaryRate(Response):
    """Successes as a share of what a rule counts as a trial."""

    rule: str
    """Name of the rule, explained under ``rules``."""
    trials: int
    """How many trials the rule counts."""
    rate: ReportRange
    """Share that succeeded, with its interval."""


class SummaryRow(Response):
    """The trials of an object with one gripper, protocol and source, by outcome."""

    object: ObjectId
    revision: Revision
    gripper: ChosenGripper
    gripper_version: OneGripperVersion = None
    protocol: ChosenProtocol
    source: ChosenSource
    outcomes: OutcomeCounts
    trials: int
    """How many trials there are, packed outcomes included."""
    successes: int
    """How many of them succeeded."""
    rates: list[SummaryRate]
    """Success rates by each way of counting."""
    doubled_successes: int
    """Successes with each one's twin under the jaw's half turn counted, too."""
    doubled_failures: int
    """Failures with each one's twin under the jaw's half turn counted, too."""


class SummaryReport(Response):
    """Every object's trials by outcome, and success rates by each way of counting (table I)."""

    report: Literal["summary"] = "summary"
    """Name of the report, as in its path."""
    text: str
    """The answer in words."""
    level: IntervalLevel
    rules: dict[str, str]
    """What each way of counting counts as a trial, in words."""
    rows: list[SummaryRow]
    """A row for every object, gripper, protocol and source."""
    warnings: Warnings = Field(default_factory=list)


class PromiseBin(Response):
    """Answers that promised about as much."""

    lower: float
    """Lower end of the promised success probability, 0 to 1."""
    upper: float
    """Upper end of the promised success probability, 0 to 1."""
    answers: int
    """How many answers promised so much and were tried."""
    trials: int
    """How many trials tried them."""
    promised: float | None
    """Mean promise over the answers, 0 to 1; null without any."""
    happened: ReportRange
    """Share of successes over the answers, each counted once, with its interval."""


class PromiseSelection(Response):
    """How much too high promises may be because only the highest were tried."""

    share_of_all: float | None
    """Share of successes among the attempts that name no answer, 0 to 1; null without any."""
    at_most: float
    """By how much the mean promise may be too high from choosing the highest of many estimates: 2.5 of their
    standard errors, as of the largest of a hundred of one truth."""
    more_than_selection: bool | None
    """Whether what happened lies below even that, so the estimates themselves promise too much; null where
    undecided."""
    came_true: ReportRange
    """Of what was promised above ``share_of_all``, the part that came true, with its interval: what a promise
    should be shrunk by towards that share; null where promises are no higher than it."""


class PromisedPrior(Response):
    """Promises of geometry or other objects, where no attempt was near enough."""

    trials: int
    """How many trials tried such grasps."""
    promised: float | None
    """Mean prior success probability, 0 to 1; null without any."""
    happened: ReportRange
    """Share of successes among these trials with its interval, as of independent ones."""


class PromisePlacement(Response):
    """How far from the commanded poses the tool was, where trials tell the achieved ones."""

    trials: int
    """How many trials tell the pose that they achieved."""
    position_m: float | None
    """Median distance of the achieved from the commanded position, metres; null without any."""
    position_p90_m: float | None
    """The distance that 9 of 10 trials stay below, metres; null without any."""
    rotation_deg: float | None
    """Median angle of the achieved from the commanded rotation, degrees; null without any."""
    rotation_p90_deg: float | None
    """The angle that 9 of 10 trials stay below, degrees; null without any."""
    position_held_m: float | None
    """Median distance where the grasp held, metres; null where none did."""
    position_failed_m: float | None
    """Median distance where the grasp failed, metres; null where none did."""
    rotation_held_deg: float | None
    """Median angle where the grasp held, degrees; null where none did."""
    rotation_failed_deg: float | None
    """Median angle where the grasp failed, degrees; null where none did."""
    commanded_probability: float | None
    """Mean success probability at the commanded poses, by today's attempts without these trials, over those
    where both it and the next are known; null without any."""
    achieved_probability: float | None
    """The same at the achieved poses: what it lies below, misplacing explains by the estimate; null without
    any."""


class PromisesReport(Report):
    """What was promised against what happened: trials that name the answer they tried.

    It speaks only of the range that was promised: what promised little was not tried.
    """

    question: ClassVar[str] = (
        "What was promised against what happened: success probabilities of answers that were tried, mindful"
        " that only promising grasps were."
    )
    options: ClassVar[type[Request]] = PromisesOptions
    report: Literal["promises"] = "promises"
    """Name of the report, as in its path."""
    level: IntervalLevel
    verdict: Literal["undecided", "as-promised", "over-promised", "under-promised"]
    """``undecided`` below 10 answers; ``as-promised`` where the interval of the difference holds 0."""
    answers_given: int
    """How many best grasps about the object are kept, whatever they selected; those that nothing keeps are
    deleted in time."""
    answers_never_tried: int
    """How many of these no trial names: nothing is known of what they promised."""
    trials: int
    """How many trials of the selection name an answer."""
    unmatched: int
    """How many of these lie farther from every grasp of their answer than the limits: they tried something
    else."""
    match_position_m: float | None
    """Median distance of the others' commanded poses from the grasp that they tried, metres; null without
    any."""
    match_rotation_deg: float | None
    """Median angle of the others' commanded poses from the grasp that they tried, degrees; null without
    any."""
    without_promise: int
    """How many tried grasps that were told by their density alone: no probability was promised."""
    prior: PromisedPrior
    """Those that geometry alone promised, which enter nothing below."""
    answers: int
    """How many answers promised a probability and were tried: each counts once, with the mean of its
    trials."""
    judged: int
    """How many trials tried these."""
    promised: ReportRange
    """Mean promise, with the least and the highest promise as its ends."""
    happened: ReportRange
    """Share of successes over the answers, with its interval."""
    difference: ReportRange
    """What happened less what was promised, with its interval; below 0 was promised too much."""
    brier: float | None
    """Mean squared error of the promises, 0 is perfect; null without any."""
    skill: ReportRange
    """Part of the squared error of always telling the share that happened which the promises spare, with its
    interval; null where all held or none did."""
    selection: PromiseSelection
    """What choosing the highest estimates explains."""
    placement: PromisePlacement
    """How far from the commanded poses the tool was, and what that explains."""
    bins: list[PromiseBin]
    """By what was promised, from 0 to 1."""


class EnginesOptions(Request):
    """Of which linked sweeps."""

    gripper: GripperRef | None = None
    """Only sweeps with this gripper; by default the one that the trials name."""
    protocol: Slug | None = None
    """Only sweeps judged by this protocol; by default the one that the trials name."""


EngineReasonName = Literal["draws", "margin", "edge", "timeout", "unexplained", "broke-off"]


class EngineReason(Response):
    """Poses that engines differ on for one reason."""

    reason: EngineReasonName
    """``draws``: of poses simulated several times, they succeed in about as many, half lying between;
    ``margin``: a quality within 0.2 of the limit; ``edge``: one missed it or lost it, far from the limit;
    ``timeout``: one did not come to an end; ``unexplained``: none of these; ``broke-off``: one could not
    simulate it, such as where a finger sank in, so that nothing is compared."""
    poses: int
    """How many poses they are."""
    share: float
    """Their share of all poses that engines differ on or that one broke off, 0 to 1."""
    text: str
    """What that means, in words."""


class EngineOutcomes(Response):
    """Poses of one pair of outcomes."""

    outcome: str
    """What the engine says whose trials are stored."""
    other_outcome: str
    """What the other says."""
    poses: int
    """Of how many poses."""


class EngineDisagreement(Response):
    """A grasp that holds in one engine only."""

    pose_index: int
    """Index of the pose in the sweeps' plan."""
    position: ToolPosition
    quaternion_xyzw: ToolRotation
    outcome: str
    """What the engine says whose trials are stored."""
    other_outcome: str
    """What the other says."""
    attempts: int | None = None
    """How often each engine simulated it; null: once."""
    successes: int | None = None
    """How many of the first's attempts succeeded; null where it was simulated once."""
    other_successes: int | None = None
    """How many of the other's attempts succeeded; null where it was simulated once."""
    quality: float | None
    """The first's margin by the protocol, without a unit; null where physics measured none."""
    other_quality: float | None
    """The other's margin; null where physics measured none."""
    width_m: float | None
    """Distance between the fingers at the end in the first, metres; null where it was not measured."""
    other_width_m: float | None
    """The same in the other, metres; null where it was not measured."""
    reason: EngineReasonName
    """Why they differ, as far as the numbers tell."""
    text: str
    """The same in words, with the numbers."""


class EnginePair(Response):
    """Two linked sweeps."""

    sweep: str
    """Id of the sweep whose trials are stored."""
    linked: str
    """Id of the sweep that compares."""
    protocol: str
    """How outcomes were judged."""
    fidelity: str
    """Time step and iterations of the physics: ``standard``, or ``fine``."""
    purpose: str
    """``collect``, or ``check``: neither enters an estimate."""
    engines: list[str]
    """What simulated the first, with versions."""
    other_engines: list[str]
    """What simulated the other, with versions."""
    poses: int
    """How many poses both have simulated and judged."""
    waiting: int
    """How many poses of the plan only one or none has simulated so far."""
    broken_off: int
    """How many one could not simulate: they are not among ``poses``."""
    agreement: ReportRange
    """Share of poses that hold in both or in neither, with its interval, as of independent ones."""
    physics: int
    """How many of the poses rest on physics: where neither collides nor is empty between the fingers by
    geometry alone, which both engines share and agree on trivially."""
    physics_agreement: ReportRange
    """The same share of these."""
    outcomes: list[EngineOutcomes]
    """How often each pair of outcomes came, the most frequent first."""
    disagreements: int
    """How many poses hold in one only."""
    reasons: list[EngineReason]
    """Why, the most frequent first."""
    first: list[EngineDisagreement]
    """The first of them by their place in the plan, of all pairs at most 100."""


class EnginesReport(Report):
    """What two physics engines say of the same poses: how often they agree, where not, and why."""

    question: ClassVar[str] = (
        "How far two physics engines agree on the same grasps of linked sweeps, on which they do not, and"
        " why."
    )
    options: ClassVar[type[Request]] = EnginesOptions
    report: Literal["engines"] = "engines"
    """Name of the report, as in its path."""
    level: IntervalLevel
    pairs: list[EnginePair]
    """Each pair of linked sweeps, in the order of their making."""


REPORTS: Mapping[str, type[Report]] = {
    model.model_fields["report"].default: model
    for model in (
        ProjectionReport,
        ConvergenceReport,
        AnisotropyReport,
        CalibrationReport,
        BandwidthReport,
        KernelSimilarityReport,
        SourcesReport,
        PromisesReport,
        EnginesReport,
    )
}


class ReportRun(Response):
    """The computation of a report, or of a kernel that is being fitted (:class:`StoredKernel` once it is)."""

    id: str
    """Id of the run."""
    object: ObjectId
    report: ReportName | Literal["kernel"]
    """Name of the report; ``kernel`` for a kernel that is being fitted."""
    revision: Revision
    parameters: dict[str, Any]
    """What the report was asked with."""
    state: AnyRunState
    """``running``, ``done``, ``failed`` or ``cancelled``."""
    progress: float
    """How far it is, from 0 to 1."""
    result: dict[str, Any] | None = None
    """The report, or the kernel; null until it is done."""
    problem: dict[str, Any] | None = None
    """The problem it failed with; null where it did not."""
    created_at: datetime
    """When it was asked for, UTC."""
    finished_at: datetime | None = None
    """When it ended, UTC; null before."""
