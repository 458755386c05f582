"""Where on the object do grasps succeed? The density on a plane: the projection report."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from graspdb.wire.base import Triple
from graspdb.wire.reports import ProjectionOptions, ProjectionProfile, ProjectionReport
from graspdb_density.kde.weighted_sums import Progress
from graspdb_density.statistics.far_rows import far_rows
from graspdb_density.statistics.plane_marginal import MARGIN, Marginal, Orientation, Plane, marginal
from graspdb_geometry import meshes
from graspdb_service.problems import conflict, too_few_trials
from graspdb_service.storage import assets
from graspdb_service.storage.database import Database
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Bools, Floats, Ints
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.geometry.mesh_form import form_of
from graspdb_service.usecases.reports.common import LEVEL, ReportInputs, head, interval

#: Normals by the names of planes: towards the viewer, so that the first letter runs to the right.
PLANES = {"xy": (0.0, 0.0, 1.0), "xz": (0.0, -1.0, 0.0), "yz": (1.0, 0.0, 0.0)}
#: Fewer grasps than this make a picture, but no statement.
_FEW = 50
#: So many grasps far from the others are named.
_NAMED = 5


def projection_report(
    inputs: ReportInputs, built: Built, options: ProjectionOptions, progress: Progress
) -> ProjectionReport:
    """The density on a plane; 409 without a success, or where none points the way asked for."""
    density = built.asked
    if density is None or built.density is None:
        raise too_few_trials(
            "A projection needs at least 1 successful trial, and there is none: post trials"
            f" (POST /objects/{built.object_row.slug}/trials) or sweep a grid first",
        )
    near = ~_far(built, np.eye(3))
    name, plane = _plane(options.plane, built.density.positions[near])
    approach, direction = _vector(options.approach), _vector(options.direction)
    wanted = Orientation(
        approach=approach,
        approach_cone=math.radians(options.approach_cone_deg),
        direction=direction,
        direction_cone=math.radians(options.direction_cone_deg),
    )
    found = marginal(density, plane, wanted, level=LEVEL)
    progress(0.8)
    peak = float(found.value.max())
    if not peak > 0.0:
        raise conflict(
            "no-such-grasps",
            f"None of the {built.density.size:,} successful grasps points that way: widen approach_cone_deg"
            " or direction_cone_deg, or leave approach or direction out",
        )
    away = np.flatnonzero(_far(built, np.stack([plane.across, plane.upward], axis=1)))
    report = ProjectionReport(
        **head(built),
        warnings=_warnings(built, found, away),
        kernel=built.kernel,
        grasps=built.density.size,
        passing=found.passing,
        share=interval(found.share, found.share_low, found.share_high),
        plane=name,
        normal=_triple(plane.normal),
        across=_triple(plane.across),
        upward=_triple(plane.upward),
        approach=None if approach is None else _triple(approach),
        approach_cone_deg=None if approach is None else options.approach_cone_deg,
        direction=None if direction is None else _triple(direction),
        direction_cone_deg=None if direction is None else options.direction_cone_deg,
        across_m=_rounded(found.across_edges, 6),
        upward_m=_rounded(found.upward_edges, 6),
        values=np.round(found.value / peak, 4).tolist(),
        peak_per_m2=peak,
        profiles=_profiles(found, plane),
        outline=_outline(inputs, built, plane),
        drawn=found.drawn,
        outside=len(away),
    )
    return report.model_copy(update={"text": _text(report, found)})


def _far(built: Built, sides: Floats) -> Bools:
    """Which successful grasps lie far from all others along some axes (3, n), by the cells' own rule."""
    assert built.density is not None
    return far_rows(built.density.positions @ sides, least=MARGIN * built.density.kernel.sigma_position_m)


def _warnings(built: Built, found: Marginal, away: Ints) -> list[str]:
    """What to mind of the picture; ``away`` are the grasps outside it."""
    assert built.density is not None
    positions, width = built.density.positions, built.density.kernel.sigma_position_m
    warnings = []
    if found.passing < _FEW:
        warnings.append(f"the picture rests on {found.passing:,} grasps: single ones show")
    if len(away):
        distance = np.linalg.norm(positions[away] - np.median(positions, axis=0), axis=1)
        lie, trials = ("lies", "trial") if len(away) == 1 else ("lie", "trials")
        named = ", ".join([*map(str, built.seq[away[:_NAMED]]), *(["..."] if len(away) > _NAMED else [])])
        warnings.append(
            f"{len(away):,} of {len(positions):,} successful grasps {lie} up to {distance.max():.3g} m from"
            f" the middle of all, outside the picture ({trials} {named}): posted in another unit, perhaps"
        )
    cell = float(found.across_edges[1] - found.across_edges[0])
    if cell > width and not found.drawn:
        warnings.append(
            f"the grasps lie so far apart that a cell of the picture, {1e3 * cell:.0f} mm, is wider than the"
            f" kernel, {1e3 * width:.1f} mm: it shows single grasps as squares"
        )
    return warnings


