"""Do the labels hold at a far finer time step? A sample of poses that met physics, simulated again.

The sample is stratified by the outcome at the ordinary fidelity, so that rare outcomes are checked too;
the agreement over all poses weighs each stratum by its share. The labels are either simulated here, or
those that a service has stored for a sweep; what such a sweep draws is drawn again, the same. The lower bound
is the 5 % quantile of that weighted sum when each stratum's agreement follows its posterior under Jeffreys'
prior, Beta(agree + 1/2, disagree + 1/2).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import SimulatePayload
from graspdb_geometry import collision
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.poses import ToolPoses
from graspdb_simworker.inspection.stored_outcomes import StoredOutcomes
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.bodies import Part
from graspdb_simworker.simulation.draws import noisy
from graspdb_simworker.simulation.labels import Outcome

LEVEL = 0.95
_DRAWS = 200_000


@dataclass(frozen=True)
class Stratum:
    """Poses of one outcome at the ordinary fidelity.

    ``available`` of them were found, ``checked`` were simulated again, ``agree`` on success or failure,
    ``same`` on the outcome's very name.
    """

    outcome: Outcome
    available: int
    checked: int
    agree: int
    same: int


@dataclass(frozen=True)
class Agreement:
    """Agreement on success or failure between two fidelities, over all poses that met physics."""

    strata: tuple[Stratum, ...]
    agreement: float
    lower: float
    same: float
    successes_apart: float | None = None
    """By what share of its draws a pose's successes differ, on average; None where nothing is drawn."""

    @property
    def checked(self) -> int:
        return sum(stratum.checked for stratum in self.strata)

    def summary(self, name: str) -> str:
        """A table of the strata, and what they come to for an object of this name."""
        lines = [f"{'outcome':20} {'found':>7} {'checked':>8} {'agree':>7} {'same name':>10}"]
        lines += [
            f"{s.outcome.name.lower():20} {s.available:7} {s.checked:8}"
            f" {s.agree / s.checked:7.4f} {s.same / s.checked:10.4f}"
            for s in self.strata
        ]
        lines.append(
            f"{name}: success or failure agrees in {self.agreement:.4f} of the poses that met physics"
            f" (at least {self.lower:.4f} at {LEVEL:.0%}; {self.checked} checked);"
            f" the same outcome in {self.same:.4f}"
        )
        if self.successes_apart is not None:
            lines.append(
                "success is that of at least half of a pose's draws, which were drawn again; how many of them"
                f" succeed differs by {self.successes_apart:.4f} of them on average"
            )
        return "\n".join(lines)


def enough_poses(payload: SimulatePayload, parts: Sequence[Part], count: int) -> SimulatePayload:
    """The payload with so many random poses of its grid that about three times ``count`` meet physics."""
    assert payload.grid is not None
    scene, shape = collision.Scene(parts), shape_of(payload.gripper)
    poses = 20_000
    while True:
        grid = payload.grid.model_copy(update={"max_poses": poses})
        total = min(poses, chunks.grid_of(grid).candidate_total)
        larger = payload.model_copy(update={"grid": grid, "start": 0, "stop": total})
        _, positions, quaternions = chunks.poses_of(larger)
        codes, _ = scene.classify(ToolPoses(positions, quaternions), shape)
        if total < poses or int((codes == collision.CONTACT).sum()) >= 3 * count:
            return larger
        poses *= 2


