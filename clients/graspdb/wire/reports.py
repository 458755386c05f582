"""Reports: tolerance around a success, whether there are enough trials, whether numbers can be believed."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from graspdb.wire.base import Response
from graspdb.wire.queries import KernelInfo

ReportName = Literal["convergence", "anisotropy", "calibration"]
Method = Literal["empirical", "density"]
Matching = Literal["determinants", "likelihood", "success"]
RunState = Literal["running", "done", "failed", "cancelled"]


class Report(Response):
    """What every report says first: of which trials it is, and ``text``, its answer in words."""

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


class ConvergenceReport(Report):
    """Have we tried enough? N counts successes; twins by the jaw's symmetry are not counted.

    With a stored kernel the second curve is the isotropic kernel matched to it, and ``ratio`` the grasps it
    needs over those the isotropic one needs.
    """

    report: Literal["convergence"] = "convergence"
    level: float
    held_out: int
    subsets: int
    replicates: int
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


class AnisotropyReport(Report):
    """What a success tells about its vicinity, by displacement in the frame of ``alignment``.

    ``aligned`` of the ``grasps`` have axes of that alignment, the others the gripper's.
    """

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


class CalibrationReport(Report):
    """Whether ``success_probability`` can be believed, on outcomes it has not seen (blocks left out).

    ``skill`` is Brier's: 1 perfect, 0 no better than the share of successes. ``ece`` is over predictions
    above 0.1. ``auc_*`` is the chance that a success ranks above a failure. ``free_skill`` is the skill over
    attempts that did not collide.
    """

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


AnyReport = ConvergenceReport | AnisotropyReport | CalibrationReport
REPORTS: dict[str, type[ConvergenceReport] | type[AnisotropyReport] | type[CalibrationReport]] = {
    "convergence": ConvergenceReport,
    "anisotropy": AnisotropyReport,
    "calibration": CalibrationReport,
}


class ReportRun(Response):
    """A report's computation; ``result`` once it is done, ``problem`` where it failed."""

    id: str
    object: str
    report: ReportName
    revision: int
    parameters: dict[str, Any]
    state: RunState
    progress: float
    result: dict[str, Any] | None = None
    problem: dict[str, Any] | None = None
    created_at: datetime
    finished_at: datetime | None = None
