"""Rows that were posted before: told by digests of some rows of every batch, always the same ones.

Of each batch the rows with the smallest digests are kept, so two batches that share rows keep the same of
them, however many there are; of a batch of no more than `MOST` rows every one is kept.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graspdb_service.storage.trials.binary_copy import microseconds
from graspdb_service.trial_columns import Ints, TrialColumns

#: Rows of a batch that are kept, and so are compared.
MOST = 1_024
#: Metres, and parts of a unit quaternion, below which poses are the same: what a change of unit may round.
_STEP = 1e-8

_Words = NDArray[np.uint64]


def fingerprints(columns: TrialColumns, object_id: int, qualities: Sequence[str]) -> tuple[Ints, Ints]:
    """Ascending places of the rows that are compared, and a digest of each.

    Rows have one digest where pose (to :data:`_STEP`), achieved pose, outcome, width, quality, named
    ``qualities`` and time agree, whatever gripper, source or protocol they name: who forgot those and posts
    again posts the same rows.
    """
    words = np.full(len(columns), object_id, dtype=np.uint64)
    quaternions = columns.quaternion_xyzw
    # Of the two quaternions of a rotation the one whose largest component is positive.
    largest = np.abs(quaternions).argmax(axis=1, keepdims=True)
    turned = quaternions * np.sign(np.take_along_axis(quaternions, largest, axis=1))
    for column in (*columns.position.T, *turned.T):
        words = _mixed(words ^ np.rint(column / _STEP).astype(np.int64).view(np.uint64))
    words = _mixed(words ^ columns.outcome.astype(np.uint64))
    rows = np.arange(len(words))
    if len(rows) > MOST:
        rows = np.sort(np.argpartition(words, MOST)[:MOST])
    kept = words[rows]
    scores = [(1, columns.width_m), (2, columns.quality)]
    # In one order, however the request had them.
    named = sorted((name, place) for place, name in enumerate(qualities))
    scores += [(zlib.crc32(name.encode()) + 3, columns.qualities[:, place]) for name, place in named]
    for salt, values in scores:
        if len(values):
            numbers = np.ascontiguousarray(values[rows])
            known = _mixed(kept ^ numbers.view(np.uint64) ^ np.uint64(salt))
            kept = np.where(np.isnan(numbers), kept, known)
    if len(columns.achieved):
        achieved = columns.achieved[rows]
        known, here = ~np.isnan(achieved[:, 0]), kept
        for column in np.nan_to_num(achieved).T:
            here = _mixed(here ^ np.rint(column / _STEP).astype(np.int64).view(np.uint64))
        kept = np.where(known, here, kept)
    if len(columns.measured_at):
        times = [columns.measured_at[row] for row in rows.tolist()]
        passed = np.array([microseconds(time) for time in times], dtype=np.int64).view(np.uint64)
        kept = np.where([time is None for time in times], kept, _mixed(kept ^ passed))
    return rows, kept.view(np.int64)


def _mixed(words: _Words) -> _Words:
    """A permutation of 64-bit words in which every bit depends on all (Steele et al. 2014, SplitMix64)."""
    words = words + np.uint64(0x9E3779B97F4A7C15)
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))
