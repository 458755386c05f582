"""Reports: how far a grasp may be off, whether enough was tried, whether the numbers can be believed."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Unpack

from graspdb import wire
from graspdb.figures import FILE_FORMATS, draw, render
from graspdb.figures.canvas import Figure
from graspdb.options import Option, known_keywords
from graspdb.poses import vector
from graspdb.resources.pages import Resource
from graspdb.resources.runs import RunProgress, computed
from graspdb.resources.selection import Selection, SourceWeight, TrialSelection, query
from graspdb.resources.sweeps import Sweep
from graspdb.wire.reports import REPORT_NAMES

Floats = NDArray[np.float64]
R = TypeVar("R", bound=wire.reports.Report | wire.reports.SummaryReport)
M = TypeVar("M", bound=wire.reports.Report)


class Report(Generic[R]):
    """A report; ``text`` is its answer in words and ``raw`` the whole of it."""

    def __init__(self, raw: R) -> None:
        self.raw = raw

    @property
    def text(self) -> str:
        """The answer in words."""
        return self.raw.text

    @property
    def warnings(self) -> list[str]:
        """What to mind."""
        return self.raw.warnings

    def plot(self) -> Figure:
        """The figure, as the service draws it; a notebook shows it. Needs matplotlib (extra ``plot``)."""
        return draw(self.raw)

    def save(self, path: str | Path) -> None:
        """Write the figure to a ``.png`` or ``.svg`` file."""
        suffix = Path(path).suffix.lower()
        if suffix not in FILE_FORMATS:
            raise ValueError(f"figures are .png or .svg files, not {suffix or path!r}")
        Path(path).write_bytes(render(self.raw, FILE_FORMATS[suffix]))

    @property
    def _of(self) -> str:
        raw: Any = self.raw
        return f"{type(self).__name__} of {raw.object}, revision {raw.revision}"

    def __repr__(self) -> str:
        told = "".join(f"\n  mind: {warning}" for warning in self.warnings)
        return f"<{self._of}: {self.text}{told}>"

    def _repr_html_(self) -> str:
        mind = "".join(f"<li>{html.escape(warning)}</li>" for warning in self.warnings)
        return f"<p><b>{html.escape(self._of)}</b><br>{html.escape(self.text)}</p>" + (
            f"<ul>{mind}</ul>" if mind else ""
        )


class Convergence(Report[wire.reports.ConvergenceReport]):
    """Have we tried enough? Arrays are those of the kernel asked for, by rising number of grasps."""

    @property
    def verdict(self) -> wire.reports.Verdict:
        """``enough``, ``more`` or ``borderline``, and how many more."""
        return self.raw.curves[0].verdict

    @property
    def enough(self) -> bool:
        """Whether the density would hardly change if its grasps were drawn again."""
        return self.verdict.state == "enough"

    @property
    def grasps(self) -> NDArray[np.int64]:
        """(P,) successful grasps."""
        return np.array([point.grasps for point in self.raw.curves[0].points], dtype=np.int64)

    @property
    def similarity(self) -> Floats:
        """(P,) eq 9: 1 where bootstrap replicates agree with the whole."""
        return np.array([point.similarity for point in self.raw.curves[0].points])

    @property
    def log_likelihood(self) -> Floats:
        """(P,) mean log density of held-out grasps, nats of 1/(m^3 rad^3)."""
        return np.array([point.log_likelihood for point in self.raw.curves[0].points])


class Anisotropy(Report[wire.reports.AnisotropyReport]):
    """What a success tells about its vicinity."""

    @property
    def tolerances(self) -> dict[str, wire.reports.AnisotropyTolerance]:
        """By axis: ``x``, ``y``, ``z`` in metres, ``rx``, ``ry``, ``rz`` in radians."""
        return {item.axis: item for item in self.raw.tolerances}

    @property
    def forgives(self) -> dict[str, float | None]:
        """Half width by axis, metres and radians; None where too little was tried. Where its ``beyond`` is
        set it is at least so much, for nothing was tried beyond.
        """
        return {axis: item.half_width for axis, item in self.tolerances.items()}

    @property
    def tried(self) -> dict[str, tuple[float, float]]:
        """How far trials lie apart along or about every axis, towards minus and plus, metres and radians."""
        return {axis: item.tried or (0.0, 0.0) for axis, item in self.tolerances.items()}


class Calibration(Report[wire.reports.CalibrationReport]):
    """Whether ``success_probability`` can be believed."""

    @property
    def skill(self) -> float | None:
        """Brier skill: 1 is perfect, 0 no better than the share of successes."""
        return self.raw.skill.value

    @property
    def predicted(self) -> Floats:
        """(B,) mean prediction of every bin; nan where empty."""
        return np.array([item.predicted for item in self.raw.bins], dtype=np.float64)

    @property
    def observed(self) -> Floats:
        """(B,) share that came true."""
        return np.array([item.observed for item in self.raw.bins], dtype=np.float64)


class Projection(Report[wire.reports.ProjectionReport]):
    """Where grasps succeed, on a plane."""

    @property
    def share(self) -> float | None:
        """Share of the density that points the way asked for."""
        return self.raw.share.value

    @property
    def values(self) -> Floats:
        """(n, m) density on the plane over its two axes, 1 at the highest cell."""
        return np.array(self.raw.values)

    @property
    def across_m(self) -> Floats:
        """(n + 1,) edges of the cells along the plane's first axis."""
        return np.array(self.raw.across_m)

    @property
    def upward_m(self) -> Floats:
        """(m + 1,) edges of the cells along the plane's second axis."""
        return np.array(self.raw.upward_m)


