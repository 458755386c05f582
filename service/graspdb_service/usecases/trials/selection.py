"""Which trials a question is about: by gripper, protocol and source; of whichever engines."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graspdb.wire import OUTCOMES, SOURCES, GripperProfile
from graspdb.wire.base import source_weights
from graspdb.wire.grippers import SHAPE_FIELDS
from graspdb.wire.queries import TrialSelection
from graspdb_service import principal
from graspdb_service.problems import ProblemError, conflict, found, invalid
from graspdb_service.storage import grippers
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.grippers import GripperRow
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.trials import copies, provenances
from graspdb_service.trial_columns import Bools, Floats, Ints, Provenance, gripper_parts, is_gripper
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.asked import or_kept

_KEPT = 4_096
#: Versions that a warning tells of.
_TOLD = 5
UNSPECIFIED = "unspecified"
"""What the source of trials that name none is called."""
#: Names that a message lists.
_LISTED = 20


@dataclass(frozen=True, eq=False)
class Selected:
    """What a request's selection means for an object as it was when it was resolved.

    ``row`` is the object; ``gripper`` and ``protocol`` are the one named, else the only one among the trials,
    else None. ``provenances`` are internal ids of the selected trials' provenances, each with whether its jaw
    is mirror-symmetric; ``sources`` the source of each; ``tried`` those of sources that post failures, too:
    only they tell how likely a success is. ``outcomes`` counts selected trials by outcome, packed ones
    included, ``by_source`` those of each source. ``gripper`` may be one version, as in ``panda@1``; else
    ``profile`` is the newest's, whatever ``versions`` the trials are of, and ``warnings`` say so. ``stamp``
    is another one whenever the profile is.
    """

    row: ObjectRow
    gripper: str | None
    protocol: str | None
    source: str | None
    source_weight: str | None
    profile: GripperProfile | None
    provenances: Mapping[int, bool]
    sources: Mapping[int, str]
    outcomes: Mapping[str, int]
    by_source: Mapping[str, Mapping[str, int]]
    tried: frozenset[int]
    versions: Sequence[int]
    stamp: int | None
    warnings: Sequence[str]

    @property
    def filters(self) -> TrialSelection:
        """What selects the same trials whatever else is added to the object."""
        names = ("gripper", "protocol", "source", "source_weight")
        return TrialSelection(**{name: getattr(self, name) for name in names})

    @property
    def asked_weights(self) -> dict[str, float]:
        """The weights that were asked for, by source, the largest of all 1."""
        asked = source_weights(self.source_weight)
        return {name: weight / _largest(asked) for name, weight in asked.items()}

    @property
    def weights_by_source(self) -> dict[str, float]:
        """How much trials count by their source, 1 for those that count most of all."""
        asked = source_weights(self.source_weight)
        return {name: asked.get(name, 1.0) / _largest(asked) for name in self.by_source}

    def weights(self, provenance: Ints) -> Floats:
        """How much trials (n,) of the selection count by their provenances' sources."""
        found = np.ones(len(provenance))
        by_source = self.weights_by_source
        for number, source in self.sources.items():
            if by_source[source] != 1.0:
                found[provenance == number] = by_source[source]
        return found

    @property
    def key(self) -> tuple[int, TrialSelection, int | None]:
        """What is kept of a selection goes by this, and by the object's revision."""
        return self.row.id, self.filters, self.stamp

    def symmetric(self, provenance: Ints) -> Bools:
        """Whether the jaw was mirror-symmetric, of trials (n,) of the selection by their provenances."""
        return np.isin(provenance, [number for number, symmetric in self.provenances.items() if symmetric])

    @property
    def jaw_symmetric(self) -> bool:
        return self.profile is None or self.profile.symmetric

    @property
    def successes(self) -> int:
        return self.outcomes.get("success", 0)


def _largest(asked: Mapping[str, float]) -> float:
    """The largest weight, that of sources which none was asked for included."""
    return max([*asked.values(), *([1.0] if len(asked) < len(SOURCES) else [])])


