"""P(success | how the jaw lies to pairs of surfaces and of edges), from every attempt."""

from __future__ import annotations

import numpy as np

from graspdb.wire.reports import AnisotropyRelation
from graspdb_density.success.block_bootstrap import shares
from graspdb_geometry.features.jaw_pairs import KINDS, JawPairs
from graspdb_service.trial_columns import Bools, Floats, Ints
from graspdb_service.usecases.reports.common import LEVEL, as_model, finite
from graspdb_service.usecases.trials.attempts import AllTrials

#: Ends of the ranges of angles between the closing axis and the pair's, degrees.
ANGLES_DEG = (0.0, 10.0, 20.0, 30.0, 45.0, 90.0)
#: Attempts looked at, drawn at random where there are more.
_MOST_ATTEMPTS = 300_000
_WORDS = {
    "surfaces": "two opposite surfaces",
    "coplanar-edges": "two parallel edges of one face",
    "parallel-edges": "two opposite edges",
}
#: A share from fewer attempts is not put into words.
_LEAST_TOLD = 20


def relations(everything: AllTrials, pairs: JawPairs) -> list[AnisotropyRelation]:
    """The share of attempts that succeeded for every kind of pair and angle, and at no pair."""
    rows = everything.some(_MOST_ATTEMPTS)
    poses, won, hit = everything.poses[rows], everything.success[rows], everything.collided[rows]
    found: list[AnisotropyRelation] = []
    edges = np.radians(ANGLES_DEG)
    alone = np.ones(len(rows), dtype=bool)
    for kind in KINDS:
        which, angle = pairs.of(kind).at(poses)
        alone &= which < 0
        if not (pairs.kinds == KINDS.index(kind)).any():
            continue
        group = np.clip(np.searchsorted(edges, np.nan_to_num(angle), side="right") - 1, 0, len(edges) - 2)
        group[which < 0] = -1
        found += _rows(kind, won, hit, group, poses.positions)
    return found + _rows("none", won, hit, np.where(alone, 0, -1), poses.positions)


def _rows(
    kind: str,
    won: Bools,
    hit: Bools,
    group: Ints,
    positions: Floats,
) -> list[AnisotropyRelation]:
    groups = 1 if kind == "none" else len(ANGLES_DEG) - 1
    every = shares(won, group, positions, groups=groups, level=LEVEL)
    free = shares(won, np.where(hit, -1, group), positions, groups=groups, level=LEVEL)
    return [
        as_model(
            AnisotropyRelation,
            share,
            relation=kind,
            angle_deg=None if kind == "none" else (ANGLES_DEG[number], ANGLES_DEG[number + 1]),
            collisions=share.attempts - clear.attempts,
            free_probability=finite(clear.probability),
            free_low=finite(clear.low),
            free_high=finite(clear.high),
        )
        for number, (share, clear) in enumerate(zip(every, free, strict=True))
    ]


def in_words(found: list[AnisotropyRelation]) -> str:
    """The squarest grasps at each kind of pair, beside those at none; empty where that says nothing.

    Of attempts that did not collide: whether the open gripper fits is told without trials.
    """
    told, alone = [], ""
    for item in found:
        chance, low, high = item.free_probability, item.free_low, item.free_high
        if item.attempts - item.collisions < _LEAST_TOLD or chance is None or low is None or high is None:
            continue
        share = f"{100 * chance:.3g} % ({100 * low:.3g} to {100 * high:.3g})"
        if item.angle_deg is None:
            alone = f"; at none of these {share}"
        elif item.angle_deg[0] == 0.0:
            told.append(f"on {_WORDS[item.relation]} {share}")
    if not told:
        return ""
    return (
        f" Of attempts that do not collide and close within {ANGLES_DEG[1]:g} deg of square"
        f" {', '.join(told)} succeed{alone}."
    )
