"""How much every success of a density weighs (eq 1), and why.

Trials are chosen by *strategies*: grids, whose density is known everywhere; those of a source that tell their
proposal densities; those of a source that do not. Of one source alone, grids weigh ``1 / sum n_k g_k``
(`proposal_density`), told densities ``1 / g``, others beside them their mean, and where nothing is told all
weigh the same. Where a selection mixes sources, or grids and other trials, every success weighs
``1 / sum_s n_s g_s(x)`` over all strategies (the balance heuristic): n_s attempts, failures included, chosen
by the density g_s. A pose tried several times weighs that times its share of successes, k of n. At a success
of its own g_s is what it tells; elsewhere, and where it tells nothing, it is estimated from where the
attempts of s lie (:mod:`graspdb_density.kde.attempt_exposure`), 0 far from all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import SOURCES, WeightsInfo
from graspdb_density import GraspDensity, IsotropicKernel, importance_weights
from graspdb_density.kde.attempt_exposure import attempts_per_volume, own_exposure
from graspdb_density.kde.isotropic import CUTOFF
from graspdb_density.se3 import Poses
from graspdb_service.storage.database import Tx
from graspdb_service.trial_columns import Bools, Floats, Ints
from graspdb_service.usecases.densities.proposal_density import Exposure
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.attempts import NO_ATTEMPT, AllTrials, Stored
from graspdb_service.usecases.trials.selection import UNSPECIFIED, Selected

Codes = NDArray[np.int8]
"""Strategies: three times the place of the source in `SOURCE_NAMES` and what is known of the choice."""

SOURCE_NAMES = (*SOURCES, UNSPECIFIED)
UNTOLD, TOLD, GRID = range(3)
_KINDS = 3
#: Weights are told apart in float32: a row that counts less than this share of the heaviest gets this share.
_LEAST_SHARE = 1e-30
#: Of more attempts of one strategy so many, drawn at random, say where all lie.
_MOST_ATTEMPTS = 100_000


def codes_of(selected: Selected, provenance: Ints, proposal: Floats, swept: Bools) -> Codes:
    """The strategy of every trial (n,) of a selection."""
    source = np.zeros(len(provenance), dtype=np.int8)
    for number, name in selected.sources.items():
        source[provenance == number] = SOURCE_NAMES.index(name)
    kind = np.where(swept, GRID, np.where(np.isnan(proposal), UNTOLD, TOLD))
    return (_KINDS * source + kind).astype(np.int8)


def mixes(selected: Selected, exposure: Exposure, codes: Codes) -> bool:
    """Whether successes with these codes need a rule that compares strategies."""
    tried = sum(1 for counts in selected.by_source.values() if counts.keys() - {"simulation_error"})
    kinds = {*(np.unique(codes) % _KINDS).tolist(), *([GRID] if exposure.lattices else [])}
    # Of one source, those that tell no density may stand beside those that do: they are of the same choice.
    return bool(len(codes)) and (tried > 1 or (GRID in kinds and len(kinds) > 1))


@dataclass(frozen=True, eq=False)
class _Part:
    """Attempts of one strategy, ``count`` of them; each of those held stands for ``worth``."""

    held: GraspDensity
    count: int
    worth: float = 1.0


@dataclass(frozen=True, eq=False)
class Tried:
    """Where the attempts of strategies that are no grids lie, by strategy."""

    kernel: IsotropicKernel
    parts: Mapping[int, _Part] = field(default_factory=dict)

    @classmethod
    def of(cls, kernel: IsotropicKernel, found: AllTrials, codes: Codes) -> Tried:
        """Attempts with their strategies (n,)."""
        parts = {}
        rng = np.random.default_rng(0)
        for code in np.unique(codes).tolist():
            rows = np.flatnonzero(codes == code)
            count = len(rows)
            if count > _MOST_ATTEMPTS:
                rows = np.sort(rng.choice(rows, size=_MOST_ATTEMPTS, replace=False))
            parts[code] = _Part(found.density(kernel, rows), count, count / len(rows))
        return cls(kernel, parts)

    def joined(self, more: Tried) -> Tried:
        """With further attempts under the same kernel."""
        parts = dict(self.parts)
        for code, part in more.parts.items():
            before = parts.get(code)
            if before is not None:
                rows = np.flatnonzero(
                    np.random.default_rng(before.count).random(part.held.size) * before.worth < 1.0
                )
                new = part.held.poses[rows], None, part.held.symmetric[rows]
                part = _Part(before.held.extend(*new), before.count + part.count, before.worth)
            parts[code] = part
        return Tried(self.kernel, parts)

    def under(self, kernel: IsotropicKernel) -> Tried:
        """The same attempts under another kernel."""
        if kernel == self.kernel:
            return self
        parts = {
            code: replace(
                part,
                held=GraspDensity.build(part.held.poses, kernel=kernel, symmetric=part.held.symmetric),
            )
            for code, part in self.parts.items()
        }
        return Tried(kernel, parts)

    def per_volume(self, poses: Poses, codes: Codes, threads: int) -> Floats:
        """(n,) attempts per m^3 rad^3 at successes with these strategies, without a success's own where that
        tells its density.
        """
        found = np.zeros(len(poses))
        for code, part in self.parts.items():
            rows = np.arange(len(poses)) if code % _KINDS == UNTOLD else np.flatnonzero(codes != code)
            reach = CUTOFF * self.kernel.sigma_position_m
            low, high = part.held.positions.min(axis=0) - reach, part.held.positions.max(axis=0) + reach
            at = poses.positions[rows]
            rows = rows[((at >= low) & (at <= high)).all(axis=1)]
            if rows.size:
                found[rows] += part.worth * attempts_per_volume(part.held, poses[rows], threads=threads)
        return found

    @property
    def nbytes(self) -> int:
        return sum(part.held.nbytes for part in self.parts.values())


@dataclass(frozen=True, eq=False)
class Weighing:
    """What tells how much the successes (N,) of a density weigh.

    ``proposal`` is in 1/(m^3 rad^3) as it came, NaN where unknown; ``share`` by how much each succeeded.
    ``tried`` and ``near`` (N,), how densely strategies other than grids tried there, only where strategies
    are mixed; a strategy that tells its density is left out at its own successes. Weights are multiplied by
    those ``by_source``.
    """

    exposure: Exposure
    codes: Codes
    proposal: Floats
    share: Floats
    by_source: Mapping[str, float] = field(default_factory=dict)
    tried: Tried | None = None
    near: Floats | None = None

    def followed_by(self, more: Weighing) -> Weighing:
        """With rows that came since, and the exposure of now; what is ``near`` them is not known yet."""
        return replace(
            self,
            exposure=more.exposure,
            by_source=more.by_source,
            codes=np.concatenate([self.codes, more.codes]),
            proposal=np.concatenate([self.proposal, more.proposal]),
            share=np.concatenate([self.share, more.share]),
        )

    @property
    def simulated(self) -> Bools:
        """Which of them a simulation found."""
        return np.asarray(self.codes // _KINDS == SOURCE_NAMES.index("simulation"))

    @property
    def swept(self) -> Bools:
        """Which of them a grid tried."""
        return np.asarray(self.codes % _KINDS == GRID)

    @property
    def nbytes(self) -> int:
        held = self.codes.nbytes + self.proposal.nbytes + self.share.nbytes
        more = (part.nbytes for part in (self.tried, self.near) if part is not None)
        return held + sum(more)

    def weights(self, poses: Poses, symmetric: Bools) -> Floats | None:
        """Weights (N,) of eq 1, their mean 1, no row lost to rounding; None where all are equal."""
        g = self._alone(poses)
        if self.tried is not None:
            by_source = np.array([self.by_source.get(name, 1.0) for name in SOURCE_NAMES])
            g = self._mixed(poses, symmetric) / by_source[self.codes // _KINDS]
        known = g[~np.isnan(g)]
        alike = not len(known) or bool((known == known[0]).all())
        if alike and (self.share == self.share[0]).all():
            return None
        weights = self.share if alike else importance_weights(g) * self.share
        weights = np.maximum(weights, weights.max() * _LEAST_SHARE)
        return np.asarray(weights / weights.mean(), dtype=np.float64)

    def _alone(self, poses: Poses) -> Floats:
        """What the trials of one strategy were drawn with, NaN where that is unknown."""
        swept, exposure = self.swept, self.exposure
        if not swept.any():
            return self.proposal
        g = self.proposal.copy()
        g[swept] = exposure.density(poses.positions[swept]) if exposure.several else exposure.uniform
        return g

    def _mixed(self, poses: Poses, symmetric: Bools) -> Floats:
        """How densely all strategies together tried at every success: 1/(m^3 rad^3) times attempts."""
        assert self.tried is not None
        assert self.near is not None
        total = self.near + self.exposure.per_volume(poses.positions)
        for code in np.unique(self.codes[self.codes % _KINDS == TOLD]).tolist():
            own = self.codes == code
            part = self.tried.parts.get(code)
            total[own] += (int(own.sum()) if part is None else part.count) * self.proposal[own]
        # Where only some of the attempts are held, it may not be among them.
        untold = self.codes % _KINDS == UNTOLD
        total[untold] = np.maximum(total[untold], own_exposure(self.tried.kernel, symmetric[untold]))
        return total

    @property
    def info(self) -> WeightsInfo:
        """By which rule they are weighed."""
        kinds = set((self.codes % _KINDS).tolist())
        unknown = int((self.codes % _KINDS == UNTOLD).sum())
        tried = self.exposure.tried if self.exposure.lattices else None
        kind, rule = "equal", "all equal: nothing tells that some grasps were tried more densely than others"
        if self.tried is not None:
            kind = "balance"
            rule = (
                "1 / sum n_s g_s(x) over all that tried (balance heuristic): n_s attempts, failures included,"
                " chosen with density g_s; " + "; ".join(self._parts_told())
            )
            if any(weight != 1.0 for weight in self.by_source.values()):
                asked = ", ".join(f"{name} {weight:g}" for name, weight in sorted(self.by_source.items()))
                rule += f"; times the weight of the source: {asked}"
        elif GRID in kinds and self.exposure.several:
            kind = "mixture"
            rule = (
                "1 / sum n_k g_k(x) over the grids, n_k the distinct poses tried and g_k uniform over the"
                " grid's region"
            )
        elif GRID in kinds:
            rule = "all equal: a grid tried its region equally densely everywhere"
        elif TOLD in kinds:
            kind, rule = "own", "1 / g of each trial's own proposal density"
            if unknown:
                rule += "; trials without a proposal density take the mean weight of the rest"
        if (self.share < 1.0).any():
            rule += "; of several attempts at one pose, times the share that succeeded"
        return WeightsInfo(kind=kind, rule=rule, poses_tried=tried, without_proposal_density=unknown)

    def _parts_told(self) -> list[str]:
        """How densely each strategy tried, in words."""
        assert self.tried is not None
        told = []
        if self.exposure.lattices:
            told.append(f"grids: {self.exposure.tried:,} poses, uniform over each grid's region")
        for code, part in sorted(self.tried.parts.items()):
            source, what = SOURCE_NAMES[code // _KINDS], "its attempts'"
            if code % _KINDS == TOLD:
                told.append(
                    f"{source}: {part.count:,} attempts, g their own proposal density, elsewhere estimated"
                )
            else:
                told.append(f"{source}: {part.count:,} attempts, g estimated from where {what[:-1]} lie")
        return told

    def of_source(self, source: str) -> str:
        """How the successes of one source are weighed, in words."""
        place = SOURCE_NAMES.index(source)
        kinds = sorted({int(code) % _KINDS for code in np.unique(self.codes) if code // _KINDS == place})
        if self.tried is None:
            return self.info.rule if kinds else "no successes"
        words = {
            UNTOLD: "no proposal density: how densely it tried is estimated from where its attempts lie",
            TOLD: "by the proposal densities that its trials tell",
            GRID: "by how densely its grids tried",
        }
        return "; ".join(words[kind] for kind in kinds) or "no successes"

    def shares(self, weights: Floats) -> Mapping[str, float]:
        """Each source's share of the weights (N,)."""
        sums = np.bincount(self.codes // _KINDS, weights=weights, minlength=len(SOURCE_NAMES))
        return dict(zip(SOURCE_NAMES, (sums / sums.sum()).tolist(), strict=True))


def fetch_tried(tx: Tx, selected: Selected, since: Selected | None) -> Stored:
    """Attempts of a selection that no grid made, of sources that post successes only, too; all, or those that
    came since.
    """
    every = replace(selected, tried=frozenset(selected.provenances))
    seq, revision = (0, 0) if since is None else (since.row.last_seq, since.row.revision)
    return attempts.fetch(
        tx, every, without=[NO_ATTEMPT], after_seq=seq, after_revision=revision, grids=False
    )


def weighed(
    weighing: Weighing,
    kernel: IsotropicKernel,
    selected: Selected,
    stored: Stored | None,
    poses: Poses,
    threads: int,
) -> Weighing:
    """With what tells how densely strategies tried near all successes (N,), where they are mixed.

    ``stored`` are attempts that are not in ``weighing`` yet, None where nothing is mixed.
    """
    if stored is None:
        return replace(weighing, tried=None, near=None)
    found = attempts.joined(stored)
    codes = codes_of(selected, found.provenance, found.proposal, np.zeros(len(found), dtype=np.bool_))
    fresh, past, near = Tried.of(kernel, found, codes), weighing.tried, weighing.near
    tried = fresh if past is None else past.under(kernel).joined(fresh)
    if past is None or near is None or kernel != past.kernel:
        return replace(weighing, tried=tried, near=tried.per_volume(poses, weighing.codes, threads))
    known = len(near)
    old = near + fresh.per_volume(poses[:known], weighing.codes[:known], threads)
    new = tried.per_volume(poses[known:], weighing.codes[known:], threads)
    return replace(weighing, tried=tried, near=np.concatenate([old, new]))
