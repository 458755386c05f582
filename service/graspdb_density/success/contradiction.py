"""Whether outcomes contradict a symmetry: do attempts fare as those that a motion takes to where they are?

At places that are apart the attempts there are compared with those that some motion takes there from
elsewhere: two shares of successes, each of so many effective trials, by Fisher's exact test. Kernels blur a
share where outcomes change, and by another amount where other poses were tried; so no side counts for more
than :data:`_TRIALS`, and differences of about a tenth are none.

The symmetry is refused where a single place differs (Bonferroni), or those together of which no motion takes
one to another (Fisher's combination), or by their side of the object: a handle that the mesh lacks is in one
place, a centre of mass off the middle tells a little everywhere. All are asked under the kernel and one twice
as wide, under which few attempts tell more; together they refuse a symmetric object no more often than
:data:`CHANCE`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, betaincinv, chdtrc

from .. import se3
from ..kde.cell_list import Cells
from ..kde.rows import Rows
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses
from .kernel_regression import SuccessKernel, SuccessModel
from .motions import Motions

__all__ = ["CHANCE", "Place", "SymmetryVerdict", "contradiction"]

#: How often a symmetric object with noisy outcomes is refused, at most.
CHANCE = 0.05
#: Attempts at which sides are compared, places that are left of them, and how far those are apart, in widths.
_LOOKED_AT, _PLACES, _APART = 200, 70, 3.0
#: Most attempts that are compared: of more, so many drawn at random.
_COMPARED = 10_000
#: Most trials that a side counts for, fewest of either side that are compared, and fewest in all that tell.
_TRIALS, _LEAST, _ENOUGH = 40.0, 0.9, 8.0
#: A place speaks against it from this probability on.
_AGAINST = 0.05
#: Widths at which they are compared, in kernel widths, and the widest rotation, radians.
_SCALES, _WIDEST = (1.0, 2.0), math.radians(45.0)
#: Fewest places of which sides are told, and how little attempts may be spread along one beside the others.
_FEWEST, _FLAT, _STRICTER = 10, 1e-3, 3.0
#: From so many motions on, each place is compared with many others.
_MANY = 6
#: Farther than any attempt, metres.
_NOWHERE = 1e3
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


@dataclass(frozen=True, eq=False, slots=True)
class Place:
    """A place where attempts were compared: their share of successes and effective trials, and those of the
    attempts that motions take there; ``chance`` of so large a difference if there is none.
    """

    position: Floats
    share: float
    trials: float
    other_share: float
    other_trials: float
    chance: float


@dataclass(frozen=True, eq=False, slots=True)
class SymmetryVerdict:
    """What outcomes say of a symmetry.

    Attributes
    ----------
    places
        Where it was asked, the strongest against it first.
    told : bool
        Whether there was enough to tell anything.
    refused : bool
        Whether they contradict it.
    """

    places: tuple[Place, ...]
    told: bool
    refused: bool

    @property
    def against(self) -> tuple[Place, ...]:
        """The places that speak against it."""
        return tuple(place for place in self.places if place.chance <= _AGAINST)


def contradiction(
    model: SuccessModel, motions: Motions, *, threads: int = 1, chance: float = CHANCE
) -> SymmetryVerdict:
    """What a model's own outcomes say of motions; the same for the same attempts in the same order.

    Parameters
    ----------
    model
        Not shared by any motion.
    """
    found = [_compared(_widened(model, scale), motions, threads, chance / len(_SCALES)) for scale in _SCALES]
    told = [each for each in found if each.told]
    if not told:
        return found[0]
    # What is refused, and else what compares the finest.
    return next((each for each in told if each.refused), told[0])


def _compared(model: SuccessModel, motions: Motions, threads: int, chance: float) -> SymmetryVerdict:
    """As `contradiction`, under one kernel."""
    asked = Poses.concatenate([poses for _, poses in model.drawn(_LOOKED_AT // 2, np.random.default_rng(0))])
    nothing = SymmetryVerdict((), False, False)
    if not len(asked):
        return nothing
    other_motions = _Elsewhere.of_model(model, motions, asked)
    elsewhere = SuccessModel(model.kernel, model.parts, other_motions)
    here, there = (each._sums(asked, threads) for each in (model, elsewhere))
    trials = np.stack([_trials(sums.total, sums.squares) for sums in (here, there)])
    shares = np.stack([sums.won / np.where(sums.total > 0.0, sums.total, 1.0) for sums in (here, there)])
    order = np.argsort(-np.minimum(trials.min(axis=0), _TRIALS), kind="stable")
    chosen = _apart(model, None, asked, order[trials.min(axis=0)[order] >= _LEAST])
    # Places of one orbit share what they are compared with: little where that is of many others.
    single = chosen if len(other_motions) >= _MANY else _apart(model, motions, asked, chosen)
    if np.minimum(trials[:, single].min(axis=0), _TRIALS).sum() < _ENOUGH:
        return nothing
    chances, places = np.empty(len(asked)), []
    for row in chosen:
        (own, other), (n, m) = shares[:, row].tolist(), trials[:, row].tolist()
        chances[row] = _fisher(own, min(n, _TRIALS), other, min(m, _TRIALS))
        places.append(Place(asked.positions[row], own, n, other, m, float(chances[row])))
    places.sort(key=lambda place: place.chance)
    logs = np.log(np.maximum(chances[single], 1e-300))
    together = float(chdtrc(2 * len(logs), -2.0 * logs.sum()))
    sided = _sided(asked[single], motions.centre, shares[:, single], np.minimum(trials[:, single], _TRIALS))
    # Of few trials a place the score is no normal deviate: it gets a smaller share of the chance.
    least = min(together, _STRICTER * sided, len(chosen) * float(chances[chosen].min()))
    refused = least <= chance / 3.0
    return SymmetryVerdict(tuple(places), True, refused)


def _sided(asked: Poses, centre: Floats, shares: Floats, trials: Floats) -> float:
    """How probable it is by chance alone that attempts fare so much better to one side of the object, or from
    one direction: a score test of the differences (2, K) of shares along position and approach.
    """
    won, total = (shares * trials).sum(axis=0), trials.sum(axis=0)
    pooled = (won + 0.5) / (total + 1.0)
    weight = 1.0 / (pooled * (1.0 - pooled) * (1.0 / trials).sum(axis=0))
    away = asked.positions - centre
    size = math.sqrt(float(np.mean(away * away))) or 1.0
    approach = se3.rotate(asked.quaternions_xyzw, np.array([0.0, 0.0, 1.0]))
    sides = np.concatenate([away / size, approach], axis=1)
    score = sides.T @ (weight * (shares[0] - shares[1]))
    values, vectors = np.linalg.eigh((sides * weight[:, None]).T @ sides)
    told = values > _FLAT * values.max(initial=0.0)
    if not told.any() or len(weight) < _FEWEST:
        return 1.0
    along = vectors.T @ score
    return float(chdtrc(int(told.sum()), np.sum(along[told] ** 2 / values[told])))


def _widened(model: SuccessModel, scale: float) -> SuccessModel:
    """The same attempts, or a sample of many, under a kernel that is so many times as wide."""
    share = _COMPARED / max(model.size, 1)
    if scale == 1.0 and share >= 1.0:
        return model
    kernel: SuccessKernel
    if isinstance(model.kernel, IsotropicKernel):
        rotation = min(scale * model.kernel.sigma_rotation, _WIDEST)
        kernel = IsotropicKernel(scale * model.kernel.sigma_position_m, rotation)
    else:
        kernel = replace(model.kernel, sigmas=tuple(scale * sigma for sigma in model.kernel.sigmas))
    wider = SuccessModel(kernel)
    parts, rng = [], np.random.default_rng(0)
    for part in model.parts:
        # In the order that they came in, along the axes that they lie along already.
        places = np.argsort(part.cells.rows, kind="stable")
        if share < 1.0:
            places = places[rng.permutation(part.size)[: math.ceil(share * part.size)]]
        symmetric = part.cells.symmetric[places]
        rows = Rows(part.cells.poses(places), np.ones(len(places)), symmetric)
        parts.append(part._replace(cells=Cells.build(rows, wider.widest_m)))
    return SuccessModel(kernel, tuple(parts))


class _Elsewhere(Motions):
    """Motions without those that leave a pose about where it is; turns about an axis as far apart."""

    widths: tuple[float, float]

    @classmethod
    def of_model(cls, model: SuccessModel, motions: Motions, poses: Poses) -> _Elsewhere:
        sigmas = model.sigmas
        metres, radians = max(sigmas[:3]), max(sigmas[3:])
        every = motions
        if motions.upright is not None:
            away = se3.rotate(motions.upright, poses.positions - motions.centre)
            lever = float(np.median(np.hypot(away[:, 0], away[:, 1])))
            width = 1.0 / math.hypot(lever / metres, 1.0 / radians)
            every = motions.turned(max(int(math.tau / (_APART * width)), 2))
        found = cls(motions.centre, every.quaternions, every.mirrors)
        object.__setattr__(found, "widths", (metres, radians))
        return found

    def images(self, poses: Poses) -> Poses:
        images = super().images(poses)
        shift = np.linalg.norm(images.positions - poses.positions[:, None], axis=-1) / self.widths[0]
        own = poses.quaternions_xyzw[:, None]
        turn = np.minimum(
            se3.angle_between(own, images.quaternions_xyzw),
            se3.angle_between(se3.jaw_twin(own), images.quaternions_xyzw),
        )
        near = np.hypot(shift, turn / self.widths[1]) < _APART
        return Poses(images.positions + np.where(near, _NOWHERE, 0.0)[..., None], images.quaternions_xyzw)


def _apart(
    model: SuccessModel, motions: Motions | None, poses: Poses, order: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Rows that are apart, also after every motion, those that come first in this order."""
    sigmas = model.sigmas
    kernel = IsotropicKernel(max(sigmas[:3]), max(sigmas[3:]))
    chosen: list[int] = []
    left = np.array(order, dtype=np.int64)
    while len(left) and len(chosen) < _PLACES:
        first = left[:1]
        chosen.append(int(first[0]))
        one = SuccessModel.build(poses[first], np.ones(1, dtype=np.bool_), kernel=kernel)
        if motions is not None:
            one = one.shared(motions)
        _, _, nearest = one.without_interval(poses[left])
        left = left[nearest.widths >= _APART]
        left = left[left != first[0]]
    return np.array(chosen, dtype=np.int64)


