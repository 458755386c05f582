"""Kernels learned from grasps: where other successes lie around a success, as a few Gaussians.

Displacements between successes inside a window, weighted by the importance of where they lead, are what the
paper draws its sampled kernel from (eq 5). A mixture fitted to them follows the same statistics at a
hundredth of the evaluations. Its shape is theirs; its size is another question: conditional statistics are
as wide as their window lets them be, so all widths are scaled by the factor under which grasps are likeliest
given those of other blocks of space.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from .. import se3
from ..kde.bhattacharyya import Coefficient, DisplacementWindow, bhattacharyya, sampled_kernel_rows
from ..kde.density import Density
from ..kde.isotropic import GraspDensity
from ..kde.mixture import MixtureDensity
from ..kde.rows import Rows
from ..kde.weighted_sums import KernelRows, Progress
from ..kernels.gaussian_mixture import AnisotropicKernel, mirror
from ..kernels.isotropic import HAAR_VOLUME, IsotropicKernel
from ..se3 import Floats, Poses
from ..success.calibration import assign_blocks

__all__ = [
    "LEAST_DISPLACEMENTS",
    "LEAST_SUCCESSES",
    "Displacements",
    "FittedKernel",
    "displacements",
    "fit_kernel",
    "mixture_parts",
    "sampled_rows",
    "similarity_to_sampled",
]

#: Fewer successes or displacements than this shape no kernel.
LEAST_SUCCESSES, LEAST_DISPLACEMENTS = 50, 200
#: Numbers of components tried where none is asked for, until two in a row have not raised the likelihood by
#: so many nats: what queries cost grows with them.
_TRIED_COMPONENTS, _GIVEN_UP, _WORTH = (1, 2, 3, 4, 6, 8, 12, 16), 2, 0.02
_FACTORS = tuple(float(f) for f in np.geomspace(0.3, 1.7, 9))
_ITERATIONS, _ENOUGH = 60, 1e-5
#: Share of all that a component stands for at least: what none is near keeps its place.
_LEAST_MASS = 1e-12
#: Successes that displacements start from, and displacements from one, drawn at random and weighted for the
#: rest.
_STARTS_MOST, _EACH_MOST = 2_000, 200
_FITTED_MOST, _SCALED_MOST, _JUDGED_MOST = 8_000, 5_000, 600
#: What a fitted Gaussian spreads at least, of all displacements, and in metres and radians where those do not
#: spread at all along or about some axis: all grasps from one height, or at one rotation.
_LEAST_OF_ALL, _LEAST_SPREAD = 1e-3, np.repeat([1e-5, 1e-4], 3)
#: Share of a uniform density mixed in, so that a grasp without neighbours counts as an outlier and no more.
_UNIFORM_SHARE = 1e-3
_SAMPLES = 900
#: What the shape takes of the time where numbers of components are tried.
_SHAPE_SHARE = 0.8


@dataclass(frozen=True, eq=False, slots=True)
class Displacements:
    """Displacements from successes to others.

    Attributes
    ----------
    vectors : (n, 6) translation along the axes (metres), rotation vector in the gripper's frame (radians)
    weights : (n,) summing to n
    origin : (n,) int64
        Which success each starts from.
    """

    vectors: Floats
    weights: Floats
    origin: NDArray[np.int64]


@dataclass(frozen=True, eq=False, slots=True)
class FittedKernel:
    """A kernel and what it was fitted on.

    Attributes
    ----------
    kernel : AnisotropicKernel
    scale : float
        Factor on all widths of the fitted shape.
    displacements, successes : int
    similarity : Coefficient
        Of the fitted shape (before scaling) to a sampled kernel of 900 displacements, inside the window.
    likelihoods : {components: nats}
        Mean log density of held-out displacements for every number of components tried.
    log_likelihood, isotropic_log_likelihood : float
        Mean log density of held-out successes, blocks left out, under the kernel and under the isotropic
        kernel given for comparison; nats of 1/(m^3 rad^3), nan where all lie in one block.
    """

    kernel: AnisotropicKernel
    scale: float
    displacements: int
    successes: int
    similarity: Coefficient
    likelihoods: dict[int, float]
    log_likelihood: float
    isotropic_log_likelihood: float


def displacements(
    rows: Rows,
    *,
    window: DisplacementWindow,
    rng: np.random.Generator,
    frame: ArrayLike | None = None,
) -> Displacements:
    """Displacements inside a window from successes to other successes, and to their twins.

    Parameters
    ----------
    rows : N
        Successes to start from are drawn by weight, those arrived at count with it (eq 1).
    frame : (3, 3), (N, 3, 3) or None
        Columns are the axes of translations, object frame; None: each grasp's gripper.
    """
    (p, q), w, flags = rows.poses, rows.weights, rows.symmetric
    reach = window.position_m * math.sqrt(3.0)
    tree = cKDTree(p)
    frames = None if frame is None else np.asarray(frame, dtype=np.float64)
    starts = rng.choice(len(p), size=min(_STARTS_MOST, len(p)), replace=False, p=w / w.sum())
    vectors: list[Floats] = []
    shares: list[Floats] = []
    origins: list[NDArray[np.int64]] = []
    for a in starts.tolist():
        near = np.array(tree.query_ball_point(p[a], reach), dtype=np.int64)
        near = near[near != a]
        if not near.size:
            continue
        axes = se3.to_matrix(q[a]) if frames is None else frames if frames.ndim == 2 else frames[a]
        shift = (p[near] - p[a]) @ axes
        turn = se3.canonical(se3.multiply(se3.conjugate(q[a]), q[near]))
        # The nearer twin: the other is the same displacement from the twin of the first.
        other = se3.canonical(se3.multiply(se3.conjugate(q[a]), se3.jaw_twin(q[near])))
        nearer = flags[near] & (other[:, 3] > turn[:, 3])
        turn = np.where(nearer[:, None], other, turn)
        inside = np.flatnonzero(window.holds(se3.Poses(shift, turn)))
        if not inside.size:
            continue
        kept = inside if inside.size <= _EACH_MOST else rng.choice(inside, size=_EACH_MOST, replace=False)
        vectors.append(np.concatenate([shift[kept], se3.to_rotation_vector(turn[kept])], axis=1))
        shares.append(w[near[kept]] * (inside.size / kept.size))
        origins.append(np.full(kept.size, a, dtype=np.int64))
    if not vectors:
        return Displacements(np.empty((0, 6)), np.empty(0), np.empty(0, dtype=np.int64))
    share = np.concatenate(shares)
    return Displacements(np.concatenate(vectors), share / share.mean(), np.concatenate(origins))


# long: its parameters are explained one by one, and its steps are one after the other.
def fit_kernel(
    rows: Rows,
    *,
    window: DisplacementWindow,
    widths: IsotropicKernel,
    compared: IsotropicKernel,
    components: int | None = None,
    frame: ArrayLike | None = None,
    threads: int = 1,
    progress: Progress | None = None,
) -> FittedKernel:
    """Learn a kernel from successful grasps.

    Parameters
    ----------
    rows : N
    window
        Displacements looked at.
    widths
        Of the components of the sampled kernel that the mixture stands for: added to its covariances.
    compared
        The isotropic kernel whose held-out likelihood is told beside the fitted one's.
    components : int or None
        1: one Gaussian about no displacement. More: a mixture; a component off the mirror's plane is a pair.
        None: 1 to 16 by the likelihood of held-out displacements.
    frame : (3, 3), (N, 3, 3) or None
        Axes that do not turn with the jaw, for a kernel aligned with them: the object's principal ones, or of
        every grasp those of its edge or pair of surfaces, the gripper's where not finite. Their signs mean
        nothing, so it is one Gaussian without correlations between translations, nor of those with
        rotations.

    Raises
    ------
    ValueError
        For too few successes or displacements (saying how many are needed), a mixture in axes that do not
        turn with the jaw, or a fit whose rotations are wider than a component may be.
    """
    if len(rows) < LEAST_SUCCESSES:
        raise ValueError(
            f"a kernel is fitted on at least {LEAST_SUCCESSES} successes; there are {len(rows)}, so "
            f"{LEAST_SUCCESSES - len(rows)} more are needed"
        )
    if frame is not None and components not in (None, 1):
        raise ValueError(
            "axes that do not turn with the jaw have no sign: a kernel aligned with them has 1 component"
        )
    frames = None if frame is None else _own_where_unknown(frame, rows.poses.quaternions_xyzw)
    rng = np.random.default_rng(0)
    found = displacements(rows, window=window, rng=rng, frame=frames)
    if len(found.vectors) < LEAST_DISPLACEMENTS:
        raise ValueError(
            f"the window holds {len(found.vectors)} displacements between successes, and a kernel is fitted "
            f"on at least {LEAST_DISPLACEMENTS}: widen the window or add trials"
        )
    added = widths.overall_covariance
    tried = (1,) if frame is not None else _TRIED_COMPONENTS if components is None else (components,)
    told = progress or (lambda _: None)
    shape, likelihoods = _shape(
        found, tried, added, frame is not None, rng, lambda done: told(_SHAPE_SHARE * done)
    )
    chosen = rng.choice(
        len(found.vectors), size=min(_SAMPLES, len(found.vectors)), p=found.weights / found.weights.sum()
    )
    similarity = similarity_to_sampled(
        shape, sampled_rows(found.vectors[chosen], widths), rng, points=4_000, window=window, threads=threads
    )
    judge = _Judge(rows, frames, compared, rng, threads)
    # Where nothing can be held out, the size of the kernel compared with.
    fallback = compared.sigma_position_m / shape.isotropic.sigma_position_m
    candidates = [(f, k) for f in (*_FACTORS, fallback) if (k := _scaled(shape, f)) is not None]
    if not candidates:
        raise ValueError(
            "the displacements spread over more than a kernel may be wide: ask for a smaller window"
        )
    values = []
    for _, candidate in candidates:
        values.append(judge.anisotropic(candidate))
        told(_SHAPE_SHARE + (1.0 - _SHAPE_SHARE) * len(values) / len(candidates))
    known = [i for i, value in enumerate(values) if math.isfinite(value)]
    best = max(known, key=lambda i: values[i]) if known else len(candidates) - 1
    return FittedKernel(
        kernel=candidates[best][1],
        scale=candidates[best][0],
        displacements=len(found.vectors),
        successes=len(rows),
        similarity=similarity,
        likelihoods=likelihoods,
        log_likelihood=values[best],
        isotropic_log_likelihood=judge.isotropic(compared),
    )


def _own_where_unknown(frame: ArrayLike, q: Floats) -> Floats:
    """Axes (3, 3) or (N, 3, 3), the gripper's where a grasp has none of its own."""
    f = np.asarray(frame, dtype=np.float64)
    if f.shape not in ((3, 3), (len(q), 3, 3)):
        raise ValueError(f"axes have shape (3, 3) or ({len(q)}, 3, 3), not {f.shape}")
    known: NDArray[np.bool_] = np.asarray(np.isfinite(f).all(axis=(-2, -1)))
    if f.ndim == 2 and not known:
        raise ValueError("the object's axes must be finite")
    return f if f.ndim == 2 else np.where(known[:, None, None], f, se3.to_matrix(q))


