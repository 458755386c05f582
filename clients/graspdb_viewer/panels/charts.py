"""Reports as Plotly figures that fit the panel."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go

from graspdb.figures.style import BLUE, COLOURS, GREY
from graspdb.reports import Bandwidth, Calibration, Convergence, Projection


def convergence(report: Convergence) -> go.Figure:
    """Similarity and its target against the number of successes."""
    figure = _figure("successes", "similarity (eq 9)")
    for curve, colour in zip(report.raw.curves, COLOURS, strict=False):
        figure.add_scatter(
            x=[point.grasps for point in curve.points],
            y=[point.similarity for point in curve.points],
            error_y={"array": [point.deviation for point in curve.points]},
            name=curve.label,
            line={"color": colour},
        )
        figure.add_hline(curve.verdict.target, line={"color": GREY, "dash": "dot"})
    tried = sorted({point.grasps for curve in report.raw.curves for point in curve.points})
    _logarithmic(figure, {float(count): f"{count:,}" for count in tried})
    return figure


def calibration(report: Calibration) -> go.Figure:
    """How often what was predicted came true; on the line predictions are right."""
    figure = _figure("predicted", "came true")
    bins = [item for item in report.raw.bins if item.predicted is not None and item.observed is not None]
    observed = np.array([item.observed for item in bins], dtype=np.float64)
    high = np.array([item.high for item in bins], dtype=np.float64) - observed
    low = observed - np.array([item.low for item in bins], dtype=np.float64)
    figure.add_scatter(x=[0, 1], y=[0, 1], mode="lines", line={"color": GREY, "dash": "dot"})
    figure.add_scatter(
        x=[item.predicted for item in bins],
        y=observed.tolist(),
        error_y={"array": high.tolist(), "arrayminus": low.tolist()},
        text=[f"{item.count:,} attempts" for item in bins],
        mode="markers",
        marker={"color": BLUE, "size": 8},
    )
    figure.update_layout(showlegend=False)
    return figure


def widths(report: Bandwidth) -> go.Figure:
    """How likely left-out successes are by the kernel's widths."""
    figure = _figure("position width [mm]", "log density of left-out grasps")
    turns = sorted({point.sigma_rotation_deg for point in report.raw.grid})
    for turn, colour in zip(turns, COLOURS, strict=False):
        points = [p for p in report.raw.grid if p.sigma_rotation_deg == turn and p.log_likelihood is not None]
        figure.add_scatter(
            x=[1e3 * point.sigma_position_m for point in points],
            y=[point.log_likelihood for point in points],
            name=f"{turn:.3g}°",
            line={"color": colour},
        )
    figure.add_vline(1e3 * report.recommended[0], line={"color": GREY, "dash": "dot"})
    figure.update_layout(legend_title_text="rotation width")
    tried = sorted({1e3 * point.sigma_position_m for point in report.raw.grid})
    _logarithmic(figure, {width: f"{width:.3g}" for width in tried})
    return figure


def projection(report: Projection) -> go.Figure:
    """The density on a plane, with the object's outline."""
    raw = report.raw
    figure = _figure(f"{_axis(raw.across)} [mm]", f"{_axis(raw.upward)} [mm]")
    middle = [1e3 * (edges[:-1] + edges[1:]) / 2 for edges in (report.across_m, report.upward_m)]
    figure.add_heatmap(
        x=middle[0].tolist(),
        y=middle[1].tolist(),
        z=report.values.T.tolist(),
        colorscale="Viridis",
        showscale=False,
    )
    for polygon in raw.outline:
        points = 1e3 * np.array([*polygon, polygon[0]])
        figure.add_scatter(
            x=points[:, 0].tolist(),
            y=points[:, 1].tolist(),
            mode="lines",
            line={"color": "white", "width": 1},
        )
    figure.update_layout(showlegend=False)
    figure.update_yaxes(scaleanchor="x")
    return figure


def _figure(across: str, upward: str) -> go.Figure:
    figure = go.Figure()
    figure.update_layout(
        template="plotly_white",
        margin={"l": 50, "r": 10, "t": 10, "b": 40},
        legend={"orientation": "h", "y": 1.12},
        font={"size": 11},
        xaxis_title=across,
        yaxis_title=upward,
    )
    return figure


def _logarithmic(figure: go.Figure, ticks: dict[float, str]) -> None:
    """Across by factors, with a tick where something was computed."""
    figure.update_xaxes(type="log", tickvals=list(ticks), ticktext=list(ticks.values()))


def _axis(direction: Any) -> str:
    """x, -y and so on where it is an axis, else its numbers."""
    vector = np.asarray(direction, dtype=np.float64)
    place = int(np.argmax(np.abs(vector)))
    if abs(vector[place]) < 0.999:
        return ", ".join(f"{value:.2f}" for value in vector)
    return f"{'-' if vector[place] < 0 else ''}{'xyz'[place]}"
