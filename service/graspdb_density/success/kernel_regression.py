"""How likely a grasp is to succeed, and how sure that is.

``P = (a m0 + n p) / (a + n)`` with ``p = sum k s / sum k`` over the attempts within reach (s is 1 for a
success), n the effective number of attempts ``(sum k)^2 / sum k^2``, m0 the share of successes among all
attempts and a = 1. Kernels count once an attempt whatever its proposal density: a share of attempts needs no
weighting. The interval is that of the Beta distribution with mean P and n + a trials.

Attempts that are trusted less have a weight w below 1: an attempt then counts as w of one, in the sums of k,
of k^2 and in m0 alike, so that twice the weight is the same as posting it twice (power prior, Ibrahim and
Chen 2000).

An attempt may be k of n tries at one pose: it succeeded by that share, s = k / n, and is one attempt. Tries
at one pose tell much of it and little of its neighbours, so they narrow no interval there.

Where judges of attempts differ, such as two engines, s is their mean, and each attempt's spread is half of
what they differ by. The ends of the interval move outwards by the spread's own kernel mean: within them lies
what any of the judges alone says.

The kernel is isotropic, or a Gaussian with a bandwidth for every axis. The interval covers the truth smoothed
by it, not the truth at a point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv

from .._compiled import diagonal, isotropic, nearest
from .._compiled.orbits.images import image_sums
from .._compiled.orbits.revolution import revolution_displacements, revolution_sums
from .._compiled.threads import for_blocks
from ..kde.cell_list import Cells
from ..kde.isotropic import TWIN_ROTATION, scaled_radius
from ..kde.rows import Rows
from ..kernels.diagonal import DiagonalKernel
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses
from .motions import Motions

__all__ = [
    "PRIOR_TRIALS",
    "SUCCESS_CUTOFF",
    "Attempts",
    "NearestAttempts",
    "Part",
    "Plain",
    "SuccessEstimate",
    "SuccessKernel",
    "SuccessModel",
]

SuccessKernel = IsotropicKernel | DiagonalKernel

#: Trials the prior share is worth.
PRIOR_TRIALS = 1.0
#: An attempt is within reach when position and rotation together are within this many standard deviations.
SUCCESS_CUTOFF = 5.0
#: Poses a thread takes at once.
_ISOTROPIC_BLOCK, _DIAGONAL_BLOCK, _ORBIT_BLOCK, _FAR_BLOCK = 256, 128, 64, 16
#: Shares of a sum in float32 that are its rounding.
_ROUNDING = 1e-5


@dataclass(frozen=True, eq=False, slots=True)
class NearestAttempts:
    """How far M poses are from the attempt nearest to each in the kernel's own measure.

    Attributes
    ----------
    position_m, rotation : (M,)
        Metres, and radians from it or from its jaw's twin, whichever is nearer.
    position_widths, rotation_widths : (M,)
        The same in standard deviations of the kernel.
    displacement : (M, 6) or None
        The translation, metres, along the attempt's gripper's axes, or along the kernel's where it has its
        own; and the rotation vector, radians, in the gripper's axes. None where it was not kept.
    """

    position_m: Floats
    rotation: Floats
    position_widths: Floats
    rotation_widths: Floats
    displacement: Floats | None = None

    @property
    def widths(self) -> Floats:
        """(M,) position and rotation together."""
        return np.hypot(self.position_widths, self.rotation_widths)


@dataclass(frozen=True, eq=False, slots=True)
class SuccessEstimate:
    """Estimates at M poses.

    Attributes
    ----------
    probability, low, high : (M,)
        Success probability and the ends of its interval.
    effective_trials : (M,)
        0 where no attempt is within reach; there the probability is the share of successes of all attempts.
    level : float
        Probability the interval holds.
    """

    probability: Floats
    low: Floats
    high: Floats
    effective_trials: Floats
    level: float


class Attempts(NamedTuple):
    """Attempts (N,) of a model, those of one outcome and weight in the order in which they came.

    ``share`` by how much each succeeded, ``weight`` as how much of one it counts, ``symmetric`` whether its
    jaw is mirror-symmetric.
    """

    poses: Poses
    share: Floats
    weight: Floats
    symmetric: NDArray[np.bool_]


class Plain(NamedTuple):
    """The kernel estimate without its interval at M poses.

    Probability, effective trials, and by how much it may be off where judges of attempts differ, each (M,);
    and how far the nearest attempts are.
    """

    probability: Floats
    trials: Floats
    spread: Floats
    nearest: NearestAttempts


class Part(NamedTuple):
    """Attempts that succeeded by one ``share`` (1, or 0, of most), sorted; each counts as ``weight`` of one.
    The share is known to within the ``spread``.
    """

    cells: Cells
    share: float
    weight: float
    spread: float

    @property
    def size(self) -> int:
        return len(self.cells.rows)


class _Sums(NamedTuple):
    """Weighted sums at poses (M,): of k times the share of success, of k, of k^2, and of k times the spread;
    of every part (P, M) the nearest attempt's exponent and its place, where they were asked for.
    """

    won: Floats
    total: Floats
    squares: Floats
    spread: Floats
    best: Floats
    places: Floats

    @classmethod
    def zeros(cls, count: int, parts: int) -> _Sums:
        return cls(*np.zeros((4, count)), *np.empty((2, parts, count)))


class SuccessModel:
    """Attempts under a kernel, sorted for evaluation; immutable. Use `build` and `extend`."""

    def __init__(
        self, kernel: SuccessKernel, parts: tuple[Part, ...] = (), motions: Motions | None = None
    ) -> None:
        self.kernel = kernel
        #: The attempts by share of success, weight and spread, successes first.
        self.parts = parts
        #: Of a symmetric object, by which each attempt tells of other poses, too.
        self.motions = motions
        #: Within how many standard deviations attempts tell.
        self.cutoff = SUCCESS_CUTOFF

    @classmethod
    def build(
        cls,
        poses: Poses,
        success: ArrayLike,
        *,
        kernel: SuccessKernel,
        symmetric: ArrayLike | bool = True,
        weights: ArrayLike | None = None,
        spread: ArrayLike | None = None,
    ) -> SuccessModel:
        """Sort attempts.

        Parameters
        ----------
        poses : N
            Every attempt, failures included; attempts that broke off for reasons of their own are left out.
        success : (N,) bool, or float from 0 to 1
            Whether each succeeded, or by what share, of few different values.
        kernel
        symmetric : bool or (N,)
            Whether the row's jaw is mirror-symmetric.
        weights : (N,) or None
            As how much of an attempt each counts, positive, of few different values; None: 1.
        spread : (N,) or None
            By how much each share may be wrong either way, of few different values; None: 0.

        Raises
        ------
        ValueError
            For wrong shapes, shares or spreads outside 0 to 1, or weights that are not positive and finite.
        """
        return cls(kernel).extend(poses, success, symmetric, weights, spread)

    def extend(
        self,
        poses: Poses,
        success: ArrayLike,
        symmetric: ArrayLike | bool = True,
        weights: ArrayLike | None = None,
        spread: ArrayLike | None = None,
    ) -> SuccessModel:
        """A model with further attempts; what is present is not sorted again."""
        won = _shares("success", success, len(poses))
        apart = None if spread is None else _shares("spread", spread, len(poses))
        attempts = Rows.of(self._along(poses), weights, symmetric)
        worth = attempts.weights
        # Weights are the parts': kernels count once.
        attempts = Rows(attempts.poses, np.ones(len(attempts)), attempts.symmetric)
        parts = {part[1:]: part.cells for part in self.parts}
        for share, weight, wide, chosen in _alike(won, worth, apart):
            rows = attempts[chosen]
            present = parts.get((share, weight, wide))
            # No width is larger than the one the cells are made for, so their runs reach far enough.
            parts[share, weight, wide] = (
                Cells.build(rows, self.widest_m) if present is None else present.extend(rows)
            )
        # Heaviest successes first, whatever came first.
        ordered = sorted(parts, reverse=True)
        return SuccessModel(self.kernel, tuple(Part(parts[key], *key) for key in ordered), self.motions)

    def shared(self, motions: Motions, *, most: int | None = None) -> SuccessModel:
        """The same attempts, each telling of every pose that a motion of the object takes its own to.

        It stays one attempt wherever it tells of. Of more than ``most`` attempts so many, drawn at random,
        are taken. Under an axis of revolution, widths along fixed axes of the object become one that takes as
        much room.
        """
        kernel, size = self.kernel, self.size
        thinned = most is not None and size > most
        if motions.upright is None and not thinned:
            return SuccessModel(kernel, self.parts, motions)
        if motions.upright is not None and isinstance(kernel, DiagonalKernel) and kernel.axes is not None:
            even = math.prod(kernel.sigmas[:3]) ** (1.0 / 3.0)
            kernel = DiagonalKernel.of([even, even, even, *kernel.sigmas[3:]])
        found = SuccessModel(kernel, (), motions)
        rng, parts = np.random.default_rng(0), []
        for part in self.parts:
            # In the order that they came in, which does not depend on how they were added.
            places = np.argsort(part.cells.rows, kind="stable")
            if thinned and most is not None:
                places = places[rng.permutation(part.size)[: math.ceil(most * part.size / size)]]
            poses = part.cells.poses(places)
            if motions.upright is not None:
                if isinstance(self.kernel, DiagonalKernel):
                    poses = self.kernel.back(poses)
                poses = motions.in_half_plane(poses)
            rows = Rows(poses, np.ones(len(places)), part.cells.symmetric[places])
            parts.append(part._replace(cells=Cells.build(rows, found.widest_m)))
        return SuccessModel(kernel, tuple(parts), motions)

    def narrowed(self, cutoff: float) -> SuccessModel:
        """Nearly the same, from the attempts within fewer standard deviations: 3 leave a sixth of the
        kernel's mass out and three quarters of the work.
        """
        found = SuccessModel(self.kernel, self.parts, self.motions)
        found.cutoff = cutoff
        return found

    @property
    def size(self) -> int:
        """Attempts, whatever they weigh."""
        return sum(part.size for part in self.parts)

    @property
    def worth(self) -> tuple[float, float]:
        """As how many attempts those that succeeded count by their weights, and all of them."""
        won = sum(part.weight * part.size * part.share for part in self.parts)
        return won, sum(part.weight * part.size for part in self.parts)

    @property
    def prior_share(self) -> float:
        """Share of successes among all attempts by their weights, nan without any."""
        won, total = self.worth
        return won / total if total else math.nan

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        return sum(part.cells.nbytes for part in self.parts)

    def drawn(self, count: int, rng: np.random.Generator) -> list[tuple[float, Poses]]:
        """As how many attempts the successes count, and the failures, and about ``count`` of each drawn at
        random in proportion to their weights.
        """
        found = []
        for won in (True, False):
            counted = [
                part.weight * part.size * (part.share if won else 1.0 - part.share) for part in self.parts
            ]
            total = sum(counted)
            drawn = [Poses(np.empty((0, 3)), np.empty((0, 4)))]
            for part, counts in zip(self.parts, counted, strict=True):
                if not counts:
                    continue
                most = math.ceil(count * counts / total)
                drawn.append(part.cells.poses(rng.permutation(part.size)[:most]))
            poses = Poses.concatenate(drawn)
            if self.motions is not None and self.motions.upright is not None:
                poses = self.motions.from_half_plane(poses)
            elif isinstance(self.kernel, DiagonalKernel):
                poses = self.kernel.back(poses)
            found.append((total, poses))
        return found

    def attempts(self) -> Attempts:
        """All of them, their poses as precise as they are held."""
        if not self.parts:
            raise ValueError("a model without attempts has none")
        poses, symmetric = [], []
        for part in self.parts:
            came = np.argsort(part.cells.rows)
            poses.append(part.cells.poses(came))
            symmetric.append(part.cells.symmetric[came])
        every = Poses.concatenate(poses)
        if isinstance(self.kernel, DiagonalKernel):
            every = self.kernel.back(every)
        share, weight = (
            np.concatenate([np.full(part.size, part[column]) for part in self.parts]) for column in (1, 2)
        )
        return Attempts(every, share, weight, np.concatenate(symmetric))

    def without(self, others: SuccessModel, poses: Poses, *, threads: int = 1) -> tuple[Floats, Floats]:
        """The probability and effective trials at M poses if ``others``, some of the attempts under the same
        kernel, had not been tried; 0 trials where all that tell are of them.
        """
        mine, theirs = self._sums(poses, threads), others._sums(poses, threads)
        # What is left of equal sums is their rounding.
        some = mine.total - theirs.total > _ROUNDING * mine.total
        won, total, squares = (
            np.where(some, np.maximum(whole - part, 0.0), 0.0)
            for whole, part in zip(mine[:3], theirs[:3], strict=True)
        )
        (won_all, worth), (won_part, worth_part) = self.worth, others.worth
        prior = (won_all - won_part) / (worth - worth_part) if worth > worth_part else self.prior_share
        squares = np.where(some, np.maximum(squares, _ROUNDING * total * total), 0.0)
        probability, trials, _ = shrunk_share(np.minimum(won, total), total, squares, prior)
        return probability, trials

    def evaluate(self, poses: Poses, *, level: float = 0.9, threads: int = 1) -> SuccessEstimate:
        """Success probability with its interval at M poses.

        Raises
        ------
        ValueError
            Without any attempt, or for a level outside (0, 1).
        """
        return self._estimate(self._sums(poses, threads), level, threads)

    def evaluate_near(
        self, poses: Poses, *, level: float = 0.9, threads: int = 1
    ) -> tuple[SuccessEstimate, NearestAttempts]:
        """As `evaluate`, and how far the nearest attempts are, however far: for little more."""
        sums = self._sums(poses, threads, nearest=True)
        return self._estimate(sums, level, threads), self._nearest(poses, sums, threads, everywhere=True)

    def _estimate(self, sums: _Sums, level: float, threads: int) -> SuccessEstimate:
        if not 0.0 < level < 1.0:
            raise ValueError(f"level must be between 0 and 1, not {level!r}")
        probability, trials, alpha, beta = self._beta(sums)
        tail = 0.5 * (1.0 - level)
        apart = _spread(sums)
        low = np.maximum(_quantiles(alpha, beta, tail, threads) - apart, 0.0)
        high = np.minimum(_quantiles(alpha, beta, 1.0 - tail, threads) + apart, 1.0)
        return SuccessEstimate(probability, low, high, trials, level)

    def probability(self, poses: Poses, *, threads: int = 1) -> Floats:
        """The probability of `evaluate` alone, (M,): much faster, for the interval's ends take longest."""
        return self._beta(self._sums(poses, threads))[0]

    def without_interval(
        self, poses: Poses, *, everywhere: bool = False, threads: int = 1
    ) -> tuple[Floats, Floats, NearestAttempts]:
        """The probability and effective trials of `evaluate`, (M,), and how far the nearest attempts are.

        Those beyond the cut-off are only looked for ``everywhere``: else their distance is infinite.
        """
        plain = self.without_quantiles(poses, everywhere=everywhere, threads=threads)
        return plain.probability, plain.trials, plain.nearest

    def counted(self, poses: Poses, *, threads: int = 1) -> tuple[Floats, Floats]:
        """As how many successes and as how many attempts those around count at M poses, (M,) each: one at a
        pose counts as 1 there, and by the kernel elsewhere. Unlike effective trials they fall off with
        distance.
        """
        if not self.size or not len(poses):
            return np.zeros(len(poses)), np.zeros(len(poses))
        sums, (one,) = self._sums(poses, threads), self._alone(poses[:1], poses[:1])
        return sums.won / one, sums.total / one

    def nearness(self, pose: Poses, poses: Poses) -> Floats:
        """As how much of an attempt one more at a pose (1) would count at M others, by kernel and motions."""
        return self._alone(pose, poses) / self._alone(pose, pose)

    def _alone(self, pose: Poses, poses: Poses) -> Floats:
        """The kernel sum (M,) of one attempt, with a jaw as that of those there are."""
        symmetric = all(part.cells.symmetric.all() for part in self.parts)
        won = np.ones(1, dtype=np.bool_)
        alone = SuccessModel.build(pose, won, kernel=self.kernel, symmetric=symmetric)
        return (alone if self.motions is None else alone.shared(self.motions))._sums(poses, 1).total

    def support(self, poses: Poses, *, threads: int = 1) -> tuple[Floats, NearestAttempts]:
        """Effective trials at M poses, and how far the nearest attempts are, however far."""
        _, trials, nearest = self.without_interval(poses, everywhere=True, threads=threads)
        return trials, nearest

    def without_quantiles(self, poses: Poses, *, everywhere: bool, threads: int) -> Plain:
        """As `without_interval`, and what the interval is wider by: of the kernels alone, for estimates that
        are made of it.
        """
        sums = self._sums(poses, threads, nearest=True)
        probability, trials, _, _ = self._beta(sums)
        nearest = self._nearest(poses, sums, threads, everywhere=everywhere)
        return Plain(probability, trials, _spread(sums), nearest)

    def lower_end(
        self,
        poses: Poses,
        *,
        level: float = 0.9,
        near: Callable[[NearestAttempts], NDArray[np.bool_]] | None = None,
        threads: int = 1,
    ) -> Floats:
        """The lower end of `evaluate` alone, (M,); where the nearest attempt is not ``near``, no higher than
        if nothing had been tried.
        """
        sums = self._sums(poses, threads, nearest=near is not None)
        _, _, alpha, beta = self._beta(sums)
        low = np.maximum(_quantiles(alpha, beta, 0.5 * (1.0 - level), threads) - _spread(sums), 0.0)
        if near is None:
            return low
        told = near(self._nearest(poses, sums, threads, everywhere=False))
        return np.where(told, low, np.minimum(low, self.untried_low(level)))

    def untried_low(self, level: float) -> float:
        """The lower end of the interval where nothing has been tried."""
        _, _, alpha, beta = self._beta(_Sums.zeros(1, 0))
        return float(_quantiles(alpha, beta, 0.5 * (1.0 - level), 1)[0])

    def _beta(self, sums: _Sums) -> tuple[Floats, Floats, Floats, Floats]:
        """Probability, effective trials and the parameters of the interval's Beta distribution, each (M,)."""
        if not self.size:
            raise ValueError("a success probability needs at least one attempt")
        prior = self.prior_share
        probability, trials, share = shrunk_share(sums.won, sums.total, sums.squares, prior)
        alpha = PRIOR_TRIALS * prior + trials * share
        beta = PRIOR_TRIALS * (1.0 - prior) + trials * (1.0 - share)
        # Without any success, or any failure, the matching Beta would be a point: the interval then starts
        # from the share that half a trial more of either would give.
        if prior in (0.0, 1.0):
            won, attempts = self.worth
            softened = (won + 0.5) / (attempts + 1.0)
            alpha, beta = alpha + (softened - prior), beta - (softened - prior)
        return probability, trials, alpha, beta

    def _sums(self, poses: Poses, threads: int, *, nearest: bool = False) -> _Sums:
        """The kernel sums at poses; with the ``nearest`` attempt of every part."""
        found = _Sums.zeros(len(poses), len(self.parts))
        for number, part in enumerate(self.parts):
            total, squares, *place = self._sums_of(part.cells, poses, 4 if nearest else 2, threads).T
            for column, factor, of in (
                (found.won, part.share, total),
                (found.total, 1.0, total),
                (found.squares, 1.0, squares),
                (found.spread, part.spread, total),
            ):
                if factor:
                    column += of if factor * part.weight == 1.0 else factor * part.weight * of
            if nearest:
                found.best[number], found.places[number] = place
        return found

    def _sums_of(self, cells: Cells, poses: Poses, columns: int, threads: int) -> Floats:
        radius, kernel = scaled_radius(self.cutoff), self.kernel
        arrays = cells.arrays
        if self.motions is not None:
            work = partial(self._orbit_sums, self.motions, cells, radius)
            return cells.at_poses(work, poses, columns=(columns,), block=_ORBIT_BLOCK, threads=threads)
        if isinstance(kernel, DiagonalKernel):
            half, turning, block = self.half(cells), self.turning, _DIAGONAL_BLOCK

            def loop(p: Floats, q: Floats, out: Floats) -> None:
                diagonal.square_sums(arrays, p, q, half, turning, radius, out)
        else:
            kappa, wide, block = kernel.kappa, kernel.sigma_rotation > TWIN_ROTATION, _ISOTROPIC_BLOCK

            def loop(p: Floats, q: Floats, out: Floats) -> None:
                isotropic.square_sums(arrays, p, q, kappa, radius, wide, out)

        return cells.at_poses(loop, self._along(poses), columns=(columns,), block=block, threads=threads)

    def _orbit_sums(
        self, motions: Motions, cells: Cells, radius: float, p: Floats, q: Floats, out: Floats
    ) -> None:
        """As `_sums_of`, of attempts that every motion of the object has taken elsewhere, too."""
        positions, quaternions = self._seen(motions, Poses(p, q))
        half, kappa = self.half(cells), self._kappa
        if motions.upright is not None:
            revolution_sums(cells.arrays, positions, quaternions, half, kappa, self.turning, radius, out)
            return
        wide = kappa > 0.0 and 2.0 / math.sqrt(kappa) > TWIN_ROTATION
        image_sums(cells.arrays, positions, quaternions, half, kappa, wide, self.turning, radius, out)

    def _seen(self, motions: Motions, poses: Poses) -> Poses:
        """The images (M, n) of poses as the sorted attempts lie."""
        images = motions.images(poses)
        if motions.upright is not None:
            return motions.in_half_plane(images)
        shape = images.positions.shape[:2]
        flat = Poses(images.positions.reshape(-1, 3), images.quaternions_xyzw.reshape(-1, 4))
        along = self._along(flat)
        return Poses(along.positions.reshape(*shape, 3), along.quaternions_xyzw.reshape(*shape, 4))

    @property
    def _kappa(self) -> float:
        """The concentration of an isotropic kernel, 0 of another."""
        return self.kernel.kappa if isinstance(self.kernel, IsotropicKernel) else 0.0

    def _nearest(self, poses: Poses, sums: _Sums, threads: int, *, everywhere: bool) -> NearestAttempts:
        """How far the nearest attempts are; those that no sum reached are looked for ``everywhere``."""
        best, places = sums.best, sums.places
        far = np.flatnonzero(places.max(axis=0, initial=-1.0) < 0.0)
        if everywhere and far.size:
            best[:, far], places[:, far] = self._search(poses[far], threads)
        distances = np.full((len(poses), 10), np.inf)
        nearer = np.argmax(best, axis=0) if self.parts else np.empty(0)
        for number, part in enumerate(self.parts):
            rows = np.flatnonzero((nearer == number) & (places[number] >= 0.0))
            if rows.size:
                distances[rows] = self._displaced(part.cells, places[number, rows], poses[rows])
        metres, radians, along, about = np.ascontiguousarray(distances[:, :4].T)
        return NearestAttempts(metres, radians, along, about, distances[:, 4:])

    def _displaced(self, cells: Cells, places: Floats, poses: Poses) -> Floats:
        """From sorted attempts to poses, or the image of each that is nearest to its attempt, (M, 10)."""
        motions = self.motions
        if motions is None:
            return self.displacements(cells, places, self._along(poses))
        seen = self._seen(motions, poses)
        if motions.upright is not None:
            out, at = np.empty((len(poses), 10)), places.astype(np.int64)
            half, kappa = self.half(cells), self._kappa
            revolution_displacements(cells.arrays, at, *seen, half, kappa, self.turning, out)
            return out
        shape = seen.positions.shape[:2]
        flat = Poses(seen.positions.reshape(-1, 3), seen.quaternions_xyzw.reshape(-1, 4))
        away = self.displacements(cells, np.repeat(places, shape[1]), flat)
        nearer = np.argmin(np.hypot(away[:, 2], away[:, 3]).reshape(shape), axis=1)
        return np.asarray(away.reshape(*shape, 10)[np.arange(len(poses)), nearer])

    def displacements(self, cells: Cells, places: Floats, along: Poses) -> Floats:
        """From sorted attempts to poses along the kernel's axes, (M, 10), as `diagonal.displacements`."""
        at, out = places.astype(np.int64), np.empty((len(along), 10))
        gripper = self.turning or isinstance(self.kernel, IsotropicKernel)
        diagonal.displacements(cells.arrays, at, *along, self.half(cells), self.turning, gripper, out)
        return out

    def _search(self, poses: Poses, threads: int) -> Floats:
        """Largest exponents and their places in every part, however far, (2, P, M)."""
        motions = self.motions
        if motions is not None:
            seen = self._seen(motions, poses)
            return self._search_images(
                seen if motions.upright is None else motions.turned_about(seen), threads
            )
        return self._search_along(self._along(poses), threads)

    def _search_along(self, along: Poses, threads: int) -> Floats:
        """As `_search`, as the sorted attempts lie."""
        found = np.empty((2, len(self.parts), len(along)))
        kernel = self.kernel
        for number, part in enumerate(self.parts):
            arrays = part.cells.arrays
            if isinstance(kernel, DiagonalKernel):
                loop = partial(_nearest_diagonal, arrays, self.half(part.cells), self.turning)
            else:
                loop = partial(_nearest_anywhere, arrays, kernel.kappa)
            best = part.cells.at_poses(loop, along, columns=(2,), block=_FAR_BLOCK, threads=threads)
            found[:, number] = best.T
        return found

    def _search_images(self, images: Poses, threads: int) -> Floats:
        """As `_search`, the largest of all images (M, n) of each pose."""
        found = np.full((2, len(self.parts), len(images)), -np.inf)
        for number in range(images.positions.shape[1]):
            p, q = (np.ascontiguousarray(part[:, number]) for part in images)
            seen = self._search_along(Poses(p, q), threads)
            found = np.where(seen[0] > found[0], seen, found)
        return found

    @property
    def widest_m(self) -> float:
        """The kernel's largest width in position."""
        kernel = self.kernel
        return kernel.sigma_position_m if isinstance(kernel, IsotropicKernel) else max(kernel.sigmas[:3])

    @property
    def sigmas(self) -> tuple[float, ...]:
        """The kernel's width along and about every axis, metres and radians, (6,)."""
        kernel = self.kernel
        if isinstance(kernel, IsotropicKernel):
            return (kernel.sigma_position_m,) * 3 + (kernel.sigma_rotation,) * 3
        return tuple(kernel.sigmas)

    @property
    def turning(self) -> bool:
        """Whether translations are along each attempt's gripper's axes."""
        return isinstance(self.kernel, DiagonalKernel) and self.kernel.axes is None

    def half(self, cells: Cells) -> Floats:
        """1 / (2 sigma^2) of every axis (6,), translations in units of the cells' scale."""
        kernel = self.kernel
        if isinstance(kernel, IsotropicKernel):
            return np.repeat([1.0, 0.5 / kernel.sigma_rotation**2], 3)
        half = 0.5 / np.array(kernel.sigmas) ** 2
        half[:3] /= cells.arrays.scale**2
        return np.asarray(half, dtype=np.float64)

    def _along(self, poses: Poses) -> Poses:
        """Poses with their positions along the kernel's fixed axes, where it has such."""
        if isinstance(self.kernel, IsotropicKernel):
            return poses
        return self.kernel.along(poses)