class Bandwidth(Report[wire.reports.BandwidthReport]):
    """Which widths the kernel should have."""

    @property
    def recommended(self) -> tuple[float, float]:
        """``sigma_position_m`` and ``sigma_rotation_deg``."""
        return self.raw.recommended.sigma_position_m, self.raw.recommended.sigma_rotation_deg

    @property
    def calls(self) -> list[wire.reports.CheckCall]:
        """Sweeps that would make what is missing: draws at several widths, simulated as checks."""
        return self.raw.calls


class KernelSimilarity(Report[wire.reports.KernelSimilarityReport]):
    """How many samples, or Gaussians, a kernel needs to be like the statistics it comes from (figure 13)."""

    @property
    def samples(self) -> tuple[NDArray[np.int64], Floats]:
        """(K,) numbers of samples and their similarity."""
        return _curve(self.raw.samples)

    @property
    def mixtures(self) -> tuple[NDArray[np.int64], Floats]:
        """(K,) numbers of Gaussians and their similarity."""
        return _curve(self.raw.mixtures)


class Sources(Report[wire.reports.SourcesReport]):
    """Simulation against real trials."""

    @property
    def by_source(self) -> dict[str, wire.reports.SourceComparison]:
        """``robot``, ``human`` and ``import``, those there are."""
        return {item.source: item for item in self.raw.sources}


class Promises(Report[wire.reports.PromisesReport]):
    """What answers promised against what happened."""

    @property
    def verdict(self) -> str:
        """``undecided``, ``as-promised``, ``over-promised`` or ``under-promised``."""
        return self.raw.verdict

    @property
    def difference(self) -> wire.reports.ReportRange:
        """What happened less what was promised, with its interval."""
        return self.raw.difference


class Engines(Report[wire.reports.EnginesReport]):
    """What two physics engines say of the same grasps."""

    @property
    def pairs(self) -> list[wire.reports.EnginePair]:
        """Each pair of linked sweeps: how far they agree, and the grasps that hold in one engine only."""
        return self.raw.pairs


class Summary(Report[wire.reports.SummaryReport]):
    """Every object's trials by outcome, and success rates by each way of counting."""

    @property
    def _of(self) -> str:
        return "Summary of all objects"

    def rates(self, rule: str) -> dict[str, float | None]:
        """Success rate of every row by object (with gripper, protocol and source where it has several)."""
        names = [row.object for row in self.raw.rows]
        found: dict[str, float | None] = {}
        for row in self.raw.rows:
            parts = [row.gripper, row.protocol, row.source]
            alone = names.count(row.object) == 1
            name = row.object if alone else " ".join([row.object, *(part for part in parts if part)])
            found[name] = next(item.rate.value for item in row.rates if item.rule == rule)
        return found


def _curve(points: Iterable[wire.reports.SimilarityPoint]) -> tuple[NDArray[np.int64], Floats]:
    counts, similarities = zip(*((point.count, point.similarity) for point in points), strict=True)
    return np.array(counts, dtype=np.int64), np.array(similarities, dtype=np.float64)


