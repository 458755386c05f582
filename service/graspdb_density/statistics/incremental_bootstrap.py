"""A convergence curve extended with its grasps: sums are kept, and new grasps are added to them.

The last point of a curve is s of all grasps (eq 9). Its kernel sums are kept, at the points drawn from the
density and for every bootstrap replicate, so that a new grasp costs its own kernels only. That needs
replicates and points which new grasps leave as they are:

- *Replicates* count a grasp ``c`` times with c from a Poisson distribution of mean 1, which is a function of
  seed, replicate and the grasp's place in the order of commitment, and renormalise (the Poisson bootstrap).
  Given how many n are drawn altogether, these are the counts of drawing n with replacement. Equation 9 draws
  N. Since 1 - s falls as 1/n (isolated kernels: as n^-0.94), it is taken times n/N.
- *Points* are drawn systematically over the cumulated weights with a step that stays the same until the
  number of grasps doubles: those of the first grasps stay, and a new grasp brings its own.

The other points of a curve are of subsets of the first 200, 400, 800, ... grasps, at most half of them, with
replicates that draw with replacement. Those and the held-out grasps stay the same until the number doubles,
and so do default widths (see `selection`). So a curve that was extended and one computed at once agree within
rounding. Where the order of commitment is not random, smaller points are of what was tried first.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kde.rows import Rows
from ..kde.weighted_sums import TRUSTED_SUM, KernelRows, Progress
from ..kernels.gaussian_mixture import Kernel
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses
from .convergence import (
    LEAST_GRASPS,
    ConvergenceCurve,
    CurvePoint,
    bootstrap_similarity,
    coefficients,
    curve_sizes,
)
from .counter_rng import CounterRng

__all__ = ["IncrementalCurve", "curve_prefix"]

#: Grasps held out for the likelihood: this share of the first ones, but no more than.
_HELD_OUT_SHARE, _HELD_OUT_MOST = 0.1, 2_000
#: Raw weights that differ by less, relatively, are the same: they are divided by a mean.
_SAME = 1e-9


def curve_prefix(count: int) -> int:
    """How many of ``count`` grasps, the first ones in commit order, a curve's smaller points are drawn from:
    200, 400, 800, ...
    """
    if count < LEAST_GRASPS:
        return 0
    return int(LEAST_GRASPS << ((count // LEAST_GRASPS).bit_length() - 1))


@dataclass(frozen=True, slots=True)
class _Plan:
    """What the numbers of a curve are drawn by."""

    subsets: int
    replicates: int
    points: int
    seed: int

    @property
    def per_subset(self) -> int:
        return max(2, self.points // self.subsets)

    @property
    def draws(self) -> CounterRng:
        return CounterRng(self.seed)


@dataclass(frozen=True, eq=False, slots=True)
class _Group:
    """Points drawn from the density of all grasps, and their kernel sums.

    Attributes
    ----------
    poses : M
    sums : (M, 1 + B) float64
        Under the raw weights, then under those times each replicate's counts. In float64, since grasps may
        come one by one.
    totals : (1 + B,)
        The weights' sums.
    counted : (B,)
        How many grasps each replicate counts.
    """

    poses: Poses
    sums: Floats
    totals: Floats
    counted: Floats

    @classmethod
    def empty(cls, replicates: int) -> _Group:
        nowhere = Poses(np.empty((0, 3)), np.empty((0, 4)))
        return cls(nowhere, np.empty((0, 1 + replicates)), np.zeros(1 + replicates), np.zeros(replicates))

    @property
    def nbytes(self) -> int:
        arrays = self.poses.positions, self.poses.quaternions_xyzw, self.sums, self.totals, self.counted
        return sum(array.nbytes for array in arrays)

    def values(self, size: int) -> Floats:
        """BC of every replicate with the whole of ``size`` grasps, (B,), as if it had counted that many."""
        found = coefficients(self.sums[:, 0], self.sums[:, 1:], self.totals[1:] / self.totals[0])
        return np.asarray(1.0 - (1.0 - found) * (self.counted / size), dtype=np.float64)


@dataclass(frozen=True, eq=False, slots=True)
class _HeldOut:
    """Grasps that judge the likelihood, of the first ones.

    Attributes
    ----------
    rows : (H,)
    sums : (H,)
        Kernel sums of the other grasps under their raw weights, within the cut-off.
    log_sums : (H,)
        The same without a cut-off, where little is within it; nan elsewhere.
    """

    rows: NDArray[np.int64]
    sums: Floats
    log_sums: Floats

    @property
    def nbytes(self) -> int:
        return self.rows.nbytes + self.sums.nbytes + self.log_sums.nbytes


@dataclass(frozen=True, eq=False, slots=True)
class IncrementalCurve:
    """A convergence curve and the sums that it is extended from. Immutable.

    Attributes
    ----------
    curve : ConvergenceCurve
    size : int
        Grasps in all.
    prefix : int
        Grasps that the smaller points are drawn from.
    kept : int
        Grasps whose sums were taken from the curve before; 0 where it was computed at once.
    generation : bytes
        The same while a curve is extended, another one when it is computed anew.
    """

    curve: ConvergenceCurve
    size: int
    prefix: int
    kept: int
    generation: bytes
    _signature: bytes
    _digest: bytes
    _raw: Floats
    _held: _HeldOut
    _groups: tuple[_Group, ...]

    def _begins(self, rows: KernelRows, signature: bytes, raw: Floats) -> bool:
        """Whether this is a curve of the first of some rows."""
        return (
            self._signature == signature
            and self.size <= len(raw)
            and np.allclose(self._raw, raw[: self.size], rtol=_SAME, atol=0.0)
            and self._digest == _digest(rows, self.size)
        )

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        points = sum(point.replicates.nbytes for point in self.curve.points)
        return sum(group.nbytes for group in self._groups) + self._held.nbytes + self._raw.nbytes + points

    # long: the options of the report, explained one by one.
    @classmethod
    def of(
        cls,
        grasps: Rows,
        kernel: Kernel,
        *,
        before: IncrementalCurve | None = None,
        frames: ArrayLike | None = None,
        subsets: int = 5,
        replicates: int = 50,
        points: int = 20_000,
        seed: int = 0,
        threads: int = 1,
        progress: Progress | None = None,
    ) -> IncrementalCurve:
        """s and the held-out likelihood against the number of grasps (figures 6 and 14).

        Parameters
        ----------
        grasps : N
            Successful ones in commit order, one row a physical grasp.
        kernel, frames
            As `KernelRows` takes them.
        before
            A curve of the first of these grasps. What of it still holds is kept: all of it while grasps are
            added under the same kernel, weights of the first ones and frames, up to twice as many; nothing
            otherwise. It makes the answer quicker and no different.
        subsets : int
            Subsets drawn without replacement at each size, at least 5. At the whole number they are the same
            grasps with other draws.
        points : int
            Draws from the density at each size, over its subsets together; at the whole number between half
            and all of it, since the draws of the first grasps stay.

        Raises
        ------
        ValueError
            Where there are too few grasps (saying how many are needed) or an argument is out of range.
        """
        count = len(grasps)
        sizes = curve_sizes(count)
        if subsets < 5:
            raise ValueError("a point of a curve is the mean over at least 5 subsets")
        if replicates < 2 or points < 2:
            raise ValueError("a bootstrap needs at least 2 replicates and 2 points")
        plan = _Plan(subsets, replicates, points, seed)
        rows = KernelRows(grasps, kernel, frames=frames)
        prefix = curve_prefix(count)
        # In units of the first ones' mean, which stays.
        raw = rows.weights / rows.weights[:prefix].mean()
        # Heavy grasps that come late do not bring more points than there may be.
        thinned = 2 ** max(0, math.floor(math.log2(raw.sum() / prefix)))
        step = thinned * 2.0 * prefix / plan.per_subset
        signature = _signature(rows, plan, prefix, step)
        if before is not None and not before._begins(rows, signature, raw):
            before = None
        if before is not None and before.size == count:
            return replace(before, kept=count)
        first = 0 if before is None else before.size
        groups = (_Group.empty(replicates),) * subsets if before is None else before._groups
        work = _Work(rows, raw, plan, step, threads, _Steps(progress))
        ladder = plan.per_subset * subsets * sum(sizes[:-1]) if before is None else 0
        drawn = work.drawn()
        present = sum(len(group.poses) for group in groups)
        fresh = count - first
        work.steps.total = ladder + (present + _HELD_OUT_MOST) * fresh + (drawn * subsets - present) * count
        split, *children = np.random.default_rng(seed).spawn(1 + len(sizes[:-1]) * subsets)
        if before is None:
            judged = _held_out(split, prefix)
            smaller = tuple(work.smaller(sizes[:-1], prefix, judged, children))
            held = _HeldOut(judged, np.zeros(len(judged)), np.full(len(judged), np.nan))
        else:
            smaller, held = before.curve.points[:-1], before._held
        held, log_density = work.judged(held, first)
        groups = tuple(work.group(g, group, first, drawn) for g, group in enumerate(groups))
        last = _curve_point(
            count, np.array([group.values(count) for group in groups]), log_density, raw[held.rows]
        )
        return cls(
            curve=ConvergenceCurve((*smaller, last), len(held.rows)),
            size=count,
            prefix=prefix,
            kept=first,
            generation=_digest(rows, prefix) + signature if before is None else before.generation,
            _signature=signature,
            _digest=_digest(rows, count),
            _raw=raw,
            _held=held,
            _groups=groups,
        )


def _signature(rows: KernelRows, *numbers: object) -> bytes:
    """Of all that every sum depends on: ``numbers`` and the kernel."""
    kernel = rows.kernel
    found = hashlib.blake2b(repr(numbers).encode())
    if isinstance(kernel, IsotropicKernel):
        found.update(repr(kernel).encode())
    else:
        found.update(kernel.frame.encode())
        for array in (kernel.weights, kernel.means, kernel.covariances):
            found.update(np.ascontiguousarray(array).data)
    return found.digest()


def _digest(rows: KernelRows, count: int) -> bytes:
    """Of the first rows."""
    found = hashlib.blake2b()
    arrays: list[NDArray[np.generic]] = [*rows.poses[:count], rows.symmetric[:count]]
    if not rows.turning:
        arrays.append(rows.frames[:count])
    for array in arrays:
        found.update(np.ascontiguousarray(array).data)
    return found.digest()


@dataclass(slots=True)
class _Steps:
    """Progress over several parts, in products of rows and points."""

    report: Progress | None
    total: int = 1
    done: int = 0

    def part(self, amount: int, share: float = 1.0) -> Progress | None:
        """For a part whose own progress is that ``share`` of it."""
        if self.report is None:
            return None
        report, done, total = self.report, self.done, self.total
        return lambda part: report((done + share * part * amount) / total)

    def finish(self, amount: int) -> None:
        self.done = min(self.done + amount, self.total)
        if self.report is not None:
            self.report(self.done / self.total)


@dataclass(frozen=True, slots=True)
class _Work:
    """The parts of a curve."""

    rows: KernelRows
    raw: Floats
    plan: _Plan
    step: float
    threads: int
    steps: _Steps

    def drawn(self) -> int:
        """Points of a group at most, over the cumulated weights there are."""
        return max(1, math.ceil(float(self.raw.sum()) / self.step))

    def smaller(
        self,
        sizes: list[int],
        prefix: int,
        judged: NDArray[np.int64],
        children: list[np.random.Generator],
    ) -> Iterator[CurvePoint]:
        """The points of subsets of the first rows."""
        plan, rows = self.plan, self.rows
        is_judged = np.zeros(prefix, dtype=bool)
        is_judged[judged] = True
        test = rows.poses[judged]
        for index, size in enumerate(sizes):
            values, likelihoods = [], []
            for turn in range(plan.subsets):
                picker, draws = children[index * plan.subsets + turn].spawn(2)
                chosen = np.sort(picker.permutation(prefix)[:size])
                amount = size * plan.per_subset
                values.append(
                    bootstrap_similarity(
                        rows.subset(chosen),
                        draws,
                        replicates=plan.replicates,
                        points=plan.per_subset,
                        threads=self.threads,
                        progress=self.steps.part(amount, 0.9),
                    )
                )
                training = rows.subset(chosen[~is_judged[chosen]])
                likelihoods.append(training.log_density(test, threads=self.threads))
                self.steps.finish(amount)
            yield _curve_point(size, np.array(values), np.mean(likelihoods, axis=0), self.raw[judged])

    def judged(self, held: _HeldOut, first: int) -> tuple[_HeldOut, Floats]:
        """The held-out grasps with the rows from ``first`` on, and their log density."""
        rows, raw = self.rows, self.raw
        training = np.ones(rows.size, dtype=bool)
        training[held.rows] = False
        fresh = first + np.flatnonzero(training[first:])
        at = rows.poses[held.rows]
        sums = held.sums.copy()
        if len(fresh):
            added = rows.subset(fresh).sums(
                at, raw[fresh, None], least=0.0, threads=self.threads,
                progress=self.steps.part(len(fresh) * _HELD_OUT_MOST),
            )  # fmt: skip
            sums += added[:, 0]
        self.steps.finish((rows.size - first) * _HELD_OUT_MOST)
        # Where little is left, what lies beyond the cut-off may count as much: without one, there.
        far = sums <= TRUSTED_SUM * float(raw[training].min())
        log_sums = np.where(far, held.log_sums, np.nan)
        for known in (True, False):
            which = np.flatnonzero(far & (np.isfinite(log_sums) == known))
            new = fresh if known else np.flatnonzero(training)
            if len(which) and len(new):
                found = rows.subset(new).exact_log_density(at[which], threads=self.threads) + math.log(
                    float(raw[new].sum())
                )
                log_sums[which] = np.logaddexp(log_sums[which], found) if known else found
        total = math.log(float(raw[training].sum()))
        with np.errstate(divide="ignore"):
            near = np.log(sums) + rows.log_unit
        return _HeldOut(held.rows, sums, log_sums), np.where(far, log_sums, near) - total

    def group(self, number: int, group: _Group, first: int, most: int) -> _Group:
        """A group with the rows from ``first`` on: added at its points, and bringing points of their own."""
        plan, rows, raw = self.plan, self.rows, self.raw
        fresh = np.arange(first, rows.size)
        present = len(group.poses)
        weightings, counted = self._weightings(number, first)
        totals = group.totals + weightings.sum(axis=0, dtype=np.float64)
        counted = counted + group.counted
        sums = group.sums
        if present:
            amount = present * len(fresh)
            sums = sums + rows.subset(fresh).sums(
                group.poses, weightings,
                threads=self.threads, progress=self.steps.part(amount),
            )  # fmt: skip
            self.steps.finish(amount)
        # Summed one by one from the first row on, so that rows added later move no point.
        edges = np.cumsum(raw)
        at = (np.arange(present, most) + plan.draws.offset(number)) * self.step
        row = np.searchsorted(edges, at[at < edges[-1]], side="right")
        row = np.minimum(row, rows.size - 1)
        if not len(row):
            return replace(group, sums=sums, totals=totals, counted=counted)
        drawn = rows.displaced(
            row, *plan.draws.displacements(rows.kernel, number, present, present + len(row))
        )
        if first:
            weightings, _ = self._weightings(number, 0)
        amount = len(row) * rows.size
        added = rows.sums(drawn, weightings, threads=self.threads, progress=self.steps.part(amount))
        self.steps.finish(amount)
        poses = Poses.concatenate([group.poses, drawn])
        return _Group(poses, np.concatenate([sums, added]), totals, counted)

    def _weightings(self, group: int, first: int) -> tuple[NDArray[np.float32], Floats]:
        """Of the rows from ``first`` on, (n, 1 + B): their weights, and times each replicate's counts; and
        how many each counts.
        """
        raw = self.raw[first:].astype(np.float32)
        counts = self.plan.draws.counts(group, first, self.rows.size, self.plan.replicates)
        out = np.empty((len(raw), 1 + self.plan.replicates), dtype=np.float32)
        out[:, 0] = raw
        np.multiply(counts, raw[:, None], out=out[:, 1:])
        return out, counts.sum(axis=0, dtype=np.float64)


def _held_out(rng: np.random.Generator, prefix: int) -> NDArray[np.int64]:
    share = min(_HELD_OUT_MOST, max(1, round(_HELD_OUT_SHARE * prefix)))
    return np.sort(rng.permutation(prefix)[:share])


def _curve_point(grasps: int, values: Floats, log_density: Floats, shares: Floats) -> CurvePoint:
    share = shares / shares.sum()
    mean = float(share @ log_density)
    return CurvePoint(
        grasps=grasps,
        similarity=float(values.mean()),
        deviation=float(np.sqrt(values.var(axis=1, ddof=1).mean())),
        replicates=values,
        log_likelihood=mean,
        log_likelihood_error=float(np.linalg.norm(share * (log_density - mean))),
    )