def _nearest_anywhere(arrays: Any, kappa: float, p: Floats, q: Floats, out: Floats) -> None:
    nearest.nearest_anywhere(arrays, p, q, kappa, out)


def _nearest_diagonal(arrays: Any, half: Floats, turning: bool, p: Floats, q: Floats, out: Floats) -> None:
    diagonal.nearest_anywhere(arrays, p, q, half, turning, out)


def shrunk_share(
    won: Floats, total: Floats, squares: Floats, prior: float | Floats
) -> tuple[Floats, Floats, Floats]:
    """Success probability, effective trials and the share it is shrunk from, each (M,).

    Parameters
    ----------
    won, total, squares : (M,)
        Sums of k over successes, and of k and k^2 over all attempts.
    prior : float or (M,)
        The share of successes among all attempts.
    """
    reached = total > 0.0
    safe = np.where(reached, total, 1.0)
    share = np.where(reached, won / safe, 0.0)
    trials = np.where(reached, safe * (safe / np.where(reached, squares, 1.0)), 0.0)
    return (PRIOR_TRIALS * prior + trials * share) / (PRIOR_TRIALS + trials), trials, share


def _quantiles(alpha: Floats, beta: Floats, level: float, threads: int) -> Floats:
    """Quantiles (M,) of Beta distributions."""
    out = np.empty(len(alpha))

    def work(begin: int, end: int) -> None:
        out[begin:end] = betaincinv(alpha[begin:end], beta[begin:end], level)

    for_blocks(work, len(alpha), block=4_096, threads=threads)
    return out


