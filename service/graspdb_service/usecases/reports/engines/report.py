"""How far two physics engines agree on the poses of linked sweeps: the engines report."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES, OUTCOMES
from graspdb.wire.reports import (
    EngineDisagreement,
    EngineOutcomes,
    EnginePair,
    EngineReason,
    EngineReasonName,
    EnginesOptions,
    EnginesReport,
)
from graspdb_density.kde.weighted_sums import Progress
from graspdb_service.problems import conflict
from graspdb_service.storage.database import Tx
from graspdb_service.storage.simulation import linked, outcomes, sweeps
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.trial_columns import Bools, Floats, Ints, TrialColumns, is_gripper
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.reports.common import LEVEL, ReportInputs, finite, head, share
from graspdb_service.usecases.reports.engines.reasons import WORDS, Said, reason, words
from graspdb_service.usecases.trials import sweep_plan
from graspdb_service.usecases.trials.selection import Selected

#: Grasps that engines differ on which are listed, of all pairs together.
_LISTED = 100
_SUCCESS, _BROKE_OFF = OUTCOME_CODES["success"], OUTCOME_CODES["simulation_error"]

Codes = NDArray[np.uint8]


def engines_report(
    inputs: ReportInputs, built: Built, options: EnginesOptions, progress: Progress
) -> EnginesReport:
    """Compare what linked sweeps have both simulated; 409 where none have."""
    with inputs.database.read() as tx:
        found = _pairs(tx, built.object_row.id, built.selected)
    pairs: list[EnginePair] = []
    for number, pair in enumerate(found):
        left = _LISTED - sum(len(item.first) for item in pairs)
        pairs.append(_compared(pair, left))
        progress((number + 1) / len(found))
    if not any(pair.poses or pair.broken_off for pair in pairs):
        raise conflict(
            "linked-sweeps-needed",
            "Two engines have not simulated the same grasps of this selection yet: sweep with both, and have"
            f' workers for each (POST /objects/{built.object_row.slug}/sweeps {{"engine": "both"}})',
        )
    report = EnginesReport(**head(built), pairs=pairs)
    return report.model_copy(update={"text": _text(report), "warnings": _warnings(report)})


@dataclass(frozen=True, eq=False)
class _Engine:
    """What one engine says of poses (n,): codes, in how many of the ``draws`` each succeeded, whether they
    ``met`` physics, and qualities and widths, NaN where it measured none.
    """

    engines: list[str]
    draws: int
    codes: Codes
    successes: Codes
    met: Bools
    quality: Floats
    width_m: Floats

    @property
    def name(self) -> str:
        return self.engines[0].split()[0] if self.engines else "an unknown engine"

    def said(self, row: int) -> Said:
        return Said(
            self.name,
            OUTCOMES[self.codes[row]],
            float(self.quality[row]),
            float(self.width_m[row]),
            int(self.successes[row]),
            self.draws,
        )


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two linked sweeps and what both say of the poses (n,) of these ``chunks``, by start and stop."""

    sweep: SweepRow
    other: SweepRow
    chunks: list[tuple[int, int]]
    one: _Engine
    two: _Engine
    stored: TrialColumns | None

    def poses(self, rows: Ints) -> TrialColumns:
        """Some of the poses, with their indices in the plan."""
        ends = np.cumsum([stop - start for start, stop in self.chunks])
        which = np.searchsorted(ends, rows, side="right")
        index = np.empty(len(rows), dtype=np.int64)
        for chunk in np.unique(which).tolist():
            start, stop = self.chunks[chunk]
            here = which == chunk
            # A grid orders the poses of a chunk, not those of a plan.
            places = np.arange(start, stop) if self.stored is not None else self._indices(start, stop)
            index[here] = places[rows[here] - (ends[chunk] - (stop - start))]
        if self.stored is not None:
            return self.stored[index]
        return sweep_plan.grid_poses(sweep_plan.grid_of(self.sweep), index)

    def _indices(self, start: int, stop: int) -> Ints:
        return sweep_plan.grid_of(self.sweep).pose_indices(start, stop)


def _pairs(tx: Tx, object_id: int, selected: Selected) -> list[_Pair]:
    """Linked sweeps of a selection's gripper and protocol, with what both have finished."""
    others = sweeps.find_many(tx, linked.comparing(tx, object_id))
    firsts = sweeps.find_many(tx, sorted(row.linked for row in others.values() if row.linked is not None))
    found = []
    for other in sorted(others.values(), key=lambda row: row.id):
        sweep = None if other.linked is None else firsts.get(other.linked)
        if sweep is None or not _is_of(sweep, selected):
            continue
        chunks = linked.both(tx, sweep.id, other.id)
        one = [(chunk.outcomes, chunk.successes, chunk.measured) for chunk in chunks]
        two = [(chunk.other_outcomes, chunk.other_successes, chunk.other_measured) for chunk in chunks]
        draws = sweep_plan.draws(sweep)
        found.append(
            _Pair(
                sweep,
                other,
                [(chunk.start, chunk.stop) for chunk in chunks],
                _engine(outcomes.engines(tx, sweep.id), draws, one),
                _engine(outcomes.engines(tx, other.id), draws, two),
                sweep_plan.chunk_poses(tx, sweep, 0, sweep.pose_count),
            )
        )
    return found


def _is_of(sweep: SweepRow, selected: Selected) -> bool:
    name = f"{sweep.gripper}@{sweep.gripper_version}"
    fits = selected.gripper is None or is_gripper(name, selected.gripper)
    return fits and selected.protocol in (None, sweep.protocol)


