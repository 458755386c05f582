"""Openings: tips that move on arcs, what fingers close on then, and how far open a jaw has to come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb_geometry import openings
from graspdb_geometry.collision import Part, Scene, Surface, box_part
from graspdb_geometry.grippers import PALM, GripperShape
from graspdb_geometry.poses import ToolPoses
from known_jaws import PANDA, SHAPES

HERE = ToolPoses([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]])
ARC = SHAPES["robotiq-2f-85"]


def box(half: tuple[float, float, float], centre: tuple[float, float, float]) -> Part:
    return box_part(half, centre, (0, 0, 0, 1))


def solids(*parts: Part) -> list[Scene | Surface]:
    corners, faces, start = [], [], 0
    for vertices, triangles in parts:
        corners.append(vertices)
        faces.append(np.asarray(triangles) + start)
        start += len(np.asarray(vertices))
    return [Scene(parts), Surface(np.concatenate(corners), np.concatenate(faces), watertight=False)]


@given(share=st.floats(0.01, 1.0), name=st.sampled_from(sorted(SHAPES)))
def test_a_jaw_less_far_open_keeps_its_palm_and_has_its_tips_where_they_are(share: float, name: str) -> None:
    shape = SHAPES[name]
    opening = share * shape.max_opening_m
    less = shape.at(opening)
    for part, other in zip(less.boxes(), shape.boxes(opening), strict=True):
        np.testing.assert_allclose(part, other, atol=1e-12)
    half, centres = less.boxes()
    wide_half, wide_centres = shape.boxes()
    np.testing.assert_allclose((centres - half)[PALM], (wide_centres - wide_half)[PALM], atol=1e-12)
    assert (centres + half)[0, 2] == pytest.approx(shape.tip_at(opening), abs=1e-12)
    # Fingers begin at the palm, however far ahead their tips are.
    np.testing.assert_allclose((centres - half)[:2, 2], (centres + half)[PALM, 2], atol=1e-12)
    smaller = opening * 0.5
    assert less.tip_at(smaller) == pytest.approx(shape.tip_at(smaller), abs=1e-4)


def test_published_heights_of_tips() -> None:
    """149.3 mm from the base wide open, 162.8 mm closed, by the linkage of the 2F-85's description."""
    assert 0.130 + ARC.tip_at(0.085) == pytest.approx(0.1493, abs=1e-4)
    assert 0.130 + ARC.tip_at(0.0) == pytest.approx(0.1628, abs=1e-4)
    rg2 = SHAPES["onrobot-rg2"]
    assert 0.185 + rg2.tip_at(0.110) == pytest.approx(0.1900, abs=1e-4)
    assert 0.185 + rg2.tip_at(0.0) == pytest.approx(0.2336, abs=2e-4)


@pytest.mark.parametrize(
    "tips",
    [
        ((0.01, 0.02), (0.01, 0.02)),
        ((0.02, 0.02), (0.01, 0.02)),
        ((0.08, 0.02),),
        ((-0.01, 0.02),),
        ((0.01, np.nan),),
        ((np.nan, 0.01),),
        ((0.01, -0.01),),
        ((0.01, 3.0),),
    ],
)
def test_degenerate_arcs_are_refused_by_field(tips: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValueError, match="tip_offsets"):
        replace(PANDA, tip_offsets=tips)


@settings(max_examples=40, deadline=None)
@given(width=st.floats(0.002, 0.08), ahead=st.floats(-0.03, 0.03), shift=st.floats(-0.004, 0.004))
def test_tips_on_arcs_close_on_what_they_reach_then(width: float, ahead: float, shift: float) -> None:
    """A plate whose near face is so far ahead of the open tips, across the jaw's middle."""
    near = ARC.tip_offset_m + ahead
    plate = box((0.05, width / 2, 0.05), (0.0, shift, near + 0.05))
    for solid in solids(plate):
        (found,) = openings.widths(solid, HERE, ARC)
        (held,) = openings.holds(solid, HERE, ARC)
        if solid.collides(HERE, ARC)[0]:
            assert np.isnan(found)
            assert not held
        elif near > ARC.farthest_tip_m + 1e-6:
            assert np.isnan(found)
        elif near < ARC.tip_at(width) - 2e-4:
            # The tips are past its near face before they are as close together as it is wide.
            # What lies aside may reach out from between them then.
            assert width - 2 * abs(shift) - 1e-6 <= found <= width + 1e-6
            assert held
        elif not np.isnan(found):
            # They come down on it: never closer together than it is wide, but for a step between openings.
            assert found <= width + 1e-6


