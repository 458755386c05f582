"""Figures of reports: one drawing for the service's PNG and SVG and for ``.plot()`` in a notebook.

A report's figure is a function ``draw_<report>`` in the file of its name. Colours are Okabe and Ito's, which
colour-blind readers tell apart; heat maps are viridis. What has no data is white and hatched, never a colour.
"""

from __future__ import annotations

import io
import threading
from collections.abc import Callable
from typing import Any, Literal

from graspdb.figures.anisotropy import draw_anisotropy
from graspdb.figures.bandwidth import draw_bandwidth
from graspdb.figures.calibration import draw_calibration
from graspdb.figures.canvas import Figure
from graspdb.figures.compared.engines import draw_engines
from graspdb.figures.compared.promises import draw_promises
from graspdb.figures.compared.sources import draw_sources
from graspdb.figures.convergence import draw_convergence
from graspdb.figures.kernel_similarity import draw_kernel_similarity
from graspdb.figures.projection import draw_projection
from graspdb.figures.summary import draw_summary
from graspdb.wire import reports
from graspdb.wire.reports import Report, SummaryReport

__all__ = ["FILE_FORMATS", "Format", "draw", "render"]

Format = Literal["png", "svg"]
FILE_FORMATS: dict[str, Format] = {".png": "png", ".svg": "svg"}
"""The formats of figures by the suffix of a file."""

_DRAW: dict[type[Any], Callable[[Any], Figure]] = {
    reports.AnisotropyReport: draw_anisotropy,
    reports.BandwidthReport: draw_bandwidth,
    reports.CalibrationReport: draw_calibration,
    reports.ConvergenceReport: draw_convergence,
    reports.EnginesReport: draw_engines,
    reports.KernelSimilarityReport: draw_kernel_similarity,
    reports.ProjectionReport: draw_projection,
    reports.PromisesReport: draw_promises,
    reports.SourcesReport: draw_sources,
    reports.SummaryReport: draw_summary,
}
_DPI = 120
# Matplotlib shares its font cache and text paths between figures.
_LOCK = threading.Lock()


def render(report: Report | SummaryReport, format: Format) -> bytes:
    """The figure of a report as a file's bytes."""
    with _LOCK:
        target = io.BytesIO()
        # No date: the same report gives the same bytes.
        metadata = {"Date": None} if format == "svg" else {"Software": None}
        draw(report).savefig(target, format=format, dpi=_DPI, metadata=metadata)
        return target.getvalue()


def draw(report: Report | SummaryReport) -> Figure:
    """The figure of a report; needs matplotlib (extra ``plot``)."""
    return _DRAW[type(report)](report)
