"""The force test against linear programming, closed forms and its symmetries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from graspdb_simworker.simulation.force_test import weakest_force

FLOAT = NDArray[np.float64]


def reach(normals: FLOAT, forces: FLOAT, friction: float, direction: FLOAT, edges: int = 64) -> float:
    """Largest s with s * direction in the sum of capped cones, each cone replaced by a pyramid around it.

    Variables: s, and the force along every pyramid edge; the normal parts of a contact's edges sum to
    at most its force.
    """
    columns, caps = [], []
    # Circumscribed: the pyramid's inscribed circle is the cone's, so the answer is a little above the
    # exact one.
    wide = friction / math.cos(math.pi / edges)
    for contact, normal in enumerate(normals):
        first = np.linalg.svd(normal[None])[2][1]
        second = np.cross(normal, first)
        for k in range(edges):
            angle = 2.0 * math.pi * k / edges
            columns.append(normal + wide * (math.cos(angle) * first + math.sin(angle) * second))
            caps.append(contact)
    upper = np.zeros((len(normals), 1 + len(columns)))
    for column, contact in enumerate(caps):
        upper[contact, 1 + column] = 1.0
    answer = linprog(
        np.r_[-1.0, np.zeros(len(columns))],
        A_ub=upper,
        b_ub=forces,
        A_eq=np.column_stack([-direction, np.array(columns).T]),
        b_eq=np.zeros(3),
        bounds=(0, None),
    )
    assert answer.status == 0
    return float(answer.x[0])


def contacts(rng: np.random.Generator, kind: int) -> tuple[FLOAT, FLOAT, float]:
    count = int(rng.integers(2, 9))
    if kind == 0:
        normals = rng.normal(size=(count, 3))
    else:
        # Two fingers: nearly flat on both sides, or one of them on an edge.
        normals = np.resize([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], (count, 3))
        normals = normals + rng.normal(size=(count, 3)) * (0.02 if kind == 1 else 0.4)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, rng.uniform(0.5, 40.0, count), float(rng.uniform(0.1, 1.2))


@pytest.mark.parametrize("seed", range(24))
def test_agrees_with_linear_programming(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normals, forces, friction = contacts(rng, seed % 3)
    force, direction = weakest_force(normals, forces, friction)
    slack = 2e-3 * forces.sum()
    # At the weakest direction the ball touches the set of forces: the reach there is the force itself.
    assert reach(normals, forces, friction, direction) == pytest.approx(force, abs=slack)
    # And nowhere is it shorter.
    others = rng.normal(size=(25, 3))
    others = np.vstack([others / np.linalg.norm(others, axis=1, keepdims=True), normals, -normals])
    assert min(reach(normals, forces, friction, d) for d in others) >= force - slack


@pytest.mark.parametrize("seed", range(60))
def test_is_the_global_minimum_of_the_support_function(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    normals, forces, friction = contacts(rng, seed % 3)
    force, direction = weakest_force(normals, forces, friction)
    sphere = rng.normal(size=(40_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)

    def support(d: FLOAT) -> FLOAT:
        along = d @ normals.T
        across = np.sqrt(np.maximum(0.0, 1.0 - along**2))
        return np.asarray((forces * np.maximum(0.0, along + friction * across)).sum(axis=1))

    assert np.linalg.norm(direction) == pytest.approx(1.0)
    assert support(direction[None])[0] == pytest.approx(force, rel=1e-9, abs=1e-9)
    assert support(sphere).min() >= force - 1e-6 * forces.sum()


@given(
    st.floats(0.05, 2.0),
    st.floats(0.1, 100.0),
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
)
@settings(max_examples=60, deadline=None)
def test_two_opposite_contacts_in_closed_form(
    friction: float, force: float, axis: tuple[float, float, float]
) -> None:
    normal = np.array(axis) / np.linalg.norm(axis)
    found, _ = weakest_force(np.array([normal, -normal]), np.array([force, force]), friction)
    # Lowest where one contact stops pushing, at the angle atan(mu) from the plane of the contacts, or
    # along the normal.
    phi = math.atan(friction)
    assert found == pytest.approx(min(2.0 * friction * force * math.cos(phi), force), rel=1e-6)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_does_not_depend_on_the_frame_and_scales_with_the_forces(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normals, forces, friction = contacts(rng, seed % 3)
    force, _ = weakest_force(normals, forces, friction)
    turn = Rotation.random(rng=rng).as_matrix()
    turned, _ = weakest_force(normals @ turn.T, forces, friction)
    # The search may miss the very lowest valley, by a share of the forces that no simulation resolves.
    scale = 1e-3 * forces.sum()
    assert turned == pytest.approx(force, abs=scale)
    assert weakest_force(normals, 4.0 * forces, friction)[0] == pytest.approx(4.0 * force, abs=4.0 * scale)
    # More friction or one more contact never hurts.
    assert weakest_force(normals, forces, friction * 1.5)[0] >= force - scale
    assert (
        weakest_force(np.vstack([normals, normals[:1] + 0.0]), np.r_[forces, 3.0], friction)[0]
        >= force - scale
    )


def test_one_contact_and_none_hold_nothing() -> None:
    assert weakest_force(np.empty((0, 3)), np.empty(0), 0.4)[0] == 0.0
    assert weakest_force(np.array([[0.0, 1.0, 0.0]]), np.array([40.0]), 0.4)[0] == pytest.approx(
        0.0, abs=1e-9
    )
