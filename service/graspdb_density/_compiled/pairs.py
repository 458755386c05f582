"""Compiled loops over pairs of trials: what became of trials B displaced by so much from a successful A.

Candidates B of the A at ``a`` are the rows ``order[run[0]:run[1]]`` of ``runs[first[a]:first[a + 1]]``.
Only A's own row is left out: another trial of the same pose tells how repeatable success is.

``nearby`` (A, 3, bins, 5) takes the pairs of profiles one grasp A at a time, see `LatticeProfiles`, in the
place of the profiles' ``tried`` and ``won``; with no grasps those are filled.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .options import exact, inlined

__all__ = [
    "Displaced",
    "RotationBins",
    "Tally",
    "TranslationBins",
    "Trials",
    "rotation_pairs",
    "translation_pairs",
]

Floats = NDArray[np.float64]

_EDGE_M = 1e-9


class Trials(NamedTuple):
    """Trials (N,), and their rows in an order (N,) that runs refer to."""

    positions: Floats
    quaternions: Floats
    success: NDArray[np.bool_]
    order: NDArray[np.int64]


class Displaced(NamedTuple):
    """Successes A: rows (A,), frames (A, 3, 3) of translations, weights (A, 1 + resamples), and runs of
    candidates.
    """

    rows: NDArray[np.int64]
    frames: Floats
    weights: NDArray[np.float32]
    first: NDArray[np.int64]
    runs: NDArray[np.int64]


class TranslationBins(NamedTuple):
    """``across`` bins span -extent .. extent in x and y; ``slices`` slices of ``slice_m`` in z; profiles have
    ``profile_bins`` bins of ``profile`` metres, the middle one about 0, the other axes within ``off_axis``.
    """

    extent: float
    slices: int
    slice_m: float
    across: int
    profile: float
    profile_bins: int
    off_axis: float


class RotationBins(NamedTuple):
    """``bins`` span the circle, the first centred on -pi, so that one is centred on 0; profiles as there, in
    radians.
    """

    bins: int
    profile: float
    profile_bins: int
    off_axis: float


class Tally(NamedTuple):
    """What became of displaced trials, by bin: weighted, as observed (column 0) and in every resample of the
    grasps A.

    Attributes
    ----------
    tried, won : (bins, 1 + resamples) float32
    pairs : (bins,) int64
        Observations.
    moved : (bins,)
        The sum of their displacements, so that a profile knows where its data lie.
    farthest : (bins,)
        The largest of them in amount, so that it knows where they end.
    """

    tried: NDArray[np.float32]
    won: NDArray[np.float32]
    pairs: NDArray[np.int64]
    moved: Floats
    farthest: Floats


@inlined
def _add(tried, won, pairs, bin_, success, weights):
    pairs[bin_] += 1
    for r in range(weights.shape[0]):
        tried[bin_, r] += weights[r]
    if success:
        for r in range(weights.shape[0]):
            won[bin_, r] += weights[r]


@inlined
def _note(nearby, bin_, success, at, off_u, off_v):
    """A pair of one grasp in the profile of an axis (bins, 5)."""
    if 0 <= bin_ < nearby.shape[0]:
        nearby[bin_, 0] += 1.0
        nearby[bin_, 1] += 1.0 if success else 0.0
        nearby[bin_, 2] += at
        nearby[bin_, 3] += abs(off_u)
        nearby[bin_, 4] += abs(off_v)


@inlined
def _to_profile(lines, apart, bin_, bins, axis, at, success, weights):
    """A pair into its bin of an axis' profile; whether it has one."""
    if bin_ < 0 or bin_ >= bins:
        return False
    tried, won, pairs, moved, farthest = lines
    place = axis * bins + bin_
    if apart:
        pairs[place] += 1
    else:
        _add(tried, won, pairs, place, success, weights)
    moved[place] += at
    farthest[place] = max(farthest[place], abs(at))
    return True