class Selections:
    """The selections of one service process, each resolved once for a revision of its object."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._resolved: OrderedDict[tuple[object, ...], Selected] = OrderedDict()
        self._lock = threading.Lock()

    def resolve(self, slug: str, asked: TrialSelection) -> Selected:
        """The object as it is now, and which of its trials a request is about (404, 409 where ambiguous).

        While the database does not answer, as it was when that was last asked.
        """
        principal.refuse_hidden(slug)
        key = slug, asked.gripper, asked.protocol, asked.source, asked.source_weight
        with self._lock:
            known = self._resolved.get(key)
            if known is not None:
                self._resolved.move_to_end(key)

        def read() -> Selected:
            with self._database.read() as tx:
                row = require(tx, slug)
                holds = known is not None and known.row.id == row.id and _still_holds(tx, known, row)
                return known if known is not None and holds else resolve(tx, row, asked)

        try:
            selected = or_kept(read, known)
        except ProblemError:
            # Gone, or ambiguous by now: no outage may bring it back.
            with self._lock:
                self._resolved.pop(key, None)
            raise
        if selected is known:
            return selected
        with self._lock:
            self._resolved[key] = selected
            self._resolved.move_to_end(key)
            while len(self._resolved) > _KEPT:
                self._resolved.popitem(last=False)
        return selected


def as_of(tx: Tx, selected: Selected) -> Selected:
    """The selection as the transaction sees it: the same, unless something was committed since; refused as
    :meth:`Selections.resolve`, 409 where the object was replaced.
    """
    row = require(tx, selected.row.slug, object_id=selected.row.id)
    return selected if _still_holds(tx, selected, row) else resolve(tx, row, selected.filters)


def _still_holds(tx: Tx, selected: Selected, row: ObjectRow) -> bool:
    """Whether neither the object has changed since nor what the gripper's name stands for."""
    if selected.row.revision != row.revision:
        return False
    return selected.gripper is None or grippers.version_id(tx, selected.gripper) == selected.stamp


def resolve(tx: Tx, row: ObjectRow, asked: TrialSelection) -> Selected:
    """Find the provenances that a request is about.

    A trial without gripper or protocol fits every selection and makes none ambiguous, nor do several versions
    of a gripper. 404 for an unknown gripper; 422 for source weights that leave no trial; 409
    ``ambiguous-selection`` where several grippers or protocols are left and none is named.
    """
    named_gripper = None if asked.gripper is None else _gripper(tx, asked.gripper)
    known = provenances.of_object(tx, row.id)
    counts = outcome_counts(tx, row.id, known)
    # A provenance all of whose trials were deleted is none of the object's any more.
    candidates = {
        number: item
        for number, item in known.items()
        if number in counts
        and asked.source in (None, item.source)
        and (asked.gripper is None or item.gripper is None or is_gripper(item.gripper, asked.gripper))
        and (asked.protocol is None or item.protocol in (None, asked.protocol))
    }
    candidates = _weighing(candidates, asked)
    items = candidates.values()
    named = {
        "gripper": distinct(item.gripper and gripper_parts(item.gripper)[0] for item in items),
        "protocol": distinct(item.protocol for item in items),
    }
    ambiguous = [name for name, values in named.items() if len(values) > 1 and getattr(asked, name) is None]
    if ambiguous:
        told = "; ".join(f"{name}: {_listed(named[name])}" for name in ambiguous)
        raise conflict(
            "ambiguous-selection",
            f"The trials are of several {' and '.join(name + 's' for name in ambiguous)}: name one ({told})",
            grippers=named["gripper"],
            protocols=named["protocol"],
        )
    gripper, protocol = (getattr(asked, name) or next(iter(values), None) for name, values in named.items())
    if gripper is not None and named_gripper is None:
        named_gripper = _gripper(tx, gripper)
    profile = None if named_gripper is None else GripperProfile.model_validate(named_gripper.profile)
    names = {"gripper": gripper, "protocol": protocol, "source": asked.source}
    selected = of_provenances(
        row, candidates, counts, profile=profile, source_weight=asked.source_weight, **names
    )
    warnings = _of_another_mesh(tx, row)
    stamp = None
    if named_gripper is not None and profile is not None:
        stamp = named_gripper.version_id
        warnings += _of_other_versions(tx, named_gripper, profile, selected.versions)
    return replace(selected, stamp=stamp, warnings=warnings)


def _weighing(candidates: dict[int, Provenance], asked: TrialSelection) -> dict[int, Provenance]:
    """Those of sources that weigh anything."""
    weights = source_weights(asked.source_weight)
    left = {n: item for n, item in candidates.items() if item.source is None or weights.get(item.source, 1.0)}
    if candidates and not left:
        names = ", ".join(distinct(item.source for item in candidates.values()))
        raise invalid("source_weight", f"leaves no trial: all there are of {names}, and weigh nothing")
    return left


