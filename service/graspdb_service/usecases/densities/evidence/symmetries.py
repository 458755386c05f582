"""Attempts shared by an object's symmetry, where its mesh has one and outcomes do not contradict it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from graspdb.wire import Selection, SymmetryAxis, SymmetryInfo, SymmetryPlane
from graspdb_density import GraspDensity, ModeSearch, SuccessModel
from graspdb_density.success.contradiction import SymmetryVerdict, contradiction
from graspdb_density.success.fuller import FullerModel
from graspdb_density.success.motions import Motions
from graspdb_geometry.symmetry import Symmetry
from graspdb_service.problems import ProblemError, conflict
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.geometry.symmetries import ShapeSymmetries
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.trials.selection import Selected

#: Attempts are shared, times the images of each; of more, a random sample is. Searches feel their way by so
#: many.
_SHARED, _QUICK = 200_000, 20_000
#: Successes about whose images a search looks for grasps, times those images; turns about an axis of which
#: images are made, so that kernels of 15 degrees overlap.
_CENTRES, _TURNS = 100_000, 36
#: A verdict stands until such a share of the attempts is new, of few every time; so many are kept.
_CHANGED, _FEW, _VERDICTS = 0.25, 200, 1_024
#: Places that a refusal names.
_NAMED = 3


@dataclass(frozen=True, eq=False)
class _Shared:
    """What is made of a model, by the motions of a mesh: it shared, or why its outcomes refuse that."""

    motions: Motions
    model: Model
    verdict: SymmetryVerdict


class Symmetries:
    """What symmetries share in one service process, looked at once for every model of attempts."""

    def __init__(self, shapes: ShapeSymmetries, compute: Compute) -> None:
        self._shapes = shapes
        self._compute = compute
        self._shared: WeakKeyDictionary[SuccessModel, _Shared] = WeakKeyDictionary()
        self._known: WeakKeyDictionary[Symmetry, dict[bool, Motions | None]] = WeakKeyDictionary()
        self._searches: WeakKeyDictionary[Built, tuple[Motions, ModeSearch]] = WeakKeyDictionary()
        self._judged: OrderedDict[object, tuple[Motions, int, int, SymmetryVerdict]] = OrderedDict()
        self._lock = threading.Lock()

    def applied(
        self, request: Selection, built: Built, model: Model | None
    ) -> tuple[Model | None, SymmetryInfo | None]:
        """A model whose attempts tell of their images, too, where a request asks for it, and what was done;
        the model itself where it does not, or where there is no symmetry.

        409 ``mesh-missing``, and ``symmetry-contradicted`` where outcomes contradict it.
        """
        if getattr(request, "symmetry", None) != "auto":
            return model, None
        selected = built.selected
        found = self._shapes.of(selected.row)
        motions = self._motions(found, selected)
        info = _told(found)
        if not found:
            told = f"no symmetry of the mesh was found within {_mm(found.tolerance_m)}"
            return model, info.model_copy(update={"reason": f"{told}: answered as with symmetry=off"})
        if motions is None:
            told = "mirror planes alone were found, and the jaw has no such symmetry"
            return model, info.model_copy(update={"reason": f"{told}: answered as with symmetry=off"})
        if model is None:
            return model, info.model_copy(update={"reason": "there is no attempt to share"})
        # What was learned tells of places that were not tried by itself: kernels alone share.
        model = model.plain or model
        shared = self._of(built, model, motions)
        verdict = shared.verdict
        if verdict.refused:
            raise _refused(selected, verdict)
        counts = {"places": len(verdict.places), "against": len(verdict.against)}
        reason = _reason(found, selected, model, shared)
        return shared.model, info.model_copy(
            update={"applied": True, "tested": verdict.told, "reason": reason, **counts}
        )

    def search(self, request: Selection, built: Built, search: ModeSearch) -> ModeSearch:
        """A search about successes and their images, where a request asks for symmetry: only what it ranks
        by chance is looked for there, and its density means nothing.
        """
        density = built.density
        if getattr(request, "symmetry", None) != "auto" or density is None:
            return search
        motions = self._motions(self._shapes.of(built.selected.row), built.selected)
        if motions is None:
            return search
        with self._lock:
            known = self._searches.get(built)
        if known is not None and known[0] is motions:
            return known[1]

        def spread() -> ModeSearch:
            rows = np.random.default_rng(0).permutation(density.size)
            count = len(motions) * (1 if motions.upright is None else _TURNS)
            some = density.poses[np.sort(rows[: max(_CENTRES // count, 1)])]
            images = motions.spread(some, _TURNS)
            symmetric = bool(density.symmetric.all())
            return ModeSearch(GraspDensity.build(images, kernel=density.kernel, symmetric=symmetric))

        found = self._compute.run(spread)
        with self._lock:
            self._searches[built] = motions, found
        return found

    def _motions(self, found: Symmetry, selected: Selected) -> Motions | None:
        """The same ones for the same mesh and kind of jaw, as long as it is kept."""
        mirrors = _mirrored(selected)
        with self._lock:
            known = self._known.setdefault(found, {})
            if mirrors not in known:
                known[mirrors] = motions_of(found, mirrors=mirrors)
            return known[mirrors]

    def _of(self, built: Built, model: Model, motions: Motions) -> _Shared:
        with self._lock:
            known = self._shared.get(model.whole)
        # A copy may have got another mesh, and its trials may be the same.
        if known is None or known.motions is not motions:
            verdict = self._verdict(built, model, motions)
            known = self._compute.run(lambda: _share(model, motions, verdict))
            with self._lock:
                self._shared[model.whole] = known
        return known

    def _verdict(self, built: Built, model: Model, motions: Motions) -> SymmetryVerdict:
        """What outcomes say of it, judged anew once a quarter of the attempts are others."""
        key = (*built.selected.key, built.kernel.sigma_position_m, built.kernel.sigma_rotation_deg)
        size, epoch = model.whole.size, built.object_row.epoch
        with self._lock:
            judged = self._judged.get(key)
        if judged is not None:
            of, then, at, verdict = judged
            if of is motions and at == epoch and size > _FEW and then <= size <= (1.0 + _CHANGED) * then:
                return verdict
        threads = self._compute.threads
        verdict = self._compute.run(lambda: contradiction(model.quick, motions, threads=threads))
        with self._lock:
            self._judged[key] = motions, size, epoch, verdict
            self._judged.move_to_end(key)
            while len(self._judged) > _VERDICTS:
                self._judged.popitem(last=False)
        return verdict


def doubts(symmetry: SymmetryInfo | None) -> list[str]:
    """Warnings of symmetries that share nothing, or that nothing has tested."""
    if symmetry is None or (symmetry.applied and symmetry.tested):
        return []
    return [f"symmetry=auto: {symmetry.reason}"]


def _mirrored(selected: Selected) -> bool:
    """Whether mirrors share a selection's attempts: the jaw is its own mirror image, of each of them."""
    return selected.jaw_symmetric and all(selected.provenances.values())