class Waiting(TypedDict, total=False):
    """Reports wait until they are computed; ``progress`` is called with the run meanwhile, and ``timeout_s``
    ends the wait, not the computation: asking again goes on waiting.
    """

    progress: RunProgress | None
    timeout_s: float | None


class TrialOptions(TrialSelection, Waiting, total=False):
    """Which trials a report is about."""

    source_weight: SourceWeight


class DensityOptions(Selection, Waiting, total=False):
    """Which trials a report is about, and the kernel."""


class ConvergenceOptions(DensityOptions, total=False):
    matching: Annotated[
        str | None, Option("convergence: determinants, likelihood or success, beside a stored kernel.")
    ]


class AnisotropyOptions(DensityOptions, total=False):
    method: Annotated[str | None, Option("anisotropy: empirical or density.")]
    alignment: Annotated[str | None, Option("anisotropy: gripper, object, edge or surface-pair.")]


class ProjectionOptions(DensityOptions, total=False):
    plane: Annotated[str | ArrayLike | None, Option("projection: xy, xz, yz or the plane's normal x,y,z.")]
    approach: Annotated[
        str | ArrayLike | None,
        Option("projection: only grasps whose tool z points along x,y,z (or -z ...)."),
    ]
    approach_cone_deg: Annotated[float | None, Option("projection: half angle, 30 by default.")]
    direction: Annotated[
        str | ArrayLike | None,
        Option("projection: only grasps whose tool x lies along x,y,z (or z ...)."),
    ]
    direction_cone_deg: Annotated[float | None, Option("projection: half angle, 30 by default.")]


class KernelSimilarityOptions(TrialOptions, total=False):
    window_position_m: Annotated[float | None, Option("kernel-similarity: half edge of the window.")]
    window_rotation_deg: Annotated[float | None, Option("kernel-similarity: largest turn.")]
    component_position_m: Annotated[float | None, Option("kernel-similarity: width of a sample.")]
    component_rotation_deg: Annotated[float | None, Option("kernel-similarity: width of a sample.")]


class PromisesOptions(TrialOptions, total=False):
    match_position_m: Annotated[float | None, Option("promises: trials farther off tried another grasp.")]
    match_rotation_deg: Annotated[float | None, Option("promises: trials turned farther tried another.")]


class SourcesOptions(Waiting, total=False):
    gripper: str | None
    protocol: str | None
    sigma_position_m: float | None
    sigma_rotation_deg: float | None


class EnginesOptions(Waiting, total=False):
    gripper: str | None
    protocol: str | None


