"""Densities made of trials: built from all of them, or extended by those that came since."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from graspdb.wire import KernelInfo, SelectedSource, SelectionInfo
from graspdb_density import (
    DEFAULT_KERNEL,
    DiagonalKernel,
    GraspDensity,
    IsotropicKernel,
    MixtureDensity,
    ModeSearch,
    SampledKernel,
    importance_weights,
    se3,
    widths_prefix,
)
from graspdb_density.bandwidth.selection import FIRST_CHOICE
from graspdb_density.kde.rows import Rows
from graspdb_density.kde.sample_kernel import MOST_COMPONENTS
from graspdb_service.problems import ProblemError
from graspdb_service.storage.derived.width_choices import ChosenWidths
from graspdb_service.storage.kernels import KernelRow
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Bools, Floats, Ints, TrialColumns
from graspdb_service.usecases.densities import stored_kernel
from graspdb_service.usecases.densities.weighing import Weighing, weighed
from graspdb_service.usecases.densities.widths.choosing import WidthChoosing
from graspdb_service.usecases.geometry.features import Axes
from graspdb_service.usecases.trials.attempts import Stored
from graspdb_service.usecases.trials.selection import Selected

_DEFAULT_POSITION_M = DEFAULT_KERNEL.sigma_position_m
_DEFAULT_ROTATION_DEG = round(math.degrees(DEFAULT_KERNEL.sigma_rotation), 9)
#: Weights are told apart in float32: a row that counts less than this share of the heaviest gets this share.
_LEAST_SHARE = 1e-30
#: Weights that differ by less count as the same; starts of searches ranked by weights that differ by up to
#: this factor are ranked well enough.
_SAME, _ABOUT = 1e-9, 1.25


class Fresh(NamedTuple):
    """Successes that came since, how all of them weigh, and attempts that came since where these tell it."""

    rows: TrialColumns
    weighing: Weighing
    attempts: Stored | None


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
    under the stored one; ``search`` is beside the one asked for, its starts ranked by the weights
    ``ranked_by``. Rows (N,): ``seq`` ascending; ``weighing`` how much each counts. The first ``chosen_from``
    of them chose the widths. ``success_kernel`` estimates success probabilities, where a kernel for those was
    asked for.
    """

    selected: Selected
    weighing: Weighing
    kernel: KernelInfo
    density: GraspDensity | None
    seq: Ints
    chosen_from: int = 0
    shaped: MixtureDensity | None = None
    sampled: GraspDensity | None = None
    search: ModeSearch | None = None
    ranked_by: Floats | None = None
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
        own = self.seq.nbytes + self.weighing.nbytes
        parts = (self.density, self.shaped, self.sampled, self.search, self.ranked_by)
        held = sum(part.nbytes for part in parts if part is not None)
        return own + held + 4_096

    @cached_property
    def selection(self) -> SelectionInfo:
        """Which trials count, and how much those of each source."""
        selected, weighing = self.selected, self.weighing
        shares: Mapping[str, float] = {}
        if self.density is not None:
            shares = weighing.shares(self.density.weights)
        sources = {
            name: SelectedSource(
                trials=sum(counts.values()) - counts.get("simulation_error", 0),
                successes=counts.get("success", 0),
                share_of_weight=shares.get(name, 0.0),
                weights=weighing.of_source(name),
                source_weight=selected.weights_by_source[name],
            )
            for name, counts in selected.by_source.items()
        }
        for name, weight in selected.asked_weights.items():
            if name not in sources:
                words = "no trials" if weight else "left out: its weight is 0"
                nothing = {"trials": 0, "successes": 0, "share_of_weight": 0.0}
                sources[name] = SelectedSource(**nothing, weights=words, source_weight=weight)
        return SelectionInfo(gripper=selected.gripper, protocol=selected.protocol, sources=sources)


