"""Densities made of trials: built from all of them, or extended by those that came since.

Weights (eq 1). A success that a grid tried has the weight 1 / g of all the selection's grids seen as one
strategy (`proposal_density`); where nothing else is selected, that is the balance
heuristic ``1 / sum n_k g_k``. Other strategies can't be evaluated at poses that they did not draw: theirs
have ``1 / g_own``. Who tells no proposal density takes the mean weight of the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from graspdb.wire import KernelInfo, WeightsInfo
from graspdb_density import (
    DEFAULT_KERNEL,
    DiagonalKernel,
    GraspDensity,
    MixtureDensity,
    ModeSearch,
    SampledKernel,
    choose_widths,
    importance_weights,
    se3,
    widths_prefix,
)
from graspdb_density.bandwidth.selection import FIRST_CHOICE
from graspdb_density.kde.rows import Rows
from graspdb_density.kde.sample_kernel import MOST_COMPONENTS
from graspdb_service.problems import ProblemError
from graspdb_service.storage.kernels import KernelRow
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Bools, Floats, Ints, TrialColumns
from graspdb_service.usecases.densities import stored_kernel
from graspdb_service.usecases.densities.proposal_density import Exposure
from graspdb_service.usecases.geometry.features import Axes
from graspdb_service.usecases.trials.selection import Selected

_DEFAULT_POSITION_M = DEFAULT_KERNEL.sigma_position_m
_DEFAULT_ROTATION_DEG = round(math.degrees(DEFAULT_KERNEL.sigma_rotation), 9)
#: Weights are told apart in float32: a row that counts less than this share of the heaviest gets this share.
_LEAST_SHARE = 1e-30
#: Weights that differ by less count as the same.
_SAME = 1e-9


class Grasps(NamedTuple):
    """Poses (n,), and whether the jaw of each is symmetric (n,)."""

    poses: se3.Poses
    symmetric: Bools


@dataclass(frozen=True)
class KernelChoice:
    """The kernel a request asks for; all None: isotropic, widths by the default rule.

    ``stored`` is a stored kernel's id, or ``anisotropic`` for the newest of the object and gripper.
    """

    sigma_position_m: float | None = None
    sigma_rotation_deg: float | None = None
    stored: str | None = None

    @property
    def by_default(self) -> bool:
        return self.sigma_position_m is None and self.sigma_rotation_deg is None and self.stored is None


@dataclass(frozen=True, eq=False)
class Built:
    """A density and what it was built of, immutable.

    ``density`` is None where no trial of the selection succeeded. With a stored kernel it is under the
    isotropic one of equal determinants, and ``shaped`` (of Gaussians) or ``sampled`` (of sampled components)
    under the stored one; ``search`` is beside the one asked for. Rows (N,): ``seq`` ascending;
    ``proposal_density`` as it came, NaN where unknown; ``swept``: a grid tried it. The first ``chosen_from``
    of them chose the widths. ``success_kernel`` estimates success probabilities, where a kernel for those was
    asked for.
    """

    selected: Selected
    exposure: Exposure
    kernel: KernelInfo
    density: GraspDensity | None
    seq: Ints
    proposal_density: Floats
    swept: Bools
    chosen_from: int = 0
    shaped: MixtureDensity | None = None
    sampled: GraspDensity | None = None
    search: ModeSearch | None = None
    success_kernel: DiagonalKernel | None = None

    @property
    def object_row(self) -> ObjectRow:
        """The object as it was."""
        return self.selected.row

    @property
    def revision(self) -> int:
        return self.selected.row.revision

    @property
    def asked(self) -> GraspDensity | MixtureDensity | None:
        """The density under the kernel that was asked for."""
        return self.shaped or self.sampled or self.density

    @property
    def nbytes(self) -> int:
        own = self.seq.nbytes + self.proposal_density.nbytes + self.swept.nbytes
        parts = (self.density, self.shaped, self.sampled, self.search)
        held = sum(part.nbytes for part in parts if part is not None)
        return own + held + 4_096

    @property
    def weights_info(self) -> WeightsInfo:
        """By which rule its rows were weighted."""
        own = ~self.swept & ~np.isnan(self.proposal_density)
        unknown = int((~self.swept & np.isnan(self.proposal_density)).sum())
        grids = len(self.exposure.lattices) if self.swept.any() else 0
        mixed = bool(self.swept.any()) and self.exposure.several
        kind = "equal"
        rule = "all equal: nothing tells that some grasps were tried more densely than others"
        if grids:
            rule = "all equal: their grid tried every pose of its region once"
        if mixed:
            kind = "mixture"
            rule = (
                "1 / sum n_k g_k(x) over the grids, n_k the distinct poses tried and g_k uniform over the"
                " grid's region"
            )
        if own.any():
            kind = "mixture-and-own" if self.swept.any() else "own"
            rule = "1 / g of each trial's own proposal density"
            if self.swept.any():
                rule += "; grids as one strategy, g = sum n_k g_k(x) / sum n_k, n_k the distinct poses tried"
        if unknown and kind != "equal":
            rule += "; trials without a proposal density take the mean weight of the rest"
        return WeightsInfo(
            kind=kind,
            rule=rule,
            poses_tried=self.exposure.tried if grids else None,
            without_proposal_density=unknown,
        )


def build(
    choice: KernelChoice,
    stored: KernelRow | None,
    axes: Axes,
    selected: Selected,
    exposure: Exposure,
    rows: TrialColumns,
    before: Built | None,
    threads: int,
) -> Built:
    """The density of the rows there were and those that came since; ``axes`` are those of a stored kernel.

    413 for more components than a density may have.
    """
    fresh = Grasps(rows.poses, selected.symmetric(rows.provenance))
    seq, proposal = rows.seq, rows.proposal_density
    swept = np.isin(rows.batch, sorted(exposure.batches))
    old = None if before is None else before.density
    if before is not None and old is not None:
        seq = np.concatenate([before.seq, seq])
        proposal = np.concatenate([before.proposal_density, proposal])
        swept = np.concatenate([before.swept, swept])
    # A kernel that predicts success shapes no density: that one is as if none was asked for.
    for_success = stored is not None and stored.kind == "probability"
    built = Built(
        selected=selected,
        exposure=exposure,
        kernel=_info(choice) if stored is None else stored_kernel.info_of(stored, _info(KernelChoice())),
        density=None,
        seq=seq,
        proposal_density=proposal,
        swept=swept,
        chosen_from=widths_prefix(len(seq)) if choice.by_default or for_success else 0,
        success_kernel=stored_kernel.load_success_kernel(stored, axes) if stored and for_success else None,
    )
    if not len(seq):
        return built

    def everything() -> Grasps:
        if old is None:
            return fresh
        return Grasps(
            se3.Poses.concatenate([old.poses, fresh.poses]), np.concatenate([old.symmetric, fresh.symmetric])
        )

    weights = _weights(built, everything)
    added = None if old is None else _in_units_of(old, weights, len(rows))
    shaping = None if for_success else stored
    same_widths = before is not None and before.chosen_from == built.chosen_from
    if before is not None and same_widths:
        built = replace(built, kernel=before.kernel)
    elif built.chosen_from:
        chosen = _choose(everything(), proposal, built.chosen_from, threads)
        built = replace(built, kernel=chosen if stored is None else stored_kernel.info_of(stored, chosen))
    if shaping is not None and shaping.kind == "sampled":
        _check_components(stored_kernel.load_sampled(shaping), everything().symmetric)
    if before is not None and same_widths and old is not None and added is not None:
        return _searched(_extended(built, before, old, shaping, axes, fresh, added), before)
    return _searched(_made(built, shaping, axes, everything(), weights), None)


def _searched(built: Built, before: Built | None) -> Built:
    """With the search in its density, an extended one where that is what there was before, extended."""
    assert built.asked is not None
    if before is None or before.search is None:
        return replace(built, search=ModeSearch(built.asked, built.density))
    return replace(built, search=before.search.extended(built.asked, built.density))


def _made(
    built: Built, shaping: KernelRow | None, axes: Axes, grasps: Grasps, weights: Floats | None
) -> Built:
    """The density of all grasps, under the stored kernel that shapes it, if any."""
    poses, symmetric = grasps
    if shaping is not None and shaping.kind != "sampled":
        kernel, frames = stored_kernel.load(shaping), stored_kernel.axes_at(axes, poses)
        shaped = MixtureDensity(poses, kernel=kernel, weights=weights, symmetric=symmetric, frames=frames)
        return replace(built, density=shaped.isotropic, shaped=shaped)
    widths = stored_kernel.isotropic(built.kernel)
    density = GraspDensity.build(poses, kernel=widths, weights=weights, symmetric=symmetric)
    if shaping is None:
        return replace(built, density=density)
    sampled = stored_kernel.load_sampled(shaping).placed(poses, weights=weights, symmetric=symmetric)
    return replace(built, density=density, sampled=sampled)


def _extended(
    built: Built,
    before: Built,
    old: GraspDensity,
    shaping: KernelRow | None,
    axes: Axes,
    fresh: Grasps,
    added: Floats,
) -> Built:
    """The density ``old`` of ``before`` with further grasps, weights in its unit."""
    poses, symmetric = fresh
    if before.shaped is not None:
        frames = stored_kernel.axes_at(axes, poses)
        shaped = before.shaped.extend(poses, weights=added, symmetric=symmetric, frames=frames)
        return replace(built, density=shaped.isotropic, shaped=shaped)
    sampled = before.sampled
    if sampled is not None and shaping is not None and len(added):
        more = stored_kernel.load_sampled(shaping).placed(poses, weights=added, symmetric=symmetric)
        total = float(added.sum())
        sampled = sampled.extend(more.poses, weights=more.weights * total, symmetric=more.symmetric)
    return replace(built, density=old.extend(poses, added, symmetric), sampled=sampled)


def _check_components(kernel: SampledKernel, symmetric: Bools) -> None:
    """413 for more components than a density of these grasps, and of symmetric jaws' turns, may have."""
    rows, placed = len(symmetric), len(symmetric) + int(symmetric.sum())
    many = kernel.size * placed
    if many <= MOST_COMPONENTS:
        return
    fit = MOST_COMPONENTS // placed
    raise ProblemError(
        413,
        "too-many-components",
        f"{rows:,} successes under a kernel of {kernel.size:,} components, at both turns of a symmetric jaw,"
        f" are {many:,} components; a density may have {MOST_COMPONENTS:,}. Fit a kernel of kind anisotropic,"
        ' a mixture of a few that follows the same statistics (POST /kernels {"kind": "anisotropic"})'
        + (f", take at most {fit:,} components" if fit else "")
        + ", or select fewer trials (gripper, protocol, source)",
        errors=[("kernel", f"at most {fit:,} components for {rows:,} successes")],
        extra={"limit": MOST_COMPONENTS},
    )


