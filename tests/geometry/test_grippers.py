"""Gripper shapes against their published dimensions, and refusal of degenerate ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graspdb_geometry import grippers
from known_jaws import PANDA, PG70, SHAPES


def test_pg70_boxes() -> None:
    half, centres = PG70.boxes()
    low, high = centres - half, centres + half
    np.testing.assert_allclose(half * 2, [[0.02, 0.015, 0.07], [0.02, 0.015, 0.07], [0.08, 0.112, 0.092]])
    assert low[grippers.FINGER_PLUS, 1] == pytest.approx(0.035)
    assert high[grippers.FINGER_MINUS, 1] == pytest.approx(-0.035)
    np.testing.assert_allclose(high[:, 2], [0.023, 0.023, -0.047])  # the palm starts where the fingers do
    # The base is 140 mm behind the tool's origin in RobWork's files: 139 here.
    assert low[grippers.PALM, 2] == pytest.approx(-0.139)


def test_pandas_base_is_103_4_mm_behind_the_pads_centre() -> None:
    half, centres = PANDA.boxes()
    assert (centres - half)[grippers.PALM, 2] == pytest.approx(-0.1034)


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_column_fills_the_gap_between_the_fingers(name: str) -> None:
    shape = SHAPES[name]
    for opening in (None, 0.0, 0.03):
        half, centres = shape.boxes(opening)
        column_half, column_centre = shape.column(opening)
        assert (centres - half)[0, 1] == pytest.approx(column_half[1])
        assert (centres + half)[1, 1] == pytest.approx(-column_half[1])
        np.testing.assert_allclose(column_half[[0, 2]], half[0, [0, 2]])
        np.testing.assert_allclose(column_centre[[0, 2]], centres[0, [0, 2]])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_opening_m", 0.0),
        ("max_opening_m", -0.07),
        ("finger_width_m", np.nan),
        ("finger_thickness_m", np.inf),
        ("finger_length_m", 70.0),
        ("tip_offset_m", 0.08),
        ("tip_offset_m", -0.01),
        ("tip_offset_m", np.nan),
        ("palm_size_m", (0.1, 0.1)),
        ("palm_size_m", (0.1, 0.0, 0.1)),
    ],
)
def test_degenerate_grippers_are_refused_by_field(field: str, value: Any) -> None:
    fields: dict[str, Any] = {
        "max_opening_m": 0.07,
        "finger_width_m": 0.02,
        "finger_thickness_m": 0.015,
        "finger_length_m": 0.07,
        "tip_offset_m": 0.023,
        "palm_size_m": (0.08, 0.112, 0.092),
    }
    with pytest.raises(ValueError, match=field):
        grippers.GripperShape(**(fields | {field: value}))