class Reports(Resource):
    """``mug.reports``. They take the selection of trials, most of them the kernel, too: see
    :class:`Selection`; and how to wait for them: see :class:`Waiting`.
    """

    def convergence(self, **options: Unpack[ConvergenceOptions]) -> Convergence:
        """Whether there are enough successful grasps, and how many more it takes.

        ``matching``, with a stored kernel: how the isotropic one beside it is chosen, by ``determinants``,
        ``likelihood``, or ``success`` of draws simulated as checks. ChecksNeeded where these have not been
        simulated: :meth:`simulate` its ``calls`` and ask again. Conflict says how many successes are needed.
        """
        return Convergence(self._get(wire.reports.ConvergenceReport, ConvergenceOptions, options))

    def anisotropy(self, **options: Unpack[AnisotropyOptions]) -> Anisotropy:
        """How far a good grasp may be displaced along and about every axis.

        - ``method``: ``empirical`` counts pairs of trials; ``density`` compares densities.
        - ``alignment``: axes of translations: ``gripper``, ``object`` (its principal ones), ``edge`` (the
          nearest) or ``surface-pair`` (what the jaw closes on); all but the first take a mesh.
        """
        return Anisotropy(self._get(wire.reports.AnisotropyReport, AnisotropyOptions, options))

    def calibration(self, **options: Unpack[DensityOptions]) -> Calibration:
        """How often grasps hold that are predicted to, judged on trials the prediction has not seen."""
        return Calibration(self._get(wire.reports.CalibrationReport, DensityOptions, options))

    def projection(self, **options: Unpack[ProjectionOptions]) -> Projection:
        """The density on a plane: where grasps succeed.

        - ``plane``: ``xy``, ``xz``, ``yz`` or a normal (3,); None: the one that shows most of the grasps.
        - ``approach``, ``direction``: only grasps whose tool z, or tool x with either sign, points along this
          vector or axis (``"-z"``), within the cone.
        """
        return Projection(self._get(wire.reports.ProjectionReport, ProjectionOptions, options))

    def bandwidth(self, **options: Unpack[TrialOptions]) -> Bandwidth:
        """Which widths the kernel should have, and how often draws at several widths succeed.

        Those are simulated by sweeps of purpose ``check``; ``calls`` says which are missing.
        """
        return Bandwidth(self._get(wire.reports.BandwidthReport, TrialOptions, options))

    def kernel_similarity(self, **options: Unpack[KernelSimilarityOptions]) -> KernelSimilarity:
        """How many samples, or Gaussians, a kernel needs (figure 13).

        Displacements count within a window (a cube's half edge, the largest turn); every sample's component
        has the component's widths.
        """
        return KernelSimilarity(
            self._get(wire.reports.KernelSimilarityReport, KernelSimilarityOptions, options)
        )

    def sources(self, **options: Unpack[SourcesOptions]) -> Sources:
        """Whether simulation tells what robots find.

        ``protocol`` is that of the simulated trials; real ones of it are taken where there are any, else all.
        """
        return Sources(self._get(wire.reports.SourcesReport, SourcesOptions, options))

    def promises(self, **options: Unpack[PromisesOptions]) -> Promises:
        """What answers promised against what became of the trials that name them.

        Only what promised much was tried, so it speaks of that range only, and says what choosing the highest
        of many estimates explains. A trial farther than the match's limits from every grasp of its answer
        tried something else.
        """
        return Promises(self._get(wire.reports.PromisesReport, PromisesOptions, options))

    def engines(self, **options: Unpack[EnginesOptions]) -> Engines:
        """How far two physics engines agree on the same grasps, on which they do not, and why.

        Of sweeps with ``engine="both"``; Conflict where none of them has finished a chunk in both.
        """
        return Engines(self._get(wire.reports.EnginesReport, EnginesOptions, options))

    def simulate(self, calls: Iterable[wire.reports.CheckCall | Mapping[str, Any]]) -> list[Sweep]:
        """Make the sweeps that a report names as missing: checks, which enter no density.

        ``calls`` are those of a bandwidth report, or of :class:`graspdb.errors.ChecksNeeded`, with which
        ``convergence(matching="success")`` is refused.
        """
        made = []
        for item in calls:
            call = wire.reports.CheckCall.model_validate(item)
            expected = f"{self._path}/sweeps"
            if (call.method, call.path) != ("POST", expected):
                raise ValueError(f"{call.method} {call.path} makes no sweep of this object (POST {expected})")
            answer = self._transport.json("POST", expected, body=call.body, idempotent=True)
            made.append(Sweep(self._transport, wire.SweepInfo.model_validate(answer)))
        return made

    def _get(self, model: type[M], keywords: type[Any], options: Mapping[str, Any]) -> M:
        name: str = model.model_fields["report"].default
        params = query(known_keywords(keywords, options, name.replace("-", "_")))
        progress, timeout_s = (params.pop(key, None) for key in ("progress", "timeout_s"))
        answer = self._transport.request(
            "GET",
            f"{self._path}/reports/{name}",
            params={key: _in_query(key, value) for key, value in params.items()},
            headers={"Accept": "application/json"},
        )
        found = computed(self._transport, answer, f"the {name} report", progress, timeout_s)
        return model.model_validate(found)

    def __repr__(self) -> str:
        return f"<reports: {', '.join(REPORT_NAMES)}>"


class AllReports(Resource):
    """``db.reports``: what there is to say of all objects together."""

    def summary(self) -> Summary:
        """Every object's trials by outcome, and success rates by each way of counting (table I)."""
        answer = self._transport.model(wire.reports.SummaryReport, "GET", f"{self._path}/summary")
        return Summary(answer)

    def __repr__(self) -> str:
        return "<reports: summary>"


def _in_query(name: str, value: Any) -> Any:
    """A vector as a query takes it; names and numbers are as they are."""
    return value if np.ndim(value) == 0 else ",".join(map(repr, vector(name, value, "x, y, z")))
