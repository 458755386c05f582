"""From a closing to a label, by one of three protocols.

**wrench**: can the contact forces hold the object, whichever way down is (:mod:`.force_test`)? Where the
forces ring because the object still moves, several instants of the stalled jaw are rated and the median of
the last five counts. If some of these hold the weight and some do not, the closing goes on in finer steps.

**lift**: is the object still held, and where it was, after the jaw lifted and shook it? **shake**: is it
still held after the jaw shook it, nothing weighing? Motions, and how far an object may move in the jaw, are
in :mod:`.lifting`.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from graspdb_simworker.simulation.bodies import Carried, Closing, End
from graspdb_simworker.simulation.lifting import Displacement, Motion

WORST_QUALITY = -1000.0
RATED = 5
"""So many of the last instants of a stalled jaw are rated at most."""


class Outcome(IntEnum):
    """Codes of outcomes, as packed in results. The same numbers as on the wire; a test compares the two."""

    FAILURE = 0
    SUCCESS = 1
    COLLISION = 2
    MISSED = 3
    SLIPPED = 4
    DROPPED = 5
    WRENCH_INSUFFICIENT = 6
    TIMEOUT = 7
    SIMULATION_ERROR = 8


@dataclass(frozen=True)
class Label:
    """What a grasp came to; ``width_m`` is between the fingers at the end.

    ``quality`` of ``wrench`` is the largest weight the contacts hold in the worst direction, over the
    object's weight; success from 1 on. Of the others: 1 minus the farthest displacement in the jaw, in units
    of what is allowed (the larger of translation and rotation over theirs: 1 mm and half a degree of
    ``lift``, 50 mm and half a turn of ``shake``); 1 did not move at all, success down to 0. NaN where
    nothing was measured.
    """

    outcome: Outcome
    width_m: float
    quality: float


SIMULATION_ERROR = Label(Outcome.SIMULATION_ERROR, math.nan, math.nan)


def label_of(closing: Closing, motion: Motion | None = None) -> Label:
    """Name a closing's outcome and rate it; ``motion`` is what the object was carried through.

    ``missed``: nothing was between the fingers, or the object was pushed out before both touched it;
    ``slipped``: both had touched it and it was squeezed out; ``timeout``: the jaw neither stalled nor
    closed; ``simulation_error``: a pose that is not finite any more, or fingers that sank into the object;
    ``wrench_insufficient``: the force test failed. After a motion: ``dropped``: not held at the end;
    ``slipped``: held, but moved too far.
    """
    width = max(0.0, closing.opening_m)
    if closing.end is End.EMPTY:
        return Label(Outcome.SLIPPED if closing.touched else Outcome.MISSED, width, 0.0)
    if closing.end is End.TIMEOUT:
        return Label(Outcome.TIMEOUT, width, math.nan)
    if closing.end in (End.UNSTABLE, End.SUNK):
        return SIMULATION_ERROR
    if closing.carried is not None and motion is not None:
        return _carried_label(closing.carried, motion.allowed, width)
    quality = statistics.median(closing.ratings[-RATED:])
    return Label(Outcome.SUCCESS if quality >= 1.0 else Outcome.WRENCH_INSUFFICIENT, width, quality)


def majority(outcomes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What draws (n, poses) of each pose come to (poses,): success where at least half succeeded, else the
    failure that most ended in, of equally many that of the lowest code.

    A simulation error is no success, and no kind of failure unless all are: beside successes alone it leaves
    just ``failure``.
    """
    counts = np.array([(outcomes == code).sum(axis=0) for code in Outcome])
    failures = counts.copy()
    failures[[Outcome.SUCCESS, Outcome.SIMULATION_ERROR]] = 0
    found: NDArray[np.uint8] = np.argmax(failures, axis=0).astype(np.uint8)
    found[2 * counts[Outcome.SUCCESS] >= len(outcomes)] = Outcome.SUCCESS
    found[counts[Outcome.SIMULATION_ERROR] == len(outcomes)] = Outcome.SIMULATION_ERROR
    return found


def _carried_label(carried: Carried, allowed: Displacement, width_m: float) -> Label:
    quality = 1.0 - max(
        carried.translation_m / allowed.translation_m, carried.rotation_rad / allowed.rotation_rad
    )
    if not math.isfinite(quality):
        return SIMULATION_ERROR
    quality = max(WORST_QUALITY, quality)
    if not carried.held:
        return Label(Outcome.DROPPED, width_m, quality)
    return Label(Outcome.SUCCESS if quality >= 0.0 else Outcome.SLIPPED, width_m, quality)