class _Judge:
    """Held-out likelihood of successes, the same blocks for every kernel."""

    def __init__(
        self,
        rows: Rows,
        frame: Floats | None,
        compared: IsotropicKernel,
        rng: np.random.Generator,
        threads: int,
    ) -> None:
        kept = np.sort(rng.permutation(len(rows))[:_SCALED_MOST])
        self._rows = rows[kept]
        self._frame = frame if frame is None or frame.ndim == 2 else frame[kept]
        self._threads = threads
        self._judged = rng.permutation(len(kept))[:_JUDGED_MOST]
        positions = self._rows.poses.positions
        try:
            blocks = assign_blocks(positions, edge_m=3.0 * compared.sigma_position_m)
            self._fold, self._folds = blocks.fold, blocks.folds
        except ValueError:
            self._folds = 0
        spread = np.maximum(np.ptp(positions, axis=0), 1e-3)
        self._uniform = 1.0 / (float(np.prod(spread)) * HAAR_VOLUME)

    def anisotropic(self, kernel: AnisotropicKernel) -> float:
        return self._mean(
            lambda rows, train: MixtureDensity(
                rows.poses, kernel=kernel, weights=rows.weights, symmetric=rows.symmetric,
                frames=self._frames(train),
            )
        )  # fmt: skip

    def isotropic(self, kernel: IsotropicKernel) -> float:
        return self._mean(
            lambda rows, _: GraspDensity.build(
                rows.poses, kernel=kernel, weights=rows.weights, symmetric=rows.symmetric
            )
        )

    def _frames(self, train: NDArray[np.int64]) -> Floats | None:
        return self._frame if self._frame is None or self._frame.ndim == 2 else self._frame[train]

    def _mean(self, density: Callable[[Rows, NDArray[np.int64]], Density]) -> float:
        total = weight = 0.0
        for fold in range(self._folds):
            held = self._judged[self._fold[self._judged] == fold]
            if not held.size:
                continue
            train, judged = np.flatnonzero(self._fold != fold), self._rows[held]
            log_density = density(self._rows[train], train).log_density(judged.poses, threads=self._threads)
            mixed = (1.0 - _UNIFORM_SHARE) * np.exp(log_density) + _UNIFORM_SHARE * self._uniform
            total += float(judged.weights @ np.log(mixed))
            weight += float(judged.weights.sum())
        return total / weight if weight > 0.0 else math.nan