def _trials(total: Floats, squares: Floats) -> Floats:
    return np.asarray(total * (total / np.where(total > 0.0, squares, 1.0)))


def _fisher(share: float, trials: float, other_share: float, other_trials: float) -> float:
    """Two-sided probability of shares that differ so much, of trials that need not be whole numbers.

    Fisher's exact test in its form as a comparison of two Beta distributions (Altham, J. R. Stat. Soc. B 31,
    1969): P(p >= q), p of Beta(k + 1, n - k), q of Beta(l, m - l + 1), and the other way round.
    """
    won, lost = share * trials, (1.0 - share) * trials
    other_won, other_lost = other_share * other_trials, (1.0 - other_share) * other_trials
    more = _exceeds(won + 1.0, lost, other_won, other_lost + 1.0)
    fewer = _exceeds(other_won + 1.0, other_lost, won, lost + 1.0)
    return min(1.0, 2.0 * min(more, fewer))


def _exceeds(a: float, b: float, c: float, d: float) -> float:
    """P(p >= q) of p of Beta(a, b) and q of Beta(c, d); 1 where p is 1 or q is 0 for certain."""
    if b <= 1e-9 or c <= 1e-9:
        return 1.0
    # Over equal steps of q's own distribution.
    u = 0.5 * (_NODES + 1.0)
    q = betaincinv(c, d, u)
    return float(0.5 * np.dot(_WEIGHTS, 1.0 - betainc(a, b, q)))