def build(
    choice: KernelChoice,
    stored: KernelRow | None,
    axes: Axes,
    selected: Selected,
    fresh: Fresh,
    before: Built | None,
    widths: WidthChoosing,
    threads: int,
) -> Built:
    """The density of the rows there were and those that came since.

    ``axes`` are those of a stored kernel, ``widths`` tells what rows choose by default.

    413 for more components than a density may have.
    """
    rows = fresh.rows
    grasps = Grasps(rows.poses, selected.symmetric(rows.provenance))
    old = None if before is None else before.density
    # A kernel that predicts success shapes no density: that one is as if none was asked for.
    for_success = stored is not None and stored.kind == "probability"
    seq = rows.seq if before is None else np.concatenate([before.seq, rows.seq])
    built = Built(
        selected=selected,
        weighing=fresh.weighing,
        kernel=_info(choice) if stored is None else stored_kernel.info_of(stored, _info(KernelChoice())),
        density=None,
        seq=seq,
        chosen_from=widths_prefix(len(seq)) if choice.by_default or for_success else 0,
        success_kernel=stored_kernel.load_success_kernel(stored, axes) if stored and for_success else None,
    )
    if not len(seq):
        return built
    everything = grasps
    if old is not None:
        symmetric = np.concatenate([old.symmetric, grasps.symmetric])
        everything = Grasps(se3.Poses.concatenate([old.poses, grasps.poses]), symmetric)
    same_widths = before is not None and before.chosen_from == built.chosen_from
    if before is not None and same_widths:
        built = replace(built, kernel=before.kernel)
    elif built.chosen_from:
        first = _choosing(everything, built.weighing.proposal, built.chosen_from)
        chosen = _told(widths.choose(selected.row.id, first, threads=threads), built.chosen_from)
        built = replace(built, kernel=chosen if stored is None else stored_kernel.info_of(stored, chosen))
    isotropic = stored_kernel.isotropic(built.kernel)
    weighing = weighed(built.weighing, isotropic, selected, fresh.attempts, everything.poses, threads)
    built = replace(built, weighing=weighing)
    weights = weighing.weights(*everything)
    shaping = None if for_success else stored
    if shaping is not None and shaping.kind == "sampled":
        _check_components(stored_kernel.load_sampled(shaping), everything.symmetric)
    if before is not None and old is not None and same_widths:
        unit = _in_units_of(old, weights, len(everything.symmetric))
        if unit is not None and (unit.same or (before.shaped is None and before.sampled is None)):
            return _extended(built, before, old, shaping, axes, grasps, unit)
    return _searched(_made(built, shaping, axes, everything, weights), None)


def _searched(built: Built, before: Built | None) -> Built:
    """With the search in its density: an extended one where that is what there was before, extended, and its
    rows weigh about what they did when they were ranked.
    """
    assert built.asked is not None
    assert built.density is not None
    now = built.density.raw_weights
    if before is not None and before.search is not None and before.ranked_by is not None:
        known = before.ranked_by
        change = now[: len(known)] / known
        if change.max() <= _ABOUT and change.min() >= 1.0 / _ABOUT:
            ranked_by = np.concatenate([known, now[len(known) :]])
            search = before.search.extended(built.asked, built.density)
            return replace(built, search=search, ranked_by=ranked_by)
    return replace(built, search=ModeSearch(built.asked, built.density), ranked_by=now)


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
    unit: _InUnit,
) -> Built:
    """The density ``old`` of ``before`` with further grasps, and its rows weighed anew where that is due."""
    poses, symmetric = fresh
    added = unit.weights[old.size :]
    if before.shaped is not None:
        frames = stored_kernel.axes_at(axes, poses)
        shaped = before.shaped.extend(poses, weights=added, symmetric=symmetric, frames=frames)
        return _searched(replace(built, density=shaped.isotropic, shaped=shaped), before)
    sampled = before.sampled
    if sampled is not None and shaping is not None and len(added):
        more = stored_kernel.load_sampled(shaping).placed(poses, weights=added, symmetric=symmetric)
        total = float(added.sum())
        sampled = sampled.extend(more.poses, weights=more.weights * total, symmetric=more.symmetric)
    if not unit.same:
        old = old.reweighted(unit.weights[: old.size])
    density = old.extend(poses, added, symmetric)
    return _searched(replace(built, density=density, sampled=sampled), before)


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


# -- weights and widths -------------------------------------------------------------------------------------


class _InUnit(NamedTuple):
    """Weights (N,) of rows of which the first are those of a density, in its unit; whether they weigh there
    what they did.
    """

    weights: Floats
    same: bool


def _in_units_of(old: GraspDensity, weights: Floats | None, count: int) -> _InUnit | None:
    """Weights (count,), None where all are equal, in the unit of a density of the first rows; None where
    none of that unit would do.

    Every density is built with weights of mean 1, so its raw ones are in the unit that it is extended in.
    """
    raw = old.raw_weights
    if weights is None:
        weights = np.ones(count)
    factor = raw / weights[: len(raw)]
    same = bool(np.ptp(factor) <= _SAME * factor[0])
    found = weights * (factor[0] if same else float(np.median(factor)))
    if same:
        found[: len(raw)] = raw
    usable = np.isfinite(found).all() and (found > 0.0).all()
    return _InUnit(np.asarray(found), same) if usable else None


def _choosing(grasps: Grasps, proposal: Floats, count: int) -> Rows:
    """The first rows, which choose the widths.

    By their own proposal densities: how much else was tried since must not change what they choose.
    """
    first = slice(0, count)
    weights = None
    if not np.isnan(proposal[first]).all():
        weights = importance_weights(proposal[first])
        weights = np.maximum(weights, weights.max() * _LEAST_SHARE)
    return Rows.of(grasps.poses[first], weights, grasps.symmetric[first])


def _told(found: ChosenWidths, count: int) -> KernelInfo:
    """Widths that the first ``count`` rows have chosen."""
    rule = f"default: {found.rule} likelihood of the first {count} successes"
    if found.rule == "default":
        rule = f"default: the first {count} successes lie in one block, so that none can be left out"
    return stored_kernel.isotropic_info(IsotropicKernel(found.sigma_position_m, found.sigma_rotation), rule)


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
