"""Linked sweeps: what two engines say of the same poses.

The second of two compares: its outcomes are no trials. A chunk of one and the chunk of the other with the
same number are the same poses in the same order. Of linked sweeps it is kept what physics measured, for each
pose that met it in that engine.
"""

from __future__ import annotations

import numpy as np

from graspdb_service.trial_columns import Floats, Ints

_MEASURED = np.dtype([("place", "<u4"), ("quality", "<f4"), ("width_m", "<f4")])


def measured(place: Ints, quality: Floats, width_m: Floats) -> bytes:
    """What was measured of poses at these places (n,) of a chunk, as it is stored."""
    table = np.empty(len(place), dtype=_MEASURED)
    table["place"], table["quality"], table["width_m"] = place, quality, width_m
    return table.tobytes()
