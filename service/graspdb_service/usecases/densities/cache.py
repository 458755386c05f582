"""Densities built on demand and kept: extended when trials come, rebuilt when the past changes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graspdb.wire import KernelSpec, Selection
from graspdb_density.kde.isotropic import CUTOFF
from graspdb_density.kernels.isotropic import POSITION_LIMITS_M, ROTATION_LIMITS
from graspdb_service.problems import ProblemError, conflict, invalid, not_found
from graspdb_service.storage import kernels
from graspdb_service.storage.database import Database
from graspdb_service.storage.kernels import KernelRow
from graspdb_service.storage.trials import rows as trial_rows
from graspdb_service.usecases.densities import build, proposal_density, stored_kernel
from graspdb_service.usecases.densities.build import Built, KernelChoice
from graspdb_service.usecases.geometry.features import Features
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.trials.selection import Filters, Selected, Selections, as_of

__all__ = ["Built", "Densities", "KernelChoice", "kernel_of"]

#: Beyond this many standard deviations a cut-off changes no answer: evaluated exactly instead.
_LARGEST_CUTOFF = 10.0


def kernel_of(request: Selection) -> tuple[KernelChoice, float | None]:
    """The kernel and the cut-off (None: exact) of a request; 422 for widths beside a stored kernel."""
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

    def __init__(
        self,
        database: Database,
        selections: Selections,
        compute: Compute,
        features: Features,
        max_bytes: int,
    ) -> None:
        self._database = database
        self.selections = selections
        self._compute = compute
        self._features = features
        self._cache: SingleFlightCache[_Key, Built] = SingleFlightCache(max_bytes, lambda b: b.nbytes)

    def get(self, selected: Selected, kernel: KernelChoice) -> Built:
        """The density of a selection, at least as new; refused as :meth:`stored`, and as the selection where
        the object has changed since.
        """
        stored = None
        if kernel.stored is not None:
            stored = self.stored(selected, kernel.stored)
            kernel = KernelChoice(stored=stored.id)
        return self._cache.get(
            _Key(selected.row.id, selected.filters, kernel),
            lambda built: built.revision >= selected.row.revision,
            lambda before: self._refresh(selected, kernel, stored, before),
        )

    def requested(self, slug: str, request: Selection) -> Built:
        """The density that a request is about."""
        choice, _ = kernel_of(request)
        return self.get(self.selections.resolve(slug, Filters.of(request)), choice)

    def stored(self, selected: Selected, name: str) -> KernelRow:
        """The stored kernel with this id (404), or for ``anisotropic`` the newest of its gripper (409)."""
        row = selected.row
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

    def _refresh(
        self, selected: Selected, kernel: KernelChoice, stored: KernelRow | None, before: Built | None
    ) -> Built:
        with self._database.read() as tx:
            selected = as_of(tx, selected)
            row = selected.row
            if before is not None and before.object_row.epoch != row.epoch:
                before = None
            exposure = proposal_density.read(tx, selected)
            after_seq = 0 if before is None else before.object_row.last_seq
            rows = trial_rows.successes(tx, row.id, selected.provenances, after_seq=after_seq)
        # Failures of one grid change no weight, those of several do.
        if before is not None and not len(rows) and (exposure == before.exposure or not exposure.several):
            return replace(before, selected=selected, exposure=exposure)
        threads = self._compute.threads
        axes = None if stored is None else stored_kernel.axes(stored.alignment, selected, self._features)
        return self._compute.run(
            lambda: build.build(kernel, stored, axes, selected, exposure, rows, before, threads)
        )