def _spread(sums: _Sums) -> Floats:
    """The kernel mean (M,) of by how much shares may be wrong."""
    return np.asarray(sums.spread / np.where(sums.total > 0.0, sums.total, 1.0))


def _alike(
    won: NDArray[Any], worth: Floats, spread: NDArray[Any] | None
) -> Iterator[tuple[float, float, float, NDArray[np.bool_]]]:
    """Attempts (N,) that share a share, a weight and a spread: the three, and which they are."""
    # Of millions nearly all succeeded or failed, and weigh the same: no search for what differs then.
    shares = (1.0, 0.0) if won.dtype == np.bool_ else np.unique(won).tolist()
    spreads = [0.0] if spread is None else np.unique(spread).tolist()
    for weight in np.unique(worth).tolist():
        weighs = worth == weight
        for share in shares:
            alike = weighs & (won == share)
            for wide in spreads:
                chosen = alike if spread is None else alike & (spread == wide)
                if chosen.any():
                    yield share, weight, wide, chosen


def _shares(name: str, values: ArrayLike, count: int) -> NDArray[Any]:
    """Whether attempts (N,) succeeded, or by what share, checked."""
    found = np.asarray(values)
    if found.shape != (count,) or found.dtype not in (np.bool_, np.float64):
        raise ValueError(
            f"{name} must be bools or float64 of shape ({count},), not {found.dtype} of shape {found.shape}"
        )
    if found.dtype != np.bool_ and not ((found >= 0.0) & (found <= 1.0)).all():
        raise ValueError(f"{name} must be from 0 to 1")
    return found


def checked_outcomes(success: ArrayLike, count: int) -> NDArray[np.bool_]:
    """Whether attempts (N,) succeeded, checked."""
    won = np.asarray(success)
    if won.shape != (count,) or won.dtype != np.bool_:
        raise ValueError(f"success must be bools of shape ({count},), not {won.dtype} of shape {won.shape}")
    return won
