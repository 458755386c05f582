"""Collision with a mesh's own triangles: against linear programming, the convex parts, and inside tests."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from graspdb.examples import EXAMPLES, example
from graspdb_geometry import collision, grids
from graspdb_geometry._compiled import surface as compiled
from graspdb_geometry._compiled import tree
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70


def triangle_depth(corners: np.ndarray, box: np.ndarray) -> float:
    """How far inside the box (half-spaces n.x + d <= 0) the triangle reaches; negative outside."""
    # Unknowns: three barycentric weights and the margin, to be maximised.
    matrix = np.column_stack([box[:, :3] @ corners.T, np.ones(len(box))])
    answer = linprog(
        [0, 0, 0, -1],
        A_ub=matrix,
        b_ub=-box[:, 3],
        A_eq=[[1, 1, 1, 0]],
        b_eq=[1],
        bounds=[(0, None)] * 3 + [(None, None)],
    )
    assert answer.status == 0, answer.message
    return float(answer.x[3])


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_loose_triangles_agree_with_linear_programming(seed: int, oracle: Any, random_poses: Any) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 12))
    corners = rng.uniform(-0.1, 0.1, size=(count, 1, 3)) + rng.normal(size=(count, 3, 3)) * 0.03
    surface = collision.Surface(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), watertight=False)
    positions, quaternions = random_poses(rng, 4, 0.15)
    hits = surface.collides(ToolPoses(positions, quaternions), PG70)
    half_extents, centres = PG70.boxes()
    for p, q, hit in zip(positions, quaternions, hits, strict=True):
        rotation = Rotation.from_quat(q).as_matrix()
        deepest = max(
            triangle_depth(t, oracle.box(c, h, p, rotation))
            for t in corners
            for c, h in zip(centres, half_extents, strict=True)
        )
        if abs(deepest) > 1e-6:
            assert hit == (deepest > 0)


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_closed_surface_collides_like_its_convex_parts(name: str) -> None:
    thing = example(name)
    vertices, faces = thing.triangles
    surface = collision.Surface(vertices, faces, watertight=True)
    scene = collision.Scene(thing.parts)
    grid = grids.PoseGrid(*(tuple(b) for b in thing.bounds), max_poses=20_000, seed=2)
    positions, quaternions = grid.poses(grid.pose_indices(0, grid.total))
    for opening in (None, 0.02):
        by_surface = surface.collides(ToolPoses(positions, quaternions), PG70, opening, threads=2)
        assert np.array_equal(by_surface, scene.collides(ToolPoses(positions, quaternions), PG70, opening))
        assert 0 < by_surface.sum() < len(positions)


def test_a_gripper_wholly_inside_collides_with_solids_only() -> None:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)]
    pose = [[0.1, 0.2, 0.3]], [[0.0, 0.0, 0.0, 1.0]]
    assert collision.Surface(corners, faces, watertight=True).collides(ToolPoses(*pose), PG70).all()
    assert not collision.Surface(corners, faces, watertight=False).collides(ToolPoses(*pose), PG70).any()


def _box(half: float, *, without: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A cube's corners and triangles, some of which are missing."""
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return corners, np.array([[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)])[without:]


def test_parts_tell_what_is_inside_of_an_open_mesh() -> None:
    corners, faces = _box(1.0, without=2)
    inside, crossing, outside = [0.1, 0.2, 0.3], [0.1, 0.2, -0.98], [0.1, 0.2, 1.5]
    poses = ToolPoses([inside, crossing, outside], [[0.0, 0.0, 0.0, 1.0]] * 3)
    parts = collision.Scene([(corners, [])])

    def hits(**options: Any) -> list[bool]:
        return collision.Surface(corners, faces, watertight=False, **options).collides(poses, PG70).tolist()

    assert hits() == [False, True, False]
    assert hits(inside=parts, inside_off_m=0.001) == [True, True, False]
    # Parts so far off may fill a room: nothing is known, and what is not known does not collide.
    assert hits(inside=parts, inside_off_m=0.1) == [False, True, False]
    far = collision.Surface(corners, faces, watertight=False, inside=parts)
    assert far.nbytes > collision.Surface(corners, faces, watertight=False).nbytes > 0


