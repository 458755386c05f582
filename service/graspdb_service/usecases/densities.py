"""Densities built on demand and kept: extended when trials come, rebuilt when the past changes."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import KernelInfo, KernelSpec, Selection
from graspdb_density import (
    DEFAULT_KERNEL,
    GraspDensity,
    IsotropicKernel,
    MixtureDensity,
    choose_widths,
    importance_weights,
    widths_prefix,
)
from graspdb_density.density import CUTOFF
from graspdb_density.kernels import POSITION_LIMITS_M, ROTATION_LIMITS
from graspdb_density.widths import FIRST_CHOICE
from graspdb_service.problems import ProblemError, conflict, invalid, not_found
from graspdb_service.storage import kernels, objects, trials
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.kernels import KernelRow
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases import shapes
from graspdb_service.usecases.cache import SingleFlightCache
from graspdb_service.usecases.compute import Compute
from graspdb_service.usecases.selection import Filters, Selected, resolve
from graspdb_service.usecases.slugs import is_slug

Floats = NDArray[np.float64]

_DEFAULT_POSITION_M = DEFAULT_KERNEL.sigma_position_m
_DEFAULT_ROTATION_DEG = round(math.degrees(DEFAULT_KERNEL.sigma_rotation), 9)
#: Beyond this many standard deviations a cut-off changes no answer: evaluated exactly instead.
_LARGEST_CUTOFF = 10.0
#: Weights are told apart in float32: a row that counts less than this share of the heaviest gets this share.
_LEAST_SHARE = 1e-30
_RESOLVED = 4_096


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


def kernel_of(request: Selection) -> tuple[KernelChoice, float | None]:
    """The kernel and the cut-off (None: exact) that a request asks for.

    Raises
    ------
    ProblemError
        422 for widths given twice, or beside a stored kernel.
    """
    choice, cutoff = _choice(request)
    for name, value, (low, high) in (
        ("sigma_position_m", choice.sigma_position_m, POSITION_LIMITS_M),
        ("sigma_rotation_deg", choice.sigma_rotation_deg, np.degrees(ROTATION_LIMITS)),
    ):
        if value is not None and not low <= value <= high:
            raise invalid(name, f"a width must be between {low:g} and {high:g}")
    return choice, cutoff


def _choice(request: Selection) -> tuple[KernelChoice, float | None]:
    beside = KernelChoice(request.sigma_position_m, request.sigma_rotation_deg)
    kernel = request.kernel
    if isinstance(kernel, KernelSpec):
        inside = KernelChoice(kernel.sigma_position_m, kernel.sigma_rotation_deg)
        twice = [
            name
            for name in ("sigma_position_m", "sigma_rotation_deg")
            if getattr(inside, name) is not None and getattr(beside, name) is not None
        ]
        if twice:
            raise ProblemError(
                422,
                "invalid-request",
                "A width is given both in kernel and beside it",
                errors=[(name, "give it once, in kernel or beside it") for name in twice],
            )
        choice = KernelChoice(
            inside.sigma_position_m if beside.sigma_position_m is None else beside.sigma_position_m,
            inside.sigma_rotation_deg if beside.sigma_rotation_deg is None else beside.sigma_rotation_deg,
        )
        if "cutoff" not in kernel.model_fields_set:
            return choice, CUTOFF
        exact = kernel.cutoff is None or kernel.cutoff > _LARGEST_CUTOFF
        return choice, None if exact else kernel.cutoff
    if kernel in (None, "isotropic"):
        return beside, CUTOFF
    given = [name for name in ("sigma_position_m", "sigma_rotation_deg") if getattr(beside, name) is not None]
    if given:
        raise ProblemError(
            422,
            "invalid-request",
            "A stored kernel has its own widths",
            errors=[(name, "only the isotropic kernel takes widths") for name in given],
        )
    return KernelChoice(stored=kernel), CUTOFF


@dataclass(frozen=True, eq=False)
class Built:
    """A density and what it was built of, immutable.

    Attributes
    ----------
    density
        None where no trial of the selection succeeded. With a stored kernel the density under the isotropic
        one of equal determinants.
    shaped
        The density under the stored kernel, where one was asked for.
    seq
        (N,) sequence numbers of its rows, ascending.
    proposal_density
        (N,) NaN where unknown; None where none is known.
    weight_unit
        Weight times proposal density, the same for every row that has one.
    chosen_from
        How many of the first rows the widths were chosen from.
    """

    revision: int
    epoch: int
    last_seq: int
    object_row: ObjectRow
    selected: Selected
    kernel: KernelInfo
    density: GraspDensity | None
    seq: NDArray[np.int64]
    proposal_density: Floats | None
    weight_unit: float | None
    chosen_from: int = 0
    shaped: MixtureDensity | None = None

    @property
    def asked(self) -> GraspDensity | MixtureDensity | None:
        """The density under the kernel that was asked for."""
        return self.density if self.shaped is None else self.shaped

    @property
    def nbytes(self) -> int:
        own = self.seq.nbytes + (0 if self.proposal_density is None else self.proposal_density.nbytes)
        held = sum(part.nbytes for part in (self.density, self.shaped) if part is not None)
        return own + held + 4_096


@dataclass(frozen=True)
class _Key:
    object_id: int
    filters: Filters
    kernel: KernelChoice


class Densities:
    """The densities of one service process, over a database that others may share.

    Every query reads the object's revision, one indexed row. Trials that came since are read as a tail and
    extend the density; any other change (a new epoch) rebuilds it. So what another process committed is in
    the next answer of this one. Nothing is computed inside a transaction.
    """

    def __init__(self, database: Database, compute: Compute, max_bytes: int) -> None:
        self._database = database
        self._compute = compute
        self._cache: SingleFlightCache[_Key, Built] = SingleFlightCache(max_bytes, lambda b: b.nbytes)
        self._resolved: OrderedDict[tuple[int, Filters], tuple[int, Selected]] = OrderedDict()
        self._lock = threading.Lock()

    def current(self, slug: str, filters: Filters) -> tuple[ObjectRow, Selected]:
        """The object as it is now, and which of its trials the filters select.

        Raises
        ------
        ProblemError
            404 for the object or gripper, 409 for an ambiguous selection.
        """
        with self._database.read() as tx:
            row = require_object(tx, slug)
            with self._lock:
                known = self._resolved.get((row.id, filters))
            if known is not None and known[0] == row.revision:
                return row, known[1]
            selected = resolve(tx, row.id, filters)
        with self._lock:
            self._resolved[row.id, filters] = row.revision, selected
            self._resolved.move_to_end((row.id, filters))
            while len(self._resolved) > _RESOLVED:
                self._resolved.popitem(last=False)
        return row, selected

    def get(self, slug: str, filters: Filters, kernel: KernelChoice) -> Built:
        """The density at least as new as the object is now.

        Raises
        ------
        ProblemError
            As :meth:`current`.
        """
        row, selected = self.current(slug, filters)
        stored = None
        if kernel.stored is not None:
            stored = self.stored(row, selected, kernel.stored)
            kernel = KernelChoice(stored=stored.id)
        key = _Key(row.id, selected.filters, kernel)
        return self._cache.get(
            key,
            lambda built: built.revision >= row.revision,
            lambda before: self._refresh(key, slug, before, stored),
        )

    def stored(self, row: ObjectRow, selected: Selected, name: str) -> KernelRow:
        """The stored kernel with this id, or the newest of the object and gripper for ``anisotropic``.

        Raises
        ------
        ProblemError
            404 without such a kernel; 409 where none was fitted, or for another gripper's.
        """
        with self._database.read() as tx:
            if name == "anisotropic":
                newest = kernels.newest(tx, row.id, selected.gripper)
                found = None if newest is None else kernels.find(tx, newest)
            else:
                found = kernels.find(tx, name)
            others = [] if found else kernels.page(tx, after=0, limit=20, object_id=row.id, gripper=None)
        names = ["isotropic", *(kernel.id for kernel in others)]
        if found is None and name == "anisotropic":
            gripper = f', "gripper": "{selected.gripper}"' if selected.gripper else ""
            raise conflict(
                "kernel-not-fitted",
                "No anisotropic kernel has been fitted for this object and gripper: fit one with"
                f' POST /kernels {{"object": "{row.slug}"{gripper}}}; kernels there are: {", ".join(names)}',
                kernels=names,
            )
        if found is None:
            raise not_found("kernel", name, f"kernels there are: {', '.join(names)} (GET /kernels)")
        if found.gripper not in (None, selected.gripper) and selected.gripper is not None:
            raise conflict(
                "kernel-of-another-gripper",
                f"Kernel {found.id} was fitted for the gripper {found.gripper!r}, these trials are of"
                f" {selected.gripper!r}: fit one for it with POST /kernels",
            )
        return found

    @property
    def nbytes(self) -> int:
        return self._cache.nbytes

    def __len__(self) -> int:
        return len(self._cache)

    def _refresh(self, key: _Key, slug: str, before: Built | None, stored: KernelRow | None) -> Built:
        with self._database.read() as tx:
            row = require_object(tx, slug, key.object_id)
            selected = resolve(tx, row.id, key.filters)
            if before is not None and before.epoch != row.epoch:
                before = None
            rows = trials.read(
                tx,
                row.id,
                provenance_ids=list(selected.provenances),
                successes_only=True,
                after_seq=0 if before is None else before.last_seq,
            )
        if before is not None and not len(rows):
            return replace(
                before, revision=row.revision, last_seq=row.last_seq, object_row=row, selected=selected
            )
        if stored is not None:
            frame = shapes.frame_of(stored, row)
            return self._compute.run(lambda: _build_shaped(stored, frame, row, selected, rows, before))
        return self._compute.run(
            lambda: _build(key.kernel, row, selected, rows, before, self._compute.threads)
        )


def require_object(tx: Tx, slug: str, object_id: int | None = None) -> ObjectRow:
    """The object with this slug, and with this internal id where one is given.

    Raises
    ------
    ProblemError
        404 without such an object, 409 where it is another one by now.
    """
    row = objects.find(tx, slug) if is_slug(slug) else None
    if row is None:
        raise not_found("object", slug[:80], "GET /objects lists those there are")
    if object_id is not None and row.id != object_id:
        raise conflict("object-replaced", f"Object {slug!r} was deleted and created anew: ask again")
    return row


def _build(
    choice: KernelChoice,
    row: ObjectRow,
    selected: Selected,
    rows: trials.Columns,
    before: Built | None,
    threads: int,
) -> Built:
    """Extend the density there was, or build it from all rows where that is not possible."""
    symmetric = np.array([selected.provenances[int(p)] for p in rows.provenance], dtype=bool)
    proposal = None if np.isnan(rows.proposal_density).all() else rows.proposal_density
    position, quaternion, seq = rows.position, rows.quaternion_xyzw, rows.seq
    old = None if before is None else before.density
    if before is not None and old is not None:
        seq = np.concatenate([before.seq, seq])
        proposal = _joined(before.proposal_density, len(before.seq), proposal, len(rows))
    chosen_from = widths_prefix(len(seq)) if choice.by_default else 0
    built = Built(
        revision=row.revision,
        epoch=row.epoch,
        last_seq=row.last_seq,
        object_row=row,
        selected=selected,
        kernel=_info(choice),
        density=None,
        seq=seq,
        proposal_density=proposal,
        weight_unit=None,
        chosen_from=chosen_from,
    )
    if not len(seq):
        return built
    if before is not None and old is not None:
        if before.chosen_from == chosen_from:
            built = replace(built, kernel=before.kernel)
            extended = _extended(before, old, rows, symmetric, proposal)
            if extended is not None:
                return replace(built, density=extended, weight_unit=before.weight_unit)
        position = np.concatenate([old.positions, position])
        quaternion = np.concatenate([old.quaternions_xyzw, quaternion])
        symmetric = np.concatenate([old.symmetric, symmetric])
    if chosen_from and (before is None or before.chosen_from != chosen_from):
        first = slice(0, chosen_from)
        widths = choose_widths(
            position[first],
            quaternion[first],
            weights=_weights(None if proposal is None else proposal[first]),
            symmetric=symmetric[first],
            threads=threads,
        )
        built = replace(built, kernel=_chosen(widths.kernel, widths.rule, widths.rows))
    weights = _weights(proposal)
    unit = None
    if weights is not None and proposal is not None:
        known = int(np.flatnonzero(~np.isnan(proposal))[0])
        unit = float(weights[known] * proposal[known])
    density = GraspDensity.build(
        position,
        quaternion,
        kernel=IsotropicKernel(built.kernel.sigma_position_m, math.radians(built.kernel.sigma_rotation_deg)),
        weights=weights,
        symmetric=symmetric,
    )
    return replace(built, density=density, weight_unit=unit)


def _build_shaped(
    stored: KernelRow,
    frame: Floats | None,
    row: ObjectRow,
    selected: Selected,
    rows: trials.Columns,
    before: Built | None,
) -> Built:
    """The density under a stored kernel; extended where all weights are equal, else built anew."""
    fresh = symmetric = np.array([selected.provenances[int(p)] for p in rows.provenance], dtype=bool)
    proposal = None if np.isnan(rows.proposal_density).all() else rows.proposal_density
    position, quaternion, seq = rows.position, rows.quaternion_xyzw, rows.seq
    if before is not None and before.density is not None:
        old = before.density
        seq = np.concatenate([before.seq, seq])
        proposal = _joined(before.proposal_density, len(before.seq), proposal, len(rows))
        position = np.concatenate([old.positions, position])
        quaternion = np.concatenate([old.quaternions_xyzw, quaternion])
        symmetric = np.concatenate([old.symmetric, symmetric])
    kernel = shapes.load(stored)
    built = Built(
        revision=row.revision,
        epoch=row.epoch,
        last_seq=row.last_seq,
        object_row=row,
        selected=selected,
        kernel=shapes.info_of(stored, kernel),
        density=None,
        seq=seq,
        proposal_density=proposal,
        weight_unit=None,
    )
    if not len(seq):
        return built
    if before is not None and before.shaped is not None and proposal is None:
        shaped = before.shaped.extend(rows.position, rows.quaternion_xyzw, symmetric=fresh, frames=frame)
    else:
        shaped = MixtureDensity(
            position, quaternion, kernel=kernel, weights=_weights(proposal), symmetric=symmetric, frames=frame
        )
    return replace(built, density=shaped.isotropic, shaped=shaped)


def _extended(
    before: Built,
    old: GraspDensity,
    rows: trials.Columns,
    symmetric: NDArray[np.bool_],
    proposal: Floats | None,
) -> GraspDensity | None:
    """The density with further rows; None where they change the weights of the first ones."""
    weights = None
    if proposal is not None:
        # A trial without a proposal density takes the mean weight of the rest, which the new rows move.
        if before.weight_unit is None or np.isnan(proposal).any():
            return None
        with np.errstate(over="ignore"):
            weights = before.weight_unit / rows.proposal_density
        if not (np.isfinite(weights).all() and (weights > 0).all()):
            return None
    return old.extend(rows.position, rows.quaternion_xyzw, weights=weights, symmetric=symmetric)


def _weights(proposal: Floats | None) -> Floats | None:
    """Weights of eq 1, no row lost to rounding; None where all are equal."""
    if proposal is None or np.isnan(proposal).all():
        return None
    weights = importance_weights(proposal)
    return np.asarray(np.maximum(weights, weights.max() * _LEAST_SHARE), dtype=np.float64)


def _joined(
    first: Floats | None, first_count: int, second: Floats | None, second_count: int
) -> Floats | None:
    if first is None and second is None:
        return None
    return np.concatenate(
        [
            np.full(first_count, np.nan) if first is None else first,
            np.full(second_count, np.nan) if second is None else second,
        ]
    )


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


def _chosen(kernel: IsotropicKernel, rule: str, rows: int) -> KernelInfo:
    return KernelInfo(
        kind="isotropic",
        sigma_position_m=kernel.sigma_position_m,
        sigma_rotation_deg=math.degrees(kernel.sigma_rotation),
        rule=f"default: {rule} likelihood of the first {rows} successes",
    )