def verify(
    payload: SimulatePayload,
    parts: Sequence[Part],
    *,
    count: int,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Agreement:
    """Simulate a chunk, then a stratified sample of ``count`` of its physics poses, or all, at fine fidelity.
    Nothing is drawn.

    ``progress`` is told how many of how many closings are done. ValueError if no pose meets physics.
    """
    _, positions, quaternions = poses = chunks.poses_of(payload)
    rng = np.random.default_rng(seed)
    with closing(chunks.prepare(payload, parts)) as coarse, closing(_fine(payload, parts)) as fine:
        codes, _ = coarse.classify(positions, quaternions)
        rows = np.flatnonzero(codes == collision.CONTACT)
        if len(rows) == 0:
            raise ValueError("no pose of this sample needs physics: take more poses")
        rows = np.sort(rng.permutation(rows)[: 3 * count])
        total = len(rows) + min(count, len(rows))
        labels = _simulated(payload, coarse, poses, rows, lambda done: progress(done, total)).outcome
        picked = _stratified(labels, count, rng)
        again = _simulated(
            payload, fine, poses, rows[picked], lambda done: progress(len(rows) + done, total)
        ).outcome
    found = {int(kind): float(n) for kind, n in zip(*np.unique(labels, return_counts=True), strict=True)}
    return _agreement(found, labels[picked], again, rng)


def verify_stored(
    payload: SimulatePayload,
    parts: Sequence[Part],
    stored: StoredOutcomes,
    *,
    count: int,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Agreement:
    """Simulate stored outcomes of the payload's object, gripper, protocol and draws again at fine fidelity: a
    stratified sample of ``count``, or all, of those that met physics (ValueError if none did).
    """
    rng = np.random.default_rng(seed)
    with closing(_fine(payload, parts)) as fine:
        poses = stored.indices, stored.positions, stored.quaternions
        physical = np.array(
            [
                fine.classify(*noisy(payload.randomise, draw, *poses))[0] == collision.CONTACT
                for draw in range(len(fine.draws))
            ]
        )
        rows = np.flatnonzero(physical.any(axis=0))
        if len(rows) == 0:
            raise ValueError("no pose of this sweep needed physics")
        labels = stored.outcomes[rows]
        # A miss may be plain from the geometry: only the share that met physics counts.
        found = {
            int(kind): stored.counts[int(kind)]
            * float((labels == kind).sum() / (stored.outcomes == kind).sum())
            for kind in np.unique(labels)
        }
        picked = _stratified(labels, count, rng)
        rows = rows[picked]
        total = int(physical[:, rows].sum())
        again = _simulated(payload, fine, poses, rows, lambda done: progress(done, total))
    apart = None
    if stored.successes is not None:
        apart = np.abs(again.successes - stored.successes[rows]) / len(fine.draws)
    return _agreement(found, labels[picked], again.outcome, rng, apart)


def _fine(payload: SimulatePayload, parts: Sequence[Part]) -> chunks.Workpiece:
    return chunks.prepare(payload.model_copy(update={"fidelity": "fine"}), parts)


def _simulated(
    payload: SimulatePayload,
    workpiece: chunks.Workpiece,
    poses: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]],
    rows: NDArray[np.int64],
    progress: Callable[[int], None],
) -> chunks.Simulated:
    """What becomes of rows of a sweep's poses: indices (n,), tool poses (n, 3), (n, 4)."""
    indices, positions, quaternions = poses
    done = itertools.count(1)
    return chunks.simulate_poses(
        payload,
        workpiece,
        indices[rows],
        positions[rows],
        quaternions[rows],
        after=lambda *_: progress(next(done)),
    )


def _stratified(labels: NDArray[np.uint8], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of about ``count`` labels: at least a tenth of them from each stratum that has as many."""
    kinds, available = np.unique(labels, return_counts=True)
    wanted = np.maximum(np.round(count * available / len(labels)).astype(int), count // 10)
    wanted = np.minimum(wanted, available)
    # What the small strata got more comes from the largest one.
    wanted[np.argmax(wanted)] -= max(0, int(wanted.sum()) - count)
    picked = [
        rng.permutation(np.flatnonzero(labels == kind))[:take]
        for kind, take in zip(kinds, np.maximum(wanted, 1), strict=True)
    ]
    return np.sort(np.concatenate(picked))


def _agreement(
    found: Mapping[int, float],
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    rng: np.random.Generator,
    successes_apart: NDArray[np.float64] | None = None,
) -> Agreement:
    strata = []
    for kind in np.unique(before):
        chosen = before == kind
        success = after[chosen] == Outcome.SUCCESS
        strata.append(
            Stratum(
                outcome=Outcome(int(kind)),
                available=round(found[int(kind)]),
                checked=int(chosen.sum()),
                agree=int((success == (kind == Outcome.SUCCESS)).sum()),
                same=int((after[chosen] == kind).sum()),
            )
        )
    weights = np.array([found[s.outcome] for s in strata], dtype=np.float64)
    weights /= weights.sum()
    shares = np.array([s.agree / s.checked for s in strata])
    same = np.array([s.same / s.checked for s in strata])
    draws = np.column_stack([rng.beta(s.agree + 0.5, s.checked - s.agree + 0.5, _DRAWS) for s in strata])
    apart = None
    if successes_apart is not None:
        apart = float(weights @ [successes_apart[before == s.outcome].mean() for s in strata])
    return Agreement(
        tuple(strata),
        float(weights @ shares),
        float(np.quantile(draws @ weights, 1.0 - LEVEL)),
        float(weights @ same),
        apart,
    )
