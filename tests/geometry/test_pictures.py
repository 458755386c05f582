"""Pictures: all is in them, light falls where it can, and the gripper is seen."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from graspdb.examples import example
from graspdb.wire.presets.grippers import PRESETS
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.picturing import views
from graspdb_geometry.picturing.drawing import Stage
from graspdb_geometry.picturing.scenes import Held, png
from graspdb_geometry.picturing.surfaces import Body

GREY = (0.5, 0.5, 0.5)


def _box(
    half: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0), colour=GREY
) -> Body:
    return Body.of_box(np.array(half), np.array(centre), np.eye(4), colour)


def _pixels(file: bytes) -> NDArray[np.int64]:
    with Image.open(io.BytesIO(file)) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB")).astype(np.int64)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("elevation", [-60.0, 0.0, 24.0, 80.0])
def test_everything_is_in_the_picture_and_fills_it(aspect: float, elevation: float) -> None:
    points = np.random.default_rng(0).normal(size=(200, 3)) * (0.1, 0.02, 0.05)
    view = views.view_from(points, 0.7, math.radians(elevation), aspect)
    right, up, towards = view.axes
    seen = points - view.eye
    depth = -seen @ towards
    tangent = math.tan(math.radians(views.FIELD_OF_VIEW_DEG / 2))
    across, along = seen @ right / depth / tangent / aspect, seen @ up / depth / tangent
    assert np.abs([across, along]).max() == pytest.approx(0.92)
    assert up[2] > 0


def test_a_box_is_as_large_as_it_is_and_nothing_is_drawn_beside() -> None:
    box = _box((0.05, 0.05, 0.05))
    stage = Stage([box])
    view = views.View((0.0, -1.0, 0.0), (0.0, 0.0, 0.0))
    width = 0.05 / 0.95 / math.tan(math.radians(views.FIELD_OF_VIEW_DEG / 2)) * 200
    assert stage.counted(view, 200, 200)[0] == pytest.approx(width**2, rel=0.02)
    image = stage.draw(view, 200, 200).astype(int)
    assert np.array_equal(image, stage.draw(view, 200, 200)), "the same scene gives the same picture"
    outside = image[:, :40]
    assert np.ptp(outside, axis=(1, 2)).max() <= 14, "the background is one shade along a row"


def test_what_stands_in_the_light_casts_a_shadow() -> None:
    floor = _box((0.2, 0.2, 0.01))
    view = views.view_from(floor.points, math.radians(-90), math.radians(50), 1.0)
    bare = Stage([floor]).draw(view, 120, 120).astype(int)
    stood = Stage([floor, _box((0.02, 0.02, 0.08), (0.0, 0.0, 0.09))]).draw(view, 120, 120).astype(int)
    darker = (bare - stood).sum(axis=2)[30:80, 70:110]
    assert darker.max() > 60, "to the right of the post the lamp's light is missing"
    assert darker.min() >= 0


def test_round_surfaces_are_smooth_and_edges_are_sharp() -> None:
    mug = example("mug").mesh()
    body = Body.of_mesh(np.array(mug.vertices), np.array(mug.faces), GREY)
    assert np.linalg.norm(body.normals, axis=2) == pytest.approx(1.0)
    cube = example("cone").mesh()
    flat = Body.of_mesh(np.array(cube.vertices), np.array(cube.faces), GREY)
    base = np.abs(flat.corners[:, :, 2] - flat.corners[:, :, 2].min()).max(axis=1) < 1e-9
    assert base.any()
    assert flat.normals[base][:, :, 2] == pytest.approx(-1.0), "the rim is an edge"


def test_triangles_without_an_area_and_single_ones_are_drawn() -> None:
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0, 0.1], [0.05, 0, 0]])
    picture = _pixels(png(vertices, np.array([[0, 1, 2], [0, 3, 1]]), None, width=64, height=48))
    assert picture.shape == (48, 64, 3)
    assert np.ptp(picture) > 50


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_gripper_is_seen_at_its_grasp(name: str) -> None:
    box = _box((0.02, 0.015, 0.05))
    vertices, places = np.unique(box.points, axis=0, return_inverse=True)
    shape = shape_of(PRESETS[name].profile)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 0.04
    held = Held(shape, pose, min(0.03, shape.max_opening_m))
    picture = _pixels(png(vertices, places.reshape(-1, 3), held, width=160, height=120))
    orange = (picture[..., 0] > 1.6 * picture[..., 2]) & (picture[..., 0] > 90)
    assert orange.sum() > 150
    columns = np.flatnonzero(orange.any(axis=0))
    assert np.diff(columns).max() > 1, "two fingers, with the object between"