def test_a_cup_of_one_sheet_stays_open_though_its_parts_fill_it() -> None:
    side = trimesh.creation.cylinder(radius=0.04, height=0.1, sections=64)
    sheet = side.submesh([np.flatnonzero(side.face_normals[:, 2] < 0.5)], append=True)
    filled = collision.Scene([(side.vertices, [])])
    # Straight down onto the rim, one finger in the cup.
    pose = ToolPoses(
        [[0.04, 0.0, 0.05]], Rotation.from_matrix([[[0, 1, 0], [1, 0, 0], [0, 0, -1]]]).as_quat()
    )
    assert filled.collides(pose, PG70).all()
    cup = collision.Surface(sheet.vertices, sheet.faces, watertight=False, inside=filled, inside_off_m=0.04)
    assert not cup.collides(pose, PG70).any()
    assert cup.holds(pose, PG70).all()


@pytest.mark.parametrize("count", [1, 2, 3, 5, 64, 1_001])
@pytest.mark.parametrize("alike", [False, True])
def test_every_triangle_stands_once_in_a_leaf_whose_boxes_hold_it(count: int, alike: bool) -> None:
    rng = np.random.default_rng(count)
    corners = rng.normal(size=(count, 3, 3))
    corners[:, :, 1] = np.round(corners[:, :, 1])
    if alike:
        corners[:] = corners[0]
    nodes, links, order = tree.build(corners, 4)
    assert np.array_equal(np.sort(order), np.arange(count))
    seen = np.zeros(count, dtype=int)
    pending = [(0, np.full(3, -np.inf), np.full(3, np.inf))]
    while pending:
        number, low, high = pending.pop()
        low = np.maximum(low, nodes[number, 0] - nodes[number, 1])
        high = np.minimum(high, nodes[number, 0] + nodes[number, 1])
        first, second = links[number]
        if first >= 0:
            pending += [(int(first), low, high), (int(second), low, high)]
            continue
        assert 0 < second - (-1 - first) <= 4
        seen[-1 - first : second] += 1
        held = corners[order[-1 - first : second]]
        assert np.all(held >= low - 1e-12)
        assert np.all(held <= high + 1e-12)
    assert np.all(seen == 1)


@pytest.mark.parametrize("name", EXAMPLES)
def test_rays_and_winding_numbers_agree_on_what_is_inside(name: str) -> None:
    thing = example(name)
    vertices, faces = thing.triangles
    tree = collision.Surface(vertices, faces, watertight=True)._tree
    low, high = thing.bounds
    points = np.random.default_rng(8).uniform(low - 0.01, high + 0.01, size=(3000, 3))
    # Straight below vertices along the ray, where a careless crossing count goes wrong.
    distances = np.random.default_rng(9).uniform(0.0005, 0.05, size=(len(vertices), 1))
    points = np.concatenate([points, vertices - distances * compiled._RAY[2]])
    stack = np.empty(128, dtype=np.int64)
    winding = np.array([compiled.winding_number(x, vertices[faces]) for x in points])
    inside = np.array([compiled.inside(x, tree, stack) for x in points])
    clear = np.abs(winding - np.round(winding)) < 1e-6
    assert clear.mean() > 0.99
    assert np.array_equal(inside[clear], winding[clear] > 0.5)
    assert 0 < inside.sum() < len(points)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], "vertices"),
        (np.full((3, 3), np.inf), [[0, 1, 2]], "finite"),
        (np.zeros((3, 3)), np.zeros((0, 3), dtype=int), "at least one"),
        (np.zeros((3, 3)), [[0, 1, 3]], "existing"),
        (np.zeros((3, 3)), [[0, 1, -1]], "existing"),
    ],
)
def test_bad_surfaces_are_refused(vertices: Any, faces: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        collision.Surface(vertices, faces, watertight=True)