def _listed(names: Sequence[str]) -> str:
    """The first names, for a person; all of them stand beside, for programs."""
    more = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {more:,} more" if more > 0 else "")


def of_provenances(
    row: ObjectRow,
    chosen: Mapping[int, Provenance],
    counts: Mapping[int, Mapping[str, int]],
    *,
    gripper: str | None,
    protocol: str | None,
    source: str | None,
    profile: GripperProfile | None,
    source_weight: str | None = None,
) -> Selected:
    """The selection of provenances of no other gripper than this; ``counts`` of each are by outcome."""
    failing = {
        item.source
        for number, item in chosen.items()
        if counts[number].keys() - {"success", "simulation_error"}
    }
    symmetric = profile is None or profile.symmetric
    items = chosen.values()
    sources = {number: item.source or UNSPECIFIED for number, item in chosen.items()}
    return Selected(
        row=row,
        gripper=gripper,
        protocol=protocol,
        source=source,
        source_weight=source_weight,
        profile=profile,
        provenances={number: item.gripper is None or symmetric for number, item in chosen.items()},
        sources=sources,
        outcomes=total([counts[number] for number in chosen]),
        by_source={
            source: total([counts[number] for number in chosen if sources[number] == source])
            for source in sorted(set(sources.values()))
        },
        tried=frozenset(number for number, item in chosen.items() if item.source in failing),
        versions=sorted({gripper_parts(item.gripper)[1] or 0 for item in items if item.gripper is not None}),
        stamp=None,
        warnings=(),
    )


def outcome_counts(tx: Tx, object_id: int, known: Mapping[int, Provenance]) -> dict[int, dict[str, int]]:
    """Trials by provenance, of those ``known`` of the object, and outcome, packed ones included.

    A provenance without any is not among them, unless it differs from one that has some by the engine alone:
    a sweep's own may have none, where rows of its chunks are all that there is.
    """
    counts: dict[int, dict[str, int]] = {}
    for provenance, code, rows, packed in provenances.tallies(tx, object_id):
        if rows + packed:
            counts.setdefault(provenance, {})[OUTCOMES[code]] = rows + packed
    there = {known[number].kin for number in counts}
    return {number: counts.get(number, {}) for number, item in known.items() if item.kin in there}


def total(counts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    """Counts by outcome together, in the order of outcomes."""
    sums = {name: sum(item.get(name, 0) for item in counts) for name in OUTCOMES}
    return {name: number for name, number in sums.items() if number}


def _gripper(tx: Tx, name: str) -> GripperRow:
    return found(grippers.find(tx, name), "gripper", name, "GET /grippers lists those there are")


def _of_another_mesh(tx: Tx, row: ObjectRow) -> list[str]:
    """Warnings of trials that came with a copy whose mesh has been changed since."""
    origin = row.copied_from
    if origin is None or not origin["other_mesh"]:
        return []
    if not copies.has_copied(tx, row.id, last_seq=origin["last_seq"], revision=origin["revision"]):
        return []
    return [
        f"trials copied from {origin['object']!r} count, and the mesh is another than they were made with:"
        " their outcomes, simulated ones above all, are of the mesh before (source=robot leaves those out);"
        " collisions are told by the mesh that there is"
    ]


def _of_other_versions(
    tx: Tx, gripper: GripperRow, profile: GripperProfile, versions: Collection[int]
) -> list[str]:
    """Warnings of trials that were made with other profiles of the gripper than the one that counts."""
    others = grippers.profiles(tx, gripper.id, set(versions) - {gripper.version})
    differing = {
        number: fields
        for number, other in sorted(others.items())
        if (fields := profile.differences(GripperProfile.model_validate(other)))
    }
    if not differing:
        return []
    told = [f"{gripper.id}@{number} differs in {', '.join(fields)}" for number, fields in differing.items()]
    if len(told) > _TOLD:
        told[_TOLD:] = [f"{len(told) - _TOLD} more versions differ, too"]
    kept = ""
    if any(field.startswith(SHAPE_FIELDS) for fields in differing.values() for field in fields):
        kept = "; their outcomes, collisions among them, are of the shapes that they were made with"
    return [
        f"trials of several versions of gripper {gripper.id!r} count, and the profile of {gripper.versioned}"
        f" for all of them: {'; '.join(told)}{kept} (gripper={gripper.id}@{next(iter(differing))} selects one"
        " version)"
    ]


def distinct(values: Iterable[str | None]) -> list[str]:
    """The names there are, sorted."""
    return sorted({value for value in values if value is not None})