def _scaled(kernel: AnisotropicKernel, factor: float) -> AnisotropicKernel | None:
    """Means and widths times a factor; None where a component becomes wider than it may be."""
    try:
        return AnisotropicKernel(
            kernel.weights, kernel.means * factor, kernel.covariances * factor**2, kernel.frame
        )
    except ValueError:
        return None


def _shape(
    found: Displacements,
    tried: Sequence[int],
    added: Floats,
    plain: bool,
    rng: np.random.Generator,
    told: Progress,
) -> tuple[AnisotropicKernel, dict[int, float]]:
    """The mixture with the best held-out likelihood, fitted again on all, and those likelihoods."""
    keep = np.sort(rng.permutation(len(found.vectors))[:_FITTED_MOST])
    x, w, origin = found.vectors[keep], found.weights[keep], found.origin[keep]
    if len(tried) == 1:
        return _fitted(x, w, tried[0], added, plain), {}
    # Divided by the success they start from: displacements from one are not independent.
    held = np.isin(origin, rng.permutation(np.unique(origin))[: max(1, len(np.unique(origin)) // 5)])
    if held.all() or not held.any():
        return _fitted(x, w, tried[0], added, plain), {}
    likelihoods = {}
    best, highest, failed = tried[0], -math.inf, 0
    for at, count in enumerate(tried):
        # A fit takes as long as it has components; the last one is repeated on all displacements.
        told(sum(tried[:at]) / (sum(tried) + tried[-1]))
        try:
            kernel = _fitted(x[~held], w[~held], count, added, plain)
        except ValueError:
            # A component wider than one may be: those of more components may not be.
            continue
        likelihoods[count] = float(np.average(kernel.log_kernel(x[held]), weights=w[held]))
        if likelihoods[count] > highest + _WORTH:
            best, highest, failed = count, likelihoods[count], 0
        else:
            failed += 1
        if failed == _GIVEN_UP:
            break
    return _fitted(x, w, best, added, plain), likelihoods


def _fitted(x: Floats, w: Floats, count: int, added: Floats, plain: bool) -> AnisotropicKernel:
    weights, means, covariances = mixture_parts(x, count, w)
    if count > 1:
        return AnisotropicKernel.symmetrised(weights, means, covariances + added)
    second = covariances[0]
    if plain:
        second[:3, :3] = np.diag(np.diag(second)[:3])
        second[:3, 3:] = second[3:, :3] = 0.0
    return AnisotropicKernel.gaussian(second + added, frame="fixed" if plain else "gripper")


def sampled_rows(vectors: Floats, components: IsotropicKernel) -> KernelRows:
    """The sampled kernel of displacements (n, 6)."""
    return sampled_kernel_rows(Poses(vectors[:, :3], se3.from_rotation_vector(vectors[:, 3:])), components)


def similarity_to_sampled(
    kernel: AnisotropicKernel,
    sampled: KernelRows,
    rng: np.random.Generator,
    *,
    points: int,
    window: DisplacementWindow,
    threads: int,
) -> Coefficient:
    """Bhattacharyya coefficient of a kernel with a sampled one, inside a window."""
    frames = None if kernel.frame == "gripper" else np.eye(3)
    origin = Rows.of(Poses(np.zeros((1, 3)), se3.IDENTITY[None]), symmetric=False)
    alone = KernelRows(origin, kernel, frames=frames)
    return bhattacharyya(sampled, alone, rng, points=points, window=window, threads=threads)


def mixture_parts(vectors: Floats, count: int, weights: ArrayLike = 1.0) -> tuple[Floats, Floats, Floats]:
    """Weights (C,), means (C, 6) and covariances (C, 6, 6) of mirrored pairs of Gaussians, fitted to
    displacements (n, 6); one is about no displacement.
    """
    # A density over rotations is one over rotation vectors divided by the volume element.
    half = 0.5 * np.linalg.norm(vectors[:, 3:], axis=1)
    v = np.asarray(weights) / np.maximum(np.sinc(half / np.pi) ** 2, 1e-3)
    second = np.einsum("n,ni,nj->ij", v / v.sum(), vectors, vectors)
    if count == 1:
        return np.ones(1), np.zeros((1, 6)), second[None]
    return _expectation_maximisation(vectors, v, count, second)


def _expectation_maximisation(
    x: Floats, v: Floats, count: int, second: Floats
) -> tuple[Floats, Floats, Floats]:
    """A mixture of mirrored pairs: component c stands for N(m, S) and N(A m, A S A) with half its weight."""
    a = mirror("gripper")
    floor = np.diag(np.maximum(_LEAST_OF_ALL * np.diag(second), _LEAST_SPREAD**2))
    weights = np.full(count, 1.0 / count)
    # Nested to begin with, and apart along the widest direction.
    scales = np.geomspace(0.3, 1.5, count)
    values, vectors = np.linalg.eigh(second)
    widest = vectors[:, -1] * math.sqrt(max(values[-1], 0.0))
    means = np.linspace(0.0, 0.5, count)[:, None] * widest
    covariances = scales[:, None, None] * second + floor
    both = np.stack([x, x * a])
    before = -math.inf
    for _ in range(_ITERATIONS):
        inverse = np.linalg.inv(covariances)
        _, logdet = np.linalg.slogdet(covariances)
        off = both[:, :, None, :] - means
        logs = np.log(weights) - 0.5 * logdet - 0.5 * np.einsum("snci,cij,sncj->snc", off, inverse, off)
        total = logsumexp(logs, axis=(0, 2))
        share = np.exp(logs - total[None, :, None]) * v[None, :, None]
        mass = np.maximum(share.sum(axis=(0, 1)), _LEAST_MASS * v.sum())
        means = np.einsum("snc,sni->ci", share, both) / mass[:, None]
        off = both[:, :, None, :] - means
        covariances = np.einsum("snc,snci,sncj->cij", share, off, off) / mass[:, None, None] + floor
        weights = np.maximum(mass / mass.sum(), 1e-6)
        now = float(v @ total) / float(v.sum())
        if now - before < _ENOUGH:
            break
        before = now
    # A component that is its own mirror image but for noise is made so: half as much to evaluate.
    for c in range(count):
        image = 0.5 * (covariances[c] + a[:, None] * covariances[c] * a)
        apart = means[c] - a * means[c]
        if apart @ np.linalg.solve(image, apart) < 0.04:
            means[c], covariances[c] = 0.5 * (means[c] + a * means[c]), image
    return weights / weights.sum(), means, covariances
