"""From a closing to its label."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graspdb.wire import OUTCOME_CODES
from graspdb_simworker.simulation.bodies import Closing, Contacts, End, Gripper, closing_force
from graspdb_simworker.simulation.force_test import GRAVITY_M_S2, rating
from graspdb_simworker.simulation.labels import Outcome, label_of


def jaw(mass_kg: float) -> Gripper:
    return Gripper(
        *(0.07, 0.02, 0.015, 0.07, 0.023, (0.08, 0.112, 0.092)),
        finger_mass_kg=0.1,
        max_speed_m_s=0.06,
        force_n=40.0,
        closing_force_n=closing_force(40.0, mass_kg),
    )


def closing(end: End, *forces: float, mass_kg: float = 0.1, touched: bool = True) -> Closing:
    normals = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    contacts = [
        Contacts(normals, np.full(2, force), np.array([0, 1]), np.zeros(2)) for force in forces or (10.0,)
    ]
    ratings = tuple(rating(now, jaw(mass_kg), mass_kg, 0.4) for now in contacts)
    pose = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    return Closing(end, touched, 0.02, tuple(contacts), *pose, steps=9, ratings=ratings)


@pytest.mark.parametrize(
    ("end", "touched", "outcome"),
    [
        (End.EMPTY, False, Outcome.MISSED),
        (End.EMPTY, True, Outcome.SLIPPED),
        (End.TIMEOUT, True, Outcome.TIMEOUT),
        (End.UNSTABLE, True, Outcome.SIMULATION_ERROR),
        (End.STALLED, True, Outcome.SUCCESS),
    ],
)
def test_every_end_has_its_outcome(end: End, touched: bool, outcome: Outcome) -> None:
    assert label_of(closing(end, touched=touched)).outcome is outcome


def test_light_objects_are_closed_on_gently_and_rated_at_full_force() -> None:
    assert (closing_force(40.0, 0.29), closing_force(40.0, 0.3), closing_force(5.0, 0.1)) == (10.0, 40.0, 5.0)
    # What is lighter still, or held by an enormous force, is not thrown about either.
    assert (closing_force(40.0, 0.002), closing_force(10_000.0, 0.5)) == (2.0, 500.0)
    hold = 2.0 * 0.4 * 40.0 * math.cos(math.atan(0.4))
    for mass, measured in ((0.1, 10.0), (0.5, 40.0)):
        label = label_of(closing(End.STALLED, measured, mass_kg=mass))
        assert label.quality == pytest.approx(hold / (mass * GRAVITY_M_S2), rel=1e-6)
    # Heavier than the contacts hold.
    heavy = label_of(closing(End.STALLED, 40.0, mass_kg=3.1))
    assert heavy.outcome is Outcome.WRENCH_INSUFFICIENT
    assert heavy.quality == pytest.approx(hold / (3.1 * GRAVITY_M_S2), rel=1e-6)


def test_codes_are_those_of_the_wire() -> None:
    assert {outcome.name.lower(): outcome.value for outcome in Outcome} == OUTCOME_CODES


def test_of_several_readings_the_median_counts() -> None:
    ringing = label_of(closing(End.STALLED, 1.0, 40.0, 30.0, mass_kg=0.5))
    assert ringing.quality == label_of(closing(End.STALLED, 30.0, mass_kg=0.5)).quality
