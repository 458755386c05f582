"""A grasp density projected on a plane, and on that plane's axes (figure 5 of Bodenhagen, Detry, Piater and
Krueger): what is left of it once depth and rotation are integrated out, of all grasps or of those that point
a given way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..kde.density import SearchedDensity
from ..kde.isotropic import GraspDensity
from ..se3 import Floats
from .far_rows import far_rows

__all__ = ["MARGIN", "Marginal", "Orientation", "Plane", "Profile", "marginal"]

#: Cells along the longer side.
_CELLS = 128
#: The picture reaches this many position widths beyond the outermost rows.
MARGIN = 3.0
#: Rotations drawn from a kernel to tell which share of it points a given way: so many in all, and a row.
_TURNS, _LEAST_TURNS, _MOST_TURNS = 4_000_000, 8, 256
#: ... taken from so many.
_POOL = 16_384
#: Draws from a kernel whose position widths turn with the grasp.
_DRAWS = 200_000
_RESAMPLES, _GROUPS = 200, 1_000


@dataclass(frozen=True, eq=False, slots=True)
class Plane:
    """A plane through the origin seen along its normal.

    Attributes
    ----------
    across, upward, normal : (3,)
        Orthonormal and right-handed, object frame; the normal points to the viewer.
    """

    across: Floats
    upward: Floats
    normal: Floats

    @classmethod
    def facing(cls, normal: Floats) -> Plane:
        """The plane with this normal (3,), z upwards in it, or y where z is the normal."""
        n = np.asarray(normal, dtype=np.float64)
        n = n / np.linalg.norm(n)
        up = np.array([0.0, 0.0, 1.0]) if abs(n[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
        up = up - (up @ n) * n
        up /= np.linalg.norm(up)
        return cls(np.cross(up, n), up, n)


@dataclass(frozen=True, eq=False, slots=True)
class Orientation:
    """Which way grasps must point.

    Attributes
    ----------
    approach : (3,) or None
        Unit vector, object frame: tool z lies within ``approach_cone`` radians of it.
    direction : (3,) or None
        Unit vector, object frame: tool x, which is perpendicular to approach and closing, lies within
        ``direction_cone`` radians of it or of its opposite. So a jaw's half turn changes nothing.
    """

    approach: Floats | None = None
    approach_cone: float = math.radians(30.0)
    direction: Floats | None = None
    direction_cone: float = math.radians(30.0)

    @property
    def any(self) -> bool:
        """Whether every grasp passes."""
        return self.approach is None and self.direction is None

    def holds(self, quaternions_xyzw: Floats) -> NDArray[np.bool_]:
        """Which rotations (..., 4) point so."""
        passed = np.ones(quaternions_xyzw.shape[:-1], dtype=bool)
        if self.approach is not None:
            tool_z = se3.rotate(quaternions_xyzw, np.array([0.0, 0.0, 1.0]))
            passed &= tool_z @ self.approach >= math.cos(self.approach_cone)
        if self.direction is not None:
            tool_x = se3.rotate(quaternions_xyzw, np.array([1.0, 0.0, 0.0]))
            passed &= np.abs(tool_x @ self.direction) >= math.cos(self.direction_cone)
        return passed


@dataclass(frozen=True, eq=False, slots=True)
class Profile:
    """The projected density on one axis of the plane.

    Attributes
    ----------
    at : (n,) metres
    value, low, high : (n,)
        Share of all grasps per metre, with the bootstrap's interval over rows.
    """

    at: Floats
    value: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, eq=False, slots=True)
class Marginal:
    """A density on a plane.

    Attributes
    ----------
    across_edges, upward_edges : (n + 1,), (m + 1,) metres
    value : (n, m)
        Share of all grasps per square metre; sums to ``share`` over the cells.
    share, share_low, share_high : float
        Share of the density that points the way asked for.
    rows, passing : int
        Rows, and those of them that themselves point so.
    profiles : across, upward
    drawn : int
        Draws it was estimated from; 0 where it was computed.
    outside : int
        Rows far from all others, which the cells do not hold: see `far_rows`.
    """

    across_edges: Floats
    upward_edges: Floats
    value: Floats
    share: float
    share_low: float
    share_high: float
    rows: int
    passing: int
    profiles: tuple[Profile, Profile]
    drawn: int
    outside: int


def marginal(
    density: SearchedDensity,
    plane: Plane,
    orientation: Orientation,
    *,
    level: float = 0.9,
) -> Marginal:
    """Project a density.

    Under an isotropic kernel the projection is computed: every row has the share of its rotations that
    passes, and its position is smoothed by the kernel. A kernel whose position widths turn with the grasp is
    drawn from instead. Cells hold all rows but a few that are far from all others.

    Parameters
    ----------
    level : float
        Of the intervals, which resample rows (or draws).
    """
    rng = np.random.default_rng(0)
    own = density.isotropic
    sides = np.stack([plane.across, plane.upward], axis=1)
    far = far_rows(own.positions @ sides, least=MARGIN * own.kernel.sigma_position_m)
    if own is density:
        p, q, w = own.positions, own.quaternions_xyzw, own.weights
        sigma, drawn = own.kernel.sigma_position_m, 0
        passing = int(orientation.holds(q).sum())
        share, inside = _passing_shares(own, orientation, rng), ~far
    else:
        passing = int(orientation.holds(own.quaternions_xyzw).sum())
        p, q, w = _drawn(density, rng)
        drawn = len(p)
        share, inside = orientation.holds(q).astype(np.float64), np.repeat(~far, drawn // own.size)
        # Draws carry the kernel already: what is added only joins them.
        sigma = 0.2 * own.kernel.sigma_position_m
    at = (p @ sides).T
    edges = _edges(at[:, inside], sigma)
    cell = float(edges[0][1] - edges[0][0])
    shown = w * share * inside
    raw = _spread(at, shown, edges)
    # A weight shared between neighbouring cells is smoothed by a triangle of variance h^2 / 6 already.
    smooth = math.sqrt(max(sigma**2 - cell**2 / 6.0, 0.0)) / cell
    from scipy import ndimage  # late: 0.1 s

    value = ndimage.gaussian_filter(raw, smooth, mode="constant", truncate=5.0) / cell**2
    total, profiles = _profiles(at, w, share, inside, edges, smooth, rng, level)
    return Marginal(
        across_edges=edges[0],
        upward_edges=edges[1],
        value=value,
        share=float((w * share).sum()),
        share_low=total[0],
        share_high=total[1],
        rows=density.size,
        passing=passing,
        profiles=profiles,
        drawn=drawn,
        outside=int(far.sum()),
    )


def _passing_shares(density: GraspDensity, orientation: Orientation, rng: np.random.Generator) -> Floats:
    """Share of every row's kernel that points the way asked for, (N,)."""
    count = density.size
    if orientation.any:
        return np.ones(count)
    draws = int(np.clip(_TURNS // max(count, 1), _LEAST_TURNS, _MOST_TURNS))
    _, turns = density.kernel.sample_displacements(_POOL, rng)
    passed = np.zeros(count)
    for _ in range(draws):
        # Each row its own: turns shared by all rows would be wrong for all of them alike.
        turn = turns[rng.integers(_POOL, size=count)]
        passed += orientation.holds(se3.multiply(density.quaternions_xyzw, turn))
    return passed / draws


def _drawn(density: SearchedDensity, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Draws from every row's kernel: positions, rotations and weights, those of a row one after another.

    A symmetric row's twin is not drawn: it stands for the same grasps, turned half a turn.
    """
    own = density.isotropic
    each = int(np.clip(_DRAWS // own.size, _LEAST_TURNS, 4 * _MOST_TURNS))
    rows = np.repeat(np.arange(own.size), each)
    p, q = density.sample_rows(rows, rng)
    return p, q, own.weights[rows] / each


def _edges(at: Floats, sigma: float) -> tuple[Floats, Floats]:
    """Edges of square cells that hold every row and the reach of its kernel."""
    low, high = at.min(axis=1) - MARGIN * sigma, at.max(axis=1) + MARGIN * sigma
    cell = max(float((high - low).max()) / _CELLS, 1e-6)
    counts = np.maximum(np.ceil((high - low) / cell - 1e-9).astype(int), 1)
    middle = 0.5 * (low + high)
    across, upward = (middle[i] + cell * (np.arange(counts[i] + 1) - 0.5 * counts[i]) for i in (0, 1))
    return np.asarray(across), np.asarray(upward)


def _places(values: Floats, edges: Floats) -> tuple[NDArray[np.int64], Floats]:
    """The lower of the two cells whose middles enclose each value, and the upper one's share."""
    cell = edges[1] - edges[0]
    place = (values - edges[0]) / cell - 0.5
    lower = np.clip(np.floor(place), 0, max(len(edges) - 3, 0)).astype(np.int64)
    return lower, np.clip(place - lower, 0.0, 1.0)


def _spread(at: Floats, weight: Floats, edges: tuple[Floats, Floats]) -> Floats:
    """Weights shared linearly between the four nearest cells."""
    shape = len(edges[0]) - 1, len(edges[1]) - 1
    (i, u), (j, v) = _places(at[0], edges[0]), _places(at[1], edges[1])
    out = np.zeros(shape[0] * shape[1])
    for di, fu in ((0, 1.0 - u), (1, u)):
        for dj, fv in ((0, 1.0 - v), (1, v)):
            cells = np.minimum(i + di, shape[0] - 1) * shape[1] + np.minimum(j + dj, shape[1] - 1)
            out += np.bincount(cells, weights=weight * fu * fv, minlength=len(out))
    return out.reshape(shape)


def _profiles(
    at: Floats,
    w: Floats,
    share: Floats,
    inside: NDArray[np.bool_],
    edges: tuple[Floats, Floats],
    smooth: float,
    rng: np.random.Generator,
    level: float,
) -> tuple[tuple[float, float], tuple[Profile, Profile]]:
    """Interval of the share, and the density on both axes."""
    # What came one after the other is resampled together: draws and components of a row stay with it.
    groups = min(len(w), _GROUPS)
    group = np.arange(len(w)) * groups // len(w)
    again = rng.multinomial(groups, np.full(groups, 1.0 / groups), size=_RESAMPLES)
    counts = np.concatenate([np.ones((1, groups)), again])
    totals = counts @ np.bincount(group, weights=w, minlength=groups)
    passed = w * share
    shares = (counts @ np.bincount(group, weights=passed, minlength=groups)) / totals
    tail = 0.5 * (1.0 - level)
    found = []
    for axis in (0, 1):
        cells = len(edges[axis]) - 1
        lower, upper = _places(at[axis], edges[axis])
        last = np.minimum(lower + 1, cells - 1)
        table = np.zeros(groups * cells)
        for place, part in ((lower, 1.0 - upper), (last, upper)):
            shown = passed * part * inside
            table += np.bincount(group * cells + place, weights=shown, minlength=len(table))
        lines = (counts @ table.reshape(groups, cells)) / totals[:, None]
        if smooth > 0.0:
            from scipy import ndimage  # late: as above

            lines = ndimage.gaussian_filter1d(lines, smooth, axis=1, mode="constant", truncate=5.0)
        lines /= edges[axis][1] - edges[axis][0]
        low, high = np.quantile(lines[1:], [tail, 1.0 - tail], axis=0)
        middle = 0.5 * (edges[axis][1:] + edges[axis][:-1])
        found.append(Profile(middle, lines[0], np.minimum(low, lines[0]), np.maximum(high, lines[0])))
    low_share, high_share = (float(v) for v in np.quantile(shares[1:], [tail, 1.0 - tail]))
    return (min(low_share, float(shares[0])), max(high_share, float(shares[0]))), (found[0], found[1])