# -- weights -----------------------------------------------------------------------------------------------


def _weights(built: Built, everything: Callable[[], Grasps]) -> Floats | None:
    """Weights (N,) of eq 1, their mean 1, no row lost to rounding; None where all are equal."""
    g, swept = built.proposal_density, built.swept
    if swept.any():
        positions = everything().poses.positions if built.exposure.several else None
        g = g.copy()
        g[swept] = built.exposure.uniform if positions is None else built.exposure.density(positions[swept])
    known = g[~np.isnan(g)]
    if not len(known) or (known == known[0]).all():
        return None
    weights = importance_weights(g)
    weights = np.maximum(weights, weights.max() * _LEAST_SHARE)
    return np.asarray(weights / weights.mean(), dtype=np.float64)


def _in_units_of(old: GraspDensity, weights: Floats | None, count: int) -> Floats | None:
    """Weights (count,) of rows after those of a density, in its unit; None where those of its own changed.

    Every density is built with weights of mean 1, so its raw ones are in the unit that it is extended in.
    """
    raw = old.raw_weights
    if weights is None:
        return None if np.ptp(raw) > _SAME * raw[0] else np.full(count, raw[0])
    factor = raw / weights[: len(raw)]
    if np.ptp(factor) > _SAME * factor[0]:
        return None
    added = weights[len(raw) :] * factor[0]
    return added if np.isfinite(added).all() and (added > 0.0).all() else None