@exact
def _own_and_twin(qa, qb):
    """Cosines of half the angles from a to b and to b's twin under the jaw's turn."""
    own = abs(qa[0] * qb[0] + qa[1] * qb[1] + qa[2] * qb[2] + qa[3] * qb[3])
    twin = abs(qa[0] * qb[1] - qa[1] * qb[0] + qa[2] * qb[3] - qa[3] * qb[2])
    return own, twin


@exact
def translation_pairs(trials, displaced, bins, symmetric, least_cosine, planes, lines, nearby):
    """Pairs of the same rotation into the histograms (slice, x, y) and the profiles (axis, bin); how many.

    ``least_cosine``: of half the angle for trials off the grid, -1 where runs hold one rotation only.
    """
    positions, quaternions, success, order = trials
    grasps, frames, weights, first, runs = displaced
    extent, slices, slice_m, across, profile_m, profile_bins, off_axis_m = bins
    tried, won, pairs, _, _ = planes
    used = 0
    half_depth = 0.5 * slices * slice_m
    middle = profile_bins // 2
    apart = nearby.shape[0] > 0
    margin = (nearby.shape[2] - profile_bins) // 2
    t = np.empty(3)
    for a in range(grasps.shape[0]):
        i = grasps[a]
        f = frames[a]
        for r in range(first[a], first[a + 1]):
            for k in range(runs[r, 0], runs[r, 1]):
                j = order[k]
                if j == i:
                    continue
                d0 = positions[j, 0] - positions[i, 0]
                d1 = positions[j, 1] - positions[i, 1]
                d2 = positions[j, 2] - positions[i, 2]
                if least_cosine > 0.0:
                    own, twin = _own_and_twin(quaternions[i], quaternions[j])
                    if own < least_cosine and (not symmetric or twin < least_cosine):
                        continue
                for axis in range(3):
                    t[axis] = f[0, axis] * d0 + f[1, axis] * d1 + f[2, axis] * d2
                hit = False
                inside = abs(t[0]) <= extent + _EDGE_M and abs(t[1]) <= extent + _EDGE_M
                if inside and abs(t[2]) <= half_depth + _EDGE_M:
                    x = min(max(math.floor((t[0] + extent) / (2.0 * extent) * across), 0), across - 1)
                    y = min(max(math.floor((t[1] + extent) / (2.0 * extent) * across), 0), across - 1)
                    z = min(max(math.floor((t[2] + half_depth) / slice_m), 0), slices - 1)
                    _add(tried, won, pairs, (z * across + x) * across + y, success[j], weights[a])
                    hit = True
                for axis in range(3):
                    u, v = abs(t[(axis + 1) % 3]), abs(t[(axis + 2) % 3])
                    if u <= off_axis_m + _EDGE_M and v <= off_axis_m + _EDGE_M:
                        b = middle + math.floor(t[axis] / profile_m + 0.5)
                        if apart:
                            _note(nearby[a, axis], b + margin, success[j], t[axis], u, v)
                        if _to_profile(lines, apart, b, profile_bins, axis, t[axis], success[j], weights[a]):
                            hit = True
                used += hit
    return used


@exact
def _product(a, b, out):
    out[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    out[1] = a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0]
    out[2] = a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3]
    out[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]


@inlined
def _wrapped(angle):
    """Into [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@inlined
def _plane_entries(q, plane):
    """The entries a, b, c of a rotation's 2x2 matrix in a plane of two axes, see `composition_angles`."""
    if plane == 0:
        return q[0], q[1], q[2]
    if plane == 1:
        return q[0], q[2], -q[1]
    return q[1], q[2], q[0]


@exact
def composition_angles(q, plane):
    """The composition ``R_a(alpha) R_b(beta)`` nearest to a rotation: alpha, beta and the sine of the angle
    left, for the planes 0: (x, y), 1: (x, z), 2: (y, z).

    With ca = cos(alpha / 2) and so on, the composition's quaternion has w = ca cb, a-part sa cb, b-part ca sb
    and, up to the sign of e_a e_b, third part sa sb: as a 2x2 matrix [[w, b], [a, c]] it has rank one. The
    nearest is the best rank-one approximation; its angles follow from the sums and differences of the
    entries, and twice the determinant is the sine of the angle left.
    """
    w = q[3]
    a, b, c = _plane_entries(q, plane)
    both = math.atan2(a + b, w - c)
    apart = math.atan2(a - b, w + c)
    return _wrapped(both + apart), _wrapped(both - apart), 2.0 * abs(w * c - a * b)