def _plane(given: str | Triple | None, positions: Floats) -> tuple[str, Plane]:
    if given is None:
        extent = np.ptp(positions, axis=0)
        hidden = int(np.argmin(extent))
        given = "".join(letter for i, letter in enumerate("xyz") if i != hidden)
    if isinstance(given, str):
        return given, Plane.facing(np.array(PLANES[given]))
    normal = np.array(given, dtype=np.float64)
    return "facing " + ",".join(f"{x:.3g}" for x in normal), Plane.facing(normal)


def _vector(given: Triple | None) -> Floats | None:
    return None if given is None else np.array(given, dtype=np.float64)


def _triple(values: Floats) -> Triple:
    x, y, z = (round(float(value), 9) + 0.0 for value in values)
    return x, y, z


def _rounded(values: Floats, digits: int) -> list[float]:
    found: list[float] = np.round(values, digits).tolist()
    return found


def _axis(vector: Floats) -> str:
    """``x``, ``y`` or ``z`` where it is one, ``-x`` where it is its opposite, else its components."""
    for i, letter in enumerate("xyz"):
        if abs(abs(vector[i]) - 1.0) < 1e-9:
            return letter if vector[i] > 0 else f"-{letter}"
    return "(" + ", ".join(f"{value:.2f}" for value in vector) + ")"


def _profiles(found: Marginal, plane: Plane) -> list[ProjectionProfile]:
    return [
        ProjectionProfile(
            axis=_axis(axis),
            at_m=_rounded(item.at, 6),
            density_per_m=_rounded(item.value, 5),
            low=_rounded(item.low, 5),
            high=_rounded(item.high, 5),
        )
        for item, axis in zip(found.profiles, (plane.across, plane.upward), strict=True)
    ]


def _outline(inputs: ReportInputs, built: Built, plane: Plane) -> list[list[tuple[float, float]]]:
    """The silhouette of every convex part, or of the mesh's hull; nothing without geometry."""
    polygons = []
    for corners in _corners(inputs.database, built.object_row):
        flat = np.stack([corners @ plane.across, corners @ plane.upward], axis=1)
        try:
            hull = flat[ConvexHull(flat).vertices]
        except (QhullError, ValueError):
            # Seen edge-on it has no area.
            continue
        polygons.append([(round(float(x), 6), round(float(y), 6)) for x, y in hull])
    return polygons


def _corners(database: Database, row: ObjectRow) -> list[Floats]:
    """Corners (n, 3) of every convex part, of the mesh without any, or nothing."""
    sha256 = row.parts_sha256 or row.mesh_sha256
    if sha256 is None:
        return []
    with database.read() as tx:
        found = assets.get(tx, sha256)
    if found is None:
        return []
    if row.parts_sha256 is not None:
        return [np.asarray(part[0], dtype=np.float64) for part in meshes.parts_from_glb(found[0])]
    return [np.asarray(form_of(row).read(found[0]).vertices, dtype=np.float64)]


def _text(report: ProjectionReport, found: Marginal) -> str:
    i, j = np.unravel_index(int(np.argmax(found.value)), found.value.shape)
    at = [
        1e3 * 0.5 * float(edges[k] + edges[k + 1])
        for edges, k in ((found.across_edges, int(i)), (found.upward_edges, int(j)))
    ]
    first, second = (item.axis for item in report.profiles)
    where = f"densest at {first} = {at[0]:.0f} mm, {second} = {at[1]:.0f} mm"
    if report.approach is None and report.direction is None:
        return f"{report.grasps:,} successful grasps, {where}."
    parts = []
    if report.approach is not None:
        cone = f"{report.approach_cone_deg:g} deg"
        parts.append(f"approaches within {cone} of {_axis(np.array(report.approach))}")
    if report.direction is not None:
        cone = f"{report.direction_cone_deg:g} deg"
        parts.append(f"lies with tool x within {cone} of {_axis(np.array(report.direction))}")
    share = report.share
    value, low, high = (f"{100.0 * (v or 0.0):.1f} %" for v in (share.value, share.low, share.high))
    return (
        f"{value} ({low} to {high}) of the density {' and '.join(parts)}, {where};"
        f" {report.passing:,} of {report.grasps:,} successful grasps do."
    )