def _choose(grasps: Grasps, proposal: Floats, count: int, threads: int) -> KernelInfo:
    """Widths chosen from the first rows.

    By their own proposal densities: how much else was tried since must not change what they choose.
    """
    first = slice(0, count)
    weights = None
    if not np.isnan(proposal[first]).all():
        weights = importance_weights(proposal[first])
        weights = np.maximum(weights, weights.max() * _LEAST_SHARE)
    rows = Rows.of(grasps.poses[first], weights, grasps.symmetric[first])
    found = choose_widths(rows, threads=threads)
    rule = f"default: {found.rule} likelihood of the first {found.rows} successes"
    if found.rule == "default":
        rule = f"default: the first {found.rows} successes lie in one block, so that none can be left out"
    return stored_kernel.isotropic_info(found.kernel, rule)


def _info(choice: KernelChoice) -> KernelInfo:
    position, rotation = choice.sigma_position_m, choice.sigma_rotation_deg
    default = f"{_DEFAULT_POSITION_M * 1000:g} mm and {_DEFAULT_ROTATION_DEG:g} degrees"
    if choice.by_default:
        rule = f"default: {default} until there are {FIRST_CHOICE} successes"
    elif position is None or rotation is None:
        rule = f"as asked; the width not named by default ({default})"
    else:
        rule = "as asked"
    return KernelInfo(
        kind="isotropic",
        sigma_position_m=_DEFAULT_POSITION_M if position is None else position,
        sigma_rotation_deg=_DEFAULT_ROTATION_DEG if rotation is None else rotation,
        rule=rule,
    )