def _engine(
    engines: list[str], draws: int, chunks: list[tuple[bytes, bytes | None, bytes | None]]
) -> _Engine:
    codes, successes = [np.empty(0, dtype=np.uint8)], [np.empty(0, dtype=np.uint8)]
    measures = [np.empty((3, 0))]
    for content, drawn, measured in chunks:
        codes.append(np.frombuffer(content, dtype=np.uint8))
        won = (codes[-1] == _SUCCESS).astype(np.uint8) if drawn is None else np.frombuffer(drawn, np.uint8)
        successes.append(won)
        values = np.full((3, len(codes[-1])), np.nan)
        place, quality, width = linked.read_measured(measured)
        values[:, place] = np.ones(len(place)), quality, width
        measures.append(values)
    met, quality, width = np.concatenate(measures, axis=1)
    told = np.concatenate(codes), np.concatenate(successes)
    return _Engine(engines, draws, *told, ~np.isnan(met), quality, width)


def _compared(pair: _Pair, listed: int) -> EnginePair:
    one, two = pair.one, pair.two
    judged = (one.codes != _BROKE_OFF) & (two.codes != _BROKE_OFF)
    agree = judged & ((one.codes == _SUCCESS) == (two.codes == _SUCCESS))
    # The others were judged by geometry, by one test for both.
    physics = judged & (one.met | two.met)
    differ = np.flatnonzero(judged & ~agree)
    reasons = [reason(pair.sweep.protocol, one.said(row), two.said(row)) for row in differ.tolist()]
    broken_off = int((~judged).sum())
    return EnginePair(
        sweep=pair.sweep.id,
        linked=pair.other.id,
        protocol=pair.sweep.protocol,
        fidelity=pair.sweep.fidelity,
        purpose=pair.sweep.purpose,
        engines=one.engines,
        other_engines=two.engines,
        poses=int(judged.sum()),
        waiting=pair.sweep.pose_count - len(judged),
        broken_off=broken_off,
        agreement=share(int(agree.sum()), int(judged.sum())),
        physics=int(physics.sum()),
        physics_agreement=share(int((agree & physics).sum()), int(physics.sum())),
        outcomes=_table(one.codes, two.codes),
        disagreements=len(differ),
        reasons=_reasons(reasons, broken_off),
        first=_first(pair, differ[:listed], reasons),
    )


def _table(one: Codes, two: Codes) -> list[EngineOutcomes]:
    counts = Counter(zip(one.tolist(), two.tolist(), strict=True))
    return [
        EngineOutcomes(outcome=OUTCOMES[a], other_outcome=OUTCOMES[b], poses=number)
        for (a, b), number in sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    ]


def _reasons(found: list[EngineReasonName], broken_off: int) -> list[EngineReason]:
    counts: Counter[EngineReasonName] = Counter(found)
    if broken_off:
        counts["broke-off"] = broken_off
    total = sum(counts.values())
    return [
        EngineReason(reason=name, poses=number, share=number / total, text=WORDS[name])
        for name, number in counts.most_common()
    ]


def _first(pair: _Pair, rows: Ints, reasons: list[EngineReasonName]) -> list[EngineDisagreement]:
    poses = pair.poses(rows)
    found = []
    for place, row in enumerate(rows.tolist()):
        one, two = pair.one.said(row), pair.two.said(row)
        found.append(
            EngineDisagreement(
                pose_index=int(poses.pose_index[place]),
                position=tuple(poses.position[place].tolist()),
                quaternion_xyzw=tuple(poses.quaternion_xyzw[place].tolist()),
                outcome=one.outcome,
                other_outcome=two.outcome,
                attempts=one.draws if one.draws > 1 else None,
                successes=one.successes if one.draws > 1 else None,
                other_successes=two.successes if one.draws > 1 else None,
                quality=finite(one.quality),
                other_quality=finite(two.quality),
                width_m=finite(one.width_m),
                other_width_m=finite(two.width_m),
                reason=reasons[place],
                text=words(pair.sweep.protocol, one, two),
            )
        )
    return found


def _text(report: EnginesReport) -> str:
    told = []
    for pair in report.pairs:
        if not pair.poses:
            continue
        names = " and ".join([*pair.engines, *pair.other_engines])
        agreement, physics = pair.agreement, pair.physics_agreement
        text = (
            f"{names} agree on {agreement.value:.1%} of {pair.poses:,} poses by {pair.protocol}"
            f" ({agreement.low:.1%} to {agreement.high:.1%} at {LEVEL:.0%})"
        )
        if physics.value is not None:
            text += f", and on {physics.value:.1%} of the {pair.physics:,} that rest on physics"
        if pair.disagreements:
            reasons = ", ".join(f"{r.poses:,} {r.reason}" for r in pair.reasons if r.reason != "broke-off")
            text += f"; they differ on {pair.disagreements:,}: {reasons}"
        told.append(text + ".")
    return " ".join(told) or "Nothing that both engines simulated came to an end in both."


def _warnings(report: EnginesReport) -> list[str]:
    waiting = sum(pair.waiting for pair in report.pairs)
    listed, total = (
        sum(len(pair.first) for pair in report.pairs),
        sum(pair.disagreements for pair in report.pairs),
    )
    told = [f"{waiting:,} poses are not simulated by both engines yet"] if waiting else []
    if total > listed:
        told.append(f"the first {listed} of {total:,} grasps that engines differ on are listed")
    if any(pair.poses and not pair.physics for pair in report.pairs):
        told.append("no pose of a pair rests on physics: collisions and empty jaws agree trivially")
    return told
