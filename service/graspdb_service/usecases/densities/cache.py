"""Densities built on demand and kept: extended when trials come, rebuilt when the past changes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import replace
from functools import partial

import numpy as np

from graspdb.wire import KernelSpec, Selection
from graspdb.wire.queries import TrialSelection
from graspdb_density.kde.isotropic import CUTOFF
from graspdb_service import principal
from graspdb_service.problems import ProblemError, conflict, invalid_fields, not_found
from graspdb_service.storage import kernels
from graspdb_service.storage.database import Database
from graspdb_service.storage.kernels import KernelRow
from graspdb_service.storage.trials import rows as trial_rows
from graspdb_service.trial_columns import gripper_parts
from graspdb_service.usecases.densities import build, proposal_density, stored_kernel
from graspdb_service.usecases.densities.build import Built, Fresh, KernelChoice
from graspdb_service.usecases.densities.weighing import Weighing, codes_of, fetch_tried, mixes
from graspdb_service.usecases.densities.widths.choosing import WidthChoosing
from graspdb_service.usecases.geometry.features import Features
from graspdb_service.usecases.runtime.asked import or_kept
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.trials.selection import Selected, Selections, as_of

_WIDTHS = ("sigma_position_m", "sigma_rotation_deg")
#: Beyond this many standard deviations a cut-off changes no answer: evaluated exactly instead.
_LARGEST_CUTOFF = 10.0
#: Stored kernels remembered for while the database does not answer.
_KERNELS_KEPT = 256


def kernel_of(request: Selection) -> tuple[KernelChoice, float | None]:
    """The kernel and the cut-off (None: exact) of a request; 422 for widths beside a stored kernel."""
    kernel = request.kernel
    beside = {name: getattr(request, name) for name in _WIDTHS}
    given = [name for name, width in beside.items() if width is not None]
    if isinstance(kernel, str) and kernel != "isotropic":
        if given:
            told = "only the isotropic kernel takes widths"
            raise invalid_fields([(name, told) for name in given], "A stored kernel has its own widths")
        return KernelChoice(stored=kernel), CUTOFF
    inside = kernel if isinstance(kernel, KernelSpec) else KernelSpec()
    twice = [name for name in given if getattr(inside, name) is not None]
    if twice:
        told = "give it once, in kernel or beside it"
        title = "A width is given both in kernel and beside it"
        raise invalid_fields([(name, told) for name in twice], title)
    widths = {name: getattr(inside, name) if width is None else width for name, width in beside.items()}
    cutoff = inside.cutoff if "cutoff" in inside.model_fields_set else CUTOFF
    exact = cutoff is None or cutoff > _LARGEST_CUTOFF
    return KernelChoice(**widths), None if exact else cutoff


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
        self.widths = WidthChoosing(database)
        self.kept: SingleFlightCache[tuple[tuple[int, TrialSelection, int | None], KernelChoice], Built]
        self.kept = SingleFlightCache(max_bytes, lambda built: built.nbytes)
        self._found: OrderedDict[tuple[int, str | None, str], KernelRow] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, selected: Selected, kernel: KernelChoice) -> Built:
        """The density of a selection, at least as new; refused as :meth:`stored`, and as the selection where
        the object has changed since.
        """
        stored = None
        if kernel.stored is not None:
            stored = self.stored(selected, kernel.stored)
            kernel = KernelChoice(stored=stored.id)
        return self.kept.get(
            (selected.key, kernel),
            lambda built: built.revision >= selected.row.revision,
            lambda before: self._refresh(selected, kernel, stored, before),
        )

    def requested(self, slug: str, request: Selection) -> Built:
        """The density that a request is about."""
        choice, _ = kernel_of(request)
        return self.get(self.selections.resolve(slug, request), choice)

    def stored(self, selected: Selected, name: str) -> KernelRow:
        """The stored kernel with this id (404), or for ``anisotropic`` the newest of its gripper (409)."""
        key = selected.row.id, selected.gripper, name
        with self._lock:
            known = self._found.get(key)
        if known is not None and not principal.sees(stored_kernel.owner(known)):
            known = None
        try:
            found = or_kept(partial(self._find_stored, selected, name), known)
        except ProblemError:
            with self._lock:
                self._found.pop(key, None)
            raise
        with self._lock:
            self._found[key] = found
            self._found.move_to_end(key)
            while len(self._found) > _KERNELS_KEPT:
                self._found.popitem(last=False)
        return found

    def _find_stored(self, selected: Selected, name: str) -> KernelRow:
        row = selected.row
        with self._database.read() as tx:
            newest = name == "anisotropic"
            found = kernels.newest(tx, row.id, selected.gripper) if newest else kernels.find(tx, name)
            if found is not None and not principal.sees(stored_kernel.owner(found)):
                found = None
            others = [] if found else kernels.page(tx, after=0, limit=20, object_id=row.id, gripper=None)
        names = ["isotropic", *(kernel.id for kernel in others)]
        if found is None and newest:
            gripper = f', "gripper": "{selected.gripper}"' if selected.gripper else ""
            raise conflict(
                "kernel-not-fitted",
                "No anisotropic kernel has been fitted for this object and gripper: fit one with"
                f' POST /kernels {{"object": "{row.slug}"{gripper}}}; kernels there are: {", ".join(names)}',
                kernels=names,
            )
        if found is None:
            raise not_found("kernel", name, f"kernels there are: {', '.join(names)} (GET /kernels)")
        if (
            found.gripper
            and selected.gripper
            and gripper_parts(found.gripper)[0] != gripper_parts(selected.gripper)[0]
        ):
            raise conflict(
                "kernel-of-another-gripper",
                f"Kernel {found.id} was fitted for the gripper {found.gripper!r}, these trials are of"
                f" {selected.gripper!r}: fit one for it with POST /kernels",
            )
        return found

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
            swept = np.isin(rows.batch, sorted(exposure.batches))
            weighing = Weighing(
                exposure,
                codes_of(selected, rows.provenance, rows.proposal_density, swept),
                rows.proposal_density,
                rows.share,
                selected.weights_by_source,
            )
            known = None if before is None else before.weighing
            if known is not None:
                weighing = known.followed_by(weighing)
            attempts = None
            if mixes(selected, exposure, weighing.codes):
                since = before.selected if before is not None and before.weighing.tried is not None else None
                attempts = fetch_tried(tx, selected, since)
        # Failures of one grid change no weight, those of several do.
        if before is not None and not len(rows) and known is not None:
            alike = exposure == known.exposure or not (exposure.several or known.tried)
            mixed_as_before = (attempts is None) == (known.tried is None)
            if alike and mixed_as_before and (attempts is None or attempts.empty):
                return replace(before, selected=selected, weighing=replace(known, exposure=exposure))
        threads = self._compute.threads
        axes = None if stored is None else stored_kernel.axes(stored.alignment, selected, self._features)
        fresh = Fresh(rows, weighing, attempts)
        return self._compute.run(
            lambda: build.build(kernel, stored, axes, selected, fresh, before, self.widths, threads)
        )