def motions_of(found: Symmetry, *, mirrors: bool) -> Motions | None:
    """The motions of a mesh, with its mirrors or without; None where there is none but the identity."""
    if not found:
        return None
    elements = found.elements(mirrors=mirrors)
    axis = found.axis
    if axis is None and len(elements) == 1:
        return None
    return Motions.of(elements, found.centre, axis=None if axis is None else axis.direction)


def _share(model: Model, motions: Motions, verdict: SymmetryVerdict) -> _Shared:
    if verdict.refused:
        return _Shared(motions, model, verdict)
    whole = _of_many(model.whole, motions, _SHARED // len(motions))
    quick = whole
    if model.quick.size > _QUICK // len(motions):
        quick = _of_many(model.quick, motions, _QUICK // len(motions))
    return _Shared(motions, replace(model, whole=whole, quick=quick), verdict)


def _of_many(model: SuccessModel, motions: Motions, most: int) -> SuccessModel:
    """A model that is shared, as a sample where it has many attempts, beside all of them in their places."""
    shared = model.shared(motions, most=most)
    return shared if model.size <= most else FullerModel(shared, model)


def _told(found: Symmetry) -> SymmetryInfo:
    origin = tuple(found.centre.tolist())
    return SymmetryInfo(
        axes=[
            SymmetryAxis(origin=origin, direction=tuple(axis.direction.tolist()), turns=axis.order)
            for axis in found.axes
        ],
        planes=[
            SymmetryPlane(normal=tuple(p.normal.tolist()), offset_m=float(p.normal @ found.centre))
            for p in found.planes
        ],
        every_axis=found.ball,
        tolerance_m=found.tolerance_m,
        applied=False,
        reason="",
    )


def _reason(found: Symmetry, selected: Selected, model: Model, shared: _Shared) -> str:
    """How attempts are shared, in words."""
    verdict = shared.verdict
    by = "every turn about the axis" if found.axis is not None else "its turns"
    if found.ball:
        by = "every turn about one axis of the ball's"
    mirrors = _mirrored(selected)
    by += ", and its mirror images" if mirrors and (found.planes or found.axis) else ""
    told = f"an attempt tells of {by}, too, and stays one attempt"
    if not mirrors and (found.planes or found.axis):
        told += "; mirror planes are left out, for the jaw is not its own mirror image"
    if isinstance(shared.model.whole, FullerModel):
        told += (
            f"; of {model.whole.size:,} attempts {shared.model.whole.sampled:,} drawn at random are shared"
        )
    if not verdict.told:
        return f"{told}; too few attempts lie where others are taken to tell whether outcomes agree"
    return f"{told}; outcomes at {len(verdict.places)} places do not contradict it"


def _refused(selected: Selected, verdict: SymmetryVerdict) -> ProblemError:
    """409 that says how many attempts speak against a symmetry, and where."""
    against = verdict.against or verdict.places[:1]
    trials = sum(place.trials for place in against)
    where = "; ".join(
        f"at {', '.join(f'{1e3 * x:.0f}' for x in place.position)} mm {place.share:.0%} of"
        f" {place.trials:.0f} effective trials hold, of {place.other_trials:.0f} that the symmetry takes"
        f" there {place.other_share:.0%}"
        for place in against[:_NAMED]
    )
    return conflict(
        "symmetry-contradicted",
        f"The mesh of object {selected.row.slug!r} is symmetric, but outcomes are not: about {trials:.0f}"
        f" attempts at {len(against)} of {len(verdict.places)} places speak against it, most: {where}. The"
        " mesh may lack a part, the mass may be off the middle, or poses may be: leave symmetry out"
        " (symmetry=off)",
    )


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.2g} mm"
