"""Reports: tolerance around a success, whether there are enough trials, whether numbers can be believed.

Each is declared here once, in `REPORTS`: what it answers, by which options, with which model. Routes, runs,
the SDK and the command line follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import BeforeValidator, Field

from graspdb.wire.base import Direction, Request, Response, Slug, Triple
from graspdb.wire.kernels import Alignment
from graspdb.wire.queries import KernelInfo, SelectionQuery, TrialSelection, WidthDeg, WidthM
from graspdb.wire.states import AnyRunState

ReportName = Literal[
    "convergence",
    "anisotropy",
    "calibration",
    "projection",
    "bandwidth",
    "kernel-similarity",
    "sources",
]
REPORT_NAMES: tuple[ReportName, ...] = get_args(ReportName)
Method = Literal["empirical", "density"]
Matching = Literal["determinants", "likelihood", "success"]


class Report(Response):
    """What every report says first: of which trials it is, and ``text``, its answer in words.

    A kind of report declares the ``question`` that it answers, and the model of the options it is asked by.
    """

    question: ClassVar[str]
    options: ClassVar[type[Request]]
    report: ReportName
    object: str
    revision: int
    gripper: str | None = None
    protocol: str | None = None
    source: str | None = None
    text: str
    warnings: list[str] = Field(default_factory=list)


class ReportRange(Response):
    """A value with its interval; null where nothing can be said."""

    value: float | None
    low: float | None
    high: float | None


class ConvergencePoint(Response):
    """Similarity s (eq 9) and the held-out log likelihood (nats of 1/(m^3 rad^3)) at a number of grasps.

    ``deviation`` is the standard deviation over bootstrap replicates, ``log_likelihood_error`` a standard
    error.
    """

    grasps: int
    similarity: float
    deviation: float
    log_likelihood: float
    log_likelihood_error: float


class Verdict(Response):
    """Whether there are enough grasps: ``enough``, ``more`` or ``borderline``.

    ``needed`` are grasps in total for the target, ``more`` those beyond what there is; null where the curve
    does not rise enough to say.
    """

    state: Literal["enough", "more", "borderline"]
    grasps: int
    target: float
    similarity: ReportRange
    needed: ReportRange
    more: ReportRange
    extrapolated: bool
    exponent: float


class ConvergenceCurve(Response):
    label: str
    kernel: KernelInfo
    points: list[ConvergencePoint]
    verdict: Verdict


class ConvergenceOptions(SelectionQuery):
    """``matching`` says how the isotropic kernel beside a stored one is chosen."""

    matching: Matching | None = None


class ConvergenceReport(Report):
    """Have we tried enough? N counts successes; twins by the jaw's symmetry are not counted.

    With a stored kernel the second curve is the isotropic kernel matched to it (by equal determinants, equal
    likelihood of left-out grasps, or equal success of draws that were simulated as checks), and ``ratio`` the
    grasps it needs over those the isotropic one needs. ``method`` says how the numbers were made: which
    bootstrap, which subsets, and what stays while trials are added.
    """

    question: ClassVar = (
        "Have we tried enough? Similarity and held-out likelihood against the number of successes."
    )
    options: ClassVar = ConvergenceOptions
    report: Literal["convergence"] = "convergence"
    level: float
    held_out: int
    subsets: int
    replicates: int
    method: str = ""
    curves: list[ConvergenceCurve]
    matching: Matching | None = None
    matched: bool | None = None
    ratio: ReportRange | None = None


class AnisotropyHistogram(Response):
    """P(success) over two displacements, first axis first; null where nothing was tried.

    ``edges`` in metres (x, y) or radians (rx, ry, rz); ``slice_m`` the range of z.
    """

    axes: tuple[str, str]
    edges: tuple[list[float], list[float]]
    slice_m: tuple[float, float] | None
    probability: list[list[float | None]]
    low: list[list[float | None]]
    high: list[list[float | None]]
    count: list[list[int]]


class AnisotropyTolerance(Response):
    """How far a success may be displaced along (x, y, z; metres) or about (rx, ry, rz; radians) one axis
    until the chance of success falls to one half. ``beyond``: it does not within what was looked at;
    ``within``: it has at the smallest displacement tried, and ``half_width`` is that one (null where the
    density's kernel hides it).
    """

    axis: str
    unit: Literal["m", "rad"]
    half_width: float | None
    low: float | None
    high: float | None
    minus: float | None
    plus: float | None
    beyond: bool
    within: bool = False
    displacement: list[float]
    probability: list[float]
    profile_low: list[float]
    profile_high: list[float]
    count: list[int]


class AnisotropyRelation(Response):
    """How many attempts succeeded that lay alike to a pair the jaw can close on, collisions included.

    ``relation``: ``surfaces`` (two opposite faces), ``coplanar-edges`` (two parallel edges of one face),
    ``parallel-edges`` (two that point apart), or ``none`` (at no pair). ``angle_deg`` is the range of the
    angle between the closing axis and the way from one side of the pair to the other. ``free_*`` leave out
    the attempts that collided.
    """

    relation: str
    angle_deg: tuple[float, float] | None
    attempts: int
    collisions: int
    successes: int
    probability: float | None
    low: float | None
    high: float | None
    free_probability: float | None
    free_low: float | None
    free_high: float | None


class AnisotropyHypothesis(Response):
    """An expectation of the paper as a quotient of half widths, above 1 where it holds, with its interval.

    ``x-wide`` and ``z-wide``: x or z over y; ``ry-wide``: turns about y over the wider of the others;
    ``alignment-sharpens``: widest over narrowest translation, aligned over the gripper's axes. ``bound`` says
    where a half width reaches beyond what was looked at; null values where nothing can be said.
    """

    name: str
    ratio: float | None
    low: float | None
    high: float | None
    verdict: Literal["confirmed", "denied", "undecided"]
    bound: Literal["lower", "upper", "both"] | None = None


class AnisotropyOptions(SelectionQuery):
    """``empirical`` counts pairs of trials; ``density`` compares the density of successes with attempts'."""

    method: Method = "empirical"
    alignment: Alignment = "gripper"


class AnisotropyReport(Report):
    """What a success tells about its vicinity, by displacement in the frame of ``alignment``.

    ``aligned`` of the ``grasps`` have axes of that alignment, the others the gripper's.
    """

    question: ClassVar = (
        "How far off may the gripper be? Success by displacement from successes, tolerances by axis."
    )
    options: ClassVar = AnisotropyOptions
    report: Literal["anisotropy"] = "anisotropy"
    method: Method
    alignment: str
    level: float
    grasps: int
    attempts: int
    translation_pairs: int
    rotation_pairs: int
    kernel: KernelInfo | None = None
    tolerances: list[AnisotropyTolerance]
    translations: list[AnisotropyHistogram]
    rotations: list[AnisotropyHistogram]
    aligned: int | None = None
    hypotheses: list[AnisotropyHypothesis] = Field(default_factory=list)
    relations: list[AnisotropyRelation] = Field(default_factory=list)


class CalibrationBin(Response):
    """Predictions within ``[lower, upper)`` and how often they came true; null in an empty bin."""

    lower: float
    upper: float
    count: int
    weight: float
    predicted: float | None
    observed: float | None
    low: float | None
    high: float | None


class CheckCall(Response):
    """A request that makes what a report lacks: it has workers simulate, which no GET does."""

    method: str
    path: str
    body: dict[str, Any]


class CheckedGrasps(Response):
    """Grasps that were simulated again as checks, which no prediction rests on.

    ``rate`` is the share that succeeded, ``predicted`` what the mean prediction for them is now; ``bins`` by
    prediction.
    """

    grasps: int
    successes: int
    rate: ReportRange
    predicted: float
    outcomes: dict[str, int]
    bins: list[CalibrationBin] = Field(default_factory=list)


class CalibrationReport(Report):
    """Whether ``success_probability`` can be believed, on outcomes it has not seen (blocks left out).

    ``skill`` is Brier's: 1 perfect, 0 no better than the share of successes. ``ece`` is over predictions
    above 0.1. ``auc_*`` is the chance that a success ranks above a failure. ``free_skill`` is the skill over
    attempts that did not collide. ``checked`` are grasps whose poses were given to checks, as
    best grasps are that are verified; where there are none, a warning says how to make some.
    """

    question: ClassVar = (
        "Can success probabilities be believed? Judged on outcomes of blocks of space left out."
    )
    options: ClassVar = SelectionQuery
    report: Literal["calibration"] = "calibration"
    level: float
    kernel: KernelInfo
    attempts: int
    successes: int
    judged: int
    blocks: int
    block_edge_m: float
    folds: int
    collisions_known: bool
    share: float
    brier: float
    skill: ReportRange
    free_skill: ReportRange | None
    ece: float | None
    auc_probability: float | None
    auc_density: float | None
    bins: list[CalibrationBin]
    checked: CheckedGrasps | None = None


class ProjectionProfile(Response):
    """The projected density on one axis of the plane: share of all grasps a metre, with its interval."""

    axis: str
    at_m: list[float]
    density_per_m: list[float]
    low: list[float]
    high: list[float]


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
    """The plane, ``xy``, ``xz`` or ``yz`` or its normal ``nx,ny,nz`` (none: the one that shows most), and
    which way grasps point: ``approach`` is that of tool z, ``direction`` that of tool x, across the jaw, with
    either sign; within a cone whose half angle follows.
    """

    plane: Annotated[Literal["xy", "xz", "yz"] | Axis | None, BeforeValidator(_alone)] = None
    approach: Axis | None = None
    approach_cone_deg: Annotated[float, Field(gt=0, le=180)] = 30.0
    direction: Axis | None = None
    direction_cone_deg: Annotated[float, Field(gt=0, le=90)] = 30.0


class ProjectionReport(Report):
    """The density on a plane, depth and rotation integrated out; of grasps that point a given way, or of all.

    ``values[i][j]`` over ``across_m[i]`` and ``upward_m[j]`` (edges) is 1 at the highest cell, which is
    ``peak_per_m2`` (share of all grasps a square metre). ``share`` of the density points the way asked for,
    ``passing`` of the ``grasps`` do. ``approach`` is the way tool z points, ``direction`` that of tool x,
    across the jaw, with either sign. ``outline``: the object's silhouette as polygons (metres), one for each
    convex part, or the hull of its mesh. ``drawn`` grasps were drawn where it could not be computed.
    """

    question: ClassVar = (
        "Where do grasps succeed? The density on a plane, of all grasps or of those that point one way."
    )
    options: ClassVar = ProjectionOptions
    report: Literal["projection"] = "projection"
    level: float
    kernel: KernelInfo
    grasps: int
    passing: int
    share: ReportRange
    plane: str
    normal: Triple
    across: Triple
    upward: Triple
    approach: Triple | None = None
    approach_cone_deg: float | None = None
    direction: Triple | None = None
    direction_cone_deg: float | None = None
    across_m: list[float]
    upward_m: list[float]
    values: list[list[float]]
    peak_per_m2: float
    profiles: list[ProjectionProfile]
    outline: list[list[tuple[float, float]]] = Field(default_factory=list)
    drawn: int = 0


class BandwidthPoint(Response):
    """How likely left-out grasps are under a pair of widths: mean log density, nats of 1/(m^3 rad^3), and how
    far below the best pair's it is (standard errors over blocks).
    """

    sigma_position_m: float
    sigma_rotation_deg: float
    log_likelihood: float | None
    error: float | None
    below_best: float | None
    below_best_error: float | None


class SimulatedDraws(Response):
    """What became of draws from the density under a kernel, simulated as checks; collisions apart.

    ``success`` is the share of all draws that succeeded, ``free_success`` of those that did not collide.
    """

    kernel: KernelInfo
    protocol: str
    draws: int
    outcomes: dict[str, int]
    success: ReportRange
    collision: ReportRange
    free_success: ReportRange


class BandwidthReport(Report):
    """Which widths the kernel should have: those left-out blocks are likeliest under. How often draws
    succeed.

    ``range_m`` and ``range_deg``: widths of which the trials can't say that they are worse.
    """

    question: ClassVar = (
        "How wide should the kernel be? By left-out blocks, and by draws that were simulated as checks."
    )
    options: ClassVar = TrialSelection
    report: Literal["bandwidth"] = "bandwidth"
    level: float
    kernel: KernelInfo
    rows: int
    held_out: int
    grid: list[BandwidthPoint]
    recommended: KernelInfo
    range_m: tuple[float, float]
    range_deg: tuple[float, float]
    draws: list[SimulatedDraws] = Field(default_factory=list)
    calls: list[CheckCall] = Field(default_factory=list)


class SimilarityPoint(Response):
    """Similarity (Bhattacharyya) of a kernel with so many samples, or of a mixture with so many Gaussians, to
    the full statistics, with its standard error. Gaussians off the jaw's plane of symmetry come in pairs.
    """

    count: int
    similarity: float
    error: float


class KernelSimilarityOptions(TrialSelection):
    """Which displacements count (a cube's half edge, the largest turn), and the width of a component."""

    window_position_m: Annotated[float, Field(gt=0, le=1.0)] = 0.04
    window_rotation_deg: Annotated[float, Field(gt=0, le=180.0)] = 180.0
    component_position_m: Annotated[float, Field(ge=0.001, le=0.2)] = 0.01
    component_rotation_deg: Annotated[float, Field(ge=1.0, le=40.0)] = 10.0


class KernelSimilarityReport(Report):
    """Figure 13: how many samples, or Gaussians, the kernel needs to be like the statistics it comes from.

    It has a meaning only with its window and with the width of the components. ``reference`` displacements
    stand for the full statistics.
    """

    question: ClassVar = (
        "How many samples, or Gaussians, does a kernel need to be like its statistics? (figure 13)"
    )
    options: ClassVar = KernelSimilarityOptions
    report: Literal["kernel-similarity"] = "kernel-similarity"
    level: float
    window_position_m: float
    window_rotation_deg: float
    component_position_m: float
    component_rotation_deg: float
    successes: int
    displacements: int
    reference: int
    samples: list[SimilarityPoint]
    mixtures: list[SimilarityPoint]


class SourceSimilarity(Response):
    """Similarity (Bhattacharyya) of two sources' densities under one kernel, and what as many grasps drawn
    from simulation would have had: below that range, the sources differ by more than chance.
    """

    kernel: KernelInfo
    value: float
    error: float
    expected: ReportRange


class SourceComparison(Response):
    """One source of real trials against simulation.

    ``successes`` over ``trials`` is its own share, ``predicted`` the mean of what simulation predicts at its
    poses. ``agreement`` is the share of trials where simulation says more than one half and it held, or less
    and it did not; ``confusion`` counts those by (simulation, trial). Null where the source posts successes
    only, or has too few.
    """

    source: str
    protocols: list[str]
    trials: int
    successes: int
    outcomes: dict[str, int]
    share: ReportRange
    predicted: float | None
    predicted_at_successes: float | None
    within_reach: int
    agreement: ReportRange | None = None
    confusion: dict[str, int] | None = None
    brier: float | None = None
    skill: ReportRange | None = None
    auc: float | None = None
    bins: list[CalibrationBin] = Field(default_factory=list)
    similarity: SourceSimilarity | None = None


class SourcesOptions(Request):
    """The gripper, the protocol of the simulated trials, and the widths of the kernel that predicts."""

    source: ClassVar[Literal["simulation"]] = "simulation"
    gripper: Slug | None = None
    protocol: Slug | None = None
    sigma_position_m: WidthM | None = None
    sigma_rotation_deg: WidthDeg | None = None


ReportOptions = TrialSelection | SourcesOptions


class SourcesReport(Report):
    """Does simulation tell what real trials find?"""

    question: ClassVar = (
        "Does simulation tell what robots find? Predictions at real poses, and how alike densities are."
    )
    options: ClassVar = SourcesOptions
    report: Literal["sources"] = "sources"
    level: float
    kernel: KernelInfo
    attempts: int
    successes: int
    simulation_outcomes: dict[str, int]
    collisions_known: bool
    sources: list[SourceComparison]


class SummaryRate(Response):
    """Successes as a share of what ``rule`` counts as a trial, with its interval."""

    rule: str
    trials: int
    rate: ReportRange


class SummaryRow(Response):
    """The trials of an object with one gripper, protocol and source, by outcome.

    ``doubled_*``: successes and failures with each trial's twin under the jaw's half turn counted, too.
    """

    object: str
    revision: int
    gripper: str | None
    protocol: str | None
    source: str | None
    outcomes: dict[str, int]
    trials: int
    successes: int
    rates: list[SummaryRate]
    doubled_successes: int
    doubled_failures: int


class SummaryReport(Response):
    """Every object's trials by outcome, and success rates by each way of counting (table I)."""

    report: Literal["summary"] = "summary"
    text: str
    level: float
    rules: dict[str, str]
    rows: list[SummaryRow]
    warnings: list[str] = Field(default_factory=list)


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
    )
}


class ReportRun(Response):
    """A report's computation; ``result`` once it is done, ``problem`` where it failed.

    ``kernel`` instead of a report's name: a kernel that is being fitted (:class:`StoredKernel` once it is).
    """

    id: str
    object: str
    report: ReportName | Literal["kernel"]
    revision: int
    parameters: dict[str, Any]
    state: AnyRunState
    progress: float
    result: dict[str, Any] | None = None
    problem: dict[str, Any] | None = None
    created_at: datetime
    finished_at: datetime | None = None
