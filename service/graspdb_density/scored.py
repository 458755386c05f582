"""The best grasps by any score of a pose, and scores averaged over pose noise.

A density has its own climb (`maximum`). A success probability's lower end, an expectation under noise or a
mixture kernel's density have none; here they are searched by values alone, from where an isotropic density is
high.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri
from scipy.stats import qmc

from . import se3
from .maximum import Admissible, Maximum, Pool, Search
from .region import Region
from .se3 import Floats

if TYPE_CHECKING:
    from .density import GraspDensity

__all__ = ["PoseNoise", "Pull", "Score", "expected", "search_scored"]

#: Scores poses (K, 3), (K, 4): (K,), higher is better.
Score = Callable[[Floats, Floats], Floats]
#: Moves poses (K, 3), (K, 4).
Pull = Callable[[Floats, Floats], tuple[Floats, Floats]]

_CANDIDATES = 192
#: Centres whose score is asked for before any is climbed from: a density tells little of where another score
#: is high.
_ASKED = 4096
#: Climbs, random steps a climb tries at a time, and how often: many for a little, the best of them further.
_PHASES = ((64, 8, 12), (12, 12, 24), (3, 24, 20))
#: Draws around centres in reach, and how many of them may join the starts: where the nearest poses of centres
#: are refused, others may not be.
_DRAWN, _JOINING = 2048, 64
#: Steps in kernel widths.
_FIRST_STEP, _LAST_STEP = 0.6, 5e-3


def search_scored(
    density: GraspDensity,
    score: Score,
    region: Region | None = None,
    *,
    count: int = 1,
    min_separation_m: float = 0.01,
    min_separation: float = math.radians(20.0),
    admissible: Admissible | None = None,
    pull: Pull | None = None,
    threads: int = 1,
) -> list[Maximum]:
    """The ``count`` best distinct grasps by ``score``, best first; arguments as in `maximum.search`.

    Candidates are well separated centres of the density, projected into the region, those of the highest
    score among at most 4,096 centres: half of them where the density is highest, half drawn at random. The
    best climb by random steps, drawn from a fixed seed, that shrink as they fail. ``Maximum.score`` is the
    score. ``pull`` brings poses nearer to where they are admissible; random steps end where it puts them.
    """
    found = _ScoredSearch(density, region or Region(), admissible, threads, score, pull)
    return found.run(count, min_separation_m, min_separation)


class _ScoredSearch(Search):
    starts_wanted = _CANDIDATES

    def __init__(
        self,
        density: GraspDensity,
        region: Region,
        admissible: Admissible | None,
        threads: int,
        score: Score,
        pull: Pull | None,
    ) -> None:
        super().__init__(density, region, admissible, threads)
        self.score = score
        self.pull = pull

    @property
    def rough(self) -> int:
        return 1

    def sums(self, positions: Floats, quaternions: Floats) -> Floats:
        values = np.asarray(self.score(positions, quaternions), dtype=np.float64)
        if values.shape != (len(positions),):
            raise ValueError(f"the score answered shape {values.shape} for {len(positions)} poses")
        return values

    def values(self, found: Pool, logs: Floats) -> Floats:
        return self.sums(found.positions, found.quaternions)

    def candidates(self) -> Iterator[tuple[NDArray[np.intp], NDArray[np.bool_]]]:
        promise, turned = self.scores(0, self.density.size)
        places = np.flatnonzero(promise > -np.inf)
        rest = places[:0]
        if len(places) > _ASKED:
            places = places[np.argsort(-promise[places], kind="stable")]
            others = np.random.default_rng(0).permutation(places[_ASKED // 2 :])
            places = np.concatenate([places[: _ASKED // 2], others[: _ASKED // 2]])
            rest = others[_ASKED // 2 :]
        # Where none of the first is admissible another may be.
        for part in (places, *np.array_split(rest, -(-len(rest) // _ASKED) or 1)):
            if len(part):
                yield self.guide.order[part], turned[part]

    def starts(self, wanted: int, separation_m: float, separation: float) -> Pool:
        found = super().starts(wanted, separation_m, separation)
        rows, turned = next(self.candidates(), (np.empty(0, dtype=np.intp), np.empty(0, dtype=bool)))
        if not len(rows):
            return found
        rng = np.random.default_rng(0)
        some = rng.integers(0, len(rows), _DRAWN)
        rows, turned = rows[some], turned[some]
        quaternions = self.density.quaternions_xyzw[rows]
        quaternions = np.where(turned[:, None], se3.jaw_twin(quaternions), quaternions)
        away, turns = self.density.kernel.sample_displacements(_DRAWN, rng)
        p, q, inside = self.landed(self.density.positions[rows] + away, se3.multiply(quaternions, turns))
        drawn = self.valued(p[inside], q[inside])
        return self.add_distinct(found, drawn, len(found) + _JOINING, separation_m, separation)

    def landed(self, positions: Floats, quaternions: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Poses brought into the region, pulled to where they are admissible, and which are inside then."""
        p, q, inside = self.region.project(positions, quaternions)
        if self.pull is not None:
            p, q = self.pull(p, q)
            inside &= self.region.contains(p, q)
        return p, q, inside

    def valued(self, positions: Floats, quaternions: Floats) -> Pool:
        return self.scored(Pool(positions, quaternions, np.zeros(len(positions)))).sort()

    def climbed(self, starts: Pool, finalists: int) -> tuple[Pool, Pool]:
        rng = np.random.default_rng(0)
        ends, step, passed = starts, np.full(len(starts), _FIRST_STEP), starts.take(np.arange(0))
        for climbers, tries, rounds in _PHASES:
            order = np.argsort(-ends.sums, kind="stable")[: max(climbers, finalists)]
            ends, step = ends.take(order), step[order]
            for _ in range(rounds):
                ends, step, moved = self.tried(ends, step, tries, rng)
                passed = passed.joined(ends.take(moved))
                if step.max() < _LAST_STEP:
                    break
        return passed, ends

    def pool(self, starts: Pool, passed: Pool, ends: Pool, most: int) -> Pool:
        return starts.joined(passed).joined(ends).sort()

    def explore(self, pool: Pool) -> Pool:
        """Nothing: the climbs were of admissible steps."""
        return pool.take(np.arange(0))

    def tried(
        self, ends: Pool, step: Floats, tries: int, rng: np.random.Generator
    ) -> tuple[Pool, Floats, NDArray[np.bool_]]:
        """From each of some poses, the best of random steps where that is better and admissible.

        Returns
        -------
        ends : Pool
        step : (K,)
            Lengths to try next, in kernel widths, longer after a success and shorter after a failure.
        moved : (K,) bool
        """
        kernel = self.density.kernel
        scale = np.repeat(step, tries)[:, None]
        at, to = np.repeat(ends.positions, tries, axis=0), np.repeat(ends.quaternions, tries, axis=0)
        away = at + rng.standard_normal(at.shape) * scale * kernel.sigma_position_m
        turns = se3.from_rotation_vector(rng.standard_normal(at.shape) * scale * kernel.sigma_rotation)
        p, q, inside = self.landed(away, se3.multiply(to, turns))
        scores = np.full(len(p), -np.inf)
        scores[inside] = self.sums(p[inside], q[inside])
        better = scores > np.repeat(ends.sums, tries)
        if self.admissible is not None and better.any():
            better[better] = self.check(p[better], q[better])
        scores[~better] = -np.inf
        winner = scores.reshape(len(ends), tries).argmax(axis=1) + np.arange(len(ends)) * tries
        moved: NDArray[np.bool_] = scores[winner] > -np.inf
        there = Pool(
            np.where(moved[:, None], p[winner], ends.positions),
            np.where(moved[:, None], q[winner], ends.quaternions),
            np.where(moved, scores[winner], ends.sums),
        )
        return there, np.where(moved, np.minimum(1.1 * step, 1.0), 0.6 * step), moved


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Gaussian noise of a pose, deviations per axis in metres and radians.

    As noise of the object's pose it acts on the left, about ``pivot`` (object frame, metres): 5 degrees at a
    lever of 100 mm move a grasp by 9 mm. As tool noise it acts on the right and the pivot is the tool's
    origin.
    """

    sigma_position_m: float
    sigma_rotation: float
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        values = (self.sigma_position_m, self.sigma_rotation, *self.pivot)
        if not all(math.isfinite(v) for v in values) or min(values[:2]) < 0.0:
            raise ValueError("noise must be finite and not negative")


def expected(
    value: Score,
    *,
    object_noise: PoseNoise | None = None,
    tool_noise: PoseNoise | None = None,
    samples: int = 64,
) -> Score:
    """The mean of ``value`` (a density or a probability, not a logarithm) under pose noise, itself a score.

    The noise is a fixed scrambled Sobol set of ``samples`` draws, so that the mean is a smooth function of
    the pose; its error falls nearly as 1 / samples.
    """
    if samples < 1:
        raise ValueError(f"samples must be at least 1, not {samples}")
    normal = ndtri(
        qmc.Sobol(12, rng=np.random.default_rng(0)).random(2 ** math.ceil(math.log2(samples)))[:samples]
    )
    left_p, left_q = _draws(object_noise, normal[:, :6])
    right_p, right_q = _draws(tool_noise, normal[:, 6:])
    pivot = np.zeros(3) if object_noise is None else np.array(object_noise.pivot)

    def mean(positions: ArrayLike, quaternions: ArrayLike) -> Floats:
        p, q = np.asarray(positions, dtype=np.float64), np.asarray(quaternions, dtype=np.float64)
        seen_p = pivot + se3.rotate(left_q[:, None], p[None] - pivot) + left_p[:, None]
        seen_q = se3.multiply(left_q[:, None], q[None])
        at, to = se3.compose(seen_p, seen_q, right_p[:, None], right_q[:, None])
        values = value(at.reshape(-1, 3), se3.normalise(to.reshape(-1, 4)))
        return np.asarray(values.reshape(samples, len(p)).mean(axis=0), dtype=np.float64)

    return mean


def _draws(noise: PoseNoise | None, normal: Floats) -> tuple[Floats, Floats]:
    scale = (0.0, 0.0) if noise is None else (noise.sigma_position_m, noise.sigma_rotation)
    return normal[:, :3] * scale[0], se3.from_rotation_vector(normal[:, 3:] * scale[1])
