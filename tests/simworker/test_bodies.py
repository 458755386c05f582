"""Mass properties of convex parts against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graspdb.examples import EXAMPLES, example
from graspdb_simworker.simulation.bodies import Part, inverse, mass_properties

FACES = np.array(
    [
        [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
        [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5],
    ]
)  # fmt: skip
SIZE = np.array([0.02, 0.05, 0.11])


def box(size: np.ndarray, centre: np.ndarray, turn: np.ndarray | None = None) -> Part:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    return (corners if turn is None else corners @ turn.T) + centre, FACES


def test_a_turned_box_has_its_textbook_inertia() -> None:
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    centre = np.array([0.4, -0.2, 0.1])
    mass = mass_properties([box(SIZE, centre, turn)], 0.6)
    x, y, z = SIZE**2
    np.testing.assert_allclose(mass.centre, centre, atol=1e-12)
    np.testing.assert_allclose(
        sorted(mass.inertia), sorted(0.6 / 12.0 * np.array([y + z, x + z, x + y])), rtol=1e-9
    )
    # The principal axes are the box's, in some order and direction.
    axes = Rotation.from_quat(mass.principal_xyzw).as_matrix()
    np.testing.assert_allclose(np.sort(np.abs(turn.T @ axes), axis=0)[-1], 1.0, atol=1e-9)


def test_cutting_a_box_in_two_changes_nothing_and_winding_does_not_matter() -> None:
    whole = mass_properties([box(SIZE, np.zeros(3))], 0.6)
    half = SIZE * np.array([1.0, 0.5, 1.0])
    shift = np.array([0.0, SIZE[1] / 4.0, 0.0])
    vertices, faces = box(half, shift)
    cut = mass_properties([box(half, -shift), (vertices, faces[:, ::-1])], 0.6)
    np.testing.assert_allclose(cut.centre, whole.centre, atol=1e-15)
    np.testing.assert_allclose(cut.inertia, whole.inertia, rtol=1e-12)


def test_points_go_to_the_principal_frame() -> None:
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    vertices, faces = box(SIZE, np.array([0.4, -0.2, 0.1]), turn)
    mass = mass_properties([(vertices, faces)], 0.6)
    expected = Rotation.from_quat(inverse(mass.principal_xyzw)).apply(vertices - np.array(mass.centre))
    np.testing.assert_allclose(mass.to_principal(vertices), expected, atol=1e-12)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_have_sensible_inertia(name: str) -> None:
    thing = example(name)
    mass = mass_properties(thing.parts, thing.mass_kg)
    assert mass.mass_kg == thing.mass_kg
    x, y, z = mass.inertia
    assert 0.0 < x <= y <= z <= x + y * (1.0 + 1e-9)


@pytest.mark.parametrize("mass_kg", [0.0, -1.0, float("nan"), float("inf")])
def test_a_mass_must_be_positive_and_finite(mass_kg: float) -> None:
    with pytest.raises(ValueError, match="mass"):
        mass_properties([box(SIZE, np.zeros(3))], mass_kg)


def test_parts_without_volume_are_refused() -> None:
    flat = box(SIZE * np.array([1.0, 1.0, 0.0]), np.zeros(3))
    with pytest.raises(ValueError, match="volume"):
        mass_properties([flat], 0.1)
