"""Colours that colour-blind people tell apart: of values between two ends, and of names."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspdb.figures.style import OUTCOME_COLOURS, SOURCE_COLOURS

Bytes = NDArray[np.uint8]
UNKNOWN = (150, 150, 150)
OBJECT, OBSTACLE, STANDING = (165, 170, 178), (90, 90, 95), (196, 182, 160)
LINK, LINK_PALE, WRONG = (232, 234, 238), (205, 208, 214), (214, 48, 49)
BEST, SECOND = (213, 94, 0), (240, 170, 110)
#: Some of the colours of viridis (Smith and van der Walt, 2015), between which others are mixed.
_VIRIDIS = np.array(
    [
        *([68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141]),
        *([39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]),
    ],
    dtype=np.float64,
)
_NAMED = {
    name: tuple(bytes.fromhex(colour[1:])) for name, colour in (OUTCOME_COLOURS | SOURCE_COLOURS).items()
}


def of_values(values: ArrayLike, low: float, high: float) -> Bytes:
    """(N, 3) colours of (N,) values from dark at ``low`` to bright at ``high``; grey where unknown (NaN)."""
    given = np.asarray(values, dtype=np.float64)
    known = np.isfinite(given)
    share = np.clip((np.where(known, given, low) - low) / max(high - low, 1e-300), 0.0, 1.0)
    place = share * (len(_VIRIDIS) - 1)
    mixed = np.stack([np.interp(place, np.arange(len(_VIRIDIS)), _VIRIDIS[:, k]) for k in range(3)], axis=1)
    return np.where(known[:, None], mixed, UNKNOWN).astype(np.uint8)


def of_names(names: Sequence[str | None]) -> Bytes:
    """(N, 3) colours of outcomes and sources; grey for what has none."""
    return np.array([_NAMED.get(name or "", UNKNOWN) for name in names], dtype=np.uint8).reshape(-1, 3)


def bar(height: int = 14, width: int = 280) -> Bytes:
    """All colours of values side by side, (height, width, 3)."""
    row = of_values(np.linspace(0.0, 1.0, width), 0.0, 1.0)
    return np.broadcast_to(row, (height, width, 3)).copy()


def legend(names: Sequence[str], counts: Sequence[int]) -> str:
    """Names with their colours, as HTML; the names are the service's own."""
    return legend_of(
        [
            (_NAMED.get(name, UNKNOWN), f"{name.replace('_', ' ')} {count:,}")
            for name, count in zip(names, counts, strict=True)
        ]
    )


def legend_of(entries: Sequence[tuple[tuple[int, ...], str]]) -> str:
    """Colours and what they mean, as HTML; the words are the page's own."""
    rows = []
    for (red, green, blue), words in entries:
        dot = f"<span style='color:rgb({red},{green},{blue});font-size:1.2em'>&#9679;</span>"
        rows.append(f"{dot} {words}")
    return "<div style='padding:0 0.75em;font-size:0.85em;line-height:1.6'>" + "<br>".join(rows) + "</div>"