# long: one compiled loop over pairs, whose buffers and frames all steps share.
@exact
def rotation_pairs(trials, displaced, bins, symmetric, reach_m, planes, lines, nearby):
    """Pairs at the same position into the histograms (plane, alpha, beta) and the profiles (axis, bin); how
    many.

    Rotations are about the gripper's own axes. ``reach_m``: distance for trials off the grid, negative where
    runs hold one position. Of a symmetric jaw both A and B stand for their twins too.
    """
    positions, quaternions, success, order = trials
    grasps, _, weights, first, runs = displaced
    circle, profile_step, profile_bins, off_axis = bins
    tried, won, pairs, _, _ = planes
    used = 0
    sine = math.sin(off_axis)
    least = math.cos(0.5 * off_axis) ** 2
    middle = profile_bins // 2
    apart = nearby.shape[0] > 0
    margin = (nearby.shape[2] - profile_bins) // 2
    step = 2.0 * math.pi / circle
    turn = np.array([0.0, 0.0, 1.0, 0.0])
    back = np.array([0.0, 0.0, -1.0, 0.0])
    inverse, relative, other = np.empty(4), np.empty(4), np.empty(4)
    for a in range(grasps.shape[0]):
        i = grasps[a]
        qa = quaternions[i]
        inverse[0], inverse[1], inverse[2], inverse[3] = -qa[0], -qa[1], -qa[2], qa[3]
        for r in range(first[a], first[a + 1]):
            for k in range(runs[r, 0], runs[r, 1]):
                j = order[k]
                if j == i:
                    continue
                if reach_m >= 0.0:
                    d0 = positions[j, 0] - positions[i, 0]
                    d1 = positions[j, 1] - positions[i, 1]
                    d2 = positions[j, 2] - positions[i, 2]
                    if d0 * d0 + d1 * d1 + d2 * d2 > reach_m * reach_m:
                        continue
                hit = False
                for variant in range(4 if symmetric else 1):
                    _product(inverse, quaternions[j], relative)
                    if variant & 1:
                        other[:] = relative
                        _product(other, turn, relative)
                    if variant & 2:
                        other[:] = relative
                        _product(back, other, relative)
                    for plane in range(3):
                        e, g, h = _plane_entries(relative, plane)
                        # Most are too far from every composition: told before any angle is taken.
                        if 2.0 * abs(relative[3] * h - e * g) <= sine:
                            alpha, beta, _ = composition_angles(relative, plane)
                            x = math.floor((alpha + math.pi) / step + 0.5) % circle
                            y = math.floor((beta + math.pi) / step + 0.5) % circle
                            b = (plane * circle + x) * circle + y
                            _add(tried, won, pairs, b, success[j], weights[a])
                            hit = True
                    for axis in range(3):
                        w, v = relative[3], relative[axis]
                        if w * w + v * v >= least:
                            angle = _wrapped(2.0 * math.atan2(v, w))
                            b = middle + math.floor(angle / profile_step + 0.5)
                            if apart and variant < 2:
                                # What turns the rest of the way, in A's axes.
                                n = math.sqrt(w * w + v * v)
                                e, g = relative[(axis + 1) % 3] / n, relative[(axis + 2) % 3] / n
                                off_u = 2.0 * math.asin(min(1.0, abs(e * w - g * v)))
                                off_v = 2.0 * math.asin(min(1.0, abs(g * w + e * v)))
                                _note(nearby[a, axis], b + margin, success[j], angle, off_u, off_v)
                            if _to_profile(
                                lines, apart, b, profile_bins, axis, angle, success[j], weights[a]
                            ):
                                hit = True
                used += hit
    return used