@settings(max_examples=40, deadline=None)
@given(width=st.floats(0.01, 0.07), room=st.floats(0.0, 0.06), shift=st.floats(-0.005, 0.005))
def test_a_box_between_two_walls(width: float, room: float, shift: float) -> None:
    """Wide open the Panda hits walls nearer than its open fingers' backs; pre-shaped it needs a finger's
    thickness beside the box.
    """
    thing = box((0.01, width / 2, 0.02), (0.0, shift, 0.0))
    at = width / 2 + room
    walls = [box((0.1, 0.1, 0.1), (0.0, side * (at + 0.1) + shift, 0.08)) for side in (-1.0, 1.0)]
    reach = PANDA.max_opening_m / 2 + PANDA.finger_thickness_m
    for solid in solids(thing, *walls):
        open_hits = solid.collides(HERE, PANDA)[0]
        assert open_hits == (at - abs(shift) < reach - 1e-7 or width / 2 + abs(shift) > 0.04 + 1e-7) or (
            abs(at - abs(shift) - reach) < 1e-6
        )
        (needed,) = openings.needed(solid, HERE, PANDA)
        least = width + 2 * abs(shift)
        fits = least / 2 + PANDA.finger_thickness_m <= at - abs(shift) - 0.0026 and least <= 0.075
        if fits and open_hits:
            assert needed == pytest.approx(least, abs=1e-6)
        elif not np.isnan(needed):
            # Wide open it may be free with the walls between its fingers, too.
            assert needed >= least - 1e-6
            assert not solid.collides(HERE, PANDA.at(needed))[0]


def test_where_the_open_jaw_is_free_the_need_is_exact_and_round_millimetres_are_commanded() -> None:
    thing = box((0.01, 0.0123, 0.02), (0.0, 0.001, 0.0))
    for solid in solids(thing):
        (needed,) = openings.needed(solid, HERE, PANDA)
        assert needed == pytest.approx(2 * 0.0133, abs=1e-9)
        np.testing.assert_allclose(
            openings.commanded(np.array([needed, np.nan]), 0.01, PANDA), [0.037, 0.080]
        )
    far = ToolPoses([[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.0, 1.0]])
    assert np.isnan(openings.needed(Scene([thing]), far, PANDA)).all()
    nowhere = ToolPoses(np.empty((0, 3)), np.empty((0, 4)))
    assert openings.needed(Scene([thing]), nowhere, PANDA).shape == (0,)


@settings(max_examples=20, deadline=None)
@given(ahead=st.floats(0.001, 0.012), width=st.floats(0.005, 0.02))
def test_tips_on_arcs_open_no_farther_than_a_ledge_takes(ahead: float, width: float) -> None:
    """A stem on a plate so far ahead of the open tips: closed about the stem they would be in the plate."""
    near = ARC.tip_offset_m + ahead
    stem, plate = (
        box((0.01, width / 2, 0.02), (0, 0, near - 0.02)),
        box((0.1, 0.1, 0.01), (0, 0, near + 0.01)),
    )
    for solid in solids(stem, plate):
        (found,) = openings.needed(solid, HERE, ARC)
        assert not solid.collides(HERE, ARC.at(found))[0]
        assert found >= width - 1e-6
        # A millimetre and a half less, and either the stem or the plate is met.
        less = found - 1.5e-3 - 1e-6
        assert less < width or solid.collides(HERE, ARC.at(less))[0]


def test_the_least_opening_is_found_to_the_millimetre_wherever_it_is() -> None:
    """A stem on a plate that the tips are clear of from half a millimetre below each opening on: halving what
    is left ends, also where the middle of two whole millimetres is no whole one in floating point.
    """
    for name in ("robotiq-2f-85", "onrobot-rg2"):
        shape = SHAPES[name]
        for opening in np.arange(18, round(1e3 * shape.max_opening_m) - 2) * 1e-3:
            near, width = shape.tip_at(opening - 0.5e-3), opening - 2.5e-3
            stem, plate = (
                box((0.01, width / 2, 0.02), (0, 0, near - 0.02)),
                box((0.1, 0.1, 0.01), (0, 0, near + 0.01)),
            )
            (found,) = openings.needed(Scene([stem, plate]), HERE, shape)
            assert found == pytest.approx(opening, abs=1e-9), (name, opening)


def test_each_pose_is_tested_at_its_own_opening() -> None:
    rng = np.random.default_rng(5)
    poses = ToolPoses(rng.normal(size=(60, 3)) * 0.03, rng.normal(size=(60, 4)))
    poses = ToolPoses(poses[0], poses[1] / np.linalg.norm(poses[1], axis=1, keepdims=True))
    each = rng.choice([0.01, 0.03, 0.08], 60)
    scene = Scene([box((0.015, 0.02, 0.03), (0.0, 0.0, 0.0))])

    def hits(shape: GripperShape, some: ToolPoses) -> np.ndarray:
        return scene.collides(some, shape)

    told = openings.at_each(each, poses, PANDA, hits)
    one_by_one = [
        scene.collides(ToolPoses(poses[0][i : i + 1], poses[1][i : i + 1]), PANDA, opening)[0]
        for i, opening in enumerate(each)
    ]
    assert told.tolist() == one_by_one
    assert 0 < told.sum() < 60
