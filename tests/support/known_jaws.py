"""Shapes of the built-in grippers."""

from __future__ import annotations

from graspdb.wire.presets.grippers import PRESETS
from graspdb_geometry.grippers import shape_of

SHAPES = {name: shape_of(preset.profile) for name, preset in PRESETS.items()}
PG70, PANDA = SHAPES["pg70"], SHAPES["panda"]
